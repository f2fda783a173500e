"""The bound against optima of a conic solver, and its parts against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minimax_cal.ground.arrays import Array
from minimax_cal.solvers import dual_bound
from minimax_cal.solvers.dual_bound import (
    Multipliers,
    Rows,
    aligned,
    balanced,
    dual_value,
    gap_of,
    lower_bound,
    of_squares,
)

Problem = tuple[Rows, Array, Array]


def made(seed: int) -> Problem:
    """Nine vectors in space, four variables, a constraint from below, above, on both sides."""
    rng = np.random.default_rng(seed)
    rows = Rows(rng.normal(size=(9, 3)) + 1.0, rng.normal(size=(9, 3, 4)),
                rng.normal(size=3), rng.normal(size=(3, 4)))  # fmt: skip
    lower, upper = np.array([[-0.1, -np.inf, -0.05], [np.inf, 0.1, 0.05]])
    return rows, rows.c + lower, rows.c + upper


def optimum(problem: Problem) -> tuple[float, Multipliers]:
    """The least largest norm, and its multipliers, by Clarabel."""
    rows, lower, upper = problem
    d, t = cp.Variable(4), cp.Variable()
    cones = [cp.SOC(t, r + J @ d) for r, J in zip(rows.r, rows.J, strict=True)]
    above = [rows.c[i] + rows.C[i] @ d >= lower[i] for i in (0, 2)]
    below = [rows.c[i] + rows.C[i] @ d <= upper[i] for i in (1, 2)]
    cp.Problem(cp.Minimize(t), [*cones, *above, *below]).solve(solver=cp.CLARABEL)
    y = -np.array([np.ravel(cone.dual_value[1]) for cone in cones])
    (a, b), (c, e) = ([float(one.dual_value) for one in part] for part in (above, below))
    return float(t.value), Multipliers(y, np.array([-a, c, e - b]))


@pytest.mark.parametrize("seed", range(4))
def test_the_right_multipliers_prove_the_optimum(seed):
    problem = made(seed)
    best, right = optimum(problem)
    bound = lower_bound(*problem, right)
    assert bound <= best * (1.0 + 1e-9)
    assert_allclose(bound, best, rtol=1e-5)
    for factor in (1e-3, 7.0):  # their size is not believed
        scaled = Multipliers(factor * right.y, factor * right.lam)
        assert_allclose(lower_bound(*problem, scaled), bound, rtol=1e-9)


def test_the_bound_has_the_unit_of_the_norms():
    rows, lower, upper = made(0)
    _, right = optimum((rows, lower, upper))
    bound = lower_bound(rows, lower, upper, right)
    for unit in (1e-6, 1e6):
        there = Rows(unit * rows.r, unit * rows.J, rows.c, rows.C)
        same = Multipliers(right.y, unit * right.lam)
        assert_allclose(lower_bound(there, lower, upper, same), unit * bound, rtol=1e-9)


def test_what_pulls_along_an_open_direction_proves_nothing():
    """No vector moves with the last variable, and a constraint does: its multiplier is worthless.

    However little it pulls, as the sum then falls for ever along that direction.
    """
    rows, lower, upper = made(0)
    _, right = optimum((rows, lower, upper))
    J, C = rows.J.copy(), rows.C.copy()
    J[:, :, 3], C[:, 3] = 0.0, 0.0
    C[0, 3] = 1e-12
    free, lam = Rows(rows.r, J, rows.c, C), np.array([-1.0, 0.0, 0.0])
    given = Multipliers(balanced(free, right.y, lam), lam)
    at_rest = replace(given, y=given.y / np.linalg.norm(given.y, axis=1).sum(), lam=0.0 * lam)
    assert dual_value(free, lower, upper, at_rest, 0.0) > 0.1
    assert lower_bound(free, lower, upper, given) == 0.0


def test_no_multipliers_prove_too_much():
    rng = np.random.default_rng(5)
    problem = made(1)
    best, right = optimum(problem)
    for size in (1e-6, 1e-3, 0.1, 10.0):
        for _ in range(10):
            wrong = Multipliers(right.y + size * rng.normal(size=(9, 3)),
                                right.lam + size * rng.normal(size=3))  # fmt: skip
            assert 0.0 <= lower_bound(*problem, wrong) <= best * (1.0 + 1e-9)
    nothing = Multipliers(np.zeros((9, 3)), np.zeros(3))
    assert lower_bound(*problem, nothing) == 0.0


def test_what_is_not_balanced_is_charged_over_the_ball(monkeypatch):
    rows, lower, upper = made(2)
    rows = Rows(rows.r, 0.1 * rows.J, rows.c, 0.1 * rows.C)
    _, right = optimum((rows, lower, upper))
    off = Multipliers(right.y + 1e-4, right.lam)
    monkeypatch.setattr(dual_bound, "balanced", lambda rows, y, lam: y)
    total = np.linalg.norm(off.y, axis=1).sum()
    given = Multipliers(off.y / total, off.lam / total)
    free = dual_value(rows, lower, upper, given, 0.0)
    least = np.linalg.svd(rows.J.reshape(27, 4), compute_uv=False)[-1]
    reach = np.sqrt(((free + np.linalg.norm(rows.r, axis=1)) ** 2).sum()) / least
    rest = np.linalg.norm(np.einsum("nw,nwp->p", given.y, rows.J) + rows.C.T @ given.lam)
    assert_allclose(lower_bound(rows, lower, upper, off), free - reach * rest, rtol=1e-9)
    assert reach * rest > 1e-4


def test_the_dual_value_is_its_formula():
    rows, lower, upper = made(3)
    y, lam = np.full((9, 3), 0.1 / np.sqrt(3.0)), np.array([-0.2, 0.3, 0.0])
    rest = np.linalg.norm(np.einsum("nw,nwp->p", y, rows.J) + rows.C.T @ lam)
    value = (y * rows.r).sum() - 0.2 * (rows.c - lower)[0] + 0.3 * (rows.c - upper)[1]
    for size in (0.5, 1.0):  # the norms sum to less than one: left as they are
        found = dual_value(rows, lower, upper, Multipliers(size * y, size * lam), 0.4)
        assert_allclose(found, size * (value - 0.4 * rest), rtol=1e-12)
    found = dual_value(rows, lower, upper, Multipliers(5.0 * y, 5.0 * lam), 0.4)
    assert_allclose(found, (value - 0.4 * rest) / 0.9, rtol=1e-12)  # 5 over a sum of 4.5
    assert rest > 0.1


def test_balance_is_the_least_weighted_change():
    """min sum |dy|^2 / w over J'(y + dy) + C'lam = 0, w the size and a part in 1e6 of the mean."""
    rows, _, _ = made(4)
    rng = np.random.default_rng(6)
    y, lam = rng.normal(size=(9, 3)), rng.normal(size=3)
    y[4:] = 0.0
    size = np.linalg.norm(y, axis=1)
    w, flat = np.repeat(size + 1e-6 * size.mean(), 3), rows.J.reshape(27, 4)
    kkt = np.block([[np.diag(1.0 / w), flat], [flat.T, np.zeros((4, 4))]])
    right = np.concatenate([np.zeros(27), -flat.T @ y.ravel() - rows.C.T @ lam])
    moved = y + np.linalg.solve(kkt, right)[:27].reshape(9, 3)
    found = balanced(rows, y, lam)
    assert_allclose(found, moved, rtol=0, atol=1e-9)
    assert_allclose(found[4:], moved[4:], rtol=1e-6)
    assert_allclose(flat.T @ found.ravel() + rows.C.T @ lam, 0.0, atol=1e-12)


def test_multipliers_lie_along_the_vectors():
    rows, _, _ = made(0)
    rows = Rows(np.concatenate([np.zeros((1, 3)), rows.r[1:]]), rows.J, rows.c, rows.C)
    mu, lam = np.arange(9.0), np.array([1.0, -2.0, 0.0])
    found = aligned(rows, mu, lam)
    assert_allclose(np.linalg.norm(found.y, axis=1), mu / 36.0, rtol=1e-14)
    assert_allclose((found.y * rows.r).sum(axis=1), mu / 36.0 * rows.norms, rtol=1e-14)
    assert_allclose(found.lam, lam / 36.0, rtol=1e-14)
    squared, same = of_squares(rows, mu, lam), aligned(rows, 2.0 * mu * rows.norms, lam)
    assert_array_equal(squared.y, same.y)
    assert (gap_of(0.5, 0.25), gap_of(0.0, 0.0)) == (0.5, 0.0)
