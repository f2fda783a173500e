"""A point that meets all constraints, or the proof that there is none near."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.derivatives import CountedFunction, CountedJacobian
from minimax_cal.solvers.max_problem import MaxOfFunctions
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from minimax_cal.solvers.minimize import OptimumSearch


@dataclass(frozen=True, eq=False)
class FeasibilityAnswer:
    """x: (n,) of the least violation found.  is_feasible: whether it is within the tolerance.

    is_proven: whether, if not, the search for less converged; else it only ended.
    """

    x: Array
    is_feasible: bool
    is_proven: bool


def find_feasible_point(
    problem: MaxOfFunctions, x: Array, search: OptimumSearch
) -> FeasibilityAnswer:
    """Minimise the largest violation, each relative to its row's terms, between the bounds.

    The same search from x (n,), with the QPs that it has left; they count among its own.
    """
    rows = problem.rows
    c, normal = rows.values(x), rows.jacobian(x)
    violation = problem.relative_violations(x, c, normal)
    with np.errstate(all="ignore"):
        size = np.maximum(c - rows.upper, rows.lower - c) / violation
    reach = np.abs(normal) @ np.maximum(problem.lengths, np.abs(x))
    size = np.where((violation > 0.0) & np.isfinite(size), size, np.where(reach > 0.0, reach, 1.0))
    k = rows.bound_count
    above = np.flatnonzero(np.isfinite(rows.upper))
    above = above[above >= k]
    below = np.flatnonzero(np.isfinite(rows.lower))
    below = below[below >= k]
    if not len(above) + len(below):  # bounds alone, which no x0 between them breaks
        return FeasibilityAnswer(x, is_feasible=False, is_proven=False)

    def violations(z: Array) -> Array:
        c = rows.values(z) / size
        ends = rows.upper / size, rows.lower / size
        return np.concatenate([[0.0], (c - ends[0])[above], (ends[1] - c)[below]])

    def slopes(z: Array) -> Array:
        normal = rows.jacobian(z) / size[:, None]
        return np.concatenate([np.zeros((1, len(z))), normal[above], -normal[below]])

    function = CountedFunction(violations)
    phase_one = MaxOfFunctions(
        function, CountedJacobian(function, slopes, problem.lengths), rows.bound_rows(),
        problem.low, problem.high, 0, problem.lengths, problem.first_lengths,
    )  # fmt: skip
    bounded = np.clip(x, problem.low, problem.high)
    phase = replace(search, callback=None, history=[])
    answer = phase.find_optimum(phase_one.with_units_at(bounded), bounded, with_feasibility=False)
    search.iteration_count = phase.iteration_count
    c, normal = rows.values(answer.optimum.x), rows.jacobian(answer.optimum.x)
    left = problem.relative_violations(answer.optimum.x, c, normal).max(initial=0.0)
    return FeasibilityAnswer(
        answer.optimum.x,
        is_feasible=bool(left <= search.tolerance),
        is_proven=answer.status == Status.CONVERGED,
    )
