from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_qp import epigraph

from qp_backends import Problem, solve

pytest.importorskip("cvxpy")
import cvxpy as cp

from qp_backends import via_cvxpy


@pytest.mark.parametrize("name", via_cvxpy.solvers())
def test_each_of_its_solvers_gives_x_and_multipliers(name):
    x = cp.Variable()
    try:
        cp.Problem(cp.Minimize(x**2), [x >= 1.0]).solve(solver=name)
    except Exception as error:
        pytest.skip(f"cvxpy lists {name} and cannot run it: {type(error).__name__}")
    problem = epigraph(np.random.default_rng(0))
    exact = solve(problem, "daqp")
    solution = solve(problem, f"cvxpy:{name}", fallback=False)
    assert solution.solved
    assert_allclose(solution.x, exact.x, rtol=0, atol=1e-5 * np.abs(exact.x).max())
    assert_allclose(solution.y, exact.y, rtol=0, atol=1e-5)


def test_problems_of_one_shape_share_a_compiled_model():
    """The second problem is solved with its own data, not with those of the first."""
    via_cvxpy._compiled.cache_clear()
    rng = np.random.default_rng(1)
    for _ in range(3):
        problem = epigraph(rng, 10, 5)
        solution = solve(problem, "cvxpy:CLARABEL", fallback=False)
        assert_allclose(solution.x, solve(problem, "daqp").x, rtol=0, atol=1e-5)
    assert via_cvxpy._compiled.cache_info().misses == 1
    assert via_cvxpy._compiled.cache_info().hits == 2


def test_its_model_is_disciplined_parametrised():
    assert via_cvxpy._compiled(4, 3, 2).problem.is_dcp(dpp=True)


def test_large_problems_are_modelled_with_constants(monkeypatch):
    monkeypatch.setattr(via_cvxpy, "LARGEST_COMPILED", 0)
    rng = np.random.default_rng(2)
    A, x = rng.normal(size=(4, 6)), rng.normal(size=6)
    problem = Problem(np.diag([1.0, 2, 3, 4, 5, 0]), np.ones(6), A, A @ x, A @ x + [0, 1, 0, 1])
    bounded = Problem(problem.P, problem.q - problem.A[0], problem.A, problem.l, problem.u)
    solution = solve(bounded, "cvxpy:CLARABEL")
    assert solution.status is solve(bounded, "daqp").status
