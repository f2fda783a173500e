"""What each QP backend is worth: accuracy, reliability and time, by one judge.

    python -m experiments.solver_accuracy [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

On the QPs that calibrations really produce, on the Maros-Meszaros problems in shared data, and on
hard ones.  Each backend is asked three times: through qpsolvers with its own defaults, and through
our `solve` (no fallback) at a loose and at a tight tolerance.  A problem counts as solved where the
judge finds primal, dual and gap at most 1e-6 relative to the problem's own scale
(`qp_backends.accuracy` says how that is defined), whatever the solver claims.  A problem has three
seconds; solvers with their own defaults, which may know no clock, run in a process that is ended.
"""

from __future__ import annotations

import multiprocessing
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from multiprocessing.pool import Pool
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import qpsolvers
from rich.progress import track
from scipy import sparse

from experiments.qp_cases import MAROS_MESZAROS_SET, QP_CASE_SETS, QpCase, record_calibration_qps
from experiments.speed import fit_least_squares
from experiments.study_record import new_figure
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.fitting.cell_fit import FIT_QP_TOLERANCE
from minimax_cal.fitting.minimax_problem import build_minimax_problem, measured_distances
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.robot import load_robot
from minimax_cal.solvers import minimax
from qp_backends import Accuracy, Problem, Solution, Status, accuracy, available
from qp_backends import solve as solve_qp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SOLVED_RESIDUAL = 1e-6  # relative residual at which an answer counts as right
LOOSE_TOLERANCE, TIGHT_TOLERANCE = 1e-6, 1e-9
TOLERANCE_BY_SETTING = {"ours 1e-6": LOOSE_TOLERANCE, "ours 1e-9": TIGHT_TOLERANCE}
SOLVER_SETTINGS = (*TOLERANCE_BY_SETTING, "own defaults")
TIME_MEAN_SHIFT_SECONDS = 1e-3  # of the shifted geometric mean of times [s]
MAX_SECONDS_PER_PROBLEM = 3.0  # time for one problem [s]
DIRECT_BACKENDS = ("daqp", "quadprog", "piqp", "clarabel", "proxqp", "highs", "osqp", "scs")
FALLBACK_ORDER_NAME = "fallback order"


@dataclass(frozen=True)
class SolverRun:
    """One backend on one problem: its claim, and what the judge finds."""

    case: str
    kind: str
    backend: str
    setting: str
    status: str
    judged: Accuracy
    seconds: float

    @property
    def is_right(self) -> bool:
        """Solved to the judge's satisfaction, or rightly called infeasible or unbounded."""
        if self.kind != "solvable":
            return self.status == self.kind
        return self.judged.worst <= MAX_SOLVED_RESIDUAL

    @property
    def is_wrong_claim(self) -> bool:
        """Claimed solved, or a certificate, wrongly."""
        claims = {"solved", "infeasible", "unbounded"}
        return self.status in claims and not self.is_right


def build_direct_call(
    problem: Problem, solver_name: str
) -> tuple[Callable[[], Any], Callable[[Any], Solution]]:
    """A call of qpsolvers with the solver's defaults on ready data, and how to read its answer."""
    sparse_form = sparse.issparse(problem.P) or sparse.issparse(problem.A)
    low, high = problem.l, problem.u
    same = low == high
    above, below = np.isfinite(high) & ~same, np.isfinite(low) & ~same
    A: Any = problem.A
    A = A.tocsr() if sparse_form and hasattr(A, "tocsr") else A
    stack = sparse.vstack if sparse_form else np.vstack
    G, h = None, None
    if above.any() or below.any():
        G = stack([A[np.flatnonzero(above)], -A[np.flatnonzero(below)]])
        h = np.concatenate([high[above], -low[below]])
    E, b = (A[np.flatnonzero(same)], high[same]) if same.any() else (None, None)
    P = problem.P
    if solver_name in ("daqp", "quadprog") and sparse_form:
        P, G, E = (None if m is None else to_dense(m) for m in (P, G, E))
    elif solver_name not in ("daqp", "quadprog"):
        P, G, E = (None if m is None else sparse.csc_matrix(m) for m in (P, G, E))
    data = qpsolvers.Problem(P, problem.q, G, h, E, b)

    def call() -> Any:
        return qpsolvers.solve_problem(data, solver=solver_name)

    def answer(found: Any) -> Solution:
        x, y = np.full(len(problem.q), np.nan), np.full(len(low), np.nan)
        if found is not None and found.x is not None:
            x = np.asarray(found.x, dtype=float)
            y = np.zeros(len(low))
            z = np.zeros(0) if found.z is None else np.asarray(found.z, dtype=float)
            if len(z) == above.sum() + below.sum():
                y[above] += z[: above.sum()]
                y[below] -= z[above.sum() :]
            if found.y is not None and same.any():
                y[same] = np.asarray(found.y, dtype=float)[: same.sum()]
        claim = found is not None and bool(found.found)
        return Solution(x, y, Status.SOLVED if claim else Status.FAILED, 0.0, solver_name)

    return call, answer


def to_dense(matrix: Any) -> Array:
    """A matrix as an array."""
    return np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix)


def run_and_time_without_warnings(call: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and its seconds; solvers warn about what the judge measures."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began = time.perf_counter()
        found = call()
        return found, time.perf_counter() - began


def solve_with_own_defaults(problem: Problem, solver_name: str) -> tuple[Solution, float]:
    """The answer of a solver with its own defaults, and its seconds."""
    call, answer = build_direct_call(problem, solver_name)
    found, seconds = run_and_time_without_warnings(call)
    return answer(found), seconds


def solve_within_time_limit(
    pools: list[Pool], problem: Problem, solver_name: str
) -> tuple[Solution, float]:
    """`solve_with_own_defaults` in the process of the one pool, ended when it takes too long.

    Raises TimeoutError.
    """
    if not pools:  # a fork may hang in a solver's threads
        pools.append(multiprocessing.get_context("spawn").Pool(1))
        pools[0].apply(shifted_geometric_mean, ([0.0],))  # starting does not count
    try:
        return (
            pools[0]
            .apply_async(solve_with_own_defaults, (problem, solver_name))
            .get(MAX_SECONDS_PER_PROBLEM)
        )
    except multiprocessing.TimeoutError:
        pools.pop().terminate()
        raise TimeoutError from None


def solve_with_our_backend(
    problem: Problem, backend_name: str, tolerance: float
) -> tuple[Solution, float]:
    """The answer of our `solve`, or of its fallback order, and its seconds."""
    across = backend_name == FALLBACK_ORDER_NAME
    solve = partial(solve_qp, problem, "daqp" if across else backend_name, tolerance=tolerance)
    return run_and_time_without_warnings(
        partial(solve, time_limit=MAX_SECONDS_PER_PROBLEM, fallback=across)
    )


def run_and_judge_backend(case: QpCase, backend: str, setting: str, pools: list[Pool]) -> SolverRun:
    """Run one backend in one setting on one problem, and judge it."""
    problem, seconds = case.problem, MAX_SECONDS_PER_PROBLEM
    solution = Solution(np.zeros(0), np.zeros(0), Status.FAILED, 0.0, backend)
    try:
        if setting == "own defaults":
            solution, seconds = solve_within_time_limit(pools, problem, backend)
        else:
            solution, seconds = solve_with_our_backend(
                problem, backend, TOLERANCE_BY_SETTING[setting]
            )
    except TimeoutError:
        solution = replace(solution, status=Status.TIME_LIMIT)
    except Exception as error:  # a third-party solver may raise anything; the row then says failed
        solution = replace(solution, notes=(str(error),))
    status, judged = solution.status.name.lower(), accuracy(problem, solution)
    return SolverRun(case.name, case.kind, backend, setting, status, judged, seconds)


def reference_objectives(cases: Sequence[QpCase]) -> dict[str, float]:
    """Objectives by problem from the most accurate answer of several solvers; NaN without one."""
    values = {}
    for case in cases:
        best = (np.inf, np.nan)
        for name in ("daqp", "quadprog", "piqp", "clarabel", "highs"):
            if case.kind == "solvable" and name in available() and best[0] > 1e-13:
                solution = solve_qp(
                    case.problem,
                    name,
                    tolerance=1e-11,
                    time_limit=MAX_SECONDS_PER_PROBLEM,
                    fallback=False,
                )
                judged = accuracy(case.problem, solution)
                best = min(best, (judged.worst, judged.objective))
        values[case.name] = best[1] if best[0] <= 1e-8 else np.nan
    return values


def shifted_geometric_mean(times: Sequence[float]) -> float:
    """Shifted geometric mean [s], robust against both very fast and very slow problems."""
    return float(
        np.exp(np.mean(np.log(np.array(times) + TIME_MEAN_SHIFT_SECONDS))) - TIME_MEAN_SHIFT_SECONDS
    )


def build_accuracy_table(
    set_name: str, runs: Sequence[SolverRun], reference_objectives: dict[str, float]
) -> Table:
    """One set of problems: a row a backend and setting."""
    rows = []
    keys = dict.fromkeys((run.backend, run.setting) for run in runs)
    for backend, setting in keys:
        mine = [run for run in runs if (run.backend, run.setting) == (backend, setting)]
        solved = [run for run in mine if run.is_right and run.kind == "solvable"]
        known = [(r.judged.objective, reference_objectives[r.case]) for r in solved]
        off = [
            abs(value - best) / max(1.0, abs(best)) for value, best in known if np.isfinite(best)
        ]
        worst = [max((getattr(run.judged, name) for run in solved), default=np.nan)
                 for name in ("worst", "primal", "dual", "gap")]  # fmt: skip
        rows.append(
            (
                backend,
                setting,
                len(mine),
                float(100.0 * np.mean([r.is_right for r in mine])),
                sum(run.is_wrong_claim for run in mine),
                *worst,
                max(off, default=np.nan),
                1e3 * shifted_geometric_mean([run.seconds for run in mine]),
            )
        )
    return Table.from_rows(
        f"{set_name}: residuals are the largest over the problems solved",
        rows,
        "backend | setting | problems d | right % .1f | wrongly claimed d | "
        "worst relative .1e | primal abs .1e | dual abs .1e | gap abs .1e | "
        "objective error .1e | ms (shifted mean) .3f",
    )


def build_solve_cost_table(
    problems: Sequence[Problem], backends: Sequence[str], repeats: int
) -> Table:
    """Processor time of our `solve` beside others on the QPs of one calibration, as it asks them.

    Ours checks each answer and asks for the calibration's tolerance; qpsolvers.solve_problem gets
    ready data and the solver's defaults; daqp.solve ready arrays.  A time is the sum over the QPs
    of each one's median.
    """
    rows = []
    for backend in backends:
        spent = np.zeros((len(problems), 3))
        for number, problem in enumerate(problems):
            calls: list[Callable[[], Any]] = [
                partial(solve_qp, problem, backend, tolerance=FIT_QP_TOLERANCE),
                build_direct_call(problem, backend)[0],
                *([build_raw_daqp_call(problem)] if backend == "daqp" else []),
            ]
            times = [[mean_processor_seconds(call) for call in calls] for _ in range(repeats + 1)]
            spent[number, : len(calls)] = np.median(times[1:], axis=0)
        ours, theirs, raw = 1e6 * spent.mean(axis=0)
        raw = raw or np.nan
        rows.append((backend, len(problems), ours, theirs, ours / theirs, raw, ours / raw))
    return Table.from_rows(
        "what solve costs beside qpsolvers and beside daqp itself, on the QPs of mc.calibrate of "
        f"an IRB 2600 (100 poses, three targets, objective "
        f"minimax), tolerance {FIT_QP_TOLERANCE:g}",
        rows,
        "backend | QPs d | qp_backends.solve us .0f | qpsolvers.solve_problem us .0f | "
        "ours over it .2f | daqp.solve us .0f | ours over that .2f",
    )


def build_raw_daqp_call(problem: Problem) -> Callable[[], Any]:
    """A call of daqp itself on ready arrays: simple bounds are rows, and equalities are marked."""
    daqp = import_module("daqp")
    rows = np.ascontiguousarray(to_dense(problem.A))
    low, high = np.maximum(problem.l, -1e30), np.minimum(problem.u, 1e30)
    sense = np.where(low == high, 5, 0).astype(np.int32)
    P = np.ascontiguousarray(to_dense(problem.P))
    return lambda: daqp.solve(P, problem.q, rows, high, low, sense)


def mean_processor_seconds(call: Callable[[], Any]) -> float:
    """Seconds of the processor that a call takes, the mean over at least 2 ms of calls [s]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # solvers warn about what the judge measures
        began, count = time.process_time(), 0
        while count == 0 or time.process_time() - began < 2e-3:
            call()
            count += 1
        return (time.process_time() - began) / count


def build_subgradient_table(
    cases: Sequence[QpCase], max_iterations: int
) -> tuple[Table, dict[str, Array]]:
    """Relative objective error of the subgradient methods against iterations."""
    from qp_backends.subgradient import METHODS, iterate

    marks = [10**k for k in range(1, 7) if 10**k <= max_iterations]
    reference = reference_objectives(cases)
    curves: dict[str, Array] = {}
    rows = []
    for method in METHODS:
        reach = [mark for mark in marks if method == "restarted" or mark <= max_iterations // 10]
        errors = np.full((len(cases), len(marks)), np.nan)
        judged_well = np.zeros(len(cases), dtype=bool)
        for i, case in enumerate(cases):
            pending = list(enumerate(reach))
            error = np.inf
            for answer in iterate(case.problem, method, every=10):
                while pending and answer.iterations > pending[0][1]:
                    errors[i, pending.pop(0)[0]] = error
                judged = accuracy(case.problem, answer)
                error = objective_or_row_error(judged, reference[case.name])
                judged_well[i] |= judged.worst <= MAX_SOLVED_RESIDUAL
                if not pending or error < 1e-13:
                    break
            for j, _ in pending:
                errors[i, j] = error
        curves[method] = errors
        hit = 100.0 * np.mean(np.nanmin(errors, axis=1) <= MAX_SOLVED_RESIDUAL)
        middle = [float(np.median(column)) for column in errors.T]
        rows.append((method, float(hit), float(100.0 * judged_well.mean()), *middle))
    table = Table.from_rows(
        f"restarted averaged PDHG and paper M's subgradient on {len(cases)} calibration QPs: "
        "median error (of the objective, relative to max f, or of the rows) against iterations; "
        "share within 1e-6, and share that the judge finds solved",
        rows,
        "method | within 1e-6 % .1f | judged solved % .1f",
        *(f"{mark:g} .1e" for mark in marks),
    )
    return table, {"iterations": np.array(marks, dtype=float), **curves}


def objective_or_row_error(judged: Accuracy, reference_objective: float) -> float:
    """Error of an iterate: of its objective, or of its constraints where that is larger.

    The QP's values are relative to max f = 1, so 1 is the scale of the objective.
    """
    if not np.isfinite(judged.worst):
        return float("inf")
    return max(
        abs(judged.objective - reference_objective) / max(1.0, abs(reference_objective)),
        judged.primal_relative,
    )


def build_sqp_value_table(backends: Sequence[str], seed: int) -> Table:
    """The max F_i / m_i that the calibration's SQP reaches with each backend."""
    robot = load_robot("irb2600")
    data = simulate(robot, 100, 3, seed).data
    model, state = fit_least_squares(robot, data)
    problem = build_minimax_problem(model, state, measured_distances(data), "two-sided", "target")
    rows = []
    best = np.nan
    for backend in backends:
        loose = backend.startswith("subgradient")
        qp = partial(
            solve_qp,
            name=backend,
            tolerance=1e-6 if loose else 1e-9,
            fallback=not loose,
            time_limit=60.0 if loose else np.inf,
        )
        began = time.perf_counter()
        settings = minimax.Sqp(tolerance=1e-5 if loose else 1e-8, iterations=50)
        found = minimax.solve(problem, state, qp, settings)
        seconds = time.perf_counter() - began
        value = found.value * problem.size * 1e6
        best = value if np.isnan(best) else min(best, value)
        rows.append((backend, str(found.status), found.iterations, value, value / best - 1.0,
                     found.kkt.residual, 1e3 * seconds))  # fmt: skip
    return Table.from_rows(
        "minimax calibration (IRB 2600, 100 poses, three targets) with each backend",
        rows,
        "backend | status | QPs d | max F_i/m mm^2 .9f | above the first .1e | "
        "KKT residual .1e | ms .1f",
    )


def draw_performance_profile(set_name: str, runs: Sequence[SolverRun]) -> Figure:
    """Performance profile: share of problems solved within a factor of the fastest time."""
    figure = new_figure(7, 4.5)
    axes = figure.subplots()
    ours = [run for run in runs if run.setting == "ours 1e-6"]
    names = dict.fromkeys(run.case for run in ours)
    fastest = {
        name: min(
            (run.seconds for run in ours if run.case == name and run.is_right), default=np.nan
        )
        for name in names
    }
    for number, backend in enumerate(dict.fromkeys(run.backend for run in ours)):
        mine = [run for run in ours if run.backend == backend]
        ratio = np.sort([r.seconds / fastest[r.case] if r.is_right else np.inf for r in mine])
        share = 100.0 * (np.arange(len(ratio)) + 1) / len(ratio)
        shown = np.isfinite(ratio)
        style = ("-", "--", ":")[number // 10 % 3]
        axes.step(ratio[shown], share[shown], where="post", label=backend, linestyle=style)
    axes.set(xscale="log", xlabel="time / fastest time", ylabel="problems solved to 1e-6 (%)",
             ylim=(0, 102), title=set_name)  # fmt: skip
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")
    return figure


def draw_convergence_figure(curves: dict[str, Array]) -> Figure:
    """Error of the subgradient methods against iterations: median and quartiles."""
    figure = new_figure(7, 4.5)
    axes = figure.subplots()
    marks = curves["iterations"]
    for method, errors in curves.items():
        if method == "iterations":
            continue
        known = ~np.isnan(errors).any(axis=0)
        finite = np.maximum(errors[:, known], 1e-17)
        middle = np.median(finite, axis=0)
        (line,) = axes.plot(marks[known], middle, "o-", label=method)
        low, high = np.quantile(finite, (0.25, 0.75), axis=0)
        axes.fill_between(marks[known], low, high, color=line.get_color(), alpha=0.2)
    axes.set(xscale="log", yscale="log", xlabel="iterations", ylabel="error of objective or rows")
    axes.grid(visible=True, alpha=0.3)
    axes.legend()
    return figure


def list_available_backends(quick: bool) -> list[str]:
    """Installed backends worth a row, the fallback order last."""
    found = [name for name in (*DIRECT_BACKENDS, "ecos", "qpalm", "cvxpy") if name in available()]
    return (
        [*found, "subgradient", FALLBACK_ORDER_NAME] if not quick else [*found, FALLBACK_ORDER_NAME]
    )


def run_all_backends(quick: bool) -> tuple[dict[str, list[SolverRun]], dict[str, list[QpCase]]]:
    """All runs by set, and the problems."""
    runs: dict[str, list[SolverRun]] = {}
    problems: dict[str, list[QpCase]] = {}
    pools: list[Pool] = []
    for group, make in QP_CASE_SETS.items():
        cases = make(quick)
        problems[group] = cases
        jobs = [
            (case, backend, setting)
            for backend in list_available_backends(quick)
            for setting in SOLVER_SETTINGS
            if not (setting == "own defaults" and backend not in DIRECT_BACKENDS)
            and not (backend == "subgradient" and (setting == "ours 1e-9" or "calib" not in group))
            for case in cases
        ]
        runs[group] = [
            run_and_judge_backend(case, backend, setting, pools)
            for case, backend, setting in track(jobs, description=group, transient=True)
        ]
    for pool in pools:
        pool.terminate()
    return runs, problems


@study_options("solver_accuracy")
def main(study: Study) -> None:
    """Tables and profiles of QP accuracy, reliability and time.

    Times are compared, so the runs go one after the other: --jobs and --cluster do not apply.
    """
    quick = study.quick
    runs, problems = run_all_backends(quick)
    tables: list[Table] = []
    figures: dict[str, Figure] = {}
    summary: dict[str, object] = {}
    for group, found in runs.items():
        if not found:
            click.echo(f"{group}: no problems here (shared data absent)")
            continue
        tables.append(build_accuracy_table(group, found, reference_objectives(problems[group])))
        summary[group] = [
            {"backend": row[0], "setting": row[1], "right_percent": row[3], "lies": row[4]}
            for row in tables[-1].rows
        ]
        if group == MAROS_MESZAROS_SET:
            figures[f"profile_{group}"] = draw_performance_profile(group, found)
    small = problems["calibration, 6 rows"]
    direct_ones = [name for name in DIRECT_BACKENDS if name in available()]
    timing = build_solve_cost_table(
        record_calibration_qps(study.seed), direct_ones, 3 if quick else 9
    )
    sub, curves = build_subgradient_table(
        small[:4] if quick else small, 10_000 if quick else 100_000
    )
    values = build_sqp_value_table([*direct_ones, "cvxpy", "subgradient"], study.seed)
    figures["subgradient"] = draw_convergence_figure(curves)
    summary["overhead_ratio"] = {str(row[0]): row[4] for row in timing.rows}
    summary["subgradient_reach_percent"] = {str(row[0]): row[1] for row in sub.rows}
    summary["sqp_above_best"] = {str(row[0]): row[4] for row in values.rows}
    packages = available().keys() - {"proxqp", "highs", "subgradient"}
    study.save([*tables, timing, sub, values], summary, figures, packages)
    lies = [
        run
        for found in runs.values()
        for run in found
        if run.is_wrong_claim and "ours" in run.setting
    ]
    if lies:
        raise click.ClickException(f"{len(lies)} wrong answers were passed on as right")
