from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import solve
from scipy import optimize
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.speed import identified
from minimax_cal.fitting.minimax_problem import (
    Distances,
    MinimaxProblem,
    measured_distances,
    minimax_problem,
)
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers import minimax
from minimax_cal.solvers.minimax import Linear, Sqp
from minimax_cal.solvers.status import Status
from qp_backends import available
from qp_backends import solve as solve_qp


def worst_target(model: Model, x: State, distances: Distances, form: str) -> MinimaxProblem:
    return minimax_problem(model, x, distances, form, "target")


BACKENDS = ("daqp", "quadprog", "clarabel", "osqp", "proxqp")


def warm(robot: mc.Robot, data: mc.Measurements) -> tuple[Model, State]:
    model, begin = identified(robot, data)
    return model, solve(model, begin).x.take(np.array(0))


def run(problem, x, backend: str = "daqp", **settings: object):  # type: ignore[no-untyped-def]
    qp = partial(solve_qp, name=backend, tolerance=1e-9)
    return minimax.solve(problem, x, qp, Sqp(**settings))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Plain:
    """max of smooth functions of x in R^n, derivatives by complex step."""

    functions: tuple
    constraints: tuple = ()
    lower: np.ndarray = field(default_factory=lambda: np.zeros(0))
    upper: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([f(x) for f in self.functions]), np.array([c(x) for c in self.constraints])

    def linearise(self, x: np.ndarray) -> Linear:
        f, c = self.evaluate(x)
        steps = x + 1e-30j * np.eye(len(x))
        jacobian = np.array([[g(s).imag / 1e-30 for s in steps] for g in self.functions])
        normal = np.array([[g(s).imag / 1e-30 for s in steps] for g in self.constraints])
        n = len(x)
        return Linear(f, jacobian, c, normal.reshape(-1, n), lambda mu: np.zeros((0, 0)))

    def step(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        return x + d


def test_known_minimax_with_bfgs():
    """Rosen-Suzuki as a minimax: -44 at (0, 1, 2, -1)."""

    def f(x):  # type: ignore[no-untyped-def]
        a, b, c, d = x
        return a**2 + b**2 + 2 * c**2 + d**2 - 5 * a - 5 * b - 21 * c + 7 * d

    def penalised(g):  # type: ignore[no-untyped-def]
        return lambda x: f(x) + 10 * g(x)

    problem = Plain(
        (
            f,
            penalised(lambda x: x @ x + x[0] - x[1] + x[2] - x[3] - 8),
            penalised(lambda x: x @ x + x[1] ** 2 + x[3] ** 2 - x[0] - x[3] - 10),
            penalised(lambda x: x @ x + x[0] ** 2 - x[3] ** 2 + 2 * x[0] - x[1] - x[3] - 5),
        )
    )
    found = run(problem, np.zeros(4), hessian="bfgs")
    assert found.status is Status.CONVERGED
    assert_allclose(found.value, -44.0, rtol=1e-9)
    assert_allclose(found.x, [0, 1, 2, -1], atol=1e-6)
    assert_allclose(found.mu.sum(), 1.0, rtol=1e-12)


def test_equality_and_inequality_constraints():
    """min max(x, y) on the unit circle with x - y >= 0.4: x = y + 0.4 is active."""
    problem = Plain(
        (lambda x: x[0], lambda x: x[1]),
        (lambda x: x @ x, lambda x: x[0] - x[1]),
        np.array([1.0, 0.4]),
        np.array([1.0, np.inf]),
    )
    found = run(problem, np.array([1.0, -1.0]), hessian="bfgs")
    assert found.status is Status.CONVERGED
    y = -0.2 - np.sqrt(0.5 - 0.04)
    assert_allclose(found.value, y + 0.4, rtol=1e-8)
    assert found.lam[1] < 0  # active at its lower bound


def test_contradicting_constraints_are_said():
    problem = Plain((lambda x: x[0],), (lambda x: x[0], lambda x: x[0]), np.array([2.0, -np.inf]),
                    np.array([np.inf, 1.0]))  # fmt: skip
    found = run(problem, np.array([0.0]), hessian="bfgs")
    assert found.status is Status.INFEASIBLE
    assert "contradict" in found.status.advice


def test_the_maratos_problem_takes_full_steps():
    """Curved constraint x'x = 1, start on it: without correction every unit step is refused."""
    problem = Plain(
        (lambda x: 2 * (x @ x - 1) - x[0],), (lambda x: x @ x,), np.array([1.0]), np.array([1.0])
    )
    found = run(problem, np.array([np.cos(1.2), np.sin(1.2)]), hessian="bfgs")
    assert found.status is Status.CONVERGED
    assert_allclose(found.x, [1.0, 0.0], atol=1e-6)
    assert found.iterations < 15


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


def value_of(robot: mc.Robot, data: mc.Measurements, backend: str = "daqp") -> float:
    model, x = warm(robot, data)
    problem = worst_target(model, x, measured_distances(data), "two-sided")
    found = run(problem, x, backend)
    assert found.status is Status.CONVERGED
    return found.value * problem.size


@pytest.mark.parametrize("backend", BACKENDS)
def test_backends_end_at_the_same_value(backend, robot, noisy):
    if backend not in available():
        pytest.skip(f"{backend} is not installed")
    reference = value_of(robot, noisy.data)
    assert_allclose(value_of(robot, noisy.data, backend), reference, rtol=1e-6)


def slsqp_value(problem: MinimaxProblem, x: State) -> float:
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
    deviation = problem.deviation(found.x)[0]
    assert np.abs(problem.deviation(free.x)[0]).max() > 1.0  # it really binds
    assert np.abs(deviation).max() <= 1.0 + 1e-7
    assert np.abs(found.lam).max() > 0.0
    assert found.value >= free.value * (1 - 1e-9)


def test_kkt_conditions_hold(robot, noisy):
    model, x = warm(robot, noisy.data)
    problem = worst_target(model, x, measured_distances(noisy.data), "two-sided")
    found = run(problem, x)
    here = problem.linearise(found.x)
    assert np.abs(here.jacobian.T @ found.mu + here.normal.T @ found.lam).max() < 1e-8
    assert found.mu.min() >= 0.0
    assert found.mu @ (here.f.max() - here.f) < 1e-8
    assert here.f.max() <= problem.linearise(x).f.max()


def test_moving_the_instrument_changes_nothing(robot, noisy):
    rng = np.random.default_rng(5)
    reference = value_of(robot, noisy.data)
    for _ in range(10):
        turn = Rotation.random(rng=rng).as_matrix()
        moved = noisy.data.with_y(noisy.data.y @ turn.T + rng.normal(size=3) * 10)
        assert_allclose(value_of(robot, moved), reference, rtol=1e-8)


def test_a_qp_solver_that_fails_ends_in_a_status(robot, noisy):
    from qp_backends import Solution
    from qp_backends import Status as QpStatus

    model, x = warm(robot, noisy.data)
    problem = worst_target(model, x, measured_distances(noisy.data), "two-sided")

    def broken(qp, warm_start=None):  # type: ignore[no-untyped-def]
        nothing = np.full(len(qp.q), np.nan), np.full(len(qp.l), np.nan)
        return Solution(*nothing, QpStatus.FAILED, 0.0)

    found = minimax.solve(problem, x, broken)
    assert found.status is Status.FAILED
    assert found.x is x


def test_qps_of_some_functions_are_those_of_all(robot, noisy, monkeypatch):
    """The worst of many points: the QPs that begin with a few take the same steps."""
    model, x = warm(robot, noisy.data)
    problem = minimax_problem(model, x, measured_distances(noisy.data), "two-sided", "point")
    qp = partial(solve_qp, name="daqp", tolerance=1e-10)
    few = minimax.solve(problem, x, qp)
    asked = []
    monkeypatch.setattr(minimax, "SHARE", len(few.f))
    counted = minimax.from_nothing(lambda one: (asked.append(len(one.l)), qp(one))[1])
    whole = minimax.solve(problem, x, counted)
    assert len(few.f) > 4 * int(model.active.sum())
    assert min(asked) == len(few.f) + len(few.c)
    assert few.iterations == whole.iterations
    assert_allclose(few.x.mdh, whole.x.mdh, rtol=0, atol=1e-11)
    assert_allclose(few.mu, whole.mu, rtol=0, atol=1e-8)
