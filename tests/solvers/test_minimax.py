from __future__ import annotations

from dataclasses import replace
from functools import partial

import cvxpy as cp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems_fit import solve
from scipy import optimize

import minimax_cal as mc
from experiments.speed import identify_parameters
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.minimax_problem import (
    MinimaxProblem,
    TargetDistanceLimits,
    build_minimax_problem,
    measured_distances,
)
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.solvers import dual_bound, iterate, minimax
from minimax_cal.solvers.dual_bound import (
    LinearisedNorms,
    NormMultipliers,
    align_multipliers_with_residuals,
    convert_squared_norm_multipliers,
    dual_lower_bound,
    dual_value,
    relative_duality_gap,
    restore_stationarity,
)
from minimax_cal.solvers.epigraph_qp import ignore_warm_start
from minimax_cal.solvers.minimax import Sqp
from minimax_cal.solvers.status import Status
from qp_backends import solve as solve_qp

# ---- minimax -------------------------------------------------------------------------------------


def worst_target(
    model: PointModel, x: ParameterValues, distances: TargetDistanceLimits, form: str
) -> MinimaxProblem:
    return build_minimax_problem(model, x, distances, form, "target")


def warm(robot: mc.Robot, data: mc.Measurements) -> tuple[PointModel, ParameterValues]:
    model, begin = identify_parameters(robot, data)
    return model, solve(model, begin).x.take(np.array(0))


def run(problem, x, backend: str = "daqp", **settings: object):
    qp = partial(solve_qp, name=backend, tolerance=1e-9)
    return minimax.solve(problem, x, qp, Sqp(**settings))


def test_derivatives_of_the_calibration_problem(robot, noisy):
    model, x = warm(robot, noisy.data)
    for form in ("two-sided", "squared", "off"):
        problem = worst_target(model, x, measured_distances(noisy.data), form)
        rng = np.random.default_rng(0)
        d = rng.normal(size=model.active.sum()) * 0.3
        at = problem.step(x, d)
        here = problem.linearise(at)
        step = 1e-5  # squared distances of 1e5 mm2 lose 1e-11 to rounding
        for _ in range(5):
            e = rng.normal(size=len(d))
            plus = problem.evaluate(problem.step(at, step * e))
            minus = problem.evaluate(problem.step(at, -step * e))
            f, c = ((p - m) / (2 * step) for p, m in zip(plus, minus, strict=True))
            assert_allclose(here.jacobian @ e, f, rtol=1e-6, atol=1e-6)
            assert_allclose(here.normal @ e, c, rtol=1e-6, atol=1e-6)


def slsqp_value(problem: MinimaxProblem, x: ParameterValues) -> float:
    size = int(problem.model.active.sum())

    def inequality(u: np.ndarray) -> np.ndarray:
        f, c = problem.evaluate(problem.step(x, u[:size]))
        return np.concatenate([u[size] - f, c - problem.lower, problem.upper - c])

    found = optimize.minimize(
        lambda u: u[size],
        np.append(np.zeros(size), 1.0),
        method="SLSQP",
        constraints=[{"type": "ineq", "fun": inequality}],
        options={"maxiter": 500, "ftol": 1e-13},
    )
    return float(problem.evaluate(problem.step(x, found.x[:size]))[0].max())


def test_value_is_slsqps(robot, noisy):
    model, x = warm(robot, noisy.data)
    problem = worst_target(model, x, measured_distances(noisy.data), "two-sided")
    ours, theirs = run(problem, x).value, slsqp_value(problem, x)
    assert ours <= theirs * (1.0 + 1e-6)
    assert_allclose(ours, theirs, rtol=1e-3)


@pytest.mark.parametrize("form", ["two-sided", "squared", "off"])
@pytest.mark.parametrize("hessian", ["gauss-newton", "bfgs"])
def test_forms_and_hessians_agree(form, hessian, robot, noisy):
    model, x = warm(robot, noisy.data)
    problem = worst_target(model, x, measured_distances(noisy.data), form)
    found = run(problem, x, hessian=hessian)
    reference = run(worst_target(model, x, measured_distances(noisy.data), "two-sided"), x)
    assert found.status is Status.CONVERGED
    if form == "off":
        assert found.value <= reference.value * (1 + 1e-9)
    else:
        assert_allclose(found.value, reference.value, rtol=1e-7)


def test_tight_distances_are_kept(robot, noisy):
    """Distances that disagree with the points by 50 um bind, and hold to their tolerance."""
    model, x = warm(robot, noisy.data)
    measured = measured_distances(noisy.data, 1e-6)
    measured = replace(measured, mean=measured.mean + np.array([5e-5, -5e-5, 0.0]))
    problem = worst_target(model, x, measured, "two-sided")
    free = run(worst_target(model, x, measured, "off"), x)
    found = run(problem, x)
    assert found.status is Status.CONVERGED
    deviation = problem.constraint_values_and_jacobian(found.x)[0]
    assert np.abs(problem.constraint_values_and_jacobian(free.x)[0]).max() > 1.0  # it really binds
    assert np.abs(deviation).max() <= 1.0 + 1e-7
    assert np.abs(found.lam).max() > 0.0
    assert found.value >= free.value * (1 - 1e-9)


def test_a_qp_solver_that_fails_ends_in_a_status(robot, noisy):
    from qp_backends import Solution
    from qp_backends import Status as QpStatus

    model, x = warm(robot, noisy.data)
    problem = worst_target(model, x, measured_distances(noisy.data), "two-sided")

    def broken(qp, warm_start=None):
        nothing = np.full(len(qp.q), np.nan), np.full(len(qp.l), np.nan)
        return Solution(*nothing, QpStatus.FAILED, 0.0)

    found = minimax.solve(problem, x, broken)
    assert found.status is Status.FAILED
    assert found.x is x


def test_qps_of_some_functions_are_those_of_all(robot, noisy, monkeypatch):
    """The worst of many points: the QPs that begin with a few take the same steps."""
    model, x = warm(robot, noisy.data)
    problem = build_minimax_problem(model, x, measured_distances(noisy.data), "two-sided", "point")
    qp = partial(solve_qp, name="daqp", tolerance=1e-10)
    few = minimax.solve(problem, x, qp)
    asked = []
    monkeypatch.setattr(iterate, "WORKING_SET_FUNCTIONS_PER_UNKNOWN", len(few.f))
    counted = ignore_warm_start(lambda one: (asked.append(len(one.l)), qp(one))[1])
    whole = minimax.solve(problem, x, counted)
    assert len(few.f) > 4 * int(model.active.sum())
    assert min(asked) == len(few.f) + len(few.c)
    assert few.iterations == whole.iterations
    assert_allclose(few.x.mdh, whole.x.mdh, rtol=0, atol=1e-11)
    assert_allclose(few.mu, whole.mu, rtol=0, atol=1e-8)


# ---- dual bound ----------------------------------------------------------------------------------


Problem = tuple[LinearisedNorms, Array, Array]


def made(seed: int) -> Problem:
    """Nine vectors in space, four variables, a constraint from below, above, on both sides."""
    rng = np.random.default_rng(seed)
    rows = LinearisedNorms(rng.normal(size=(9, 3)) + 1.0, rng.normal(size=(9, 3, 4)),
                rng.normal(size=3), rng.normal(size=(3, 4)))  # fmt: skip
    lower, upper = np.array([[-0.1, -np.inf, -0.05], [np.inf, 0.1, 0.05]])
    return rows, rows.c + lower, rows.c + upper


def optimum(problem: Problem) -> tuple[float, NormMultipliers]:
    """The least largest norm, and its multipliers, by Clarabel."""
    rows, lower, upper = problem
    d, t = cp.Variable(4), cp.Variable()
    cones = [cp.SOC(t, r + J @ d) for r, J in zip(rows.r, rows.J, strict=True)]
    above = [rows.c[i] + rows.C[i] @ d >= lower[i] for i in (0, 2)]
    below = [rows.c[i] + rows.C[i] @ d <= upper[i] for i in (1, 2)]
    cp.Problem(cp.Minimize(t), [*cones, *above, *below]).solve(solver=cp.CLARABEL)
    y = -np.array([np.ravel(cone.dual_value[1]) for cone in cones])
    (a, b), (c, e) = ([float(one.dual_value) for one in part] for part in (above, below))
    return float(t.value), NormMultipliers(y, np.array([-a, c, e - b]))


@pytest.mark.parametrize("seed", range(4))
def test_the_right_multipliers_prove_the_optimum(seed):
    problem = made(seed)
    best, right = optimum(problem)
    bound = dual_lower_bound(*problem, right)
    assert bound <= best * (1.0 + 1e-9)
    assert_allclose(bound, best, rtol=1e-5)
    for factor in (1e-3, 7.0):  # their size is not believed
        scaled = NormMultipliers(factor * right.y, factor * right.lam)
        assert_allclose(dual_lower_bound(*problem, scaled), bound, rtol=1e-9)


def test_the_bound_has_the_unit_of_the_norms():
    rows, lower, upper = made(0)
    _, right = optimum((rows, lower, upper))
    bound = dual_lower_bound(rows, lower, upper, right)
    for unit in (1e-6, 1e6):
        there = LinearisedNorms(unit * rows.r, unit * rows.J, rows.c, rows.C)
        same = NormMultipliers(right.y, unit * right.lam)
        assert_allclose(dual_lower_bound(there, lower, upper, same), unit * bound, rtol=1e-9)


def test_what_pulls_along_an_open_direction_proves_nothing():
    """No vector moves with the last variable, and a constraint does: its multiplier is worthless.

    However little it pulls, as the sum then falls for ever along that direction.
    """
    rows, lower, upper = made(0)
    _, right = optimum((rows, lower, upper))
    J, C = rows.J.copy(), rows.C.copy()
    J[:, :, 3], C[:, 3] = 0.0, 0.0
    C[0, 3] = 1e-12
    free, lam = LinearisedNorms(rows.r, J, rows.c, C), np.array([-1.0, 0.0, 0.0])
    given = NormMultipliers(restore_stationarity(free, right.y, lam), lam)
    at_rest = replace(given, y=given.y / np.linalg.norm(given.y, axis=1).sum(), lam=0.0 * lam)
    assert dual_value(free, lower, upper, at_rest, 0.0) > 0.1
    assert dual_lower_bound(free, lower, upper, given) == 0.0


def test_no_multipliers_prove_too_much():
    rng = np.random.default_rng(5)
    problem = made(1)
    best, right = optimum(problem)
    for size in (1e-6, 1e-3, 0.1, 10.0):
        for _ in range(10):
            wrong = NormMultipliers(right.y + size * rng.normal(size=(9, 3)),
                                right.lam + size * rng.normal(size=3))  # fmt: skip
            assert 0.0 <= dual_lower_bound(*problem, wrong) <= best * (1.0 + 1e-9)
    nothing = NormMultipliers(np.zeros((9, 3)), np.zeros(3))
    assert dual_lower_bound(*problem, nothing) == 0.0


def test_what_is_not_balanced_is_charged_over_the_ball(monkeypatch):
    rows, lower, upper = made(2)
    rows = LinearisedNorms(rows.r, 0.1 * rows.J, rows.c, 0.1 * rows.C)
    _, right = optimum((rows, lower, upper))
    off = NormMultipliers(right.y + 1e-4, right.lam)
    monkeypatch.setattr(dual_bound, "restore_stationarity", lambda rows, y, lam: y)
    total = np.linalg.norm(off.y, axis=1).sum()
    given = NormMultipliers(off.y / total, off.lam / total)
    free = dual_value(rows, lower, upper, given, 0.0)
    least = np.linalg.svd(rows.J.reshape(27, 4), compute_uv=False)[-1]
    reach = np.sqrt(((free + np.linalg.norm(rows.r, axis=1)) ** 2).sum()) / least
    rest = np.linalg.norm(np.einsum("nw,nwp->p", given.y, rows.J) + rows.C.T @ given.lam)
    assert_allclose(dual_lower_bound(rows, lower, upper, off), free - reach * rest, rtol=1e-9)
    assert reach * rest > 1e-4


def test_the_dual_value_is_its_formula():
    rows, lower, upper = made(3)
    y, lam = np.full((9, 3), 0.1 / np.sqrt(3.0)), np.array([-0.2, 0.3, 0.0])
    rest = np.linalg.norm(np.einsum("nw,nwp->p", y, rows.J) + rows.C.T @ lam)
    value = (y * rows.r).sum() - 0.2 * (rows.c - lower)[0] + 0.3 * (rows.c - upper)[1]
    for size in (0.5, 1.0):  # the norms sum to less than one: left as they are
        found = dual_value(rows, lower, upper, NormMultipliers(size * y, size * lam), 0.4)
        assert_allclose(found, size * (value - 0.4 * rest), rtol=1e-12)
    found = dual_value(rows, lower, upper, NormMultipliers(5.0 * y, 5.0 * lam), 0.4)
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
    found = restore_stationarity(rows, y, lam)
    assert_allclose(found, moved, rtol=0, atol=1e-9)
    assert_allclose(found[4:], moved[4:], rtol=1e-6)
    assert_allclose(flat.T @ found.ravel() + rows.C.T @ lam, 0.0, atol=1e-12)


def test_multipliers_lie_along_the_vectors():
    rows, _, _ = made(0)
    rows = LinearisedNorms(np.concatenate([np.zeros((1, 3)), rows.r[1:]]), rows.J, rows.c, rows.C)
    mu, lam = np.arange(9.0), np.array([1.0, -2.0, 0.0])
    found = align_multipliers_with_residuals(rows, mu, lam)
    assert_allclose(np.linalg.norm(found.y, axis=1), mu / 36.0, rtol=1e-14)
    assert_allclose((found.y * rows.r).sum(axis=1), mu / 36.0 * rows.norms, rtol=1e-14)
    assert_allclose(found.lam, lam / 36.0, rtol=1e-14)
    squared, same = (
        convert_squared_norm_multipliers(rows, mu, lam),
        align_multipliers_with_residuals(rows, 2.0 * mu * rows.norms, lam),
    )
    assert_array_equal(squared.y, same.y)
    assert (relative_duality_gap(0.5, 0.25), relative_duality_gap(0.0, 0.0)) == (0.5, 0.0)
