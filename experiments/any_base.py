"""The tracker may stand anywhere: the global minimum from any base pose and gross angle errors.

    python -m experiments.any_base [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

What paper S leaves out.  Random base poses (any rotation, metres away) times random deviations of
theta_2 and alpha_3 within 3.1 rad: the paper's start (base at the identity, separable
Levenberg-Marquardt and Gauss-Newton) against our search over base rotations.  Poses within 1 rad,
where the paper's claim holds for a known base, and over the whole joint range, where it does not.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import click
import numpy as np

from experiments.convergence import SAME, STEP, Setting, problem_of, starts_of
from experiments.sweep import Study, study_options
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.modelling.model import Model, SumOfSquares
from minimax_cal.modelling.start import fit_base, search
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, Limits

GOOD = 5e-3  # share of the reach: what the calibration command takes for a gross miss
LARGEST = 3.1  # deviation of theta_2 and alpha_3 [rad]


@dataclass(frozen=True)
class Trial:
    """One base pose with one pair of deviations [rad]."""

    setting: Setting
    theta: float
    alpha: float


@dataclass(frozen=True)
class Result:
    """Whether each way reached the global minimum, and its time [s]."""

    snlgn: bool
    snllm: bool
    ours: bool
    paper_seconds: float
    our_seconds: float
    our_rms_mm: float
    least_rms_mm: float


def trials(seed: int, count: int, span: float) -> list[Trial]:
    """Random bases and deviations; every trial has poses and errors of its own."""
    rng = np.random.default_rng(seed)
    return [
        Trial(
            Setting(seed=seed + 1000 * i, base_angle=float(rng.uniform(0, np.pi)), span=span),
            float(rng.uniform(-LARGEST, LARGEST)),
            float(rng.uniform(-LARGEST, LARGEST)),
        )
        for i in range(count)
    ]


def run(trial: Trial) -> Result:
    """The paper's start and ours on one trial."""
    robot, model = problem_of(trial.setting)
    points = float(model.counts.sum())
    least = truth_cost(robot, model)
    off = robot.mdh.copy()
    off[1, kinematics.THETA] += trial.theta
    off[2, kinematics.ALPHA] += trial.alpha
    began = time.perf_counter()
    reached = {}
    for method in ("snlgn", "snllm"):
        begin = starts_of(robot, (trial.theta,), (trial.alpha,))
        found = least_squares.solve(
            SumOfSquares(model), begin, 1, points, METHODS[method], Limits(STEP, 500), trace=False
        )
        reached[method] = bool(found.cost[0] <= least * SAME)
    middle = time.perf_counter()
    ours = search(model, off, points, GOOD * robot.reach())
    ended = time.perf_counter()
    return Result(
        reached["snlgn"],
        reached["snllm"],
        bool(ours.cost[0] <= least * SAME),
        middle - began,
        ended - middle,
        float(1e3 * np.sqrt(ours.cost[0] / points)),
        float(1e3 * np.sqrt(least / points)),
    )


def truth_cost(robot: Robot, model: Model) -> float:
    """The global minimum, reached from the nominal geometry's closed-form start."""
    points = float(model.counts.sum())
    begin = fit_base(model, robot.mdh).state
    found = least_squares.solve(SumOfSquares(model), begin.batch(), 1, points, trace=False)
    return float(found.cost[0])


def row_of(span: float, results: Sequence[Result]) -> tuple[Cell, ...]:
    """Shares of success [%] and times [ms]."""

    def share(name: str) -> float:
        return 100.0 * float(np.mean([getattr(result, name) for result in results]))

    return (
        span,
        len(results),
        share("snlgn"),
        share("snllm"),
        share("ours"),
        1e3 * float(np.median([result.paper_seconds for result in results])) / 2.0,
        1e3 * float(np.median([result.our_seconds for result in results])),
        max(result.our_rms_mm / result.least_rms_mm for result in results),
    )


SPANS = (1.0, float(np.pi))  # poses within so far of zero [rad]


def study_of(study: Study, count: int = 200) -> dict[float, list[Result]]:
    """The trials of each span."""
    count = 4 if study.quick else count
    return {
        span: study.sweep(run, trials(study.seed, count, span), f"poses within {span:.2f} rad")
        for span in SPANS
    }


def save(study: Study, found: dict[float, list[Result]]) -> None:
    """The table."""
    table = Table.made(
        "random base poses x random deviations of theta_2, alpha_3 within 3.1 rad: share of trials "
        "that reach the global minimum",
        (row_of(span, results) for span, results in found.items()),
        "poses within rad .2f | trials d | SNLGN, paper's start % .1f | "
        "SNLLM, paper's start % .1f | our search % .1f | paper ms .0f | ours ms .0f | "
        "our worst RMS / least .6f",
    )
    names = ("span_rad", "trials", "snlgn_percent", "snllm_percent", "ours_percent", "paper_ms",
             "ours_ms", "worst_ratio")  # fmt: skip
    study.save([table], {"rows": table.records(*names)})


@study_options("any_base")
@click.option("--trials", "count", type=int, default=200, show_default=True)
def main(study: Study, count: int) -> None:
    """Global convergence from any base pose."""
    save(study, study_of(study, count))
