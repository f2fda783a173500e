"""What new poses could find: the smallest shift, how few of them suffice, what stays hidden."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.judging.watching.moved import (
    APART,
    OF_POWER,
    Candidates,
    Search,
    critical,
    joint_of,
)
from minimax_cal.judging.watching.result import SHIFT, Hidden
from minimax_cal.judging.watching.rows import Both, Rows
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.solvers.least_squares import solve_normal

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
        if base.any() and found.first.noise.share(alone, base)[0] <= APART:
            needs = "reflectors on the foot, or the old frame (known frame)"
            yield Hidden(names.all[i], "the measurement frame", needs)
        elif found.first.noise.share(alone, watched.open & ~base)[0] <= APART:
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
    if worst > SHIFT:
        return findable, None, math.ceil(watched.data.poses * (worst / SHIFT) ** 2)
    enough = fewest(rows, looked.only(zero[turning]))
    return findable, enough, enough


def fewest(rows: Both, looked: Candidates) -> int:
    """How many of the poses find SHIFT in every joint: those left out go one by one.

    Of many, some are looked at; where those are not enough, it is all of them.

    The one without which the joint that is told least is told best goes first.
    """
    told = [Told.of(each, looked.column) for each in (rows.noise, rows.alike)]
    poses = rows.noise.pose
    kept, many = np.arange(len(told[0].gram)), len(np.unique(poses[poses >= 0]))
    while len(kept) > FEWEST:
        noise, alike = (each.without(kept, looked) for each in told)
        least = (np.where(looked.alike, alike, noise) * looked.wider).max(axis=1)
        if least.min() > SHIFT:
            return len(kept) if len(kept) < len(told[0].gram) else many
        kept = np.delete(kept, np.argmin(least))
    return len(kept)


@dataclass(frozen=True, eq=False)
class Told:
    """What each pose tells.

    gram: (m, q, q), counts: (m,) as of `Rows.by_pose`.  fixed: (q, q) what is told without poses,
    by so many more coordinates.  free: of the poses, for what is open.
    """

    gram: Array
    counts: Array
    fixed: Array
    more: int
    free: int
    columns: int

    @staticmethod
    def of(rows: Rows, zero: Array) -> Told:
        """By rows weighed one way, of some parameters (c,)."""
        gram, counts = rows.by_pose(zero, MOST)
        r, c = rows.latent.shape[1], len(zero)
        q = gram.shape[1] - c - 1  # what is free, and what was not known
        fixed = np.diag(np.pad(np.ones(r), (q - r, c + 1)))
        foot = np.pad(rows.columns(zero)[rows.pose < 0], ((0, 0), (0, 1)))
        return Told(gram, counts, fixed + foot.T @ foot, rows.foot, q - r, c)

    def without(self, kept: Array, looked: Candidates) -> Array:
        """(b, c) smallest change that is found without each of the poses that are kept [SI]."""
        c, q = self.columns, self.gram.shape[1] - self.columns - 1
        without = self.fixed + self.gram[kept].sum(axis=0) - self.gram[kept]
        free, across = without[:, :q, :q], without[:, :q, q : q + c]
        told = np.einsum("bcc->bc", without[:, q : q + c, q : q + c])
        told = told - (across * solve_normal(free, across)).sum(axis=1)
        counts = self.counts[kept]
        seen = (counts.sum() - counts + self.more)[:, None] * looked.single
        margin = critical(looked.level, np.maximum(seen - self.free, 1.0)) + OF_POWER
        return np.asarray(margin / np.sqrt(np.maximum(told, TINY)))
