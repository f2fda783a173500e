from __future__ import annotations

import time

import numpy as np
from numpy.testing import assert_allclose
from problems_qp import epigraph

from qp_backends import Problem, Status, child, solve
from qp_backends.problem import COLD

VIA = "qp_backends.via_qpsolvers"


def test_the_answer_from_another_process_is_the_same():
    problem = epigraph(np.random.default_rng(0))
    here = solve(problem, "quadprog", fallback=False)
    there = child.run(VIA, problem, "quadprog", 1e-8, 60.0, COLD)
    assert there.status is Status.SOLVED
    assert_allclose(there.x, here.x, rtol=0, atol=1e-9)


def test_a_failure_in_the_process_is_told():
    there = child.run("qp_backends.nothing", epigraph(np.random.default_rng(0)), "", 1, 60.0, COLD)
    assert there.status is Status.FAILED
    assert "No module named" in there.notes[-1]


def test_a_solver_without_a_clock_is_stopped_in_time():
    """quadprog would take minutes for this one, and nothing in it looks at a clock."""
    rng = np.random.default_rng(1)
    n = 1800
    problem = Problem(
        np.eye(n), rng.normal(size=n), rng.normal(size=(n, n)), -np.ones(n), np.ones(n)
    )
    start = time.perf_counter()
    solution = solve(problem, "quadprog", time_limit=1.0, fallback=False)
    assert solution.status is Status.TIME_LIMIT
    assert time.perf_counter() - start < 30.0  # on a loaded machine, too
