"""Error against iteration on real data: all least-squares methods, and minimax with every backend.

    python -m experiments.calibration_process [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Paper S shows this for its own measurements of an IRB 2600, which are not public; here it is shown
for the public IRB 120, FANUC and UR10 measurements, and for the simulated IRB 2600.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import click
import numpy as np

import minimax_cal as mc
from experiments import sweep
from experiments.conditions import ROBOTS, shared
from experiments.real import here
from experiments.speed import identified
from experiments.sweep import Study, study_options
from minimax_cal.fitting.minimax_problem import measured_distances, minimax_problem
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.grouping import split
from minimax_cal.modelling.model import SumOfSquares, model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers import least_squares, minimax
from minimax_cal.solvers.least_squares import METHODS
from qp_backends import available
from qp_backends import solve as solve_qp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BACKENDS = ("daqp", "quadprog", "piqp", "clarabel", "osqp", "proxqp", "highs", "scs", "subgradient")
ARMS = {**ROBOTS, "ur10": ("UR10 series B, real", shared("ur10_b"), 300)}
FOLDERS = {"irb120": "irb120", "fanuc": "fanuc_r2000", "ur10": "ur10_b"}


@dataclass(frozen=True)
class Job:
    """One robot with one way: a least-squares method, or a QP backend of minimax."""

    robot: str
    way: str
    kind: str
    seed: int


@dataclass(frozen=True)
class Process:
    """RMS or RMSE(phi) of the training poses at every iteration [mm], held out at the end [mm]."""

    values: tuple[float, ...]
    held_mm: float
    status: str


def run(job: Job) -> Process:
    """Fit and keep the course of the error."""
    _, load, train = ARMS[job.robot]
    robot, data = load(job.seed)
    fitted, held, _ = split(data, 1.0 - train / data.poses, job.seed)
    model, begin = identified(robot, fitted)
    points = float(model.counts.sum())
    method = METHODS[job.way] if job.kind == "method" else METHODS["snllm"]
    squares = least_squares.solve(SumOfSquares(model), begin.batch(), 1, points, method)
    values = 1e3 * np.sqrt(squares.trace[:, 0] / points)
    status, x = str(squares.status[0]), squares.x.take(np.array(0))
    if job.kind == "backend":
        problem = minimax_problem(model, x, measured_distances(fitted), "two-sided", "target")
        loose = job.way == "subgradient"
        qp = partial(solve_qp, name=job.way, tolerance=1e-7 if loose else 1e-9, fallback=not loose)
        best = minimax.solve(problem, x, qp, minimax.Sqp(tolerance=1e-6 if loose else 1e-8))
        course = [step.value for step in best.trace] + [best.value]
        values = 1e3 * np.sqrt(np.array(course) * problem.size)
        status, x = str(best.status), best.x
    return Process(tuple(values.tolist()), held_rms(robot, held, x), status)


def held_rms(robot: mc.Robot, held: mc.Measurements, x: State) -> float:
    """RMS of a state on held-out poses [mm]."""
    error = model_of(robot, held).error(x)
    return float(1e3 * np.sqrt(np.nanmean((error**2).sum(axis=-1))))


def ways(robot: str) -> list[tuple[str, str]]:
    """Methods, and backends where there are several targets."""
    methods = [(name, "method") for name in METHODS]
    single = robot == "ur10"
    chosen = () if single else tuple(b for b in BACKENDS if b in (*available(), "subgradient"))
    return [*methods, *((name, "backend") for name in chosen)]


def table_of(title: str, found: dict[tuple[str, str], Process]) -> Table:
    """How each way ended."""
    rows: list[tuple[Cell, ...]] = [
        (
            kind,
            way,
            len(process.values) - 1,
            process.values[0],
            process.values[-1],
            process.held_mm,
            process.status,
        )
        for (way, kind), process in found.items()
    ]
    return Table(
        f"{title}: RMS of the methods, RMSE(phi) of minimax from the least-squares fit",
        ("kind", "method or backend", "iterations", "start mm", "end mm", "held-out RMS mm",
         "status"),
        tuple(rows),
        ("", "", "d", ".4f", ".9f", ".4f", ""),
    )  # fmt: skip


def courses(title: str, found: dict[tuple[str, str], Process]) -> Figure:
    """The errors against the iteration, above the least value reached."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, kind, label in zip(
        panels, ("method", "backend"), ("RMS", "RMSE(phi) of minimax"), strict=True
    ):
        chosen = {way: process for (way, k), process in found.items() if k == kind}
        for number, (way, process) in enumerate(chosen.items()):
            style = ("-", "--", ":")[number % 3]
            axes.plot(process.values, style, marker=".", label=way)
        axes.set(xlabel="iteration", ylabel=f"{label} (mm)", yscale="log")
        axes.grid(visible=True, alpha=0.3)
        if chosen:
            axes.legend(fontsize="small")
        else:
            axes.text(0.5, 0.5, "one target: minimax is the sum", ha="center",
                      transform=axes.transAxes)  # fmt: skip
    figure.suptitle(title)
    return figure


def present(robots: Sequence[str]) -> list[str]:
    """Those whose measurements are on this machine."""
    return [name for name in robots if name not in FOLDERS or here(FOLDERS[name])]


@click.command()
@study_options("calibration_process")
def main(study: Study) -> None:
    """Error against iteration for all methods and backends."""
    robots = present(("irb2600", "irb120") if study.quick else tuple(ARMS))
    jobs = [Job(name, way, kind, study.seed) for name in robots for way, kind in ways(name)]
    outcomes = study.sweep(run, jobs, "calibration process")
    tables, figures = [], {}
    content: list[dict[str, object]] = []
    for name in robots:
        found = {
            (job.way, job.kind): outcome
            for job, outcome in zip(jobs, outcomes, strict=True)
            if job.robot == name
        }
        tables.append(table_of(ARMS[name][0], found))
        figures[f"process_{name}"] = courses(ARMS[name][0], found)
        content += [
            {"robot": name, "way": way, "kind": kind, "course_mm": list(p.values),
             "holdout_rms_mm": p.held_mm, "status": p.status}
            for (way, kind), p in found.items()
        ]  # fmt: skip
    study.save(tables, {"rows": content}, figures)


if __name__ == "__main__":
    sweep.start(__file__)
