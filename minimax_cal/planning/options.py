"""What a plan is to be like: the options of `plan`, checked before any work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import plain
from minimax_cal.robots.robot import Robot

EFFORTS = ("none", "both")  # what is done about the side a pose is approached from
MOST_POSES, MOST_CANDIDATES, MOST_TARGETS = 1000, 50_000, 20


@dataclass(frozen=True)
class PlanOptions:
    """What a plan is to be like.

    criterion: of `planning.CRITERIA`.  candidates: how many to draw.  seed: of all that is random.
    tracker: (3,) in base axes [m], empty for 3 m before the arm.  targets: number on a circle of
    100 mm; spots: (k, 3) instead [m].  normals: of `visibility.NORMALS`.  acceptance: [rad].
    reach, elevation: limits of the instrument [m, rad].  joints: limits by joint index that
    narrow the robot's.  volume: (2, 3) box for the flange [m], empty for none.  floor: its height
    [m].  body: radius of the arm [m], None for a share of its reach.  whole: every target seen.
    noise, per_metre, jitter: as `Instrument`, None for what data show or its defaults.
    effects: to be fitted along with the geometry, beside those of a fit, as joint_compliance:all.
    separate: two effects that the poses are to tell apart, or none.
    approach: both for revisits from the other side.  revisit: how many.
    """

    criterion: str = "I"
    candidates: int = 2000
    seed: int = 0
    tracker: Sequence[float] = ()
    targets: int = 3
    spots: Sequence[Sequence[float]] = ()
    normals: str = "flange"
    acceptance: float = np.radians(30.0)
    reach: tuple[float, float] = (0.5, 50.0)
    elevation: tuple[float, float] = (np.radians(-50.0), np.radians(75.0))
    joints: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    volume: Sequence[Sequence[float]] = ()
    floor: float = 0.0
    body: float | None = None
    whole: bool = False
    noise: float | None = None
    per_metre: float | None = None
    jitter: float | None = None
    effects: Sequence[str] = ()
    separate: Sequence[str] = ()
    approach: str = "none"
    revisit: int = 0


def check_options(options: PlanOptions, poses: int, robot: Robot) -> None:
    """Raise OptionError for options that make no sense."""
    if not 1 <= poses <= MOST_POSES:
        raise OptionError(f"--poses {poses}: give 1 to {MOST_POSES}")
    if not poses <= options.candidates <= MOST_CANDIDATES:
        raise OptionError(
            f"--candidates {options.candidates}: give at least as many as poses, at most "
            f"{MOST_CANDIDATES}"
        )
    if options.seed < 0:
        raise OptionError(f"seed {options.seed}: give a whole number, 0 or more")
    if not 0 <= options.revisit <= poses:
        raise OptionError(f"--revisit {options.revisit}: give 0 to {poses}, the number of poses")
    if options.approach not in EFFORTS:
        raise OptionError(f"--approach {options.approach!r}: choose {' or '.join(EFFORTS)}")
    if options.approach == "both" and not options.revisit:
        raise OptionError("--approach both is about revisits: give their number with --revisit")
    if not 1 <= options.targets <= MOST_TARGETS:
        raise OptionError(f"--targets {options.targets}: give 1 to {MOST_TARGETS}")
    if not options.acceptance > 0.0:
        raise OptionError(
            "--acceptance: give an angle above 0, 180 for a target seen from anywhere"
        )
    for name, (low, high) in (("range", options.reach), ("elevation", options.elevation)):
        if not low < high:
            raise OptionError(f"--{name}: the limits are reversed; give low:high")
    for low, high in zip(*options.volume, strict=True) if len(options.volume) else ():
        if not low < high:
            raise OptionError("--volume: the limits of an axis are reversed; give low:high")
    for name in ("noise", "per_metre", "jitter", "body"):
        value = getattr(options, name)
        if value is not None and not 0.0 <= value < np.inf:
            raise OptionError(f"{name} {value:g} must be a finite number, 0 or more")
    strange = [joint for joint in options.joints if not 0 <= joint < robot.joints]
    if strange:
        raise OptionError(f"--joint: {robot.name} has no joint {strange[0] + 1}")
    if len(options.separate) not in (0, 2):
        raise OptionError("--separate: name two effects, as joint_compliance:J2 link_bending:L2")


def settings_of(options: PlanOptions, poses: int) -> dict[str, object]:
    """The options for the record."""
    joints = {str(joint): limits for joint, limits in options.joints.items()}
    return {"poses": poses, **plain({**vars(options), "joints": joints})}
