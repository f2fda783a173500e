"""Candidate poses: a quasi-random sequence within the limits, less what cannot be taken or seen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.record_fields import StoredSeparately, derived_field
from minimax_cal.core.tables import Table
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.planning.pose_visibility import (
    ARM_CONDITIONS,
    TARGET_CONDITIONS,
    ArmAtPoses,
    ArmWorkspace,
    PoseCondition,
    TrackerVisibility,
)
from minimax_cal.robots.joint_ranges import DEFAULT_SLIDE_RANGE, clip_range_near_zero
from minimax_cal.robots.robot import Robot

PoseConditions = Mapping[str, PoseCondition]
# kept free at a limit of the robot [rad, m], at most that share of the range: corrected targets and
# the arm that is not as drawn go beyond the pose that was planned
REVOLUTE_LIMIT_MARGIN, PRISMATIC_LIMIT_MARGIN, MAX_MARGIN_FRACTION_OF_RANGE = (
    np.radians(2.0),
    0.005,
    0.05,
)
POSES_DRAWN_AT_A_TIME = 2**13  # poses drawn at a time
MAX_DRAWS_WITHOUT_CANDIDATE, MAX_CANDIDATE_DRAWS = (
    2**16,
    2**19,
)  # poses drawn while none is good, and at most


@dataclass(frozen=True, eq=False)
class CandidatePoses:
    """q: (c, n) joint values as the controller gives them [rad, m].

    seen: (c, k) which targets the instrument sees.  tested: how many poses were drawn.
    rejected: share of those drawn that each condition alone would reject.
    drawn: how many of q, the first, are of the sequence; the others were looked for near some.
    """

    q: StoredSeparately[Array]
    seen: StoredSeparately[Array]
    tested: int
    rejected: Mapping[str, float]
    drawn: StoredSeparately[int]

    @derived_field()
    def count(self) -> int:
        """Of all."""
        return len(self.q)

    def rejection_table(self) -> Table:
        """What each condition rejects."""
        rows = ((name, 100.0 * share) for name, share in self.rejected.items())
        title = f"{self.drawn} candidates of {self.tested} poses drawn"
        if self.count > self.drawn:
            title += f", and {self.count - self.drawn} near the best ones"
        return Table.from_rows(title, rows, "condition | rejects alone % .1f")

    def with_candidates(self, q: Array, visible_targets: Array) -> CandidatePoses:
        """With further candidates."""
        both = np.concatenate([self.q, q]), np.concatenate([self.seen, visible_targets])
        return CandidatePoses(*both, self.tested, self.rejected, self.drawn)


class JointRanges(NamedTuple):
    """(n,) limits of the joints [rad, m], and notices on them."""

    lower: Array
    upper: Array
    notices: tuple[str, ...]


def find_joint_limits(
    robot: Robot,
    narrowed_limits: Mapping[int, tuple[float, float]],
    measurement_sets: Sequence[Measurements] = (),
) -> JointRanges:
    """(n,) lower and upper limits [rad, m], and a notice where the robot file has none.

    A joint turns at most once round, and keeps a margin to the robot's limits; one without limits
    goes as far as it went in the poses at hand. narrowed_limits: limits by joint index that cut
    these.  measurement_sets: poses at hand.  Raises OptionError.
    """
    most = np.where(robot.prismatic, DEFAULT_SLIDE_RANGE, np.pi)
    known = np.isfinite(robot.lower) & np.isfinite(robot.upper)
    named = np.isin(np.arange(robot.joints), list(narrowed_limits))
    at_hand = np.concatenate([np.zeros((0, robot.joints)), *(one.q for one in measurement_sets)])
    least, largest = at_hand.min(axis=0, initial=np.inf), at_hand.max(axis=0, initial=-np.inf)
    went = ~known & ~named & (least < largest)
    lower = np.where(np.isfinite(robot.lower), robot.lower, np.where(went, least, -most))
    upper = np.where(np.isfinite(robot.upper), robot.upper, np.where(went, largest, most))
    lower, upper = clip_range_near_zero(
        lower, upper, np.where(known & ~robot.prismatic, np.pi, np.inf)
    )
    margin = np.where(robot.prismatic, PRISMATIC_LIMIT_MARGIN, REVOLUTE_LIMIT_MARGIN)
    margin = np.minimum(margin, MAX_MARGIN_FRACTION_OF_RANGE * (upper - lower))
    lower = np.maximum(lower, robot.lower + margin)
    upper = np.minimum(upper, robot.upper - margin)
    for joint, (low, high) in narrowed_limits.items():
        lower[joint], upper[joint] = max(lower[joint], low), min(upper[joint], high)
        if not lower[joint] < upper[joint]:
            raise OptionError(
                f"joint {joint + 1}: no range is left within the limits of {robot.name}; "
                "give low:high, low below high, in deg (slides: mm)"
            )
    notices = []
    if went.any():
        notices.append(
            f"{robot.name} has no limits for some joints: they get the range of the existing poses "
            f"({', '.join(format_joint_ranges(robot, lower, upper, went))}"
            f"); set others with joints="
        )
    if (still := ~known & ~named & ~went).any():
        names = ", ".join(str(i + 1) for i in np.flatnonzero(still))
        notices.append(
            f"{robot.name} has no limits for joint {names}: +-180 deg are taken (slides +-500 mm); "
            "narrow them with joints="
        )
    return JointRanges(lower, upper, tuple(notices))


def format_joint_ranges(
    robot: Robot, lower: Array, upper: Array, is_selected: Array
) -> Iterator[str]:
    """Of some joints (n,) where they may go, as joints= takes it."""
    for i in np.flatnonzero(is_selected):
        factor, unit = (1e3, "mm") if robot.prismatic[i] else (180.0 / np.pi, "deg")
        yield f"J{i + 1}={factor * lower[i]:.0f}:{factor * upper[i]:.0f} {unit}"


def draw_collision_free_poses(workspace: ArmWorkspace, pose_count: int, seed: int) -> Array:
    """(count, n) poses anywhere that the arm can take, seen or not: where it may be put to work.

    The box does not count.  Raises OptionError where there are hardly any.
    """
    nowhere = TrackerVisibility(np.zeros(3), workspace.robot.up)
    conditions = {name: ARM_CONDITIONS[name] for name in ("floor", "self-collision")}
    return draw_poses_meeting_conditions(workspace, nowhere, pose_count, seed, conditions, {}).q


def draw_visible_candidates(
    workspace: ArmWorkspace, visibility: TrackerVisibility, pose_count: int, seed: int
) -> CandidatePoses:
    """Poses that the arm can take and the instrument sees: the first `pose_count` of a Sobol
    sequence.

    Fewer where they are rare.  Raises OptionError where there is none, with what rejects most.
    """
    return draw_poses_meeting_conditions(
        workspace, visibility, pose_count, seed, ARM_CONDITIONS, TARGET_CONDITIONS
    )


class DrawnPoses(NamedTuple):
    """Poses (m, n), and (m, k) the targets that are seen there."""

    q: Array
    visible_targets: Array


def draw_candidates_near_poses(
    workspace: ArmWorkspace,
    visibility: TrackerVisibility,
    q: Array,
    draws_per_pose: int,
    step_fraction: float,
    rng: np.random.Generator,
) -> DrawnPoses:
    """Poses around some (m, n) that can be taken and seen: their joints, and what is seen.

    draws_per_pose: how many are tried around one.  step_fraction: standard deviation, as a share of
    the joint's range; what goes beyond a limit stays at it.
    """
    spread = step_fraction * (workspace.upper - workspace.lower)
    around = np.repeat(q, draws_per_pose, axis=0)
    tried = np.clip(
        around + spread * rng.normal(size=around.shape), workspace.lower, workspace.upper
    )
    good, seen, _ = evaluate_pose_conditions(
        workspace, visibility, tried, ARM_CONDITIONS, TARGET_CONDITIONS
    )
    return DrawnPoses(tried[good], seen[good])


def draw_poses_meeting_conditions(
    workspace: ArmWorkspace,
    visibility: TrackerVisibility,
    pose_count: int,
    seed: int,
    arm_conditions: PoseConditions,
    target_conditions: PoseConditions,
) -> CandidatePoses:
    """Poses of the sequence that meet the conditions.  Raises OptionError where there is none."""
    sequence = scipy.stats.qmc.Sobol(
        len(workspace.lower), scramble=True, rng=np.random.default_rng(seed)
    )
    kept, tested, found = [], 0, 0
    total = dict.fromkeys((*arm_conditions, *target_conditions), 0)
    while found < pose_count and tested < (
        MAX_CANDIDATE_DRAWS if found else MAX_DRAWS_WITHOUT_CANDIDATE
    ):
        q = workspace.lower + (workspace.upper - workspace.lower) * sequence.random(
            POSES_DRAWN_AT_A_TIME
        )
        good, seen, against = evaluate_pose_conditions(
            workspace, visibility, q, arm_conditions, target_conditions
        )
        total = {name: number + against[name] for name, number in total.items()}
        tested += len(q)
        found += int(good.sum())
        kept.append((q[good], seen[good]))
    rejected = {name: number / tested for name, number in total.items()}
    if not found:
        raise OptionError(describe_lack_of_poses(workspace, tested, rejected))
    q, seen = (np.concatenate(part)[:pose_count] for part in zip(*kept, strict=True))
    return CandidatePoses(q, seen, tested, rejected, len(q))


class ConditionResults(NamedTuple):
    """(m,) the poses that meet all conditions, (m, k) the targets seen, and how many each
    rejects.
    """

    is_accepted: Array
    visible_targets: Array
    rejections_by_condition: dict[str, int]


def evaluate_pose_conditions(
    workspace: ArmWorkspace,
    visibility: TrackerVisibility,
    q: Array,
    arm_conditions: PoseConditions,
    target_conditions: PoseConditions,
) -> ConditionResults:
    """Which poses (m, n) meet all conditions (m,), the targets seen (m, k), and who rejects.

    A pose counts if one target is seen, or all of them where the room says so.
    """
    view, enough = (
        ArmAtPoses(workspace, visibility, q),
        np.all if workspace.all_targets_required else np.any,
    )
    good, seen = (
        np.ones(len(q), dtype=bool),
        np.ones((len(workspace.target_positions), len(q)), dtype=bool),
    )
    against = {}
    for name, holds in arm_conditions.items():
        meets = holds(view)
        against[name] = int((~meets).sum())
        good &= meets
    for name, sees in target_conditions.items():
        meets = sees(view)
        against[name] = int((~enough(meets, axis=0)).sum())
        seen &= meets
    good &= enough(seen, axis=0)
    return ConditionResults(good, seen.T, against)


REMEDY_BY_CONDITION = {
    "floor": "give floor= where it is lower",
    "volume": "make volume= larger",
    "self-collision": "give a thinner body as body=",
    "acceptance": "give another tracker=, normals= or a wider acceptance=",
    "range": "give another tracker= or reach=",
    "elevation": "give another tracker= or elevation=",
    "line of sight": "give another tracker= or a thinner body as body=",
}


def describe_main_rejection(rejected_fractions: Mapping[str, float]) -> str:
    """What rejects most poses, and what to do about it."""
    worst = max(rejected_fractions, key=lambda name: rejected_fractions[name])
    return (
        f"{worst} rejects most ({100.0 * rejected_fractions[worst]:.1f}"
        f" %): {REMEDY_BY_CONDITION[worst]}"
    )


def describe_lack_of_poses(
    workspace: ArmWorkspace, drawn_count: int, rejected_fractions: Mapping[str, float]
) -> str:
    """What to say where no pose is left."""
    return (
        f"{workspace.robot.name}: none of {drawn_count} poses can be taken "
        f"and seen; {describe_main_rejection(rejected_fractions)}"
    )
