"""What a plan is to be like: the options of `plan`, checked before any work."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.option_fields import (
    SI_PER_OPTION_UNIT,
    check_seed,
    option_field_in_group,
    parse_low_high_range,
    parse_millimetre_triple_to_metres,
)
from minimax_cal.planning.pose_information import PlanningNoise
from minimax_cal.planning.pose_visibility import NORMAL_DIRECTIONS
from minimax_cal.planning.result import CRITERION_MEANINGS, SEPARATION_CRITERION
from minimax_cal.robots.robot import Robot

APPROACH_CHOICES = ("none", "both")  # what is done about the side a pose is approached from
JOINT_LIMIT_PATTERN = re.compile(r"[Jj]?(\d+)=(.+)")
DEFAULT_PLANNING_NOISE = PlanningNoise()
MAX_PLANNED_POSES, MAX_CANDIDATE_POSES, MAX_PLANNED_TARGETS = 1000, 50_000, 20


def parse_box_corners(text: str) -> tuple[tuple[float, ...], ...]:
    """LOW:HIGH of x, y and z in millimetres, as corners in metres.  Raises OptionError."""
    axes = text.split(",")
    if len(axes) != 3:
        raise OptionError(f"volume={text!r}: give x, y and z, as 700:1700,-500:500,300:1300")
    limits = [parse_low_high_range(axis, "volume", 1e-3) for axis in axes]
    return tuple(low for low, _ in limits), tuple(high for _, high in limits)


purpose_option, visibility_option = (
    option_field_in_group("What the poses are for"),
    option_field_in_group("What the instrument sees"),
)
arm_limit_option, noise_option = (
    option_field_in_group("What the arm may do"),
    option_field_in_group("How exact things are"),
)
visit_option, search_option = option_field_in_group("Visits"), option_field_in_group("The search")


@dataclass(frozen=True)
class PlanOptions:
    """What a plan is to be like.

    criterion: D, A, E, G or I.  candidates: how many poses to choose from.
    seed: of all that is random.
    tracker: (3,) in base axes [m], 3 m before the arm unless given.
    targets: number on a circle of 100 mm.  spots: (k, 3) in the flange instead [m].
    normals: where reflectors look, of `visibility.NORMAL_DIRECTIONS`.
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

    criterion: str = purpose_option(
        "I",
        "What is minimised: "
        + "; ".join(
            f"{name}, {said}"
            for name, said in CRITERION_MEANINGS.items()
            if name != SEPARATION_CRITERION
        )
        + ".",
    )
    effects: Sequence[str] = purpose_option(
        (),
        "Effects that the calibration will fit too; they are unknown until then.",
        metavar="NAME:PLACE",
        many=tuple,
    )
    separate: Sequence[str] = purpose_option(
        (),
        "Choose poses that distinguish two effects, as joint_compliance:J2 link_bending:L2.",
        metavar="EFFECT EFFECT",
        values=2,
    )
    tracker: Sequence[float] = visibility_option(
        (),
        "Where the tracker stands, in base axes, mm [default: 3 m before the arm].",
        metavar="X,Y,Z",
        read=partial(parse_millimetre_triple_to_metres, name="tracker"),
    )
    targets: int = visibility_option(
        3, "The number of reflectors on a circle of 100 mm radius about the flange's axis."
    )
    spots: Sequence[Sequence[float]] = visibility_option(
        (),
        "The place of a reflector in the flange's frame, mm; given once for each.",
        flag="--target",
        metavar="X,Y,Z",
        read=partial(parse_millimetre_triple_to_metres, name="spots"),
        many=tuple,
    )
    normals: str = visibility_option(
        "flange", f"Where the reflectors look: {' or '.join(NORMAL_DIRECTIONS)}."
    )
    acceptance: float = visibility_option(
        np.radians(30.0), "The half angle of a reflector's cone; 180 is seen from anywhere.", "deg"
    )
    whole: bool = visibility_option(
        False, "Take only poses at which all reflectors are seen.", flag="--all-targets"
    )
    reach: tuple[float, float] = visibility_option(
        (0.5, 50.0), "From how near to how far the tracker measures, m.", "m", flag="--range"
    )
    elevation: tuple[float, float] = visibility_option(
        (np.radians(-50.0), np.radians(75.0)), "How far down and up the tracker looks, deg.", "deg"
    )
    joints: Mapping[int, tuple[float, float]] = arm_limit_option(
        dict,
        "Narrow a joint's limits, deg (slides: mm).",
        flag="--joint",
        metavar="J2=LOW:HIGH",
        read=str,  # their unit depends on the robot: see `parse_joint_limits`
        many=tuple,
    )
    volume: Sequence[Sequence[float]] = arm_limit_option(
        (),
        "The box in base axes that the flange must stay in, mm.",
        metavar="X0:X1,Y0:Y1,Z0:Z1",
        read=parse_box_corners,
    )
    floor: float = arm_limit_option(0.0, "The height of the floor above the base's origin.", "mm")
    body: float | None = arm_limit_option(
        None, "The radius of the arm's links [default: 4 % of its reach].", "mm"
    )
    noise: float | None = noise_option(
        None,
        (
            f"The noise of a coordinate [default: as the data show it, "
            f"else {1e6 * DEFAULT_PLANNING_NOISE.noise:g}]."
        ),
        "um",
    )
    per_metre: float | None = noise_option(
        None,
        f"How that noise grows with range [default: {1e6 * DEFAULT_PLANNING_NOISE.per_metre:g}].",
        "um/m",
        flag="--noise-per-metre",
    )
    jitter: float | None = noise_option(
        None,
        "How far a joint stops from where it should [default: as the data show it, else "
        f"{1e6 * DEFAULT_PLANNING_NOISE.jitter:g}].",
        "urad",
    )
    revisit: int = visit_option(0, "Go back to so many of the poses.", metavar="K")
    approach: str = visit_option(
        "none", f"From which side to come to a revisited pose: {' or '.join(APPROACH_CHOICES)}."
    )
    candidates: int = search_option(2000, "The number of poses to choose among.")
    seed: int = search_option(0, "The seed of candidates and starts.")


def parse_joint_limits(limit_texts: Sequence[str], robot: Robot) -> dict[int, tuple[float, float]]:
    """Limits by joint index, from texts as J2=-30:60.  Raises OptionError."""
    found: dict[int, tuple[float, float]] = {}
    for text in limit_texts:
        index, limits = parse_joint_index_and_limits(text, robot)
        if index in found:
            raise OptionError(f"joints={text!r}: joint {index + 1} is given twice; give it once")
        found[index] = limits
    return found


def parse_joint_index_and_limits(limit_text: str, robot: Robot) -> tuple[int, tuple[float, float]]:
    """J2=LOW:HIGH in degrees, slides in millimetres.  Raises OptionError."""
    match = JOINT_LIMIT_PATTERN.fullmatch(limit_text)
    if not match:
        raise OptionError(f"joints={limit_text!r}: write J2=-30:60, in degrees (slides: mm)")
    index = int(match[1]) - 1
    if not 0 <= index < robot.joints:
        raise OptionError(f"joints={limit_text!r}: {robot.name} has joints 1 to {robot.joints}")
    scale = 1e-3 if robot.prismatic[index] else SI_PER_OPTION_UNIT["deg"]
    return index, parse_low_high_range(match[2], "joints", scale)


def check_plan_options(options: PlanOptions, pose_count: int, robot: Robot) -> None:
    """Raise OptionError for options that make no sense."""
    criteria = [name for name in CRITERION_MEANINGS if name != SEPARATION_CRITERION]
    if options.criterion not in criteria:
        raise OptionError(f"no criterion {options.criterion!r}; choose {', '.join(criteria)}")
    if not 1 <= pose_count <= MAX_PLANNED_POSES:
        raise OptionError(f"poses={pose_count}: give 1 to {MAX_PLANNED_POSES}")
    if not pose_count <= options.candidates <= MAX_CANDIDATE_POSES:
        raise OptionError(
            f"candidates={options.candidates}: give at least as many as poses, at most "
            f"{MAX_CANDIDATE_POSES}"
        )
    check_seed(options.seed)
    if not 0 <= options.revisit <= pose_count:
        raise OptionError(f"revisit={options.revisit}: give 0 to {pose_count}, the number of poses")
    if options.approach not in APPROACH_CHOICES:
        raise OptionError(f"approach={options.approach!r}: choose {' or '.join(APPROACH_CHOICES)}")
    if options.approach == "both" and not options.revisit:
        raise OptionError("approach='both' is about revisits: give their number as revisit=")
    if not 1 <= options.targets <= MAX_PLANNED_TARGETS:
        raise OptionError(f"targets={options.targets}: give 1 to {MAX_PLANNED_TARGETS}")
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


def plan_settings_record(options: PlanOptions, pose_count: int) -> dict[str, object]:
    """The options for the record."""
    joints = {str(joint): limits for joint, limits in options.joints.items()}
    return {"poses": pose_count, **convert_to_plain_json({**vars(options), "joints": joints})}
