"""Candidate poses: a quasi-random sequence within the limits, less what cannot be taken or seen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import Apart, derived
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.planning.visibility import ARM, TRACKER, Condition, Room, Sight, View
from minimax_cal.robots.ranges import SLIDE, near_zero
from minimax_cal.robots.robot import Robot

Conditions = Mapping[str, Condition]
# kept free at a limit of the robot [rad, m], at most that share of the range: corrected targets and
# the arm that is not as drawn go beyond the pose that was planned
MARGIN_TURN, MARGIN_SLIDE, MARGIN_SHARE = np.radians(2.0), 0.005, 0.05
BATCH = 2**13  # poses drawn at a time
MAX_VAIN_TRIES, MAX_TRIES = 2**16, 2**19  # poses drawn while none is good, and at most


@dataclass(frozen=True, eq=False)
class Poses:
    """q: (c, n) joint values as the controller gives them [rad, m].

    seen: (c, k) which targets the instrument sees.  tested: how many poses were drawn.
    rejected: share of those drawn that each condition alone would reject.
    drawn: how many of q, the first, are of the sequence; the others were looked for near some.
    """

    q: Apart[Array]
    seen: Apart[Array]
    tested: int
    rejected: Mapping[str, float]
    drawn: Apart[int]

    @derived()
    def count(self) -> int:
        """Of all."""
        return len(self.q)

    def table(self) -> Table:
        """What each condition rejects."""
        rows = ((name, 100.0 * share) for name, share in self.rejected.items())
        title = f"{self.drawn} candidates of {self.tested} poses drawn"
        if self.count > self.drawn:
            title += f", and {self.count - self.drawn} near the best ones"
        return Table.made(title, rows, "condition | rejects alone % .1f")

    def join(self, q: Array, seen: Array) -> Poses:
        """With further candidates."""
        both = np.concatenate([self.q, q]), np.concatenate([self.seen, seen])
        return Poses(*both, self.tested, self.rejected, self.drawn)


def limits_of(
    robot: Robot,
    narrow: Mapping[int, tuple[float, float]],
    measured: Sequence[Measurements] = (),
) -> tuple[Array, Array, tuple[str, ...]]:
    """(n,) lower and upper limits [rad, m], and a notice where the robot file has none.

    A joint turns at most once round, and keeps a margin to the robot's limits; one without limits
    goes as far as it went in the poses at hand.
    narrow: limits by joint index that cut these.  measured: poses at hand.  Raises OptionError.
    """
    most = np.where(robot.prismatic, SLIDE, np.pi)
    known = np.isfinite(robot.lower) & np.isfinite(robot.upper)
    named = np.isin(np.arange(robot.joints), list(narrow))
    at_hand = np.concatenate([np.zeros((0, robot.joints)), *(one.q for one in measured)])
    least, largest = at_hand.min(axis=0, initial=np.inf), at_hand.max(axis=0, initial=-np.inf)
    went = ~known & ~named & (least < largest)
    lower = np.where(np.isfinite(robot.lower), robot.lower, np.where(went, least, -most))
    upper = np.where(np.isfinite(robot.upper), robot.upper, np.where(went, largest, most))
    lower, upper = near_zero(lower, upper, np.where(known & ~robot.prismatic, np.pi, np.inf))
    margin = np.where(robot.prismatic, MARGIN_SLIDE, MARGIN_TURN)
    margin = np.minimum(margin, MARGIN_SHARE * (upper - lower))
    lower = np.maximum(lower, robot.lower + margin)
    upper = np.minimum(upper, robot.upper - margin)
    for joint, (low, high) in narrow.items():
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
            f"({', '.join(ranges(robot, lower, upper, went))}); set others with joints="
        )
    if (still := ~known & ~named & ~went).any():
        names = ", ".join(str(i + 1) for i in np.flatnonzero(still))
        notices.append(
            f"{robot.name} has no limits for joint {names}: +-180 deg are taken (slides +-500 mm); "
            "narrow them with joints="
        )
    return lower, upper, tuple(notices)


def ranges(robot: Robot, lower: Array, upper: Array, chosen: Array) -> Iterator[str]:
    """Of some joints (n,) where they may go, as joints= takes it."""
    for i in np.flatnonzero(chosen):
        factor, unit = (1e3, "mm") if robot.prismatic[i] else (180.0 / np.pi, "deg")
        yield f"J{i + 1}={factor * lower[i]:.0f}:{factor * upper[i]:.0f} {unit}"


def free_poses(room: Room, count: int, seed: int) -> Array:
    """(count, n) poses anywhere that the arm can take, seen or not: where it may be put to work.

    The box does not count.  Raises OptionError where there are hardly any.
    """
    nowhere = Sight(np.zeros(3), room.robot.up)
    conditions = {name: ARM[name] for name in ("floor", "self-collision")}
    return drawn(room, nowhere, count, seed, conditions, {}).q


def candidates(room: Room, sight: Sight, count: int, seed: int) -> Poses:
    """Poses that the arm can take and the instrument sees: the first `count` of a Sobol sequence.

    Fewer where they are rare.  Raises OptionError where there is none, with what rejects most.
    """
    return drawn(room, sight, count, seed, ARM, TRACKER)


def near(
    room: Room, sight: Sight, q: Array, each: int, step: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Poses around some (m, n) that can be taken and seen: their joints, and what is seen.

    each: how many are tried around one.  step: standard deviation, as a share of the joint's range;
    what goes beyond a limit stays at it.
    """
    spread = step * (room.upper - room.lower)
    around = np.repeat(q, each, axis=0)
    tried = np.clip(around + spread * rng.normal(size=around.shape), room.lower, room.upper)
    good, seen, _ = judged(room, sight, tried, ARM, TRACKER)
    return tried[good], seen[good]


def drawn(
    room: Room, sight: Sight, count: int, seed: int, arm: Conditions, tracker: Conditions
) -> Poses:
    """Poses of the sequence that meet the conditions.  Raises OptionError where there is none."""
    sequence = scipy.stats.qmc.Sobol(
        len(room.lower), scramble=True, rng=np.random.default_rng(seed)
    )
    kept, tested, found = [], 0, 0
    total = dict.fromkeys((*arm, *tracker), 0)
    while found < count and tested < (MAX_TRIES if found else MAX_VAIN_TRIES):
        q = room.lower + (room.upper - room.lower) * sequence.random(BATCH)
        good, seen, against = judged(room, sight, q, arm, tracker)
        total = {name: number + against[name] for name, number in total.items()}
        tested += len(q)
        found += int(good.sum())
        kept.append((q[good], seen[good]))
    rejected = {name: number / tested for name, number in total.items()}
    if not found:
        raise OptionError(no_pose(room, tested, rejected))
    q, seen = (np.concatenate(part)[:count] for part in zip(*kept, strict=True))
    return Poses(q, seen, tested, rejected, len(q))


def judged(
    room: Room, sight: Sight, q: Array, arm: Conditions, tracker: Conditions
) -> tuple[Array, Array, dict[str, int]]:
    """Which poses (m, n) meet all conditions (m,), the targets seen (m, k), and who rejects.

    A pose counts if one target is seen, or all of them where the room says so.
    """
    view, enough = View(room, sight, q), np.all if room.whole else np.any
    good, seen = (
        np.ones(len(q), dtype=bool),
        np.ones((len(room.target_positions), len(q)), dtype=bool),
    )
    against = {}
    for name, holds in arm.items():
        meets = holds(view)
        against[name] = int((~meets).sum())
        good &= meets
    for name, sees in tracker.items():
        meets = sees(view)
        against[name] = int((~enough(meets, axis=0)).sum())
        seen &= meets
    good &= enough(seen, axis=0)
    return good, seen.T, against


MENDS = {
    "floor": "give floor= where it is lower",
    "volume": "make volume= larger",
    "self-collision": "give a thinner body as body=",
    "acceptance": "give another tracker=, normals= or a wider acceptance=",
    "range": "give another tracker= or reach=",
    "elevation": "give another tracker= or elevation=",
    "line of sight": "give another tracker= or a thinner body as body=",
}


def rarest(found: Mapping[str, float]) -> str:
    """What rejects most poses, and what to do about it."""
    worst = max(found, key=lambda name: found[name])
    return f"{worst} rejects most ({100.0 * found[worst]:.1f} %): {MENDS[worst]}"


def no_pose(room: Room, tested: int, rejected: Mapping[str, float]) -> str:
    """What to say where no pose is left."""
    return f"{room.robot.name}: none of {tested} poses can be taken and seen; {rarest(rejected)}"
