"""Calibration methods side by side: paper M, Tables 1 and 4.

    python -m experiments.methods [--quick] [--out FOLDER] [--json FILE] [--seed N] [--data FOLDER]

Every method sees the same training poses and is judged on the same held-out ones, by the distance
of each of the three reflectors (SMRs) from where the method says it is, and by the orientation of
the triangle that they span.  Real measurements come from shared data; where they are absent the
table says so.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import click
import numpy as np

from experiments.hand_eye import fit_mdh_to_poses, fit_nominal_arm
from experiments.pose_fitting import (
    PointFit,
    fit_poses_to_points,
    orientation_error,
    triangle_from_distances,
)
from experiments.product_of_exponentials import (
    fit_screws_to_measured_poses,
    fit_screws_to_one_target,
)
from experiments.real_arms import SHARED_DATA_FOLDER
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.tables import Table, TableCell
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.options import Objective
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.robot import Robot, load_robot

POSE_SET_NAMES = ("training", "held out")


@dataclass(frozen=True)
class MethodCase:
    """A robot and how its poses are divided.

    source: folder of real measurements, "" for simulated ones (another arm each split).
    train: training poses.  splits: how many random ones; with folds every pose is held out once.
    """

    label: str
    name: str
    source: str
    train: int
    splits: int
    folds: int = 0

    def has_measurements(self, folder: Path) -> bool:
        """Whether there are measurements."""
        return not self.source or (folder / self.source / "measurements.csv").exists()


def list_cases(quick: bool) -> list[MethodCase]:
    """A simulated robot and two real ones."""
    splits = 1 if quick else 5
    out = [
        MethodCase(
            "IRB 2600 sim", "ABB IRB 2600 (simulated, another arm each split)", "", 100, splits
        ),
        MethodCase("IRB 120", "ABB IRB 120 (real)", "irb120", 100, splits),
        MethodCase("FANUC", "FANUC R-2000 (real)", "fanuc_r2000", 30, 2 if quick else 6, folds=6),
    ]
    if not quick:
        out.insert(2, MethodCase("IRB 120, 500 poses", "ABB IRB 120 (real)", "irb120", 500, splits))
    return out


@cache
def read_measured_robot(path: Path) -> tuple[Robot, Measurements]:
    """A real robot and its measurements, at the poses where all three SMRs were seen."""
    data = read_measurements(path / "measurements.csv")
    return load_robot(path / "robot.json"), data.take(np.asarray(data.seen.all(axis=1)))


def load_and_split_robot(
    case: MethodCase, split: int, seed: int, folder: Path
) -> tuple[Robot, Measurements, Measurements]:
    """Robot, training and held-out measurements of one split."""
    if not case.source:
        robot = load_robot("irb2600")
        data = simulate(robot, 3 * case.train, 3, 1000 * seed + split).data
        rows = np.arange(data.poses)
        return robot, data.take(rows[: case.train]), data.take(rows[case.train :])
    robot, data = read_measured_robot(folder / case.source)
    if case.folds:
        number = np.random.default_rng(seed).permutation(data.poses) % case.folds
        return robot, data.take(number != split), data.take(number == split)
    order = np.random.default_rng([seed, split]).permutation(data.poses)
    return robot, data.take(order[: case.train]), data.take(order[case.train :])


# ---- the methods: (robot, training data) -> Fit, each from the nominal geometry -------------


def fit_by_library(
    robot: Robot, train: Measurements, objective: Objective, method: str = "snllm"
) -> PointFit:
    """One of the library's objectives, on its set of identified parameters."""
    found = calibrate(robot, train, objective, holdout=0.0, method=method)
    return PointFit(found.cell.predict, str(found.status))


MINIMAX_METHOD, POSE_METHOD = "minimax", "MDH pose"
SINGLE_TARGET_METHODS = ("MDH SMR 1", "MDH SMR 2", "MDH SMR 3")
SINGLE_TARGET_OBJECTIVES: tuple[Objective, ...] = ("smr:1", "smr:2", "smr:3")
CALIBRATION_METHODS: Mapping[str, Callable[[Robot, Measurements], PointFit]] = {
    "nominal": fit_nominal_arm,
    **{
        name: partial(fit_by_library, objective=one, method="nlgn")
        for name, one in zip(SINGLE_TARGET_METHODS, SINGLE_TARGET_OBJECTIVES, strict=True)
    },
    POSE_METHOD: fit_mdh_to_poses,
    **{f"POE SMR {i + 1}": partial(fit_screws_to_one_target, target_index=i) for i in range(3)},
    "POE pose": fit_screws_to_measured_poses,
    "sum": partial(fit_by_library, objective="sum"),
    MINIMAX_METHOD: partial(fit_by_library, objective="minimax"),
}


# ---- one method on one split -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MethodErrors:
    """distance: (m, 3) of each SMR [m].  angle: (m,) AO' [rad]."""

    distance: Array
    angle: Array


@dataclass(frozen=True)
class MethodJob:
    """One method on one split."""

    case: MethodCase
    split: int
    method: str
    seed: int
    folder: Path


@dataclass(frozen=True, eq=False)
class MethodOutcome:
    """Errors by part, and what the fit took [s]."""

    errors: Mapping[str, MethodErrors]
    status: str
    seconds: float


def run_method(job: MethodJob) -> MethodOutcome:
    """Fit and judge."""
    robot, train, held = load_and_split_robot(job.case, job.split, job.seed, job.folder)
    began = time.perf_counter()
    fit = CALIBRATION_METHODS[job.method](robot, train)
    seconds = time.perf_counter() - began
    shape = triangle_from_distances(train.y)
    both = zip(POSE_SET_NAMES, (train, held), strict=True)
    errors = {
        part: compute_method_errors(fit.predict(data.q), data.y, shape) for part, data in both
    }
    return MethodOutcome(errors, fit.status, seconds)


def compute_method_errors(
    predicted: Array, measured: Array, triangle_points: Array
) -> MethodErrors:
    """Errors of predicted points (m, 3, 3); orientations are those of the triangle."""
    seen, computed = (fit_poses_to_points(triangle_points, y) for y in (measured, predicted))
    distance = np.linalg.norm(measured - predicted, axis=-1)
    return MethodErrors(distance, orientation_error(seen, computed))


# What is said of a method over its splits: RMS are pooled, the largest is the largest of all.
ERROR_FIGURES: Mapping[str, tuple[str, Callable[[Sequence[MethodErrors]], float]]] = {
    "AP RMSE": ("mm", lambda e: 1e3 * rms(np.array([rms(s.distance) for s in e]))),
    "worst SMR": ("mm", lambda e: 1e3 * rms(np.array([max(map(rms, s.distance.T)) for s in e]))),
    "AP max": ("mm", lambda e: 1e3 * max(float(s.distance.max()) for s in e)),
    "AO' RMSE": ("mrad", lambda e: 1e3 * rms(np.array([rms(s.angle) for s in e]))),
    "AO' max": ("mrad", lambda e: 1e3 * max(float(s.angle.max()) for s in e)),
}
Results = Mapping[str, Sequence[MethodOutcome]]  # by method, one a split
Studies = Sequence[tuple[MethodCase, Results]]


def pooled_figure(outcomes: Sequence[MethodOutcome], figure_name: str, pose_set: str) -> float:
    """One entry of `ERROR_FIGURES`."""
    return ERROR_FIGURES[figure_name][1]([outcome.errors[pose_set] for outcome in outcomes])


# ---- tables and pictures ---------------------------------------------------------------------

METHOD_PROPERTIES_TABLE = Table(
    "what the methods are [paper M, Table 1, with its reference numbers]",
    ("method", "in M", "model", "measured", "minimises", "by", "orientation",
     "worst SMR bounded", "SMR distances"),
    (
        ("nominal", "[36]", "MDH, nominal", "poses", "pose errors: base and tool only",
         "quaternions, Gauss-Newton", "yes", "no", "measured mean"),
        ("MDH SMR i", "[18], [19]", "MDH", "one SMR", "F_i", "Gauss-Newton", "no", "no",
         "free"),
        ("MDH pose", "[28]", "MDH", "poses", "position, weighted orientation",
         "Gauss-Newton", "yes, by a weight", "no", "measured mean"),
        ("POE SMR i", "[21]", "POE", "one SMR", "F_i", "Gauss-Newton", "no", "no", "free"),
        ("POE pose", "[20], [22]", "POE", "poses", "position, weighted orientation",
         "Gauss-Newton", "yes, by a weight", "no", "measured mean"),
        ("sum", "eq. 32", "MDH", "three SMRs", "F_1 + F_2 + F_3", "separable LM (ours)",
         "through three SMRs", "no", "free"),
        ("minimax", "this paper", "MDH", "three SMRs", "max F_i", "SQP (ours)",
         "through three SMRs", "yes", "constrained"),
    ),
)  # fmt: skip
PAPER_M_TABLE_4 = Table(
    "paper M, Table 4 as printed (training poses only; - where our texts lack the entry)",
    ("robot", "method", "RMSE(phi) mm", "max mm", "AO' RMSE mrad", "AO' max mrad"),
    (
        ("SR10", "original", 16.07, 18.35, 48.0, 292.0),
        ("SR10", "minimax", 0.206, 0.554, 1.8, 4.8),
        ("SR10", "single SMR GN", 0.207, 0.600, 1.8, 5.3),
        ("SR10", "pose GN", 0.207, np.nan, 1.8, np.nan),
        ("IRB 2600", "original", 1.901, 3.404, 4.8, 25.0),
        ("IRB 2600", "minimax", 0.3323, 0.9612, 2.6, 11.7),
        ("IRB 2600", "single SMR GN", 0.3471, 1.1298, 2.7, 12.1),
        ("IRB 2600", "pose GN", 0.3431, np.nan, 2.5, np.nan),
    ),
    ("", "", ".4f", ".4f", ".1f", ".1f"),
)


def format_case_title(case: MethodCase, results: Results) -> str:
    """The robot and how its poses were divided."""
    outcomes = next(iter(results.values()))
    if not outcomes:
        return f"{case.name}: data absent"
    train, held = (len(outcomes[0].errors[part].angle) for part in POSE_SET_NAMES)
    count = len(outcomes)
    kind = f"{count} of {case.folds} folds" if case.folds else f"{count} random split"
    kind += "s, pooled" if count > 1 and not case.folds else ""
    return f"{case.name}: {train} training poses, {held} held out, {kind}"


def build_accuracy_table(case: MethodCase, results: Results) -> Table:
    """Position and orientation errors of every method, training beside held out."""
    units = {name: unit for name, (unit, _) in ERROR_FIGURES.items()}
    header = [f"{name} {units[name]}, {part} .3f" for name in units for part in POSE_SET_NAMES]
    rows = [
        (
            name,
            *(
                pooled_figure(outcomes, key, part)
                for key in ERROR_FIGURES
                for part in POSE_SET_NAMES
            ),
        )
        for name, outcomes in results.items()
        if outcomes
    ]
    rows = rows or [("data absent", *[np.nan] * len(header))]
    return Table.from_rows(
        f"{format_case_title(case, results)}.  AP: position "
        f"errors of the SMRs; worst SMR: RMSE(phi) of "
        "paper M; AO': angle between orientations",
        rows,
        "method",
        *header,
    )


def build_claims_table(studies: Studies) -> Table:
    """Minimax against the paper's two competitors."""
    nan = np.nan
    rows: list[tuple[TableCell, ...]] = [
        ("M, SR10", 0.206 / 0.207, nan, 0.206 / 0.207, nan, 1.0, nan, 1.0, nan),
        ("M, IRB 2600", 0.3323 / 0.3471, nan, 0.3323 / 0.3431, nan, 26 / 27, nan, 26 / 25, nan),
    ]
    against = {"single SMR": SINGLE_TARGET_METHODS, "pose": (POSE_METHOD,)}
    pairs = [(key, name) for key in ("worst SMR", "AO' RMSE") for name in against]
    for case, results in studies:
        if results[MINIMAX_METHOD]:
            row: list[TableCell] = [case.label]
            for key, name in pairs:
                for part in POSE_SET_NAMES:
                    theirs = [pooled_figure(results[other], key, part) for other in against[name]]
                    row.append(
                        pooled_figure(results[MINIMAX_METHOD], key, part) / float(np.median(theirs))
                    )
            rows.append(tuple(row))
    return Table.from_rows(
        "errors of minimax over those of MDH pose and over the median of MDH SMR 1, 2, 3: below 1 "
        "minimax is better.  M: paper M, Table 4",
        rows,
        "robot",
        *(f"{key} / {name}, {part} .3f" for key, name in pairs for part in POSE_SET_NAMES),
    )


# ---- the study -------------------------------------------------------------------------------

Sweep = Callable[
    [Callable[[MethodJob], MethodOutcome], Sequence[MethodJob]], Iterable[MethodOutcome]
]


def run_all_methods(quick: bool, seed: int, folder: Path, map_jobs: Sweep = map) -> Studies:
    """All methods on all robots; no outcomes where data are absent."""
    jobs = [
        MethodJob(case, split, method, seed, folder)
        for case in list_cases(quick)
        if case.has_measurements(folder)
        for split in range(case.splits)
        for method in CALIBRATION_METHODS
    ]
    done = list(zip(jobs, map_jobs(run_method, jobs), strict=True))
    return [
        (
            case,
            {
                m: [o for job, o in done if (job.case, job.method) == (case, m)]
                for m in CALIBRATION_METHODS
            },
        )
        for case in list_cases(quick)
    ]


def run_all_cases(study: Study, folder: Path = SHARED_DATA_FOLDER) -> Studies:
    """All methods on all robots."""
    return run_all_methods(study.quick, study.seed, folder, study.sweep)


def save_results(study: Study, studies: Studies) -> None:
    """The tables."""
    tables = [
        METHOD_PROPERTIES_TABLE,
        *(build_accuracy_table(case, results) for case, results in studies),
    ]
    study.save(
        [*tables, PAPER_M_TABLE_4, build_claims_table(studies)],
        {"figures": list_json_figures(studies)},
    )


def list_json_figures(studies: Studies) -> dict[str, object]:
    """Every figure by robot, method and name, for other programs."""
    return {
        case.label: {
            name: {
                f"{key}, {part} {unit}": pooled_figure(outcomes, key, part)
                for key, (unit, _) in ERROR_FIGURES.items()
                for part in POSE_SET_NAMES
            }
            for name, outcomes in results.items()
            if outcomes
        }
        for case, results in studies
    }


@study_options("methods")
@click.option("--data", "folder", type=click.Path(path_type=Path), default=SHARED_DATA_FOLDER)
def main(study: Study, folder: Path) -> None:
    """Calibration methods side by side, on simulated and real robots."""
    save_results(study, run_all_cases(study, folder))
