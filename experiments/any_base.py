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

from experiments.convergence import (
    MAX_CONVERGED_POINT_MOTION,
    MAX_SAME_MINIMUM_RATIO,
    ConvergenceSetting,
    build_identifiable_model,
    build_paper_starts,
)
from experiments.sweep import Study, study_options
from minimax_cal.core.tables import Table, TableCell
from minimax_cal.modelling.global_start import fit_base_and_targets, search_base_rotations
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LEAST_SQUARES_METHODS, LeastSquaresLimits

ACCEPTED_MISS_FRACTION_OF_REACH = (
    5e-3  # share of the reach: what the calibration command takes for a gross miss
)
MAX_ANGLE_DEVIATION = 3.1  # deviation of theta_2 and alpha_3 [rad]


@dataclass(frozen=True)
class BaseTrial:
    """One base pose with one pair of deviations [rad]."""

    setting: ConvergenceSetting
    theta: float
    alpha: float


@dataclass(frozen=True)
class BaseTrialResult:
    """Whether each way reached the global minimum, and its time [s]."""

    snlgn: bool
    snllm: bool
    ours: bool
    paper_seconds: float
    our_seconds: float
    our_rms_mm: float
    least_rms_mm: float


def draw_trials(seed: int, count: int, joint_half_range: float) -> list[BaseTrial]:
    """Random bases and deviations; every trial has poses and errors of its own."""
    rng = np.random.default_rng(seed)
    return [
        BaseTrial(
            ConvergenceSetting(
                seed=seed + 1000 * i, base_angle=float(rng.uniform(0, np.pi)), span=joint_half_range
            ),
            float(rng.uniform(-MAX_ANGLE_DEVIATION, MAX_ANGLE_DEVIATION)),
            float(rng.uniform(-MAX_ANGLE_DEVIATION, MAX_ANGLE_DEVIATION)),
        )
        for i in range(count)
    ]


def run_trial(trial: BaseTrial) -> BaseTrialResult:
    """The paper's start and ours on one trial."""
    robot, model = build_identifiable_model(trial.setting)
    points = float(model.pose_counts_by_target.sum())
    least = global_minimum_cost(robot, model)
    off = robot.mdh.copy()
    off[1, kinematics.THETA] += trial.theta
    off[2, kinematics.ALPHA] += trial.alpha
    began = time.perf_counter()
    reached = {}
    for method in ("snlgn", "snllm"):
        begin = build_paper_starts(robot, (trial.theta,), (trial.alpha,))
        found = least_squares.solve(
            PointLeastSquares(model),
            begin,
            1,
            points,
            LEAST_SQUARES_METHODS[method],
            LeastSquaresLimits(MAX_CONVERGED_POINT_MOTION, 500),
            keep_trace=False,
        )
        reached[method] = bool(found.cost[0] <= least * MAX_SAME_MINIMUM_RATIO)
    middle = time.perf_counter()
    ours = search_base_rotations(
        model, off, points, ACCEPTED_MISS_FRACTION_OF_REACH * robot.reach()
    )
    ended = time.perf_counter()
    return BaseTrialResult(
        reached["snlgn"],
        reached["snllm"],
        bool(ours.cost[0] <= least * MAX_SAME_MINIMUM_RATIO),
        middle - began,
        ended - middle,
        float(1e3 * np.sqrt(ours.cost[0] / points)),
        float(1e3 * np.sqrt(least / points)),
    )


def global_minimum_cost(robot: Robot, model: PointModel) -> float:
    """The global minimum, reached from the nominal geometry's closed-form start."""
    points = float(model.pose_counts_by_target.sum())
    begin = fit_base_and_targets(model, robot.mdh).state
    found = least_squares.solve(
        PointLeastSquares(model), begin.batch(), 1, points, keep_trace=False
    )
    return float(found.cost[0])


def build_success_row(
    joint_half_range: float, results: Sequence[BaseTrialResult]
) -> tuple[TableCell, ...]:
    """Shares of success [%] and times [ms]."""

    def share(name: str) -> float:
        return 100.0 * float(np.mean([getattr(result, name) for result in results]))

    return (
        joint_half_range,
        len(results),
        share("snlgn"),
        share("snllm"),
        share("ours"),
        1e3 * float(np.median([result.paper_seconds for result in results])) / 2.0,
        1e3 * float(np.median([result.our_seconds for result in results])),
        max(result.our_rms_mm / result.least_rms_mm for result in results),
    )


JOINT_HALF_RANGES = (1.0, float(np.pi))  # poses within so far of zero [rad]


def run_all_cases(study: Study, trials_per_span: int = 200) -> dict[float, list[BaseTrialResult]]:
    """The trials of each span."""
    trials_per_span = 4 if study.quick else trials_per_span
    return {
        span: study.sweep(
            run_trial,
            draw_trials(study.seed, trials_per_span, span),
            f"poses within {span:.2f} rad",
        )
        for span in JOINT_HALF_RANGES
    }


def save_results(study: Study, results_by_range: dict[float, list[BaseTrialResult]]) -> None:
    """The table."""
    table = Table.from_rows(
        "random base poses x random deviations of theta_2, alpha_3 within 3.1 rad: share of trials "
        "that reach the global minimum",
        (build_success_row(span, results) for span, results in results_by_range.items()),
        "poses within rad .2f | trials d | SNLGN, paper's start % .1f | "
        "SNLLM, paper's start % .1f | our search % .1f | paper ms .0f | ours ms .0f | "
        "our worst RMS / least .6f",
    )
    names = ("span_rad", "trials", "snlgn_percent", "snllm_percent", "ours_percent", "paper_ms",
             "ours_ms", "worst_ratio")  # fmt: skip
    study.save([table], {"rows": table.to_records(*names)})


@study_options("any_base")
@click.option("--trials", "count", type=int, default=200, show_default=True)
def main(study: Study, count: int) -> None:
    """Global convergence from any base pose."""
    save_results(study, run_all_cases(study, count))
