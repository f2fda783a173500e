"""The seven conditions of paper M, Table 3 and Fig. 2-6, on simulated and real robots.

    python -m experiments.conditions [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

0 nominal, 1-3 one target alone, 4 the sum, 5 minimax, 6 pose, and the worst point (ours): F_i and
RMSE(phi) = sqrt(max F_i / m), position accuracy AP and orientation accuracy AO (ISO 9283, largest
Euler deviation) and AO' = |log(R_m' R_c)|, each on the training and on the held-out poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

import minimax_cal as mc
from experiments.pose_fitting import (
    euler_deviation,
    fit_poses_to_points,
    orientation_error,
    triangle_from_distances,
)
from experiments.real_arms import has_measurements, read_real_arm
from experiments.study_record import new_figure
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.tables import Table
from minimax_cal.fitting.options import Objective
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting.plots.error_figure import AFTER_COLOUR, BEFORE_COLOUR
from minimax_cal.robots.robot import Robot, load_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Condition = Objective | Literal["nominal"]
CALIBRATION_CONDITIONS: tuple[Condition, ...] = (
    "nominal",
    "smr:1",
    "smr:2",
    "smr:3",
    "sum",
    "minimax",
    "pose",
    "point",
)
PAPER_M_TABLE_3 = {  # Table 3 of the paper: F_1, F_2, F_3 [mm^2, 100 poses], RMSE(phi) [mm]
    "nominal": (325.90, 261.23, 373.88, 1.934),
    "smr:1": (13.20, 14.72, 15.88, 0.399),
    "smr:2": (15.68, 11.27, 14.41, 0.396),
    "smr:3": (18.23, 14.38, 12.40, 0.427),
    "sum": (14.02, 11.49, 13.24, 0.374),
    "minimax": (13.86, 12.49, 13.86, 0.372),
    "pose": (15.94, 11.88, 14.00, 0.399),
}
ERROR_KINDS = (("ap", "AP (mm)"), ("ao", "AO (mrad)"), ("ao_angle", "AO' (mrad)"))


@dataclass(frozen=True)
class ConditionJob:
    """One robot under one condition: train poses, the rest held out (as many as there are)."""

    robot: str
    condition: Condition
    train: int
    seed: int


@dataclass(frozen=True)
class ConditionErrors:
    """Of one set of poses: F_i (k,) [mm^2], AP (3m,) [mm], AO and AO' (m,) [mrad]."""

    sums: tuple[float, ...]
    ap: Array
    ao: Array
    ao_angle: Array

    @property
    def phi(self) -> float:
        """RMSE(phi) of the paper [mm]."""
        return float(np.sqrt(max(self.sums) / len(self.ao)))


@dataclass(frozen=True)
class ConditionOutcome:
    """Training and held-out errors of a condition, and how the solver ended."""

    train: ConditionErrors
    held: ConditionErrors
    status: str


CONDITION_ROBOTS = {  # what it is called, the folder of a real one, training poses
    "irb2600": ("IRB 2600, simulated", "", 100),
    "irb120": ("IRB 120, real", "irb120", 100),
    "fanuc": ("FANUC R-2000, real", "fanuc_r2000", 29),
}


def load_or_simulate_robot(name: str, seed: int) -> tuple[Robot, Measurements]:
    """A real robot, or an IRB 2600 with the compliance that no geometry holds."""
    if folder := CONDITION_ROBOTS[name][1]:
        return read_real_arm(folder)
    robot = load_robot(name)
    return robot, simulate(robot, 300, 3, seed, Truth()).data


def list_available_robots() -> list[str]:
    """Those of `CONDITION_ROBOTS` that are simulated or whose measurements are on this machine."""
    return [
        name
        for name, (_, folder, _) in CONDITION_ROBOTS.items()
        if not folder or has_measurements(folder)
    ]


def run_condition(job: ConditionJob) -> ConditionOutcome:
    """Calibrate under one condition and judge it on both sets of poses."""
    robot, data = load_or_simulate_robot(job.robot, job.seed)
    train, held, _ = split_train_and_holdout(data, 1.0 - job.train / data.poses, job.seed)
    objective = "sum" if job.condition == "nominal" else job.condition
    fit = mc.calibrate(robot, train, objective, holdout=0.0)
    cell = fit.nominal if job.condition == "nominal" else fit.cell
    status = "-" if job.condition == "nominal" else str(fit.status)
    return ConditionOutcome(compute_errors(cell, train), compute_errors(cell, held), status)


def compute_errors(cell: Cell, data: Measurements) -> ConditionErrors:
    """All errors of a cell on some poses; orientation from the three targets."""
    predicted = cell.predict(data.q)
    distance = 1e3 * np.linalg.norm(data.y - predicted, axis=-1)
    shape = triangle_from_distances(data.y)
    measured, computed = fit_poses_to_points(shape, data.y), fit_poses_to_points(shape, predicted)
    return ConditionErrors(
        tuple((distance**2).sum(axis=0).tolist()),
        distance.ravel(),
        1e3 * euler_deviation(measured, computed).max(axis=1),
        1e3 * orientation_error(measured, computed),
    )


def build_condition_table(title: str, outcomes: dict[str, ConditionOutcome]) -> Table:
    """Table 3 for one robot, training and held out side by side."""
    rows = []
    for number, (condition, outcome) in enumerate(outcomes.items()):
        for where, e in (("training", outcome.train), ("held out", outcome.held)):
            rows.append((f"{number} {condition}", where, len(e.ao), *e.sums, e.phi, rms(e.ap),
                         float(e.ap.max()), float(e.ao.max()), rms(e.ao_angle),
                         float(e.ao_angle.max()), outcome.status))  # fmt: skip
    return Table.from_rows(
        title,
        rows,
        "condition | poses | count d | F_1 mm^2 .2f | F_2 mm^2 .2f | F_3 mm^2 .2f | "
        "RMSE(phi) mm .4f | AP rms mm .4f | AP max mm .4f | AO max mrad .3f | "
        "AO' rms mrad .3f | AO' max mrad .3f | status",
    )


def build_printed_table() -> Table:
    """Table 3 as printed."""
    rows = tuple(
        (f"{number} {name}", *values)
        for number, (name, values) in enumerate(PAPER_M_TABLE_3.items())
    )
    return Table.from_rows(
        "paper M, Table 3 (IRB 2600, 100 poses, training)",
        rows,
        "condition | F_1 mm^2 .2f | F_2 mm^2 .2f | F_3 mm^2 .2f | RMSE(phi) mm .3f",
    )


def draw_error_boxes(title: str, outcomes: dict[str, ConditionOutcome]) -> Figure:
    """Fig. 2-4 and 6: AP, AO and AO' per condition, training and held out."""
    figure = new_figure(12, 6)
    panels = figure.subplots(2, 3, sharex=True)
    for row, where in zip(panels, ("train", "held"), strict=True):
        for axes, (kind, name) in zip(row, ERROR_KINDS, strict=True):
            values = [getattr(getattr(outcome, where), kind) for outcome in outcomes.values()]
            axes.boxplot(values, tick_labels=[str(i) for i in range(len(outcomes))], whis=(5, 95))
            poses = "training" if where == "train" else "held out"
            axes.set(yscale="log", ylabel=f"{name}, {poses}")
            axes.grid(visible=True, axis="y", alpha=0.3)
    figure.suptitle(title + ": " + ", ".join(f"{i} {name}" for i, name in enumerate(outcomes)))
    return figure


def draw_errors_by_pose(title: str, outcomes: dict[str, ConditionOutcome]) -> Figure:
    """The right halves of Fig. 2-4: training poses in their order, a dot a reflector."""
    figure = new_figure(12, 3.2)
    for axes, (kind, name) in zip(figure.subplots(1, 3), ERROR_KINDS, strict=True):
        for condition, colour in (("nominal", BEFORE_COLOUR), ("minimax", AFTER_COLOUR)):
            errors = outcomes[condition].train
            value = np.asarray(getattr(errors, kind)).reshape(len(errors.ao), -1)
            pose = np.repeat(np.arange(1, len(value) + 1), value.shape[1])
            axes.plot(pose, value.ravel(), ".", ms=3, color=colour, label=condition)
        axes.set(xlabel="pose", ylabel=name, yscale="log")
        axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    return figure


def draw_sums_of_squares(title: str, outcomes: dict[str, ConditionOutcome]) -> Figure:
    """Fig. 5: F_i per condition (training), the nominal left out."""
    figure = new_figure(7, 4)
    axes = figure.subplots()
    names = [name for name in outcomes if name != "nominal"]
    for i in range(3):
        values = [outcomes[name].train.sums[i] for name in names]
        axes.bar(np.arange(len(names)) + 0.27 * (i - 1), values, 0.25, label=f"F_{i + 1}")
    axes.set_xticks(np.arange(len(names)), names)
    axes.set(ylabel="sum of squares (mm^2)", title=title)
    axes.legend()
    return figure


def build_minimax_claims_table(outcomes_by_robot: dict[str, dict[str, ConditionOutcome]]) -> Table:
    """Whether minimax has the smallest RMSE(phi): it must in training, it need not held out."""
    rows = []
    for robot, outcomes in outcomes_by_robot.items():
        for part, where in (("train", "training"), ("held", "held out")):
            phi = {name: getattr(outcome, part).phi for name, outcome in outcomes.items()}
            # one target alone is the minimax where it stays the worst: a tie then
            tied = phi["minimax"] <= min(phi.values()) * (1 + 1e-6)
            best = "minimax" if tied else min(phi, key=lambda name: phi[name])
            other = min(value for name, value in phi.items() if name not in ("minimax", "nominal"))
            rows.append(
                (
                    CONDITION_ROBOTS[robot][0],
                    where,
                    phi["minimax"],
                    other,
                    phi["minimax"] / other,
                    best,
                )
            )
    return Table.from_rows(
        "is minimax the smallest RMSE(phi)?",
        rows,
        "robot | poses | minimax mm .4f | best other mm .4f | ratio .4f | smallest",
    )


ConditionOutcomes = dict[str, dict[str, ConditionOutcome]]  # by robot and condition


def run_all_cases(study: Study) -> ConditionOutcomes:
    """Every robot whose measurements are here under every condition."""
    jobs = [
        ConditionJob(name, c, CONDITION_ROBOTS[name][2], study.seed)
        for name in list_available_robots()
        for c in CALIBRATION_CONDITIONS
    ]
    found: ConditionOutcomes = {job.robot: {} for job in jobs}
    for job, outcome in zip(jobs, study.sweep(run_condition, jobs, "conditions"), strict=True):
        found[job.robot][job.condition] = outcome
    return found


def save_results(study: Study, outcomes: ConditionOutcomes) -> None:
    """Tables and pictures."""
    tables = [build_condition_table(CONDITION_ROBOTS[name][0], outcomes[name]) for name in outcomes]
    summary = build_minimax_claims_table(outcomes)
    figures = {}
    for name in outcomes:
        figures[f"accuracy_{name}"] = draw_error_boxes(CONDITION_ROBOTS[name][0], outcomes[name])
        figures[f"by_pose_{name}"] = draw_errors_by_pose(CONDITION_ROBOTS[name][0], outcomes[name])
        figures[f"sums_{name}"] = draw_sums_of_squares(CONDITION_ROBOTS[name][0], outcomes[name])
    rows = [
        {"robot": row[0], "poses": row[1], "minimax_over_best_other": row[4], "best": row[5]}
        for row in summary.rows
    ]
    study.save([*tables, build_printed_table(), summary], {"rows": rows}, figures)


@study_options("conditions")
def main(study: Study) -> None:
    """Single SMR, sum, minimax, pose and worst point: paper M, Table 3, Fig. 2-6."""
    save_results(study, run_all_cases(study))
