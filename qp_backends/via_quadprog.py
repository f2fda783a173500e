"""quadprog without qpsolvers in between, where that is simple.

At the size of an SQP step qpsolvers' bookkeeping costs as much as the solve.  What quadprog does
not take directly (sparse matrices, equalities, rows open above, P without curvature, a tight
clock) goes through qpsolvers.
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
    low, high, A = problem.l, problem.u, problem.A
    m, hurry = low.size, TRAITS["quadprog"].pace * sum(A.shape) ** 3
    below = low > -np.inf
    plain = m and time_limit >= hurry and not problem.has_sparse
    if plain and high.max() < np.inf and not (low == high).any():
        rows = np.concatenate([-A, A[below]])  # quadprog wants rows x >= bound
        bound = np.concatenate([-high, low[below]])
        try:
            x, _, _, steps, y, _ = quadprog.solve_qp(problem.P, -problem.q, rows.T, bound, 0)
        except ValueError:  # no curvature somewhere, or contradicting rows: told apart there
            pass
        else:
            lower, y = y[m:], y[:m]
            y[below] -= lower
            seconds = time.perf_counter() - start
            return Solution(x, y, Status.SOLVED, seconds, iterations=int(steps[0]))
    return via_qpsolvers.solve(
        problem,
        method=method,
        tolerance=tolerance,
        time_limit=time_limit,
        warm_start=warm_start,
    )
