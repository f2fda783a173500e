"""Paper M's Algorithm 1 to the letter, on simulated and real arms.

    python -m experiments.algorithm_1 [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

The quadratic programs with one active function I (eq. 22, 25, 27), the printed T on the rows that
are violated, steps of length 1/p along it from Δx = 0 and λ = 0, full outer steps, BFGS with λ(k+1)
and λ(k) and q q' / (q's).  Mended are the sign of r and the ε of c_l alone (errata 5 and 6).  The
paper does not say: the first H, here that of the Gauss-Newton fit it starts from (eq. 32); units,
here each parameter scaled to unit curvature; redundant parameters, here left out; an update of H
with q's <= 0, which would break the H > 0 that it asks for, here left out.

Beside it the same with a line search, which the paper has not, and our own two backends of the
method.  The figure is RMSE(φ) over the optimum of the exact SQP, minus one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from experiments.conditions import CONDITION_ROBOTS, list_available_robots, load_or_simulate_robot
from experiments.speed import fit_least_squares
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.fitting.cell_fit import FIT_QP_TOLERANCE
from minimax_cal.fitting.minimax_problem import (
    MinimaxProblem,
    build_minimax_problem,
    measured_distances,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers import minimax
from minimax_cal.solvers.linearisation import Linearisation
from qp_backends import solve as solve_qp

SIMULATED_ALGORITHM_1_ARMS = ("irb2600", "irb120", "ur10e", "meca500")  # simulated
REAL_ALGORITHM_1_ARMS = {"real irb120": "irb120", "real fanuc": "fanuc"}
INNER_ITERATIONS = 3_000  # steps of the subgradient method, by the paper "while Δx not converge"
OUTER_ITERATIONS_BY_QUICK = {True: 10, False: 20}
SHOWN_OUTER_STEPS = (1, 2, 5, 10, 20)
ALGORITHM_1_VARIANTS = {"as printed": False, "with a line search": True}
SUBGRADIENT_BACKENDS = ("subgradient:eliminated", "subgradient:raw")
MIN_LINE_SEARCH_STEP = 1e-6  # of a step in the line search
MAX_GOOD_EXCESS = 1e-3  # over the optimum after ten outer steps: it works


@dataclass(frozen=True)
class Algorithm1Job:
    """An arm."""

    arm: str
    seed: int
    outer: int


@dataclass(frozen=True)
class Algorithm1Result:
    """RMSE(φ) over the optimum minus one.

    ways: after each outer step, from the start on, by name.  ours: at the end, by backend.
    """

    ways: Mapping[str, tuple[float, ...]]
    ours: Mapping[str, float]


def load_or_simulate_arm(job: Algorithm1Job) -> tuple[Robot, Measurements]:
    """A simulated arm at 100 poses, or a real one's training poses of Table 3."""
    if job.arm not in REAL_ALGORITHM_1_ARMS:
        robot = load_robot(job.arm)
        return robot, simulate(robot, 100, 3, job.seed).data
    robot, data = load_or_simulate_robot(REAL_ALGORITHM_1_ARMS[job.arm], job.seed)
    return robot, split_train_and_holdout(
        data, 1.0 - CONDITION_ROBOTS[REAL_ALGORITHM_1_ARMS[job.arm]][2] / data.poses, job.seed
    )[0]


def build_minimax_problem_and_start(
    job: Algorithm1Job, distance_form: str
) -> tuple[MinimaxProblem, ParameterValues]:
    """The minimax of an arm and its start, the least squares [M eq. 32].

    distance_form: of the distances, squared as in M eq. 8.
    """
    robot, data = load_or_simulate_arm(job)
    model, start = fit_least_squares(robot, data)
    return build_minimax_problem(
        model, start, measured_distances(data), distance_form, "target"
    ), start


def active_gradient_and_rows(linearisation: Linearisation) -> tuple[Array, Array, Array]:
    """∇F_I (p,), and the rows C (r,) and G (r, p) of M eq. 17 and 27."""
    active = int(linearisation.f.argmax())
    C = np.concatenate(
        [linearisation.f - linearisation.f.max(), linearisation.c - 1.0]
    )  # c_l = rt² - ε, over ε
    G = np.concatenate(
        [linearisation.jacobian - linearisation.jacobian[active], linearisation.normal]
    )
    return linearisation.jacobian[active], C, G


def solve_subgradient_subproblem(
    H: Array, gradient: Array, C: Array, G: Array
) -> tuple[Array, Array]:
    """Δx and λ by the primal-dual subgradient method [M eq. 22-24, Algorithm 1, inner loop]."""
    dx, lam = np.zeros(len(gradient)), np.zeros(len(C))
    for p in range(1, INNER_ITERATIONS + 1):
        row = C + G @ dx
        violated = row > 0.0
        T_x = H @ dx + gradient + G[violated].T @ lam[violated]
        T_lam = -np.where(violated, row, 0.0)
        size = math.sqrt(T_x @ T_x + T_lam @ T_lam)
        if size == 0.0:
            break
        alpha = (1.0 / p) / size
        dx, lam = dx - alpha * T_x, lam - alpha * T_lam
    return dx, lam


def backtracking_step_length(problem: MinimaxProblem, x: ParameterValues, dx: Array) -> float:
    """The first of 1, 1/2, 1/4 ... whose step lowers the largest of the F_i and keeps c_l <= 0."""

    def merit(at: ParameterValues) -> float:
        f, c = problem.evaluate(at)
        return float(f.max() + 10.0 * np.maximum(c - 1.0, 0.0).sum())

    before, share = merit(x), 1.0
    while share > MIN_LINE_SEARCH_STEP and not merit(problem.step(x, share * dx)) < before:
        share *= 0.5
    return share if share > MIN_LINE_SEARCH_STEP else 0.0


def run_algorithm_1(
    problem: MinimaxProblem, x: ParameterValues, outer_iterations: int, *, with_line_search: bool
) -> list[float]:
    """The largest F_i at the start and after each outer step [M Algorithm 1]."""
    at = problem.linearise(x)
    H = at.curvature(np.full(len(at.f), 1.0 / len(at.f)))
    lam = np.zeros(len(at.f) + len(at.c))
    values = [float(at.f.max())]
    for _ in range(outer_iterations):
        slope, C, G = active_gradient_and_rows(at)
        dx, after = solve_subgradient_subproblem(H, slope, C, G)
        dx = (backtracking_step_length(problem, x, dx) if with_line_search else 1.0) * dx
        x = problem.step(x, dx)
        at = problem.linearise(x)
        values.append(float(at.f.max()))
        if not np.isfinite(values[-1]):
            break
        next_slope, _, next_G = active_gradient_and_rows(at)
        q = next_slope + next_G.T @ after - (slope + G.T @ lam)
        lam = after
        if q @ dx > 0.0:
            Hs = H @ dx
            H = H + np.outer(q, q) / (q @ dx) - np.outer(Hs, Hs) / (dx @ Hs)
    return values


def run_all_variants(
    job: Algorithm1Job, backends: Sequence[str] = SUBGRADIENT_BACKENDS
) -> Algorithm1Result:
    """All ways on one arm, and our own search with some backends."""
    problem, start = build_minimax_problem_and_start(job, "squared")
    exact, _ = build_minimax_problem_and_start(
        job, "two-sided"
    )  # the same set, with gradients that do not vanish
    best = minimax.solve(
        exact, start, partial(solve_qp, name="daqp", tolerance=FIT_QP_TOLERANCE)
    ).value

    def over(value: float) -> float:
        return float(np.sqrt(value / best) - 1.0)

    ways = {
        way: tuple(map(over, run_algorithm_1(problem, start, job.outer, with_line_search=search)))
        for way, search in ALGORITHM_1_VARIANTS.items()
    }
    ours = {
        name: over(minimax.solve(exact, start, partial(solve_qp, name=name)).value)
        for name in backends
    }
    return Algorithm1Result(ways, ours)


def run_all_cases(study: Study) -> dict[Algorithm1Job, Algorithm1Result]:
    """All arms that are here."""
    arms = [
        *SIMULATED_ALGORITHM_1_ARMS,
        *(arm for arm, name in REAL_ALGORITHM_1_ARMS.items() if name in list_available_robots()),
    ]
    jobs = [Algorithm1Job(arm, study.seed, OUTER_ITERATIONS_BY_QUICK[study.quick]) for arm in arms]
    return dict(zip(jobs, study.sweep(run_all_variants, jobs, "arms"), strict=True))


def build_excess_table(results: Mapping[Algorithm1Job, Algorithm1Result]) -> Table:
    """RMSE(φ) over the optimum after some outer steps, and of our backends at the end."""
    steps = [step for step in SHOWN_OUTER_STEPS if all(step <= job.outer for job in results)]
    rows = []
    for job, course in results.items():
        rows += [
            (job.arm, way, values[0], *(excess_after_step(values, step) for step in steps))
            for way, values in course.ways.items()
        ]
        rows += [
            (job.arm, name, course.ways["as printed"][0], *[math.nan] * (len(steps) - 1), value)
            for name, value in course.ours.items()
        ]
    return Table.from_rows(
        "Algorithm 1 of paper M: RMSE(φ) over the optimum, minus one; our backends at their end",
        rows,
        "arm | way | start .1e",
        *(f"step {step} .1e" for step in steps),
    )


def excess_after_step(values: tuple[float, ...], step: int) -> float:
    """After an outer step, infinite where the numbers broke down before."""
    return values[step] if step < len(values) else math.inf


def save_results(study: Study, results: Mapping[Algorithm1Job, Algorithm1Result]) -> None:
    """The table."""
    content = {
        job.arm: {"ways": dict(course.ways), "ours": dict(course.ours)}
        for job, course in results.items()
    }
    study.save([build_excess_table(results)], content)


@study_options("algorithm_1")
def main(study: Study) -> None:
    """Paper M's Algorithm 1 to the letter, on simulated and real arms."""
    save_results(study, run_all_cases(study))
