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

from experiments.hand_eye import mdh_pose, nominal
from experiments.poe import poe_pose, poe_position
from experiments.poses import Fit, orientation_error, poses_of, triangle
from experiments.real import SHARED
from experiments.sweep import Study, study_options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.options import Objective
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots.robot import Robot, load_robot

PARTS = ("training", "held out")


@dataclass(frozen=True)
class Case:
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

    def present(self, folder: Path) -> bool:
        """Whether there are measurements."""
        return not self.source or (folder / self.source / "measurements.csv").exists()


def cases(quick: bool) -> list[Case]:
    """A simulated robot and two real ones."""
    splits = 1 if quick else 5
    out = [
        Case("IRB 2600 sim", "ABB IRB 2600 (simulated, another arm each split)", "", 100, splits),
        Case("IRB 120", "ABB IRB 120 (real)", "irb120", 100, splits),
        Case("FANUC", "FANUC R-2000 (real)", "fanuc_r2000", 30, 2 if quick else 6, folds=6),
    ]
    if not quick:
        out.insert(2, Case("IRB 120, 500 poses", "ABB IRB 120 (real)", "irb120", 500, splits))
    return out


@cache
def measured(path: Path) -> tuple[Robot, Measurements]:
    """A real robot and its measurements, at the poses where all three SMRs were seen."""
    data = read_measurements(path / "measurements.csv")
    return load_robot(path / "robot.json"), data.take(np.asarray(data.seen.all(axis=1)))


def divided(
    case: Case, split: int, seed: int, folder: Path
) -> tuple[Robot, Measurements, Measurements]:
    """Robot, training and held-out measurements of one split."""
    if not case.source:
        robot = load_robot("irb2600")
        data = simulate(robot, 3 * case.train, 3, 1000 * seed + split).data
        rows = np.arange(data.poses)
        return robot, data.take(rows[: case.train]), data.take(rows[case.train :])
    robot, data = measured(folder / case.source)
    if case.folds:
        number = np.random.default_rng(seed).permutation(data.poses) % case.folds
        return robot, data.take(number != split), data.take(number == split)
    order = np.random.default_rng([seed, split]).permutation(data.poses)
    return robot, data.take(order[: case.train]), data.take(order[case.train :])


# ---- the methods: (robot, training data) -> Fit, each from the nominal geometry -------------


def library(robot: Robot, train: Measurements, objective: Objective, method: str = "snllm") -> Fit:
    """One of the library's objectives, on its set of identified parameters."""
    found = calibrate(robot, train, objective, holdout=0.0, method=method)
    return Fit(found.cell.predict, str(found.status))


MINIMAX, POSE = "minimax", "MDH pose"
SINGLE = ("MDH SMR 1", "MDH SMR 2", "MDH SMR 3")
ONE_TARGET: tuple[Objective, ...] = ("smr:1", "smr:2", "smr:3")
METHODS: Mapping[str, Callable[[Robot, Measurements], Fit]] = {
    "nominal": nominal,
    **{
        name: partial(library, objective=one, method="nlgn")
        for name, one in zip(SINGLE, ONE_TARGET, strict=True)
    },
    POSE: mdh_pose,
    **{f"POE SMR {i + 1}": partial(poe_position, smr=i) for i in range(3)},
    "POE pose": poe_pose,
    "sum": partial(library, objective="sum"),
    MINIMAX: partial(library, objective="minimax"),
}


# ---- one method on one split -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Errors:
    """distance: (m, 3) of each SMR [m].  angle: (m,) AO' [rad]."""

    distance: Array
    angle: Array


@dataclass(frozen=True)
class Job:
    """One method on one split."""

    case: Case
    split: int
    method: str
    seed: int
    folder: Path


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors by part, and what the fit took [s]."""

    errors: Mapping[str, Errors]
    status: str
    seconds: float


def outcome_of(job: Job) -> Outcome:
    """Fit and judge."""
    robot, train, held = divided(job.case, job.split, job.seed, job.folder)
    began = time.perf_counter()
    fit = METHODS[job.method](robot, train)
    seconds = time.perf_counter() - began
    shape = triangle(train.y)
    both = zip(PARTS, (train, held), strict=True)
    errors = {part: errors_of(fit.predict(data.q), data.y, shape) for part, data in both}
    return Outcome(errors, fit.status, seconds)


def errors_of(predicted: Array, measured: Array, shape: Array) -> Errors:
    """Errors of predicted points (m, 3, 3); orientations are those of the triangle."""
    seen, computed = (poses_of(shape, y) for y in (measured, predicted))
    distance = np.linalg.norm(measured - predicted, axis=-1)
    return Errors(distance, orientation_error(seen, computed))


# What is said of a method over its splits: RMS are pooled, the largest is the largest of all.
FIGURES: Mapping[str, tuple[str, Callable[[Sequence[Errors]], float]]] = {
    "AP RMSE": ("mm", lambda e: 1e3 * rms(np.array([rms(s.distance) for s in e]))),
    "worst SMR": ("mm", lambda e: 1e3 * rms(np.array([max(map(rms, s.distance.T)) for s in e]))),
    "AP max": ("mm", lambda e: 1e3 * max(float(s.distance.max()) for s in e)),
    "AO' RMSE": ("mrad", lambda e: 1e3 * rms(np.array([rms(s.angle) for s in e]))),
    "AO' max": ("mrad", lambda e: 1e3 * max(float(s.angle.max()) for s in e)),
}
Results = Mapping[str, Sequence[Outcome]]  # by method, one a split
Studies = Sequence[tuple[Case, Results]]


def figure_of(outcomes: Sequence[Outcome], figure: str, part: str) -> float:
    """One entry of `FIGURES`."""
    return FIGURES[figure][1]([outcome.errors[part] for outcome in outcomes])


# ---- tables and pictures ---------------------------------------------------------------------

PROPERTIES = Table(
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
PRINTED = Table(
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


def title_of(case: Case, results: Results) -> str:
    """The robot and how its poses were divided."""
    outcomes = next(iter(results.values()))
    if not outcomes:
        return f"{case.name}: data absent"
    train, held = (len(outcomes[0].errors[part].angle) for part in PARTS)
    count = len(outcomes)
    kind = f"{count} of {case.folds} folds" if case.folds else f"{count} random split"
    kind += "s, pooled" if count > 1 and not case.folds else ""
    return f"{case.name}: {train} training poses, {held} held out, {kind}"


def accuracy_table(case: Case, results: Results) -> Table:
    """Position and orientation errors of every method, training beside held out."""
    units = {name: unit for name, (unit, _) in FIGURES.items()}
    header = [f"{name} {units[name]}, {part} .3f" for name in units for part in PARTS]
    rows = [
        (name, *(figure_of(outcomes, key, part) for key in FIGURES for part in PARTS))
        for name, outcomes in results.items()
        if outcomes
    ]
    rows = rows or [("data absent", *[np.nan] * len(header))]
    return Table.made(
        f"{title_of(case, results)}.  AP: position errors of the SMRs; worst SMR: RMSE(phi) of "
        "paper M; AO': angle between orientations",
        rows,
        "method",
        *header,
    )


def claims_table(studies: Studies) -> Table:
    """Minimax against the paper's two competitors."""
    nan = np.nan
    rows: list[tuple[Cell, ...]] = [
        ("M, SR10", 0.206 / 0.207, nan, 0.206 / 0.207, nan, 1.0, nan, 1.0, nan),
        ("M, IRB 2600", 0.3323 / 0.3471, nan, 0.3323 / 0.3431, nan, 26 / 27, nan, 26 / 25, nan),
    ]
    against = {"single SMR": SINGLE, "pose": (POSE,)}
    pairs = [(key, name) for key in ("worst SMR", "AO' RMSE") for name in against]
    for case, results in studies:
        if results[MINIMAX]:
            row: list[Cell] = [case.label]
            for key, name in pairs:
                for part in PARTS:
                    theirs = [figure_of(results[other], key, part) for other in against[name]]
                    row.append(figure_of(results[MINIMAX], key, part) / float(np.median(theirs)))
            rows.append(tuple(row))
    return Table.made(
        "errors of minimax over those of MDH pose and over the median of MDH SMR 1, 2, 3: below 1 "
        "minimax is better.  M: paper M, Table 4",
        rows,
        "robot",
        *(f"{key} / {name}, {part} .3f" for key, name in pairs for part in PARTS),
    )


# ---- the study -------------------------------------------------------------------------------

Sweep = Callable[[Callable[[Job], Outcome], Sequence[Job]], Iterable[Outcome]]


def run(quick: bool, seed: int, folder: Path, sweep: Sweep = map) -> Studies:
    """All methods on all robots; no outcomes where data are absent."""
    jobs = [
        Job(case, split, method, seed, folder)
        for case in cases(quick)
        if case.present(folder)
        for split in range(case.splits)
        for method in METHODS
    ]
    done = list(zip(jobs, sweep(outcome_of, jobs), strict=True))
    return [
        (case, {m: [o for job, o in done if (job.case, job.method) == (case, m)] for m in METHODS})
        for case in cases(quick)
    ]


def study_of(study: Study, folder: Path = SHARED) -> Studies:
    """All methods on all robots."""
    return run(study.quick, study.seed, folder, study.sweep)


def save(study: Study, found: Studies) -> None:
    """The tables."""
    tables = [PROPERTIES, *(accuracy_table(case, results) for case, results in found)]
    study.save([*tables, PRINTED, claims_table(found)], {"figures": numbers(found)})


def numbers(studies: Studies) -> dict[str, object]:
    """Every figure by robot, method and name, for other programs."""
    return {
        case.label: {
            name: {
                f"{key}, {part} {unit}": figure_of(outcomes, key, part)
                for key, (unit, _) in FIGURES.items()
                for part in PARTS
            }
            for name, outcomes in results.items()
            if outcomes
        }
        for case, results in studies
    }


@study_options("methods")
@click.option("--data", "folder", type=click.Path(path_type=Path), default=SHARED)
def main(study: Study, folder: Path) -> None:
    """Calibration methods side by side, on simulated and real robots."""
    save(study, study_of(study, folder))
