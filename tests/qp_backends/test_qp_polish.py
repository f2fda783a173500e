from __future__ import annotations

import numpy as np
import pytest
from problems_qp import epigraph, random_problem
from scipy import sparse

from qp_backends import Problem, Solution, Status, accuracy, solve
from qp_backends.polish import polish


@pytest.mark.parametrize("stored", [np.array, sparse.csc_array])
@pytest.mark.parametrize("error", [1e-8, 1e-5, 1e-3])
def test_a_nearby_answer_becomes_exact(stored, error):
    rng = np.random.default_rng(0)
    for given in (epigraph(rng, 20, 9), random_problem(rng, rank=8)):
        problem = Problem(stored(given.P), given.q, stored(given.A), given.l, given.u)
        exact = solve(given, "daqp")
        x = exact.x * (1 + error * rng.normal(size=exact.x.size))
        y = exact.y * (1 + error * rng.normal(size=exact.y.size))
        rough = Solution(x, y, Status.INACCURATE, 0.0)
        assert accuracy(problem, rough).worst > error / 100
        assert accuracy(problem, polish(problem, rough)).worst < 1e-11


def test_dependent_active_rows_do_no_harm():
    rows = np.vstack([np.ones((3, 2)), np.eye(2)])
    problem = Problem(np.eye(2), np.zeros(2), rows, np.ones(5) * [1, 1, 1, 0, 0], np.full(5, 9.0))
    rough = Solution(np.array([0.5, 0.5001]), -np.array([0.2, 0.1, 0.2, 0, 0]), Status.SOLVED, 0.0)
    assert accuracy(problem, polish(problem, rough)).worst < 1e-12


@pytest.mark.parametrize("x", [np.full(20, np.nan), np.zeros(20), np.full(20, 1e200)])
def test_an_answer_is_never_made_worse(x):
    problem = epigraph(np.random.default_rng(1), 20, 9)
    bad = Solution(x, np.zeros(9), Status.SOLVED, 0.0)
    assert accuracy(problem, polish(problem, bad)).worst <= accuracy(problem, bad).worst
