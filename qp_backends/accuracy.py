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


def accuracy(problem: Problem, solution: Solution) -> Accuracy:
    """How far a solution is from optimal, by one formula for every backend.

    The relative numbers divide by the size of what had to cancel, so that they do not change when
    the objective or a row is multiplied by a number (‖.‖ is the largest absolute entry):

    primal: violation / max(‖Ax‖, λ), each row first divided by its Euclidean norm, so that a
    violation is the distance of x from the row's half-space.
    dual: ‖Px + q + Aᵀy‖ / δ with δ = max(‖Px‖, ‖q‖, ‖Aᵀy‖).
    gap: |gap| / max(|xᵀPx|, |qᵀx|, |uᵀy⁺ - lᵀy⁻|, δλ).

    λ = min(1, δ / ‖P‖), the step on which the largest gradient meets the largest curvature, stands
    in for the size of x where x vanishes (1 for a linear program, which has no curvature). Without
    it an exact x = 0 with a rounding error would have an infinite relative residual.  For the same
    reason δ, where q = 0, is at least ‖P‖ (1 if P = 0) times the distance to the farthest bound, or
    times 1 if that is nearer.
    """
    if solution.x.shape != problem.q.shape or solution.y.shape != problem.l.shape:
        return NOWHERE
    return _judged(problem, solution.x, solution.y)


def _judged(problem: Problem, x: Array, y: Array) -> Accuracy:
    """The residuals of an x and y of the right shape."""
    if not (_size(x) < HUGE and _size(y) < HUGE):
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
    if not math.isfinite(gap):
        return NOWHERE
    outside = Ax - np.minimum(np.maximum(Ax, l), u)
    far = outside.any()
    slope, dual = _size(q), _size(Px + q + Aty)
    delta = max(slope, _size(Px), _size(Aty))
    curvature = problem.curvature
    if slope == 0.0:
        delta = max(delta, (curvature or 1.0) * _reach(problem))
    step = min(1.0, delta / curvature) if curvature > 0 else 1.0
    return Accuracy(
        primal=_size(outside) if far else 0.0,
        dual=dual,
        gap=gap,
        primal_relative=_ratio(
            _size(outside / problem.row_norm), max(_size(Ax / problem.row_norm), step)
        )
        if far
        else 0.0,
        dual_relative=_ratio(dual, delta),
        gap_relative=_ratio(gap, max(abs(xPx), abs(qx), abs(support), delta * step)),
        objective=0.5 * xPx + qx,
    )


def _reach(problem: Problem) -> float:
    """Distance from 0 to the farthest finite bound, at most 1; 1 where all bounds are 0 or open."""
    ends = np.abs((problem.l, problem.u)) / problem.row_norm
    farthest = float(np.where(np.isfinite(ends), ends, 0.0).max(initial=0.0))
    return min(1.0, farthest or 1.0)


def _size(vector: Array) -> float:
    """Largest absolute entry; NaN if there is one."""
    return float(np.abs(vector).max()) if vector.size else 0.0


def _ratio(part: float, whole: float) -> float:
    if part == 0:
        return 0.0
    return part / whole if whole > 0 else math.inf
