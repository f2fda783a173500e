from __future__ import annotations

from dataclasses import dataclass, replace

import cvxpy as cp
import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose, assert_array_equal
from problems_fit import solve
from scipy import optimize

from experiments.speed import identify_parameters
from minimax_cal.core.arrays import Array
from minimax_cal.modelling import global_start
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares, build_point_model
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.kinematics import rotation_from_vector
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.bounded_least_squares import (
    solve_bounded_least_squares,
    solve_bounded_normal_equations,
)
from minimax_cal.solvers.least_squares import (
    LEAST_SQUARES_METHODS,
    LeastSquaresLimits,
    LeastSquaresMethod,
    compare_trial_costs,
    linearise_iterates,
    solve_normal_equations,
    take_trial_step,
    update_damping_by_nielsen,
)
from minimax_cal.solvers.least_squares import (
    solve as least,
)
from minimax_cal.solvers.status import Status

# ---- least squares -------------------------------------------------------------------------------


@pytest.mark.parametrize("method", LEAST_SQUARES_METHODS)
def test_every_method_reaches_the_same_minimum(method, robot, noisy):
    model, begin = identify_parameters(robot, noisy.data)
    found = solve(model, begin, method)
    best = solve(model, begin)
    assert found.status[0] is Status.CONVERGED
    assert_allclose(found.cost, best.cost, rtol=1e-10)
    assert_allclose(found.x.mdh, best.x.mdh, rtol=0, atol=1e-9)
    assert found.trace[0] > found.trace[-1]


def test_minimum_is_scipys(robot, noisy):
    model, begin = identify_parameters(robot, noisy.data)
    best = solve(model, begin)

    def residual(dx: np.ndarray) -> np.ndarray:
        step = np.zeros(model.names.parameter_count)
        step[model.active] = dx * 1e-3
        return 1e3 * model.point_errors(begin.step(step)).reshape(-1)

    peer = optimize.least_squares(residual, np.zeros(model.active.sum()), xtol=1e-14, ftol=1e-14)
    assert_allclose(best.cost[0] * 1e6, 2 * peer.cost, rtol=1e-9)


def test_many_starts_at_once_equal_each_alone(robot, noisy):
    model, begin = identify_parameters(robot, noisy.data)
    rng = np.random.default_rng(3)
    starts = begin.repeat(5)
    dx = np.zeros((5, model.names.parameter_count))
    dx[:, model.active & ~model.names.linear_mask] = 0.1 * rng.normal(size=(5, 13))
    starts = starts.step(dx)
    points = float(model.pose_counts_by_target.sum())
    together = least_squares.solve(PointLeastSquares(model), starts, 5, points)
    for i in range(5):
        alone = least_squares.solve(PointLeastSquares(model), starts.take(np.array([i])), 1, points)
        assert_allclose(together.cost[i], alone.cost[0], rtol=1e-10)
        # the way is the same until the cost has converged; the last steps are about rounding
        way = alone.trace[:, 0]
        steps = int(np.argmax(way <= (1.0 + 1e-9) * way[-1])) + 1
        assert_allclose(together.trace[:steps, i], way[:steps], rtol=1e-7)


def test_closed_form_start_is_the_best_frame(robot, rng):
    """Base and targets of the nominal robot, against a local search from the truth."""
    for seed in range(5):
        made = simulate(robot, 30, 2, seed)
        model = build_point_model(robot, made.data)
        frame = global_start.fit_base_and_targets(model, robot.mdh)
        chosen = ~model.names.link_mask
        cell = made.cell
        near = ParameterValues(
            robot.mdh, cell.base[:3, :3], cell.base[:3, 3], cell.target_positions
        )
        local = solve(model.with_active(chosen), near)
        points = model.pose_counts_by_target.sum()
        assert_allclose(frame.mean_square * points, local.cost[0], rtol=1e-9)
        assert_allclose(model.target_costs(frame.state).sum(), local.cost[0], rtol=1e-9)


def test_100_random_bases_reach_the_global_minimum(robot):
    for seed in range(100):
        truth = Truth(noise=0, noise_per_metre=0, compliance=0)
        made = simulate(robot, 25, 1 + 2 * (seed % 2), seed, truth)
        model, begin = identify_parameters(robot, made.data)
        found = solve(model, begin)
        miss = np.sqrt(found.cost[0] / model.pose_counts_by_target.sum())
        assert miss < 1e-10, f"seed {seed}: {miss} m"


def test_search_finds_gross_angle_errors(robot):
    """Nominal theta_2 and alpha_3 off by up to 3.1 rad, the tracker anywhere."""
    rng = np.random.default_rng(8)
    for seed in range(4):
        made = simulate(robot, 40, 1, seed, Truth(noise=0, noise_per_metre=0, compliance=0))
        wrong = robot.mdh.copy()
        wrong[1, 2] += rng.uniform(-3.1, 3.1)
        wrong[2, 3] += rng.uniform(-3.1, 3.1)
        model, _ = identify_parameters(robot, made.data)
        found = global_start.search_base_rotations(
            model, wrong, float(model.pose_counts_by_target.sum())
        )
        assert np.sqrt(found.cost[0] / model.pose_counts_by_target.sum()) < 1e-9, f"seed {seed}"


def test_rotation_steps_have_no_gimbal(robot, clean):
    """A base pitched by 90 degrees, where Euler angles are singular."""
    cell = clean.cell
    pitch = rotation_from_vector(np.array([0.0, np.pi / 2, 0.0]))
    data = clean.data.with_y((clean.data.y - cell.base[:3, 3]) @ cell.base[:3, :3] @ pitch.T)
    model, begin = identify_parameters(robot, data)
    found = solve(model, begin)
    assert np.sqrt(found.cost[0] / model.pose_counts_by_target.sum()) < 1e-12


# ---- gauss newton steps --------------------------------------------------------------------------


T = np.linspace(0.0, 3.0, 25)
Y = 2.0 * np.exp(-0.5 * T) - np.exp(-1.7 * T) + 0.05 * np.random.default_rng(1).normal(size=25)
LINEAR = np.array([True, False, True, False])  # r1, w1, r2, w2
BEGIN = np.array([[1.0, 0.7, -0.5, 1.2], [2.5, 0.4, -1.5, 2.0], [1.0, 0.3, 1.0, 2.5]])
DAMPING = np.array([0.3, 0.02, 1.1])


@dataclass(frozen=True, eq=False)
class Points:
    """value: (B, 4)."""

    value: Array

    def take(self, rows: Array) -> Points:
        return Points(self.value[rows])

    def put(self, rows: Array, other: Points) -> Points:
        value = self.value.copy()
        value[rows] = other.value
        return Points(value)


@dataclass(frozen=True)
class Decay:
    """y against r1 exp(-w1 t) + r2 exp(-w2 t).  sense: of the slope that it tells, -1 a lie."""

    linear: Array
    sense: float = 1.0

    def normal(self, x: Points) -> tuple[Array, Array, Array]:
        e, J = np.array([residual(v) for v in x.value]), np.array([jacobian(v) for v in x.value])
        slope, gram = np.einsum("btp,bt->bp", J, e), np.einsum("btp,btq->bpq", J, J)
        return (e**2).sum(axis=1), self.sense * slope, gram

    def reduced(self, x: Points, *, full: bool) -> tuple[Points, Array, Array, Array, Array]:
        best = x.value.copy()
        for v in best:
            v[LINEAR] = np.linalg.lstsq(columns(v[~LINEAR]), Y, rcond=None)[0]
        moved = Points(best)
        # column i of Phi depends on angle i alone
        coupling = [np.diag(-(T[:, None] * columns(v[~LINEAR])).T @ residual(v)) for v in best]
        return moved, *self.normal(moved), np.array(coupling) * full

    def step(self, x: Points, dx: Array) -> Points:
        return Points(x.value + dx)


def columns(w: Array) -> Array:
    return np.exp(-np.outer(T, w))


def residual(v: Array) -> Array:
    return np.asarray(Y - columns(v[~LINEAR]) @ v[LINEAR])


def jacobian(v: Array) -> Array:
    """(25, 4) of the model."""
    basis = columns(v[~LINEAR])
    out = np.empty((len(T), 4))
    out[:, LINEAR], out[:, ~LINEAR] = basis, -T[:, None] * basis * v[LINEAR]
    return out


def projected(w: Array) -> Array:
    """What the best lengths leave."""
    basis = columns(w)
    return np.asarray(Y - basis @ np.linalg.lstsq(basis, Y, rcond=None)[0])


def expected(v: Array, method: LeastSquaresMethod, damping: float) -> tuple[Array, Array, Array]:
    """Residual, Jacobian and step of the problem that a method solves, from one iterate."""
    if not method.separable:
        e, J = residual(v), jacobian(v)
        scale = np.linalg.norm(J, axis=0)
    else:
        w, h = v[~LINEAR], 1e-5
        e = projected(w)
        if method.full:
            J = np.stack([-(projected(w + d) - projected(w - d)) / (2.0 * h)
                          for d in h * np.eye(2)], axis=1)  # fmt: skip
        else:
            basis = columns(w)
            best = v.copy()
            best[LINEAR] = np.linalg.lstsq(basis, Y, rcond=None)[0]
            J = jacobian(best)[:, ~LINEAR]
            J = J - basis @ np.linalg.lstsq(basis, J, rcond=None)[0]
        scale = np.repeat(np.linalg.norm(J, axis=0).max(), 2)
    weight = np.sqrt(damping * method.damped) * np.diag(scale)
    tall = np.concatenate([J, weight])
    return e, J, np.linalg.lstsq(tall, np.concatenate([e, 0.0 * scale]), rcond=None)[0]


def test_the_methods_are_those_of_the_paper():
    """Two switches, and Kaufman's form of the two that eliminate the lengths."""
    assert {
        name: (m.separable, m.damped, m.full)
        for name, m in LEAST_SQUARES_METHODS.items()
        if m.separable
    } == {
        "snlgn": (True, False, True),
        "snllm": (True, True, True),
        "snlgn-kaufman": (True, False, False),
        "snllm-kaufman": (True, True, False),
    }
    assert (
        LEAST_SQUARES_METHODS["nlgn"].damped,
        LEAST_SQUARES_METHODS["nllm"].damped,
        len(LEAST_SQUARES_METHODS),
    ) == (False, True, 6)


@pytest.mark.parametrize("name", LEAST_SQUARES_METHODS)
def test_a_step_is_that_of_dense_algebra(name):
    method, problem = LEAST_SQUARES_METHODS[name], Decay(LINEAR)
    at = linearise_iterates(problem, Points(BEGIN), method)
    trial, motion, gain = take_trial_step(problem, at, DAMPING * method.damped, 25.0, method)
    for i, begin in enumerate(BEGIN):
        e, J, step = expected(begin, method, DAMPING[i])
        moved = at.x.value[i].copy()
        moved[~LINEAR if method.separable else slice(None)] += step
        if method.separable:
            moved[LINEAR] = np.linalg.lstsq(columns(moved[~LINEAR]), Y, rcond=None)[0]
        assert_allclose(trial.x.value[i], moved, rtol=0, atol=1e-7)  # differences: h^2 = 1e-10
        assert_allclose(at.cost[i], e @ e, rtol=1e-12)
        left = e - J @ step
        assert_allclose(gain[i], e @ e - left @ left, rtol=1e-6)
        assert_allclose(motion[i], np.linalg.norm(J @ step) / 5.0, rtol=1e-6)
        assert_allclose(trial.cost[i], (residual(trial.x.value[i]) ** 2).sum(), rtol=1e-12)


@pytest.mark.parametrize("name", LEAST_SQUARES_METHODS)
def test_all_end_at_the_least_cost_and_say_when(name):
    told: list[int] = []
    found = least(
        Decay(LINEAR), Points(BEGIN[:2]), 2, 25.0, LEAST_SQUARES_METHODS[name], progress=told.append
    )
    assert found.status == (Status.CONVERGED,) * 2
    slope = [jacobian(v).T @ residual(v) for v in found.x.value]
    assert np.abs(slope).max() < 1e-10
    assert_array_equal(found.trace[0][[0, 1]], found.trace[0])
    assert_array_equal(found.trace[-1], found.cost)
    assert told == list(range(1, int(found.iterations.max()) + 1))
    assert len(found.trace) == len(told) + 1
    for i, last in enumerate(found.iterations):
        assert_array_equal(found.trace[last:, i], found.cost[i])
        alone = least(Decay(LINEAR), Points(BEGIN[i : i + 1]), 1, 25.0, LEAST_SQUARES_METHODS[name])
        assert abs(alone.iterations[0] - last) <= 1
    short = least(
        Decay(LINEAR), Points(BEGIN[:2]), 2, 25.0, LEAST_SQUARES_METHODS[name], keep_trace=False
    )
    assert_array_equal(short.trace, found.trace[[0, -1]])


def test_an_undamped_search_that_leaves_the_numbers_failed():
    far = BEGIN[:1] * [1.0, -500.0, 1.0, 1.0]  # exp(+350 t) overflows
    found = least(Decay(LINEAR), Points(far), 1, 25.0, LEAST_SQUARES_METHODS["nlgn"])
    assert found.status == (Status.FAILED,)
    assert_array_equal(found.x.value, far)


def test_a_slope_that_lies_stalls_where_it_began():
    lie = replace(Decay(LINEAR), sense=-1.0)
    limits = LeastSquaresLimits(damping=1e-2)
    found = least(lie, Points(BEGIN[:1]), 1, 25.0, LEAST_SQUARES_METHODS["nllm"], limits)
    assert found.status == (Status.STALLED,)
    assert_array_equal(found.x.value, BEGIN[:1])
    assert_array_equal(found.trace, found.trace[:1] * np.ones_like(found.trace))
    # 1e-2 grows by 2, 4, 8 ...: 2^(k (k + 1) / 2) first passes 1e14 at k = 10
    assert found.iterations[0] == 10


@pytest.mark.parametrize("most", [0, 3])
def test_a_limit_is_the_number_of_steps(most):
    limits = LeastSquaresLimits(iterations=most)
    found = least(Decay(LINEAR), Points(BEGIN[:1]), 1, 25.0, LEAST_SQUARES_METHODS["nllm"], limits)
    assert found.status == (Status.ITERATION_LIMIT,)
    assert (found.iterations[0], len(found.trace)) == (most, most + 1)
    assert np.array_equal(found.x.value, BEGIN[:1]) == (most == 0)


def test_what_is_singular_to_rounding_has_the_least_solution():
    """Two columns that agree to fifteen digits, and a right side that does not."""
    near = np.array([[1.0, 1.0 - 2e-15], [1.0 - 2e-15, 1.0]])
    for scale in (np.ones(2), np.array([1e-6, 1e6])):
        matrix, right = near * np.outer(scale, scale), scale * [2.0, 2.0 - 2e-9]
        found = solve_normal_equations(matrix, right[:, None])[:, 0]
        assert_allclose(found * scale, 1.0, rtol=0, atol=1e-8)


def test_damping_goes_by_nielsens_rule():
    damping, growth = np.full(5, 8.0), np.array([2.0, 2.0, 2.0, 4.0, 16.0])
    accept = np.array([True, True, True, False, True])
    ratio = np.array([0.5, 1.0, 0.25, 0.0, 0.75])
    after, next_growth = update_damping_by_nielsen(damping, growth, accept, ratio)
    assert_allclose(after, [8.0, 8.0 / 3.0, 9.0, 32.0, 7.0], rtol=1e-15)
    assert_array_equal(next_growth, [2.0, 2.0, 2.0, 8.0, 2.0])


def test_a_trial_is_compared_with_what_was_predicted():
    at = linearise_iterates(
        Decay(LINEAR), Points(np.repeat(BEGIN[:1], 5, axis=0)), LEAST_SQUARES_METHODS["nlgn"]
    )
    at = replace(at, cost=np.full(5, 10.0))
    trial = replace(at, cost=np.array([9.0, 11.0, 6.0, 10.0 + 1e-12, np.nan]))
    lower, ratio = compare_trial_costs(at, trial, np.array([2.0, 2.0, 2.0, 1e-13, 2.0]))
    assert_array_equal(lower, [True, False, True, True, False])
    assert_allclose(ratio, [0.5, 0.0, 1.0, 1.0, 1.0], rtol=1e-15)


# ---- bounded -------------------------------------------------------------------------------------


def test_a_bounded_step_is_the_optimum(rng):
    root = rng.normal(size=(12, 9))
    gram, pull = root.T @ root, 5.0 * rng.normal(size=9)
    low, high = np.full(9, -np.inf), np.full(9, np.inf)
    low[:4], high[2:6] = -0.05, 0.02
    x = cp.Variable(9)
    cost = cp.quad_form(x, cp.psd_wrap(gram)) - 2.0 * pull @ x
    cp.Problem(cp.Minimize(cost), [x[:4] >= -0.05, x[2:6] <= 0.02]).solve(solver=cp.CLARABEL)
    assert_allclose(solve_bounded_normal_equations(gram, pull, low, high), x.value, atol=1e-6)
    free = solve_bounded_normal_equations(gram, pull, np.full(9, -np.inf), np.full(9, np.inf))
    assert_allclose(free, np.linalg.solve(gram, pull), rtol=1e-6)


def test_columns_that_are_the_same_share_their_part(rng):
    """Products of rank 3 in 5 parameters: any split of a sum is as good, and none is infinite."""
    matrix = rng.normal(size=(12, 3))[:, [0, 1, 2, 0, 1]]
    right = 3.0 * rng.normal(size=12)
    low, high = np.array([-np.inf, -np.inf, 0.0, 0.0, 0.0]), np.full(5, np.inf)
    x = solve_bounded_normal_equations(matrix.T @ matrix, matrix.T @ right, low, high)
    y = cp.Variable(5)
    best = cp.Problem(cp.Minimize(cp.sum_squares(matrix @ y - right)), [y[2:] >= 0.0])
    best.solve(solver=cp.CLARABEL)
    assert (x >= low - 1e-12).all()
    assert_allclose(np.sum((matrix @ x - right) ** 2), best.value, rtol=1e-5)


def test_a_compiled_solver_that_gives_up_is_replaced(rng, monkeypatch):
    matrix, target = rng.normal(size=(5, 5)), rng.normal(size=5)
    low, high = np.full(5, -0.1), np.full(5, np.inf)
    fast = solve_bounded_least_squares(matrix, target, low, high)

    def stopped(*given: object, **more: object) -> None:
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(scipy.optimize, "nnls", stopped)
    assert_allclose(solve_bounded_least_squares(matrix, target, low, high), fast, rtol=0, atol=1e-9)


def test_lengths_follow_a_step_to_first_order():
    from minimax_cal.solvers.least_squares import extend_step_to_all_parameters

    method, problem = LEAST_SQUARES_METHODS["snlgn"], Decay(LINEAR)
    at = linearise_iterates(problem, Points(BEGIN), method)
    short = np.array([[1e-6, -2e-6]] * 3)
    whole = extend_step_to_all_parameters(LINEAR, short, at.gradient, at.gram, method)
    assert_array_equal(whole[:, ~LINEAR], short)
    for v, step in zip(at.x.value, whole, strict=True):
        best = np.linalg.lstsq(columns(v[~LINEAR] + step[~LINEAR]), Y, rcond=None)[0]
        fixed = np.linalg.lstsq(columns(v[~LINEAR]), -jacobian(v)[:, ~LINEAR] @ step[~LINEAR],
                                rcond=None)[0]  # fmt: skip
        assert_allclose(step[LINEAR], fixed, rtol=0, atol=1e-14)
        assert np.abs(best - v[LINEAR]).max() < 1e-4  # a small move, as it should be
