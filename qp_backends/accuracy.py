"""One judge for all backends: how well x and y meet the optimality conditions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .problem import Array, Problem, Solution


@dataclass(frozen=True)
class Accuracy:
    """Residuals of the optimality conditions, absolute and relative; infinite without x and y.

    primal: largest violation of l ≤ Ax ≤ u, in the units of its row.
    dual: largest entry of Px + q + Aᵀy, multipliers of open sides left out.
    gap: |xᵀPx + qᵀx + uᵀy⁺ - lᵀy⁻|, primal minus dual objective.
    primal_relative, dual_relative, gap_relative: see `accuracy`.
    objective: ½xᵀPx + qᵀx.
    """

    primal: float
    dual: float
    gap: float
    primal_relative: float
    dual_relative: float
    gap_relative: float
    objective: float

    @property
    def worst(self) -> float:
        """The largest of the three relative numbers: what a tolerance is compared with."""
        return max(self.primal_relative, self.dual_relative, self.gap_relative)


HUGE = 1e100  # what is larger is as good as infinite, and its square may be
NOWHERE = Accuracy(*(7 * [math.inf]))
FINE = 1e-10  # residuals up to which the cheap sizes of the terms are good enough
ROUNDING = 1e-6  # part of what could be there that counts as being there: rounding, at 1e-8
CANCELS = 1e2  # times the largest that is left: so much of terms that cancel counts
TINY = 1e-200  # makes 0 / 0 nothing


def accuracy(problem: Problem, solution: Solution) -> Accuracy:
    """How far a solution is from optimal, by one formula for every backend.

    The relative numbers divide each entry by the size of its own terms, so that they do not change
    when a variable, a row or the objective is given in other units (|.| is by entries)
    [Oettli and Prager 1964: by how much the data must change for x and y to be exact]:

    primal: the largest distance of a row to its bounds / max(|A||x|, |bound|).
    dual: the largest entry of |Px + q + Aᵀy| / max(|P||x| + |A|ᵀ|y|, |q|).
    gap: |gap| / max(|xᵀPx|, |qᵀx|, |uᵀy⁺ - lᵀy⁻|), or that of a row where it is larger: the
    distance to the bound at which y pushes / max(|A||x|, |bound|), times the part of y in the
    forces on the row's variables.

    Two limits keep rounding apart from terms (`_closely`).  Terms that cancel count for at most
    CANCELS times the largest row or force that is left, in units in which P and A are well scaled:
    else rows that contradict each other would be met by an x that is large enough.  And terms that
    vanish count for a part of the largest that could be there.
    """
    if solution.x.shape != problem.q.shape or solution.y.shape != problem.l.shape:
        return NOWHERE
    with np.errstate(all="ignore"):
        return _judged(problem, solution.x, solution.y)


def _judged(problem: Problem, x: Array, y: Array) -> Accuracy:
    """The residuals of an x and y of the right shape."""
    if not (x @ x < HUGE**2 and y @ y < HUGE**2):  # False for NaN, too
        return NOWHERE
    P, q, A, l, u = problem.P, problem.q, problem.A, problem.l, problem.u  # noqa: E741
    bound = np.where(y > 0, u, l)
    bound[y == 0] = 0.0
    support = float(y @ bound)
    if not math.isfinite(support):  # NaN, or a multiplier at an open side
        y, bound = np.where(np.isinf(bound) & ~np.isnan(y), 0.0, (y, bound))
        support = float(y @ bound)
    Px, Ax, Aty = P @ x, A @ x, y @ A
    xPx, qx = float(x @ Px), float(q @ x)
    gap = abs(xPx + qx + support)
    inside = np.minimum(np.maximum(Ax, l), u)
    outside, slope = np.abs(Ax - inside), np.abs(Px + q + Aty)
    primal, dual = _largest(outside), _largest(slope)
    if not (math.isfinite(gap) and math.isfinite(primal)):
        return NOWHERE
    energy = max(abs(xPx), abs(qx), abs(support))
    curved, rows = problem.magnitudes
    length, pull = np.abs(x), np.abs(q)
    parts, moved = curved @ length + np.abs(y) @ rows, rows @ length
    force = np.maximum(np.maximum(np.abs(Px), np.abs(Aty)), pull)
    goal = np.where(y == 0, inside, bound)
    off = np.maximum(np.abs(Ax - goal), outside)
    off = _largest(off / (np.where(goal == 0, moved, np.abs(goal)) + TINY))
    found = off, _largest(slope / (parts + pull + TINY)), max(off, gap / (energy + TINY))
    most = CANCELS**2  # times FINE is no more than CANCELS times a tolerance of 1e-8
    cancels = _largest(moved) > most * _size(Ax) or _largest(parts) > most * _largest(force)
    if cancels or not max(found) <= FINE:
        apart = np.where(y == 0, 0.0, Ax - bound)
        residuals = outside, slope, apart, gap
        found = _closely(problem, x, y, Ax, residuals, (force, parts, moved, inside, bound), energy)
    return Accuracy(primal, dual, gap, *found, 0.5 * xPx + qx)


def _closely(
    problem: Problem,
    x: Array,
    y: Array,
    Ax: Array,
    residuals: tuple[Array, Array, Array, float],
    sizes: tuple[Array, ...],
    energy: float,
) -> tuple[float, float, float]:
    """primal, dual and gap, relative, from residuals and the sizes of their terms.

    length: how far rows go, by x, by their bounds, or by the step on which the largest pull meets
    the largest curvature, all in good units.  reach: how far a variable goes, so far or until its
    own gradient meets its own curvature.  A row whose bound is 0 is measured by what its variables
    reach; a force on a variable without a pull of its own (q = 0), and all others, by a millionth
    of such a limit.
    """
    outside, slope, apart, gap = residuals
    force, parts, moved, *ends = sizes
    (s, t), rows, bend = problem.scales, problem.magnitudes[1], problem.P.diagonal()
    curvature, strength, rounding = _size(s * s * bend), _size(s * force), ROUNDING
    newton = _size(s * problem.q) / (curvature + TINY)
    length = max(_size(t * Ax), problem.farthest, min(newton, _size(x / s)))
    if not problem.q.any():
        strength = max(strength, length * curvature or 1.0)
        rounding = ROUNDING if bend.any() else 1.0  # without objective no multiplier matters
    force = np.maximum(force, np.minimum(parts, CANCELS * strength / s))
    force += np.where(problem.q == 0, rounding, 0.0) * strength / s
    reach = length * s
    reach = np.where(bend > 0, np.minimum(reach, force / bend), reach)
    moved, least = np.minimum(moved, CANCELS * length / t), rows @ reach
    here, there = (
        np.maximum(np.abs(end), moved) + np.where(end == 0, 1.0, ROUNDING) * least for end in ends
    )
    share = np.minimum(np.abs(y) * (rows @ (1.0 / (force + TINY))), 1.0)
    gap /= energy + rounding * float(force @ reach) + TINY
    return (
        _size(outside / (here + TINY)),
        _size(slope / (force + TINY)),
        max(gap, _size(apart * share / (there + TINY))),
    )


def _size(vector: Array) -> float:
    """Largest absolute entry; NaN if there is one."""
    return _largest(np.abs(vector))


def _largest(vector: Array) -> float:
    """Largest entry of what is nowhere negative; NaN if there is one."""
    return float(vector.max()) if vector.size else 0.0
