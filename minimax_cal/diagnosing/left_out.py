"""Free curves of joints beside a fit, judged by groups of its poses that are left out in turn.

A block of free functions has a Gaussian prior [Rasmussen and Williams 2006], so that it is a ridge
regression.  Its length and size are those that meet the groups left out best: what is fitted judges
nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve

from minimax_cal.diagnosing.gap import folds
from minimax_cal.diagnosing.joint import Joint
from minimax_cal.evidence.limits import FAR_OUT, FOLDS, LEAST_SWEEP
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import clusters
from minimax_cal.modelling.effects.maps import range_of, sines, spread, waves_over
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.rows import MIN_COMPUTED_NOISE

FEWEST = 10  # groups that can say anything
LENGTHS = np.radians([4.0, 8.0, 20.0, 60.0]).tolist()  # of a joint's curve [rad]
SHAPES = list(product((5e-5, 2e-4, 8e-4), LENGTHS))  # its size, beside what is left, and length
RIDGE = 1e-10  # of a parameter's own weight: what poses do not tell stays where it is


@dataclass(frozen=True, eq=False)
class Left:
    """What a fit leaves at its poses, linear there.

    y: (m, r) errors, columns: (m, r, p) their derivatives by what was fitted, arm: (m, r, n) motion
    of the points by the joints, root: (m, r) root of each weight [m, rad].  prior: (p,) weights
    that hold what was fitted near 0, of which y has then what it took away.  q: (m, n) joints, of a
    slide its place in the arm's reach [rad].  group: (m,).  parts: (f, m) masks, left out in turn.
    """

    y: Array
    columns: Array
    arm: Array
    root: Array
    prior: Array
    q: Array
    group: Array
    parts: Array

    @staticmethod
    def of(last: Joint) -> Left:
        """At the end of a fit, with the parts that it can do without."""
        scene, poses, data = last.study.scene, last.poses, last.study.data
        part, unit = folds(data, FOLDS), joint_units(scene)
        parts = np.array(last.spared([part == number for number in range(FOLDS)]))
        held = np.where(poses.prior > 0.0, poses.off, 0.0)
        return Left(
            y=poses.error - poses.jacobian @ held,
            columns=poses.jacobian,
            arm=poses.arm @ scene.linkage * unit,
            root=np.repeat(np.sqrt(last.model.weight), 3, axis=0).T,
            prior=poses.prior,
            q=(scene.q / unit[:, None]).T,
            group=clusters(data),
            parts=parts.reshape(-1, data.poses),
        )

    def take(self, rows: Array) -> Left:
        """Some of the poses.  rows: mask (m,)."""
        parts = self.parts[:, rows]
        names = ("y", "columns", "arm", "root", "q", "group")
        some: dict[str, Any] = {name: getattr(self, name)[rows] for name in names}
        return replace(self, **some, parts=parts[parts.any(axis=1)])

    @property
    def groups(self) -> int:
        """How many stand apart."""
        return len(np.unique(self.group))


def joint_units(scene: Scene) -> Array:
    """(n,) what counts as a radian of each joint: of a slide the arm's reach [m]."""
    return np.where(scene.robot.prismatic, scene.robot.reach(), 1.0)


def begun(left: Left) -> Beside:
    """The fit as it is."""
    return Beside.of(left.parts, left.y, left.columns, left.prior)


def gain_chance(before: Beside, after: Beside, group: Array) -> float:
    """Chance that groups of poses left out gain so much by what tells nothing.  group: (m,).

    By the sum of their gains, or by their ranks, which a few poses far from all others do not sway.
    """
    names = np.unique(group, return_inverse=True)[1].reshape(-1)
    gains = np.bincount(names, (before.error**2 - after.error**2).sum(axis=1))
    if len(gains) < FEWEST or not gains.sum() > 0.0:
        return 1.0
    mean = scipy.stats.ttest_1samp(gains, 0.0, alternative="greater").pvalue
    ranks = scipy.stats.wilcoxon(gains, alternative="greater").pvalue
    return min(2.0 * float(min(mean, ranks)), 1.0)


# ---- free functions ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Block:
    """Free functions at a place.

    columns: (m, r, c) motion of the points per unit of each.  priors: (h, c) their standard
    deviations, of which one row is chosen.
    """

    place: str
    columns: Array
    priors: Array


def by_joint(left: Left) -> Iterator[Block]:
    """A turn of each joint that is smooth in its own angle; of a slide, in its place."""
    for j, q in enumerate(left.q.T):
        if np.ptp(q) < np.radians(LEAST_SWEEP):
            continue
        low, high = range_of(q)
        count = max(min(waves_over(high - low), left.groups // 2), 1)
        columns = left.arm[:, :, j, None] * sines(q, low, high, count).T[:, None]
        priors = [size * spread(length, high - low, count) for size, length in SHAPES]
        yield Block(f"J{j + 1}", columns, np.array(priors))


# ---- fits without each part of the poses -------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Beside:
    """A fit of some columns, and what it predicts of each part of the poses without that part.

    parts: (f, m) masks of the poses left out, each pose in one at most.  y: (m, r) what is fitted.
    columns: (m, r, p), with weights `ridge` (p,) of a prior of mean 0.  error: (m, r) what is left
    of each pose without its part.  picked: which prior of the last block.
    """

    parts: Array
    y: Array
    columns: Array
    ridge: Array
    error: Array
    picked: int = 0

    @staticmethod
    def of(parts: Array, y: Array, columns: Array, prior: Array) -> Beside:
        """Columns that are fitted freely, but for weights (p,) that hold them near 0."""
        size = np.linalg.norm(columns.reshape(-1, columns.shape[-1]), axis=0)
        size = np.where(size > 0.0, size, 1.0)  # of what no pose shows 0 is left
        bare = Beside(parts, y, columns / size, RIDGE + prior / size**2, y)
        column = y[..., None]
        return replace(bare, error=bare.cleared(column, bare.told(column)[0])[..., 0])

    @property
    def variance(self) -> float:
        """Of a coordinate that is left out [m^2]."""
        return max(self.square / self.y.size, MIN_COMPUTED_NOISE**2)

    @cached_property
    def value(self) -> Array:
        """(p,) with all poses."""
        gram = product_of(self.columns, self.columns) + np.diag(self.ridge)
        pull = product_of(self.columns, self.y[..., None])
        return np.asarray(np.linalg.solve(gram, pull)[:, 0])

    @property
    def usual(self) -> Array:
        """(m,) True for poses that some fit does without, and that do not stand far out."""
        judged, size = self.parts.any(axis=0), (self.error**2).sum(axis=1)
        return np.asarray(judged & (size <= FAR_OUT**2 * np.median(size[judged])))

    @property
    def square(self) -> float:
        """Sum of squares at the poses left out [m^2]."""
        return float((self.error**2).sum())

    @cached_property
    def factors(self) -> list[tuple[Array, bool]]:
        """(f,) of products of the columns at all poses but a part's, and the ridge."""
        grams = self.without(self.columns, self.columns) + np.diag(self.ridge)
        return [cho_factor(gram, check_finite=False) for gram in grams]

    def without(self, one: Array, other: Array) -> Array:
        """(f, c, d) products of columns (m, r, c) and (m, r, d) at all poses but a part's."""
        own = np.array([product_of(one[part], other[part]) for part in self.parts])
        never = ~self.parts.any(axis=0)
        return np.asarray(own.sum(axis=0) + product_of(one[never], other[never]) - own)

    def told(self, columns: Array) -> tuple[Array, Array]:
        """Values (f, p, c) of this fit's columns for others (m, r, c), without each part.

        And the products (f, p, c) of its own with them.
        """
        cross = self.without(self.columns, columns)
        pairs = zip(self.factors, cross, strict=True)
        return np.array([cho_solve(one, pull, check_finite=False) for one, pull in pairs]), cross

    def cleared(self, columns: Array, values: Array) -> Array:
        """What values of this fit, as `told`, leave of columns (m, r, c), each by its part's."""
        out = np.zeros_like(columns)
        for part, value in zip(self.parts, values, strict=True):
            out[part] = columns[part] - self.columns[part] @ value
        return out

    def with_block(self, block: Block) -> Beside:
        """The fit with a block besides, by that prior of it which meets the parts best."""
        both = np.concatenate([block.columns, self.y[..., None]], axis=-1)
        values, cross = self.told(both)
        clear = self.cleared(both, values)
        left = (self.without(both, both) - np.swapaxes(cross, 1, 2) @ values)[:, None]
        ridge = self.variance / block.priors**2
        eye = np.eye(ridge.shape[1])
        value = np.linalg.solve(left[..., :-1, :-1] + ridge[:, :, None] * eye, left[..., :-1, -1:])
        error = np.zeros((len(ridge), *self.y.shape))
        for part, one in zip(self.parts, value[..., 0], strict=True):
            free, rest = clear[part, :, :-1], clear[part, :, -1]
            told = one @ free.reshape(-1, len(eye)).T
            error[:, part] = rest - told.reshape(len(ridge), *rest.shape)
        best = int(np.argmin((error**2).sum(axis=(1, 2))))
        columns = np.concatenate([self.columns, block.columns], axis=-1)
        ridge = np.append(self.ridge, ridge[best])
        return Beside(self.parts, self.y, columns, ridge, error[best], best)


def product_of(one: Array, other: Array) -> Array:
    """(c, d) products of columns (m, r, c) and (m, r, d)."""
    return np.asarray(one.reshape(-1, one.shape[-1]).T @ other.reshape(-1, other.shape[-1]))
