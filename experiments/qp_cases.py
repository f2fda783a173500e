"""Quadratic programs to judge solvers on: from calibrations, from the literature, and hard ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.io import loadmat

from experiments import real_arms
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.cell_fit import FIT_QP_TOLERANCE
from minimax_cal.fitting.minimax_problem import build_minimax_problem, measured_distances
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.robot import load_robot
from minimax_cal.solvers import minimax
from minimax_cal.solvers.epigraph_qp import ignore_warm_start
from qp_backends import Problem, Solution
from qp_backends import solve as solve_qp

MAROS_MESZAROS_FOLDER = real_arms.SHARED_DATA_FOLDER / "maros_meszaros"
MAROS_MESZAROS_SET = "Maros-Meszaros"


@dataclass(frozen=True, eq=False)
class QpCase:
    """A problem and what is known of it: solvable, infeasible or unbounded."""

    name: str
    problem: Problem
    kind: str = "solvable"


def record_sqp_qps(minimax_over: str, pose_count: int, seed: int) -> list[QpCase]:
    """The QPs that one minimax calibration really solves, in order."""
    from experiments.speed import fit_least_squares

    robot = load_robot("irb2600")
    data = simulate(robot, pose_count, 3, seed).data
    model, state = fit_least_squares(robot, data)
    problem = build_minimax_problem(
        model, state, measured_distances(data), "two-sided", minimax_over
    )
    seen: list[Problem] = []

    def listen(qp: Problem) -> Solution:
        seen.append(qp)
        return solve_qp(qp, "daqp", tolerance=1e-9)

    minimax.solve(problem, state, ignore_warm_start(listen))
    rows = len(seen[0].l)
    return [
        QpCase(f"{minimax_over} {rows} rows, seed {seed}, QP {i + 1}", p)
        for i, p in enumerate(seen)
    ]


def record_calibration_qps(seed: int) -> list[Problem]:
    """Every QP that `mc.calibrate` puts to its backend: IRB 2600, 100 poses, three targets."""
    asked: list[Problem] = []

    def listen(problem: Problem) -> Solution:
        asked.append(problem)
        return solve_qp(problem, "daqp", tolerance=FIT_QP_TOLERANCE)

    calibrate("irb2600", simulate(load_robot("irb2600"), 100, 3, seed).data, qp=listen)
    return asked


def list_small_calibration_qps(quick: bool) -> list[QpCase]:
    """Worst of three targets with three distance rows."""
    return [
        case for seed in range(3 if quick else 20) for case in record_sqp_qps("target", 100, seed)
    ]


def list_large_calibration_qps(quick: bool) -> list[QpCase]:
    """Worst of 300 points with three distance rows."""
    return [
        case for seed in range(1 if quick else 4) for case in record_sqp_qps("point", 100, seed)
    ]


def read_maros_meszaros_qps(quick: bool) -> list[QpCase]:
    """The problems in shared data, if there: Maros and Meszaros 1999, in the OSQP form."""
    paths = sorted(MAROS_MESZAROS_FOLDER.glob("*.mat"))
    cases = []
    for path in paths:
        data = loadmat(path)
        P, A = sparse.csc_array(data["P"]), sparse.csc_array(data["A"])
        low, high = data["l"].ravel(), data["u"].ravel()
        low = np.where(low <= -1e20, -np.inf, low)  # the set's way to write infinity
        high = np.where(high >= 1e20, np.inf, high)
        cases.append(QpCase(path.stem, Problem(P, data["q"].ravel(), A, low, high)))
    return [case for case in cases if len(case.problem.q) < 200] if quick else cases


def build_hard_qps(quick: bool) -> list[QpCase]:
    """Degenerate, nearly singular, badly scaled, infeasible and unbounded problems."""
    rng = np.random.default_rng(0)
    cases = []
    for trial in range(2 if quick else 6):
        n, m = 20, 30
        root = rng.normal(size=(n, n))
        x = rng.normal(size=n)
        rows = rng.normal(size=(m, n))
        at = rows @ x
        room = rng.uniform(0.1, 1.0, m)
        q = rng.normal(size=n)
        open_below = np.full(m, -np.inf)
        full, below, above = root @ root.T, at - room, at + room
        twice = [np.repeat(side, 2) for side in (open_below, above)]
        lowest, highest = np.append(open_below, at[0] + 2.0), np.append(above, np.inf)
        made = {
            "degenerate": build_degenerate_qp(full, rows, np.zeros(m), x),
            "repeated rows": Problem(full, q, np.repeat(rows, 2, axis=0), *twice),
            "nearly singular": Problem(
                draw_matrix_of_spectrum(rng, n, 1e-9), q, rows, below, above
            ),
            "singular": Problem(root[:, :4] @ root[:, :4].T, q, rows, below, above),
            "badly scaled": scale_qp_badly(rng, Problem(full, q, rows, below, above)),
            "infeasible": Problem(full, q, np.vstack([rows, rows[:1]]), lowest, highest),
            "unbounded": draw_unbounded_qp(rng, n),
        }
        kinds = {name: name for name in ("infeasible", "unbounded")}
        cases += [QpCase(f"{name} {trial}", problem, kinds.get(name, "solvable"))
                  for name, problem in made.items()]  # fmt: skip
    return cases


def build_degenerate_qp(P: Array, rows: Array, slacks: Array, solution: Array) -> Problem:
    """More active rows than unknowns meet in x, which is the solution."""
    count = len(solution) + 5
    y = np.where(np.arange(len(rows)) < count, 1.0, 0.0)
    pull = -P @ solution - rows.T @ y  # stationarity at x
    slack = np.where(y > 0, 0.0, 1.0) + slacks
    return Problem(P, pull, rows, np.full(len(rows), -np.inf), rows @ solution + slack)


def draw_matrix_of_spectrum(rng: np.random.Generator, n: int, least_eigenvalue: float) -> Array:
    """A symmetric matrix with eigenvalues from 1 down to least."""
    basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
    matrix = (basis * np.geomspace(1.0, least_eigenvalue, n)) @ basis.T
    return np.asarray(0.5 * (matrix + matrix.T))


def scale_qp_badly(rng: np.random.Generator, problem: Problem) -> Problem:
    """The same problem in units that differ by up to 1e8, rows by up to 1e6."""
    unit = 10.0 ** rng.uniform(-4, 4, len(problem.q))
    row = 10.0 ** rng.uniform(-3, 3, len(problem.l))
    return Problem(
        problem.P * np.outer(unit, unit),
        problem.q * unit,
        problem.A * np.outer(row, unit),
        problem.l * row,
        problem.u * row,
    )


def draw_unbounded_qp(rng: np.random.Generator, n: int) -> Problem:
    """No curvature and no bound along one direction, downhill."""
    away = rng.normal(size=n)
    away /= np.linalg.norm(away)
    across = np.eye(n) - np.outer(away, away)
    root = across @ rng.normal(size=(n, n))
    rows = rng.normal(size=(8, n)) @ across
    P = root @ root.T
    return Problem(0.5 * (P + P.T), -away, rows, -np.ones(8), np.ones(8))


QP_CASE_SETS = {
    "calibration, 6 rows": list_small_calibration_qps,
    "calibration, 303 rows": list_large_calibration_qps,
    MAROS_MESZAROS_SET: read_maros_meszaros_qps,
    "hard": build_hard_qps,
}
