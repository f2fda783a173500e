import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import solve
from scipy import optimize
from scipy.spatial.transform import Rotation

from experiments.speed import identified
from minimax_cal.modelling import start
from minimax_cal.modelling.model import SumOfSquares, model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.kinematics import rotation
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS
from minimax_cal.solvers.status import Status


@pytest.mark.parametrize("method", METHODS)
def test_every_method_reaches_the_same_minimum(method, robot, noisy):
    model, begin = identified(robot, noisy.data)
    found = solve(model, begin, method)
    best = solve(model, begin)
    assert found.status[0] is Status.CONVERGED
    assert_allclose(found.cost, best.cost, rtol=1e-10)
    assert_allclose(found.x.mdh, best.x.mdh, rtol=0, atol=1e-9)
    assert found.trace[0] > found.trace[-1]


def test_minimum_is_scipys(robot, noisy):
    model, begin = identified(robot, noisy.data)
    best = solve(model, begin)

    def residual(dx: np.ndarray) -> np.ndarray:
        step = np.zeros(model.names.count)
        step[model.active] = dx * 1e-3
        return 1e3 * model.error(begin.step(step)).reshape(-1)

    peer = optimize.least_squares(residual, np.zeros(model.active.sum()), xtol=1e-14, ftol=1e-14)
    assert_allclose(best.cost[0] * 1e6, 2 * peer.cost, rtol=1e-9)


def test_gradient_is_zero_at_the_minimum(robot, noisy):
    model, begin = identified(robot, noisy.data)
    found = solve(model, begin)
    cost, gradient, gram = SumOfSquares(model).normal(found.x.take(np.array(0)))
    # cosine of the angle between residual and each column of the Jacobian
    assert np.abs(gradient / np.sqrt(np.diag(gram) * cost)).max() < 1e-9


def test_true_robot_is_found_without_noise(robot, clean):
    model, begin = identified(robot, clean.data)
    found = solve(model, begin)
    assert np.sqrt(found.cost[0] / model.counts.sum()) < 1e-12  # metres


def test_iteration_limit_is_said(robot, noisy):
    model, begin = identified(robot, noisy.data)
    found = solve(model, begin, limits=least_squares.Limits(iterations=1))
    assert found.status[0] is Status.ITERATION_LIMIT
    assert "iteration limit" in found.status[0].advice


def test_many_starts_at_once_equal_each_alone(robot, noisy):
    model, begin = identified(robot, noisy.data)
    rng = np.random.default_rng(3)
    starts = begin.repeat(5)
    dx = np.zeros((5, model.names.count))
    dx[:, model.active & ~model.names.linear] = 0.1 * rng.normal(size=(5, 13))
    starts = starts.step(dx)
    points = float(model.counts.sum())
    together = least_squares.solve(SumOfSquares(model), starts, 5, points)
    for i in range(5):
        alone = least_squares.solve(SumOfSquares(model), starts.take(np.array([i])), 1, points)
        assert_allclose(together.cost[i], alone.cost[0], rtol=1e-10)
        # the way is the same until the cost has converged; the last steps are about rounding
        way = alone.trace[:, 0]
        steps = int(np.argmax(way <= (1.0 + 1e-9) * way[-1])) + 1
        assert_allclose(together.trace[:steps, i], way[:steps], rtol=1e-7)


def test_closed_form_start_is_the_best_frame(robot, rng):
    """Base and targets of the nominal robot, against a local search from the truth."""
    for seed in range(5):
        made = simulate(robot, 30, 2, seed)
        model = model_of(robot, made.data)
        frame = start.fit_base(model, robot.mdh)
        chosen = ~model.names.links
        cell = made.cell
        near = State(robot.mdh, cell.base[:3, :3], cell.base[:3, 3], cell.target_positions)
        local = solve(model.only(chosen), near)
        points = model.counts.sum()
        assert_allclose(frame.mean_square * points, local.cost[0], rtol=1e-9)
        assert_allclose(model.cost(frame.state).sum(), local.cost[0], rtol=1e-9)


def test_100_random_bases_reach_the_global_minimum(robot):
    for seed in range(100):
        truth = Truth(noise=0, noise_per_metre=0, compliance=0)
        made = simulate(robot, 25, 1 + 2 * (seed % 2), seed, truth)
        model, begin = identified(robot, made.data)
        found = solve(model, begin)
        miss = np.sqrt(found.cost[0] / model.counts.sum())
        assert miss < 1e-10, f"seed {seed}: {miss} m"


def test_search_finds_gross_angle_errors(robot):
    """Nominal theta_2 and alpha_3 off by up to 3.1 rad, the tracker anywhere."""
    rng = np.random.default_rng(8)
    for seed in range(4):
        made = simulate(robot, 40, 1, seed, Truth(noise=0, noise_per_metre=0, compliance=0))
        wrong = robot.mdh.copy()
        wrong[1, 2] += rng.uniform(-3.1, 3.1)
        wrong[2, 3] += rng.uniform(-3.1, 3.1)
        model, _ = identified(robot, made.data)
        found = start.search(model, wrong, float(model.counts.sum()))
        assert np.sqrt(found.cost[0] / model.counts.sum()) < 1e-9, f"seed {seed}"


def test_turning_the_instrument_changes_no_error(robot, noisy):
    rng = np.random.default_rng(4)
    model, begin = identified(robot, noisy.data)
    error = model.error(solve(model, begin).x.take(np.array(0)))
    for _ in range(20):
        turn = Rotation.random(rng=rng).as_matrix()
        moved = noisy.data.with_y(noisy.data.y @ turn.T + rng.normal(size=3) * 10)
        other, there = identified(robot, moved)
        again = other.error(solve(other, there).x.take(np.array(0)))
        assert_allclose(again, error, rtol=0, atol=1e-9)  # 1e-6 mm


def test_solve_normal_gives_the_least_solution_of_a_singular_system(rng):
    rows = rng.normal(size=(5, 4))
    rows = np.concatenate([rows, rows[:, :1]], axis=1)  # the last column repeats the first
    gram, right = rows.T @ rows, rows.T @ rng.normal(size=(5, 1))
    found = least_squares.solve_normal(gram, right)
    assert_allclose(gram @ found, right, rtol=0, atol=1e-9)
    assert_allclose(found[0], found[4], rtol=1e-6)


def test_rotation_steps_have_no_gimbal(robot, clean):
    """A base pitched by 90 degrees, where Euler angles are singular."""
    cell = clean.cell
    pitch = rotation(np.array([0.0, np.pi / 2, 0.0]))
    data = clean.data.with_y((clean.data.y - cell.base[:3, 3]) @ cell.base[:3, :3] @ pitch.T)
    model, begin = identified(robot, data)
    found = solve(model, begin)
    assert np.sqrt(found.cost[0] / model.counts.sum()) < 1e-12
