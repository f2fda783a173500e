"""Errors, rows, normal equations and plain steps, of either module's kernels.

Poses go in blocks that fit the cache: the Jacobian of all points is never stored.
``own`` is the module of the kernels, `plain` or `fast`.  ``at`` is a batch of B robots in their
places: mdh (B, n, 5); rotation (B, 3, 3) and origin (B, 3) of the base; targets (B, k, 3) in the
flange [m]; effects (B, e), their values.  ``sight`` is what was seen of them: q (m, n), prismatic
(n,) as `plain.chain`; y (k, 3, m) measured [m]; weight (k, m), 0 where not measured; fields
(e, k, 3, m) motion of the points per unit of each effect, moved (k, 3, m) besides, in base axes,
(0, ...) for none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType

import numpy as np

from minimax_cal.ground.arrays import Array

At = tuple[Array, ...]
Sight = tuple[Array, ...]

# Relative: a cost that grows by more did not come from rounding, 2 eps L / s of points L away that
# miss by s; with 3 m and 0.1 mm 1.3e-11.
RISE = 1e-10


def blocks(m: int, points: int, most: int) -> list[tuple[int, int]]:
    """The poses in blocks of about as many each.  points: at a pose; at most so many in a block."""
    count = min(-(-m * points // most), m)
    return [(i * m // count, (i + 1) * m // count) for i in range(count)]


@cache
def axes(n: int) -> tuple[Array, Array]:
    """Rows of `plain.unwound`, (5n + 6,) each: the axis of a parameter, and a point on it.

    The point is -1 for those that slide along their axis.
    """
    joint, base = np.arange(n), np.arange(3)
    own, beyond = 4 * (n + 1 + joint), 4 * (joint + 1)  # of the joint, of the frame after it
    axis = [own, own + 2, own + 2, own, beyond + 1, base, base]
    slide, slides = np.full(n, -1), np.full(3, -1)
    point = [slide, slide, 4 * joint + 3, beyond + 3, beyond + 3, slides, 0 * base + 3]
    return np.concatenate(axis), np.concatenate(point)


def cost(own: ModuleType, at: At, sight: Sight) -> Array:
    """Weighted sums of squares F_i of each target: (B, k) [m^2]."""
    (mdh, *place), (q, prismatic, *seen) = at, sight
    out = np.zeros((len(mdh), len(seen[0])))
    for lo, hi in blocks(len(q), out.size, own.BLOCK):
        arm = own.unwound(mdh, q, prismatic, lo, hi)
        error, _, _ = own.sighted(arm, *place, *seen, lo)
        out += np.einsum("bkic,bkic->bk", error, error)
    return out


@dataclass(frozen=True, eq=False)
class Columns:
    """Parameters (p,), ascending as `Names`: of links and base, of targets, of effects.

    first: the first of the targets.  s, end: where targets begin and end in `which`.  axis, point:
    (s,) see `axes`.  effects: (p - end,) which.
    """

    which: Array
    first: int
    s: int
    end: int
    axis: Array
    point: Array
    effects: Array

    @staticmethod
    def of(at: At, which: Array) -> Columns:
        """The parameters of robots with so many joints and targets."""
        n = at[0].shape[1]
        first, last = 5 * n + 6, 5 * n + 6 + 3 * at[3].shape[1]
        s, end = which.searchsorted((first, last)).tolist()
        axis, point = (rows[which[:s]] for rows in axes(n))
        return Columns(which, first, s, end, axis, point, which[end:] - last)

    @property
    def ends(self) -> tuple[int, int, int]:
        """s, end and first, as the kernels ask for them."""
        return self.s, self.end, self.first

    def shared(
        self, own: ModuleType, at: At, sight: Sight, lo: int, hi: int
    ) -> tuple[Array, Array, Array]:
        """Weighted errors (B, k, 3, c), what moves all targets (B, k, h, 3, c), roots (k, c).

        The roots are those of the weights.  Of the poses lo to hi, in the axes of the flange.
        """
        (mdh, *place), (q, prismatic, *seen), fields = at, sight, sight[4]
        arm = own.unwound(mdh, q, prismatic, lo, hi)
        error, swung, root = own.sighted(arm, *place, *seen, lo)
        some = fields[..., lo:hi].take(self.effects, axis=0)
        return error, own.sensed(arm, self.axis, self.point, at[3], swung, root, some), root

    def normal(self, own: ModuleType, at: At, sight: Sight) -> tuple[Array, Array, Array]:
        """See `sums.normal`."""
        B, k, p = len(at[0]), len(sight[2]), len(self.which)
        out = np.zeros((B, k)), np.zeros((B, k, p)), np.zeros((B, k, p, p))
        for lo, hi in blocks(len(sight[0]), B * k, own.BLOCK):
            error, J, root = self.shared(own, at, sight, lo, hi)
            long = 3 * (hi - lo)  # told, as -1 is of no rows that move all targets
            flat = error.reshape(B, k, long), J.reshape(*J.shape[:3], long), root
            own.summed(*flat, self.which, *self.ends, *out)
        return out


def normal(own: ModuleType, at: At, sight: Sight, which: Array) -> tuple[Array, Array, Array]:
    """Normal equations by target: F (B, k), J'We (B, k, p) and J'WJ (B, k, p, p).

    which: (p,) the parameters, ascending, in the order of `Names`.
    """
    return Columns.of(at, which).normal(own, at, sight)


def rows(
    own: ModuleType, at: At, sight: Sight, which: Array, lo: int, hi: int
) -> tuple[Array, Array]:
    """Weighted errors (k, 3, c) of the poses lo to hi, and their Jacobian J (k, p, 3, c).

    In the axes of the flange, of a batch of one; the errors' derivative is -J.  As `normal`.
    """
    columns = Columns.of(at, which)
    error, J, root = columns.shared(own, at, sight, lo, hi)
    s, end, first = columns.ends
    out = np.zeros((len(root), len(which), *error.shape[2:]))
    out[:, :s], out[:, end:] = J[0, :, :s], J[0, :, s:]
    t, axis = np.divmod(which[s:end] - first, 3)
    out[t, np.arange(s, end), axis] = root[t]
    return error[0], out


def gradients(own: ModuleType, at: At, sight: Sight, which: Array, counted: Array) -> Array:
    """J'We (B, p) of all targets, each robot's over poses of its own.

    counted: (B, m) weight of each pose besides.  As `normal`.
    """
    (B, k, _), m = at[3].shape, len(sight[0])
    columns, out = Columns.of(at, which), np.zeros((B, len(which)))
    s, end, first = columns.ends
    t, axis = np.divmod(which[s:end] - first, 3)
    for lo, hi in blocks(m, B * k, own.BLOCK):
        error, J, root = columns.shared(own, at, sight, lo, hi)
        error = error * counted[:, None, None, lo:hi]
        pull = J.reshape(*J.shape[:3], -1) @ error.reshape(B, k, -1, 1)
        pull = pull[..., 0].sum(axis=1)
        out[:, :s] += pull[:, :s]
        out[:, end:] += pull[:, s:]
        out[:, s:end] += (error @ root[..., None])[:, t, axis, 0]
    return out


def squares(own: ModuleType, at: At, sight: Sight, which: Array) -> tuple[Array, Array]:
    """Weighted squared distance of every point (k, m) [m^2] and its derivative (k, m, p).

    Of a batch of one, as `normal`.
    """
    (k, m), columns = sight[3].shape, Columns.of(at, which)
    f, slope, ends = np.empty((k, m)), np.empty((k, m, len(which))), columns.ends
    for lo, hi in blocks(m, k, own.BLOCK):
        error, J, root = columns.shared(own, at, sight, lo, hi)
        f[:, lo:hi], slope[:, lo:hi] = own.squared(error[0], J[0], root, which, *ends)
    return f, slope


def descend(
    own: ModuleType, at: At, sight: Sight, which: Array, prior: tuple[Array, Array], step: float,
    most: int,
) -> tuple[At, Array, bool]:  # fmt: skip
    """Plain Gauss-Newton steps from a start that is near: the sum of all F_i, and a prior.

    As `normal`, for a batch of one.  prior: mean and weight (p,) of `which`.
    step: root mean square motion of a point that ends it [m].  most: steps.
    Returns where it ended, the cost at every iterate (t,), and whether it ended well: each step led
    down, and the last one was small.
    """
    (mean, hold), costs, off = prior, [np.inf], np.zeros(len(which))
    columns = Columns.of(at, which)
    count = max(int(np.count_nonzero(sight[3])), 1)
    for _ in range(most):
        if hold.any():
            off = mean - values(at, which)
        dx, before, gain, told = own.solved(*columns.normal(own, at, sight), off, hold)
        costs.append(before)
        if not before <= costs[-2] * (1.0 + RISE) or not np.isfinite(before) or not told:
            return at, np.array(costs[1:]), False
        at = own.stepped(*at, which, dx)
        if gain <= count * step**2:
            return at, np.array([*costs[1:], before - gain]), True
    return at, np.array(costs[1:]), False


def values(at: At, which: Array) -> Array:
    """(p,) the parameters of a batch of one; those of the base's turn are 0, as steps are."""
    mdh, _, origin, targets, effects = (part[0] for part in at)
    every = (mdh.T.reshape(-1), origin, np.zeros(3), targets.reshape(-1), effects)
    return np.concatenate(every)[which]
