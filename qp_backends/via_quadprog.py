"""quadprog without qpsolvers in between, where that is simple: "quadprog:direct".

At the size of an SQP step qpsolvers' bookkeeping costs as much as the solve.  What quadprog does
not take directly (sparse matrices, equalities, rows open above, P without curvature, a tight
clock) goes through qpsolvers.
"""

from __future__ import annotations

import math
import time

import quadprog

from .problem import COLD, Problem, Solution, Status
from .traits import TRAITS


def solve(
    problem: Problem,
    *,
    method: str = "quadprog",
    tolerance: float = 1e-8,
    time_limit: float = math.inf,
    warm_start: Solution = COLD,
) -> Solution:
    """The answer of quadprog [Goldfarb and Idnani 1983], not yet judged."""
    start = time.perf_counter()
    m, n = problem.l.size, problem.q.size
    hurry = TRAITS["quadprog"].pace * (m + n) ** 3
    if m and time_limit >= hurry and not problem.has_sparse and problem.boxed:
        rows, bound, below = problem.above
        try:
            x, _, _, steps, y, _ = quadprog.solve_qp(problem.P, -problem.q, rows.T, bound, 0)
        except ValueError:  # no curvature somewhere, or contradicting rows: told apart there
            pass
        else:
            lower, y = y[m:], y[:m]
            y[below] -= lower
            seconds = time.perf_counter() - start
            return Solution(x, y, Status.SOLVED, seconds, iterations=int(steps[0]))
    from . import via_qpsolvers  # it loads every solver that is installed

    return via_qpsolvers.solve(
        problem,
        method=method,
        tolerance=tolerance,
        time_limit=time_limit,
        warm_start=warm_start,
    )
