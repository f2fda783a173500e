"""DAQP without qpsolvers in between.

DAQP takes l ≤ Ax ≤ u as it is, says why it failed and has a clock; qpsolvers hides
the first two and doubles the two-sided rows, which costs half as much as the whole solve at the
size of an SQP step.  Sparse problems, most of whose rows are bounds, do go through qpsolvers.
"""

from __future__ import annotations

import math
import time

import daqp
import numpy as np

from .problem import COLD, Problem, Solution, Status
from .traits import TRAITS, settings

FLAGS = {
    -1: Status.INFEASIBLE,
    -3: Status.UNBOUNDED,
    -4: Status.ITERATION_LIMIT,
    -7: Status.TIME_LIMIT,
}


def solve(
    problem: Problem,
    *,
    method: str = "daqp",
    tolerance: float = 1e-8,
    time_limit: float = math.inf,
    warm_start: Solution = COLD,
) -> Solution:
    """The answer of DAQP [Arnstrom 2022], not yet judged."""
    if problem.has_sparse:
        from . import via_qpsolvers  # it loads every solver that is installed

        return via_qpsolvers.solve(
            problem,
            method="daqp",
            tolerance=tolerance,
            time_limit=time_limit,
            warm_start=warm_start,
        )
    start = time.perf_counter()
    chosen = settings("daqp", tolerance, time_limit)
    warm = warm_start.y.size == problem.l.size > 0 and bool(np.isfinite(warm_start.y).all())
    if warm:
        chosen["dual_start"] = warm_start.y
    A, l, u, row = problem.A, problem.l, problem.u, problem.row_norm  # noqa: E741
    scaled = row.min(initial=1.0) < TRAITS["daqp"].shortest
    if scaled:
        A, l, u = A / row[:, None], l / row, u / row  # noqa: E741
    x, _, flag, info = daqp.solve(problem.P, problem.q, A, u, l, **chosen)
    status = Status.SOLVED if flag > 0 else FLAGS.get(flag, Status.FAILED)
    return Solution(
        x,
        info["lam"] / row if scaled else info["lam"],
        status,
        time.perf_counter() - start,
        iterations=info["iterations"],
        warm=warm,
    )
