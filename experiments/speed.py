"""How fast the fits are, as ratios to peers on the same problem in the same run.

    python -m experiments.speed [--quick] [--repeats N] [--out FOLDER] [--json FILE] [--seed N]

Least squares against scipy.optimize.least_squares (finite differences, and our Jacobian); minimax
against SLSQP on the same scaled epigraph problem; and the growth with the number of poses.  All
start where our own closed-form start ends, and all reach the same optimum: that is checked.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import click
import numpy as np
from scipy import optimize

from experiments import sweep
from experiments.sweep import Study, study_options
from minimax_cal.fitting import identify, start
from minimax_cal.fitting.minimax_problem import MinimaxProblem, measured_distances, minimax_problem
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import Model, SumOfSquares, model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import least_squares, minimax
from qp_backends import solve as solve_qp


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated calibration, ready to be fitted: model with its identified parameters, start."""

    robot: Robot
    model: Model
    begin: State
    worst: Callable[[State], MinimaxProblem]


def case_of(poses: int, seed: int) -> Case:
    """IRB 2600, three targets, geometric errors, some compliance, tracker noise."""
    robot = load_robot("irb2600")
    data = simulate(robot, poses, 3, seed).data
    model, begin = identified(robot, data)
    distances = measured_distances(data)
    return Case(
        robot, model, begin, lambda x: minimax_problem(model, x, distances, "two-sided", "target")
    )


def identified(robot: Robot, data: Measurements) -> tuple[Model, State]:
    """The model with its identified parameters free, and the nominal start."""
    model = model_of(robot, data)
    begin = start.fit_base(model, robot.mdh).state
    found = identify.identify(
        model,
        begin,
        identify.drop_order(robot, model.names),
        allowed=model.active,
        reference=identify.plenty_of_poses(robot, model),
        known=np.zeros(model.names.count, dtype=bool),
    )
    return model.only(found.active), begin


def fitted(robot: Robot, data: Measurements) -> tuple[Model, State]:
    """The same with its least-squares fit."""
    model, begin = identified(robot, data)
    found = least_squares.solve(SumOfSquares(model), begin.batch(), 1, float(model.counts.sum()))
    return model, found.x.take(np.array(0))


def ours_squares(case: Case) -> State:
    """Our separable least squares."""
    points = float(case.model.counts.sum())
    found = least_squares.solve(
        SumOfSquares(case.model), case.begin.batch(), 1, points, limits=least_squares.NEAR
    )
    return found.x.take(np.array(0))


def scipy_squares(case: Case, *, analytic: bool) -> State:
    """scipy's least_squares on the same residuals and parameters, scaled as ours are."""
    model, begin = case.model, case.begin
    active = model.active
    _, _, gram = SumOfSquares(model).normal(begin)
    scale = np.sqrt(np.diag(gram) / model.counts.sum())

    def state(u: Array) -> State:
        full = np.zeros(model.names.count)
        full[active] = u / scale
        return begin.step(full)

    def residual(u: Array) -> Array:
        return np.asarray(model.error(state(u)).reshape(-1) * 1e3)

    def jacobian(u: Array) -> Array:
        # the rotation is parametrised at the start, so its columns turn with it
        x = state(u)
        full = np.zeros(model.names.count)
        full[active] = u / scale
        every = model.jacobian(x).reshape(-1, model.names.count)
        first = 5 * model.names.joints
        turn = right_jacobian(full[first + 3 : first + 6])
        back = x.rotation.T @ begin.rotation
        every[:, first + 3 : first + 6] = every[:, first + 3 : first + 6] @ turn
        every[:, first : first + 3] = every[:, first : first + 3] @ back
        # errors are reported in base axes, which turn too
        error = model.error(x).reshape(-1, 3)
        turning = np.cross(error[:, None, :], turn.T[None]).transpose(0, 2, 1).reshape(-1, 3)
        out = -every
        out[:, first + 3 : first + 6] += turning
        return np.asarray(out[:, active] / scale * 1e3)

    found = optimize.least_squares(
        residual,
        np.zeros(active.sum()),
        jac=jacobian if analytic else "2-point",
        method="trf",
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    return state(found.x)


def right_jacobian(w: Array) -> Array:
    """Turn in body axes per change of the rotation vector w: (3, 3)."""
    angle = float(np.linalg.norm(w))
    k = kinematics.hat(w)
    if angle < 1e-6:
        return np.asarray(np.eye(3) - 0.5 * k)
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) - first * k + second * k @ k)


def ours_minimax(case: Case, begin: State) -> float:
    """Our SQP from the least-squares fit; returns max F_i / m_i [mm^2]."""
    problem = case.worst(begin)
    qp = partial(solve_qp, name="daqp", tolerance=1e-9)
    return minimax.solve(problem, begin, qp).value * problem.size * 1e6


def slsqp_minimax(case: Case, begin: State) -> float:
    """SLSQP on min v, f_i(x) <= v, with the same scaling, functions and derivatives as ours."""
    problem = case.worst(begin)
    size = int(case.model.active.sum())
    lower, upper = problem.lower, problem.upper

    def both(u: Array) -> tuple[Array, Array]:
        return problem.evaluate(problem.step(begin, u[:size]))

    def jacobians(u: Array) -> tuple[Array, Array]:
        at = problem.linearise(problem.step(begin, u[:size]))
        first = int(np.flatnonzero(np.flatnonzero(case.model.active) == 5 * 6 + 3)[0])
        turn = right_jacobian((u[:size] / problem.scale)[first : first + 3])
        move = kinematics.rotation((u[:size] / problem.scale)[first : first + 3]).T
        f, c = at.jacobian.copy(), at.normal
        s = problem.scale[first : first + 3]
        f[:, first : first + 3] = f[:, first : first + 3] * s @ turn / s
        s = problem.scale[first - 3 : first]
        f[:, first - 3 : first] = f[:, first - 3 : first] * s @ move / s
        return f, c

    def inequality(u: Array) -> Array:
        f, c = both(u)
        return np.concatenate([u[size] - f, c - lower, upper - c])

    def inequality_slope(u: Array) -> Array:
        f, c = jacobians(u)
        zero = np.zeros((len(c), 1))
        return np.block([[-f, np.ones((len(f), 1))], [c, zero], [-c, zero]])

    unit = np.zeros(size + 1)
    unit[size] = 1.0
    found = optimize.minimize(  # type: ignore[call-overload]
        lambda u: float(u[size]),
        np.append(np.zeros(size), 1.0),
        jac=lambda u: unit,
        method="SLSQP",
        constraints=[{"type": "ineq", "fun": inequality, "jac": inequality_slope}],
        options={"maxiter": 1000, "ftol": 1e-12},
    )
    return float(both(found.x)[0].max()) * problem.size * 1e6


def seconds(run: Callable[[], object], repeats: int) -> list[float]:
    """Times of several runs after one that does not count."""
    run()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return times


def race(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median time of each, the runs taken in turn so that a slow spell hits all alike [s]."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            began = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - began)
    return {name: statistics.median(values) for name, values in times.items()}


def rms_mm(case: Case, state: State) -> float:
    """RMS error of a fit [mm]."""
    return float(1e3 * np.sqrt(case.model.cost(state).sum() / case.model.counts.sum()))


def peers(seed: int, repeats: int) -> tuple[Table, Table, dict[str, float]]:
    """Tables of least squares and minimax against their peers, and the figures by name."""
    case = case_of(100, seed)
    fits: dict[str, Callable[[], object]] = {
        "separable least squares (ours)": lambda: ours_squares(case),
        "least_squares, our Jacobian": lambda: scipy_squares(case, analytic=True),
        "least_squares, finite differences": lambda: scipy_squares(case, analytic=False),
    }
    times = race(fits, repeats)
    ends = {
        "separable least squares (ours)": rms_mm(case, ours_squares(case)),
        "least_squares, our Jacobian": rms_mm(case, scipy_squares(case, analytic=True)),
        "least_squares, finite differences": rms_mm(case, scipy_squares(case, analytic=False)),
    }
    own = times["separable least squares (ours)"]
    squares = Table(
        "least squares, 100 poses x 3 targets, 33 parameters (median times)",
        ("method", "ms", "ratio to ours", "RMS mm"),
        tuple((name, 1e3 * t, t / own, ends[name]) for name, t in times.items()),
        ("", ".2f", ".1f", ".9f"),
    )
    begin = ours_squares(case)
    minimaxes: dict[str, Callable[[], float]] = {
        "minimax SQP (ours, daqp)": lambda: ours_minimax(case, begin),
        "SLSQP, scaled epigraph": lambda: slsqp_minimax(case, begin),
    }
    worst = race(dict(minimaxes), repeats)
    own_worst = worst["minimax SQP (ours, daqp)"]
    table = Table(
        "minimax from the least-squares fit, same problem (median times)",
        ("method", "ms", "ratio to ours", "max F_i/m mm^2"),
        tuple((name, 1e3 * t, t / own_worst, minimaxes[name]()) for name, t in worst.items()),
        ("", ".2f", ".1f", ".12f"),
    )
    figures = {
        "least_squares_fd_over_ours": times["least_squares, finite differences"] / own,
        "least_squares_jac_over_ours": times["least_squares, our Jacobian"] / own,
        "slsqp_over_minimax": worst["SLSQP, scaled epigraph"] / own_worst,
        "minimax_value_difference": abs(
            minimaxes["SLSQP, scaled epigraph"]() / minimaxes["minimax SQP (ours, daqp)"]() - 1.0
        ),
        "least_squares_rms_difference_mm": max(ends.values()) - min(ends.values()),
    }
    return squares, table, figures


def growth(seed: int, counts: tuple[int, ...], repeats: int) -> tuple[Table, dict[str, float]]:
    """Time of a whole fit, least squares and minimax, against the number of poses."""
    rows: list[tuple[str | float | int, ...]] = []
    previous = np.nan
    figures: dict[str, float] = {}
    for poses in counts:
        case = case_of(poses, seed)
        begin = ours_squares(case)
        few = max(3, repeats // (1 + poses // 2000))
        squares = statistics.median(seconds(partial(ours_squares, case), few))
        worst = statistics.median(seconds(partial(ours_minimax, case, begin), few))
        total = squares + worst
        rows.append((poses, 1e3 * squares, 1e3 * worst, 1e3 * total, total / previous))
        figures[f"growth_to_{poses}"] = total / previous
        previous = total
    table = Table(
        "growth with the number of poses (3 targets; median times)",
        ("poses", "least squares ms", "minimax ms", "together ms", "times the row above"),
        tuple(rows),
        ("d", ".2f", ".2f", ".2f", ".1f"),
    )
    return table, {key: value for key, value in figures.items() if np.isfinite(value)}


@click.command()
@study_options("speed")
@click.option("--repeats", type=int, default=15, show_default=True)
def main(study: Study, repeats: int) -> None:
    """Ratios of our fits to their peers.

    Times are compared, so the runs go one after the other: --jobs and --cluster do not apply.
    """
    repeats = 3 if study.quick else repeats
    counts = (100, 1000) if study.quick else (100, 1000, 10000)
    squares, worst, figures = peers(study.seed, repeats)
    table, grown = growth(study.seed, counts, repeats)
    study.save([squares, worst, table], {"figures": figures | grown})
    if figures["minimax_value_difference"] > 1e-6:
        raise click.ClickException("the two minimax solvers disagree")


if __name__ == "__main__":
    sweep.start(__file__)
