"""What new poses could find: the smallest shift, how few of them suffice, what stays hidden."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.judging.watching.moved import APART, Search, critical, joint_of
from minimax_cal.judging.watching.result import SHIFT, Hidden
from minimax_cal.judging.watching.watched import Rows, Watched
from minimax_cal.solvers.least_squares import solve_normal

OF_POWER = 1.645  # sigmas that a normal variable falls short of in 5 of 100 cases
FEWEST, MOST = 2, 60  # poses among which is chosen
TINY = 1e-30  # nothing is told


def hidden(watched: Watched, found: Search) -> Iterator[Hidden]:
    """Zero positions that nobody could tell from what is open, and what would tell them."""
    names, n = watched.names, watched.cell.robot.joints
    lost = [i for i in watched.zeros if i not in found.looked.column]
    place = np.arange(names.count)
    base = watched.open & (place < 5 * n + 6)
    for i in lost:
        alone = np.array([i])
        if base.any() and found.first.share(alone, base)[0] <= APART:
            needs = "reflectors on the foot, or the old frame (known frame)"
            yield Hidden(names.all[i], "the measurement frame", needs)
        elif found.first.share(alone, watched.open & ~base)[0] <= APART:
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
    _, sigma = replace(rows, error=np.zeros_like(rows.error)).scores(zero)
    level = float(looked.level[looked.zero][0])
    margin = critical(level, rows.dof) + OF_POWER
    least = margin * sigma * looked.wider[looked.zero]
    names = watched.names.all
    findable = {names[i]: float(size) for i, size in zip(zero, least, strict=True)}
    turning = ~watched.cell.robot.prismatic[[int(joint_of(names[i])[1:]) - 1 for i in zero]]
    if not turning.any():
        return findable, None, None
    worst = float(np.max(least[turning]))
    if worst > SHIFT:
        return findable, None, math.ceil(watched.data.poses * (worst / SHIFT) ** 2)
    enough = fewest(rows, zero[turning], looked.wider[looked.zero][turning], level)
    return findable, enough, enough


def fewest(rows: Rows, zero: Array, wider: Array, level: float) -> int:
    """How many of the poses find SHIFT in every joint: those left out go one by one.

    Of many, some are looked at; where those are not enough, it is all of them.

    The one without which the joint that is told least is told best goes first.
    """
    gram, counts = rows.by_pose(zero, MOST)
    r, c = rows.latent.shape[1], len(zero)
    q = gram.shape[1] - c - 1  # what is free, and what was not known
    fixed = np.diag(np.pad(np.ones(r), (q - r, c + 1)))
    if foot := rows.foot:
        last = replace(rows, pose=np.where(rows.pose < 0, 0, -1), error=np.zeros_like(rows.error))
        fixed = fixed + last.by_pose(zero)[0].sum(axis=0)
    kept, many = np.arange(len(gram)), len(np.unique(rows.pose[rows.pose >= 0]))
    while len(kept) > FEWEST:
        without = fixed + gram[kept].sum(axis=0) - gram[kept]
        free, across = without[:, :q, :q], without[:, :q, q : q + c]
        told = np.einsum("bcc->bc", without[:, q : q + c, q : q + c])
        told = told - (across * solve_normal(free, across)).sum(axis=1)
        dof = np.maximum(counts[kept].sum() - counts[kept] + foot - (q - r), 1.0)
        margin = np.array([critical(level, one) for one in dof]) + OF_POWER
        least = (margin[:, None] * wider / np.sqrt(np.maximum(told, TINY))).max(axis=1)
        if least.min() > SHIFT:
            return len(kept) if len(kept) < len(gram) else many
        kept = np.delete(kept, np.argmin(least))
    return len(kept)
