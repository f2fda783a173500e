"""Least squares between bounds against cvxpy."""

import cvxpy as cp
import numpy as np
import scipy
from numpy.testing import assert_allclose

from minimax_cal.solvers.bounded import bounded, nearest


def test_a_bounded_step_is_the_optimum(rng):
    root = rng.normal(size=(12, 9))
    gram, pull = root.T @ root, 5.0 * rng.normal(size=9)
    low, high = np.full(9, -np.inf), np.full(9, np.inf)
    low[:4], high[2:6] = -0.05, 0.02
    x = cp.Variable(9)
    cost = cp.quad_form(x, cp.psd_wrap(gram)) - 2.0 * pull @ x
    cp.Problem(cp.Minimize(cost), [x[:4] >= -0.05, x[2:6] <= 0.02]).solve(solver=cp.CLARABEL)
    assert_allclose(bounded(gram, pull, low, high), x.value, atol=1e-6)
    free = bounded(gram, pull, np.full(9, -np.inf), np.full(9, np.inf))
    assert_allclose(free, np.linalg.solve(gram, pull), rtol=1e-6)


def test_columns_that_are_the_same_share_their_part(rng):
    """Products of rank 3 in 5 parameters: any split of a sum is as good, and none is infinite."""
    matrix = rng.normal(size=(12, 3))[:, [0, 1, 2, 0, 1]]
    right = 3.0 * rng.normal(size=12)
    low, high = np.array([-np.inf, -np.inf, 0.0, 0.0, 0.0]), np.full(5, np.inf)
    x = bounded(matrix.T @ matrix, matrix.T @ right, low, high)
    y = cp.Variable(5)
    best = cp.Problem(cp.Minimize(cp.sum_squares(matrix @ y - right)), [y[2:] >= 0.0])
    best.solve(solver=cp.CLARABEL)
    assert (x >= low - 1e-12).all()
    assert_allclose(np.sum((matrix @ x - right) ** 2), best.value, rtol=1e-5)


def test_a_compiled_solver_that_gives_up_is_replaced(rng, monkeypatch):
    matrix, target = rng.normal(size=(5, 5)), rng.normal(size=5)
    low, high = np.full(5, -0.1), np.full(5, np.inf)
    fast = nearest(matrix, target, low, high)

    def stopped(*given: object, **more: object) -> None:
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(scipy.optimize, "nnls", stopped)
    assert_allclose(nearest(matrix, target, low, high), fast, rtol=0, atol=1e-9)
