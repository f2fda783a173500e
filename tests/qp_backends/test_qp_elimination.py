from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_qp import epigraph
from scipy import sparse

from qp_backends import BackendError, Problem, accuracy, eliminate, solve
from qp_backends.elimination import restore


def objective(problem, x):
    return 0.5 * x @ problem.P @ x + problem.q @ x


@pytest.mark.parametrize("stored", [np.array, sparse.csc_array])
def test_with_the_row_that_is_active_it_is_the_same_problem(stored):
    """Any row with a positive multiplier may be fixed: it holds with equality anyway."""
    given = epigraph(np.random.default_rng(0), 12, 9, curvature=1e-3)
    problem = Problem(stored(given.P), given.q, stored(given.A), given.l, given.u)
    exact = solve(given, "daqp")
    for active in np.flatnonzero(exact.y[:6] > 1e-6):
        elimination = eliminate(problem, int(active))
        assert elimination.problem.q.size == 11
        smaller = solve(elimination.problem, "daqp")
        answer = restore(elimination, smaller)
        assert accuracy(problem, answer).worst < 1e-10
        assert_allclose(answer.x, exact.x, rtol=0, atol=1e-8)
        assert_allclose(answer.y, exact.y, rtol=0, atol=1e-8)


def test_the_rows_are_those_of_the_paper():
    """(gᵢ - g_I)'d ≤ F_I - F_i, gradient g_I; paper M eq. 20, 22, 25, 27."""
    rng = np.random.default_rng(1)
    g, F = rng.normal(size=(3, 4)), np.array([1.0, 3.0, 2.0])
    H = np.eye(5) * [1, 2, 3, 4, 0]
    A = np.hstack([g, -np.ones((3, 1))])
    problem = Problem(H, np.eye(5)[4], A, np.full(3, -np.inf), F.max() - F)
    elimination = eliminate(problem)
    assert elimination.active == 1  # the largest F
    assert_allclose(elimination.problem.A, g[[0, 2]] - g[1], rtol=0, atol=1e-15)
    assert_allclose(elimination.problem.u, F[1] - F[[0, 2]], rtol=0, atol=1e-15)
    assert_allclose(elimination.problem.q, g[1], rtol=0, atol=1e-15)
    assert_allclose(elimination.problem.P, H[:4, :4], rtol=0, atol=1e-15)


def test_it_is_a_restriction():
    """Its objective is never better, and worse where the fixed row is not active."""
    rng = np.random.default_rng(2)
    worse = 0
    for _ in range(20):
        problem = epigraph(rng, 6, 5)
        exact = solve(problem, "daqp")
        elimination = eliminate(problem)
        answer = restore(elimination, solve(elimination.problem, "daqp"))
        best, found = objective(problem, exact.x), objective(problem, answer.x)
        assert accuracy(problem, answer).primal < 1e-9
        assert found >= best - 1e-9
        if found > best + 1e-6:
            worse += 1
            assert answer.y[elimination.active] < 0  # the multiplier tells
    assert worse > 0


def test_what_is_not_an_epigraph_problem_is_refused():
    plain = Problem(np.eye(2), np.ones(2), np.eye(2), np.zeros(2), np.ones(2))
    with pytest.raises(BackendError, match="not an epigraph problem"):
        eliminate(plain)
    coupled = Problem([[1, 0.5], [0.5, 1]], [0, 1], [[1, -1]], [-np.inf], [0])
    with pytest.raises(BackendError, match="couples"):
        eliminate(coupled)
    with pytest.raises(BackendError, match="row 8"):
        eliminate(epigraph(np.random.default_rng(0)), 8)
