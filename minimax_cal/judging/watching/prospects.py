"""What new poses could find: the smallest shift, how few of them suffice, what stays hidden."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from minimax_cal.fitting.accuracy import FARTHEST, Interval
from minimax_cal.judging.watching.moved import MIN_OWN_MOTION, Search, joint_of
from minimax_cal.judging.watching.result import SHIFT, Hidden
from minimax_cal.judging.watching.watched import Watched

MIN_POSES = 2  # poses that place an arm
DOUBLINGS = 6  # of the poses: nobody measures more than 64 times as many


def hidden(watched: Watched, found: Search) -> Iterator[Hidden]:
    """Zero positions that nobody could tell from what is open, and what would tell them."""
    names, n = watched.names, watched.cell.robot.joints
    lost = [i for i in watched.zeros if i not in found.looked.column]
    place = np.arange(names.count)
    base = watched.open & (place < 5 * n + 6)
    for i in lost:
        alone = np.array([i])
        if base.any() and found.before.rows.share(alone, base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors on the foot, or the old frame (known frame)"
            yield Hidden(names.all[i], "the measurement frame", needs)
        elif found.before.rows.share(alone, watched.open & ~base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors that were not touched (known targets)"
            yield Hidden(names.all[i], "the tool", needs)
        else:
            yield Hidden(names.all[i], "frame and tool", "poses that differ more")


def prospects(watched: Watched, found: Search) -> tuple[dict[str, float], int | None, int | None]:
    """The smallest shift of each zero position that is found; poses that are enough, and needed."""
    rows, looked = found.first, found.looked
    zero = looked.column[looked.zero]
    if not len(zero):
        return {}, None, None
    least = looked.least(rows)[looked.zero]
    names = watched.names.all
    findable = {names[i]: float(size) for i, size in zip(zero, least, strict=True)}
    turning = ~watched.cell.robot.prismatic[[int(joint_of(names[i])[1:]) - 1 for i in zero]]
    if not turning.any():
        return findable, None, None
    worst = float(np.max(least[turning]))
    wanted = max(math.ceil(watched.data.poses * (worst / SHIFT) ** 2), MIN_POSES)
    return findable, (wanted if worst <= SHIFT else None), wanted


def to_decide(interval: Callable[[int], Interval], value: float, size: float, poses: int) -> str:
    """How many poses decide on which side of a limit an RMS lies, in words.

    Half of all sessions of so many are decided: the interval of an RMS as seen just excludes the
    limit.  The intervals are those of 1, 2, 4 ... copies of these poses, a power law between.
    interval: of so many copies.  value: the RMS that was seen [m].  size: the limit [m].  poses:
    how many were seen.
    """
    side = int(value < size)
    wanted, width = abs(math.log(size / value)), math.inf
    for doubled in range(DOUBLINGS + 1):
        last = width
        end = float(np.clip(interval(2**doubled)[side] / value, 1.0 / FARTHEST, FARTHEST))
        width = abs(math.log(end))
        if width <= wanted:
            power = math.log(last / wanted) / math.log(last / width) if doubled else 1.0
            few = poses / (poses - 1.0)  # spread of copies, which are no new poses
            count = max(few * poses * 2.0 ** (doubled - 1.0 + power), poses + 1.0)
            return f"about {float(f'{count:.2g}'):.0f}"
    return f"more than {poses * 2**DOUBLINGS}"
