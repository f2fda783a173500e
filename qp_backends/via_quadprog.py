"""quadprog without qpsolvers in between, where that is simple.

At the size of an SQP step qpsolvers' bookkeeping costs as much as the solve.  What quadprog does
not take directly (sparse matrices, equalities, P without curvature, a tight clock) goes through
qpsolvers as before.
"""

from __future__ import annotations

import math
import time

import numpy as np
import quadprog

from . import via_qpsolvers
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
    low, high = problem.l, problem.u
    hurried = time_limit < TRAITS["quadprog"].pace * sum(problem.A.shape) ** 3
    if low.size and not (hurried or problem.has_sparse or (low == high).any()):
        above, below = high < np.inf, low > -np.inf
        A = problem.A
        rows = np.concatenate([-A[above], A[below]])  # quadprog wants rows x >= bound
        bound = np.concatenate([-high[above], low[below]])
        try:
            x, _, _, steps, lagrange, _ = quadprog.solve_qp(problem.P, -problem.q, rows.T, bound, 0)
        except ValueError:  # no curvature somewhere, or contradicting rows: told apart there
            pass
        else:
            y = np.zeros(low.shape)
            count = np.count_nonzero(above)
            y[above] = lagrange[:count]
            y[below] -= lagrange[count:]
            return Solution(
                x, y, Status.SOLVED, time.perf_counter() - start, iterations=int(steps[0])
            )
    return via_qpsolvers.solve(
        problem,
        method=method,
        tolerance=tolerance,
        time_limit=time_limit,
        warm_start=warm_start,
    )
