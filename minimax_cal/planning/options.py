"""What a plan is to be like: the options of `plan`, checked before any work."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import plain
from minimax_cal.ground.options import SI, check_seed, grouped, pair, triple
from minimax_cal.planning.prospect import Instrument
from minimax_cal.planning.result import MEANINGS, POWER
from minimax_cal.planning.visibility import NORMALS
from minimax_cal.robots.robot import Robot

EFFORTS = ("none", "both")  # what is done about the side a pose is approached from
JOINT = re.compile(r"[Jj]?(\d+)=(.+)")
USUAL = Instrument()
MOST_POSES, MOST_CANDIDATES, MOST_TARGETS = 1000, 50_000, 20


def box(text: str) -> tuple[tuple[float, ...], ...]:
    """LOW:HIGH of x, y and z in millimetres, as corners in metres.  Raises OptionError."""
    axes = text.split(",")
    if len(axes) != 3:
        raise OptionError(f"volume={text!r}: give x, y and z, as 700:1700,-500:500,300:1300")
    limits = [pair(axis, "volume", 1e-3) for axis in axes]
    return tuple(low for low, _ in limits), tuple(high for _, high in limits)


aimed, seen = grouped("What the poses are for"), grouped("What the instrument sees")
allowed, exact = grouped("What the arm may do"), grouped("How exact things are")
visits, search = grouped("Visits"), grouped("The search")


@dataclass(frozen=True)
class PlanOptions:
    """What a plan is to be like.

    criterion: D, A, E, G or I.  candidates: how many poses to choose from.
    seed: of all that is random.
    tracker: (3,) in base axes [m], 3 m before the arm unless given.
    targets: number on a circle of 100 mm.  spots: (k, 3) in the flange instead [m].
    normals: where reflectors look, of `visibility.NORMALS`.
    acceptance: half angle of a reflector's cone [rad].  whole: every target seen at each pose.
    reach, elevation: limits of the instrument [m, rad].
    joints: limits by joint index that narrow the robot's [rad, m].
    volume: (2, 3) corners of a box for the flange in base axes [m].  floor: its height [m].
    body: radius of the arm [m], a share of its reach unless given.
    noise, per_metre: of a coordinate and its growth with range [m, -].
    jitter: of a joint [rad]; as the data show them, else typical ones, unless given.
    effects: fitted along with the geometry, beside those of a fit, as joint_compliance:all.
    separate: two effects that the poses are to tell apart instead.
    approach: both for revisits from the other side.  revisit: poses to go back to.
    """

    criterion: str = aimed(
        "I",
        "What is minimised: "
        + "; ".join(f"{name}, {said}" for name, said in MEANINGS.items() if name != POWER)
        + ".",
    )
    effects: Sequence[str] = aimed(
        (),
        "Effects that the calibration will fit too; they are unknown until then.",
        metavar="NAME:PLACE",
        many=tuple,
    )
    separate: Sequence[str] = aimed(
        (),
        "Choose poses that distinguish two effects, as joint_compliance:J2 link_bending:L2.",
        metavar="EFFECT EFFECT",
        values=2,
    )
    tracker: Sequence[float] = seen(
        (),
        "Where the tracker stands, in base axes, mm [default: 3 m before the arm].",
        metavar="X,Y,Z",
        read=partial(triple, name="tracker"),
    )
    targets: int = seen(
        3, "The number of reflectors on a circle of 100 mm radius about the flange's axis."
    )
    spots: Sequence[Sequence[float]] = seen(
        (),
        "The place of a reflector in the flange's frame, mm; given once for each.",
        flag="--target",
        metavar="X,Y,Z",
        read=partial(triple, name="spots"),
        many=tuple,
    )
    normals: str = seen("flange", f"Where the reflectors look: {' or '.join(NORMALS)}.")
    acceptance: float = seen(
        np.radians(30.0), "The half angle of a reflector's cone; 180 is seen from anywhere.", "deg"
    )
    whole: bool = seen(
        False, "Take only poses at which all reflectors are seen.", flag="--all-targets"
    )
    reach: tuple[float, float] = seen(
        (0.5, 50.0), "From how near to how far the tracker measures, m.", "m", flag="--range"
    )
    elevation: tuple[float, float] = seen(
        (np.radians(-50.0), np.radians(75.0)), "How far down and up the tracker looks, deg.", "deg"
    )
    joints: Mapping[int, tuple[float, float]] = allowed(
        dict,
        "Narrow a joint's limits, deg (slides: mm).",
        flag="--joint",
        metavar="J2=LOW:HIGH",
        read=str,  # their unit depends on the robot: see `limits_of`
        many=tuple,
    )
    volume: Sequence[Sequence[float]] = allowed(
        (),
        "The box in base axes that the flange must stay in, mm.",
        metavar="X0:X1,Y0:Y1,Z0:Z1",
        read=box,
    )
    floor: float = allowed(0.0, "The height of the floor above the base's origin.", "mm")
    body: float | None = allowed(
        None, "The radius of the arm's links [default: 4 % of its reach].", "mm"
    )
    noise: float | None = exact(
        None,
        f"The noise of a coordinate [default: as the data show it, else {1e6 * USUAL.noise:g}].",
        "um",
    )
    per_metre: float | None = exact(
        None,
        f"How that noise grows with range [default: {1e6 * USUAL.per_metre:g}].",
        "um/m",
        flag="--noise-per-metre",
    )
    jitter: float | None = exact(
        None,
        "How far a joint stops from where it should [default: as the data show it, else "
        f"{1e6 * USUAL.jitter:g}].",
        "urad",
    )
    revisit: int = visits(0, "Go back to so many of the poses.", metavar="K")
    approach: str = visits(
        "none", f"From which side to come to a revisited pose: {' or '.join(EFFORTS)}."
    )
    candidates: int = search(2000, "The number of poses to choose among.")
    seed: int = search(0, "The seed of candidates and starts.")


def limits_of(texts: Sequence[str], robot: Robot) -> dict[int, tuple[float, float]]:
    """Limits by joint index, from texts as J2=-30:60.  Raises OptionError."""
    found: dict[int, tuple[float, float]] = {}
    for text in texts:
        index, limits = joint(text, robot)
        if index in found:
            raise OptionError(f"joints={text!r}: joint {index + 1} is given twice; give it once")
        found[index] = limits
    return found


def joint(text: str, robot: Robot) -> tuple[int, tuple[float, float]]:
    """J2=LOW:HIGH in degrees, slides in millimetres.  Raises OptionError."""
    match = JOINT.fullmatch(text)
    if not match:
        raise OptionError(f"joints={text!r}: write J2=-30:60, in degrees (slides: mm)")
    index = int(match[1]) - 1
    if not 0 <= index < robot.joints:
        raise OptionError(f"joints={text!r}: {robot.name} has joints 1 to {robot.joints}")
    scale = 1e-3 if robot.prismatic[index] else SI["deg"]
    return index, pair(match[2], "joints", scale)


def check_options(options: PlanOptions, poses: int, robot: Robot) -> None:
    """Raise OptionError for options that make no sense."""
    criteria = [name for name in MEANINGS if name != POWER]
    if options.criterion not in criteria:
        raise OptionError(f"no criterion {options.criterion!r}; choose {', '.join(criteria)}")
    if not 1 <= poses <= MOST_POSES:
        raise OptionError(f"poses={poses}: give 1 to {MOST_POSES}")
    if not poses <= options.candidates <= MOST_CANDIDATES:
        raise OptionError(
            f"candidates={options.candidates}: give at least as many as poses, at most "
            f"{MOST_CANDIDATES}"
        )
    check_seed(options.seed)
    if not 0 <= options.revisit <= poses:
        raise OptionError(f"revisit={options.revisit}: give 0 to {poses}, the number of poses")
    if options.approach not in EFFORTS:
        raise OptionError(f"approach={options.approach!r}: choose {' or '.join(EFFORTS)}")
    if options.approach == "both" and not options.revisit:
        raise OptionError("approach='both' is about revisits: give their number as revisit=")
    if not 1 <= options.targets <= MOST_TARGETS:
        raise OptionError(f"targets={options.targets}: give 1 to {MOST_TARGETS}")
    if not options.acceptance > 0.0:
        raise OptionError("acceptance=: give an angle above 0, 180 for a target seen from anywhere")
    for name, (low, high) in (("reach", options.reach), ("elevation", options.elevation)):
        if not low < high:
            raise OptionError(f"{name}=: the limits are reversed; give low:high")
    for low, high in zip(*options.volume, strict=True) if len(options.volume) else ():
        if not low < high:
            raise OptionError("volume=: the limits of an axis are reversed; give low:high")
    for name in ("noise", "per_metre", "jitter", "body"):
        value = getattr(options, name)
        if value is not None and not 0.0 <= value < np.inf:
            raise OptionError(f"{name}={value:g} must be a finite number, 0 or more")
    strange = [joint for joint in options.joints if not 0 <= joint < robot.joints]
    if strange:
        raise OptionError(f"joints=: {robot.name} has no joint {strange[0] + 1}")
    if len(options.separate) not in (0, 2):
        raise OptionError("separate=: name two effects, as joint_compliance:J2 link_bending:L2")


def settings_of(options: PlanOptions, poses: int) -> dict[str, object]:
    """The options for the record."""
    joints = {str(joint): limits for joint, limits in options.joints.items()}
    return {"poses": poses, **plain({**vars(options), "joints": joints})}
