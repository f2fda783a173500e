"""Calibration methods side by side: paper M, Tables 1 and 4.

    python -m experiments.methods [--quick] [--out FOLDER] [--json FILE] [--seed N] [--data FOLDER]

Every method sees the same training poses and is judged on the same held-out ones, by the distance
of each of the three reflectors (SMRs) from where the method says it is, and by the orientation of
the triangle that they span.  Real measurements come from shared data; where they are absent the
table says so.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from experiments.hand_eye import Start, mdh_pose, nominal, start_of
from experiments.poe import poe_pose, poe_position
from experiments.poses import (
    Fit,
    euler_deviation,
    inverse,
    orientation_error,
    poses_of,
    position_error,
)
from experiments.real import SHARED
from experiments.record import canvas
from experiments.sweep import Study, start, study_options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.simulate import simulate
from minimax_cal.reporting.plots.figures import AFTER, BEFORE
from minimax_cal.robots.robot import Robot, load_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS = ("training", "held out")
LENGTHS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # levers of an angle [m]; 1 is a plain sum in SI units


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


def library(robot: Robot, train: Measurements, objective: str, method: str = "snllm") -> Fit:
    """One of the library's objectives, on its set of identified parameters."""
    found = calibrate(robot, train, objective, holdout=0.0, method=method)
    active, status = found.identification.active, str(found.status)
    return Fit(found.cell.predict, len(active), int(active.sum()), found.iterations, status)


MINIMAX, POSE = "minimax", "MDH pose"
SINGLE = ("MDH SMR 1", "MDH SMR 2", "MDH SMR 3")
METHODS: Mapping[str, Callable[[Robot, Measurements], Fit]] = {
    "nominal": nominal,
    **{SINGLE[i]: partial(library, objective=f"smr:{i + 1}", method="nlgn") for i in range(3)},
    POSE: mdh_pose,
    **{f"POE SMR {i + 1}": partial(poe_position, smr=i) for i in range(3)},
    "POE pose": poe_pose,
    "sum": partial(library, objective="sum"),
    MINIMAX: partial(library, objective="minimax"),
}


# ---- one method on one split -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Errors:
    """distance: (m, 3) of each SMR, centre: (m,) of their centroid [m].

    angle: (m,) AO' and euler: (m, 3) AO [rad].
    """

    distance: Array
    centre: Array
    angle: Array
    euler: Array


@dataclass(frozen=True)
class Job:
    """One method on one split; length: of an angle's lever, for `mdh_pose` alone [m]."""

    case: Case
    split: int
    method: str
    seed: int
    folder: Path
    length: float = np.nan


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors by part, and what the fit took [s]."""

    errors: Mapping[str, Errors]
    parameters: int
    identified: int
    iterations: int
    status: str
    seconds: float


def outcome_of(job: Job) -> Outcome:
    """Fit and judge."""
    robot, train, held = divided(job.case, job.split, job.seed, job.folder)
    method = METHODS[job.method]
    if np.isfinite(job.length):
        method = partial(mdh_pose, length=job.length)
    began = time.perf_counter()
    fit = method(robot, train)
    seconds = time.perf_counter() - began
    start = start_of(robot, train)
    both = zip(PARTS, (train, held), strict=True)
    errors = {part: errors_of(fit.predict, data, start) for part, data in both}
    return Outcome(errors, fit.parameters, fit.identified, fit.iterations, fit.status, seconds)


def errors_of(predict: Callable[[Array], Array], data: Measurements, start: Start) -> Errors:
    """Errors of predictions; Euler angles are those of the triangle in the nominal base."""
    predicted = predict(data.q)
    back = inverse(start.found.x.base)
    seen, computed = (back @ poses_of(start.shape, y) for y in (data.y, predicted))
    return Errors(
        np.linalg.norm(data.y - predicted, axis=-1),
        position_error(seen, computed),
        orientation_error(seen, computed),
        euler_deviation(seen, computed),
    )


def largest(values: Iterable[float]) -> float:
    """The largest."""
    return float(max(values))


# What is said of a method over its splits: RMS are pooled, the largest is the largest of all.
FIGURES: Mapping[str, tuple[str, Callable[[Sequence[Errors]], float]]] = {
    "AP RMSE": ("mm", lambda e: 1e3 * rms(np.array([rms(s.distance) for s in e]))),
    "worst SMR": ("mm", lambda e: 1e3 * rms(np.array([max(map(rms, s.distance.T)) for s in e]))),
    "AP max": ("mm", lambda e: 1e3 * largest(s.distance.max() for s in e)),
    "AO' RMSE": ("mrad", lambda e: 1e3 * rms(np.array([rms(s.angle) for s in e]))),
    "AO' max": ("mrad", lambda e: 1e3 * largest(s.angle.max() for s in e)),
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
    header = [f"{name} {unit}, {part}" for name, (unit, _) in FIGURES.items() for part in PARTS]
    rows: list[tuple[Cell, ...]] = [
        (name, *(figure_of(outcomes, key, part) for key in FIGURES for part in PARTS))
        for name, outcomes in results.items()
        if outcomes
    ]
    rows = rows or [("data absent", *[np.nan] * len(header))]
    return Table(
        f"{title_of(case, results)}.  AP: position errors of the SMRs; worst SMR: RMSE(phi) of "
        "paper M; AO': angle between orientations",
        ("method", *header),
        tuple(rows),
        ("", *[".3f"] * len(header)),
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
    header = [f"{key} / {name}, {part}" for key, name in pairs for part in PARTS]
    return Table(
        "errors of minimax over those of MDH pose and over the median of MDH SMR 1, 2, 3: below 1 "
        "minimax is better.  M: paper M, Table 4",
        ("robot", *header),
        tuple(rows),
        ("", *[".3f"] * len(header)),
    )


def weight_table(weighted: Sequence[tuple[Case, float, Sequence[Outcome]]]) -> Table:
    """MDH pose Gauss-Newton with other weights of orientation."""
    keys = ("AP RMSE", "worst SMR", "AO' RMSE")
    rows: list[tuple[Cell, ...]] = [
        (
            case.label,
            "triangle's" if np.isnan(length) else f"{length:g}",
            *(figure_of(outcomes, key, part) for key in keys for part in PARTS),
        )
        for case, length, outcomes in weighted
    ]
    header = [f"{key} {FIGURES[key][0]}, {part}" for key in keys for part in PARTS]
    return Table(
        "MDH pose Gauss-Newton minimises |position error|^2 + (lever x angle)^2: what the lever "
        "does (1 m is a plain sum in SI units)",
        ("robot", "lever m", *header),
        tuple(rows),
        ("", "", *[".3f"] * len(header)),
    )


def iso_table(studies: Studies) -> Table:
    """Position of the triangle's centroid, and orientation by Euler angles [ISO 9283; M eq. 4]."""
    rows: list[tuple[Cell, ...]] = []
    for case, results in studies:
        for name, outcomes in results.items():
            if outcomes:
                row: list[Cell] = [case.label, name]
                over = 0.0
                for part in PARTS:
                    errors = [outcome.errors[part] for outcome in outcomes]
                    centre = np.concatenate([each.centre for each in errors])
                    euler = np.concatenate([each.euler for each in errors])
                    angle = np.concatenate([each.angle for each in errors])
                    row += [1e3 * rms(centre), *(1e3 * rms(column) for column in euler.T)]
                    over = max(over, float((euler.max(axis=1) / angle).max()))
                rows.append((*row, over))
    names = ("centroid RMSE mm", "a RMSE mrad", "b RMSE mrad", "c RMSE mrad")
    columns = [f"{name}, {part}" for part in PARTS for name in names]
    return Table(
        "as ISO 9283 has it: the triangle's centroid, and Euler angles, of which a and c exceed "
        "the angle AO' between the orientations without bound near gimbal lock (b = 90 degrees)",
        ("robot", "method", *columns, "largest AO/AO'"),
        tuple(rows),
        ("", "", *[".3f"] * len(columns), ".1f"),
    )


def cost_table(studies: Studies) -> Table:
    """Parameters, iterations and time."""
    rows: list[tuple[Cell, ...]] = []
    for case, results in studies:
        for name, outcomes in results.items():
            if outcomes:
                rows.append(
                    (
                        case.label,
                        name,
                        outcomes[0].parameters,
                        span([outcome.identified for outcome in outcomes]),
                        span([outcome.iterations for outcome in outcomes]),
                        1e3 * float(np.median([outcome.seconds for outcome in outcomes])),
                        ", ".join(sorted({outcome.status for outcome in outcomes})),
                    )
                )
    return Table.made(
        "cost: median time of the splits, start included; identified: rank of the Jacobian, or "
        "parameters freed",
        rows,
        "robot | method | parameters d | identified | iterations | ms .1f | ended",
    )


def span(values: Sequence[int]) -> str:
    """As 3, or 3-5."""
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low}-{high}"


def box_chart(case: Case, results: Results) -> Figure:
    """Box chart of errors, training beside held out; whiskers at 5 and 95 %, medians black."""
    figure = canvas(12, 4.8)
    panels: dict[str, Callable[[Errors], Array]] = {
        "AP: position error of the SMRs (mm)": lambda e: 1e3 * e.distance.reshape(-1),
        "AO': orientation error (mrad)": lambda e: 1e3 * e.angle,
    }
    shown = list(results.values())
    for axes, (label, values) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        for part, colour, aside in zip(PARTS, (BEFORE, AFTER), (-0.2, 0.2), strict=True):
            drawn = axes.boxplot(
                [np.concatenate([values(o.errors[part]) for o in every]) for every in shown],
                positions=np.arange(len(results)) + aside,
                widths=0.34,
                whis=(5, 95),
                patch_artist=True,
                flierprops={"marker": ".", "markersize": 2, "markeredgecolor": colour},
                medianprops={"color": "black"},
            )
            for patch in drawn["boxes"]:
                patch.set(facecolor=colour, alpha=0.6)
            drawn["boxes"][0].set_label(part)
        axes.set(yscale="log", ylabel=label)
        axes.set_xticks(np.arange(len(results)), list(results), rotation=30, ha="right")
        axes.grid(visible=True, axis="y", alpha=0.3)
    axes.legend(frameon=False)
    figure.suptitle(f"{title_of(case, results)} (whiskers at 5 and 95 %)", fontweight="bold")
    return figure


# ---- the study -------------------------------------------------------------------------------

Sweep = Callable[[Callable[[Job], Outcome], Sequence[Job]], Sequence[Outcome]]


def one_by_one(function: Callable[[Job], Outcome], jobs: Sequence[Job]) -> list[Outcome]:
    """Do the jobs here, in order."""
    return [function(job) for job in jobs]


def run(quick: bool, seed: int, folder: Path, sweep: Sweep = one_by_one) -> Studies:
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


def run_weights(
    quick: bool, seed: int, folder: Path, sweep: Sweep = one_by_one
) -> list[tuple[Case, float, Sequence[Outcome]]]:
    """The pose method with several levers of an angle."""
    keys = [
        (case, length)
        for case in cases(quick)
        if case.present(folder)
        for length in (np.nan, *LENGTHS)
    ]
    jobs = [
        Job(case, split, POSE, seed, folder, length)
        for case, length in keys
        for split in range(case.splits)
    ]
    waiting = iter(sweep(outcome_of, jobs))
    return [(case, length, [next(waiting) for _ in range(case.splits)]) for case, length in keys]


def tables(
    studies: Studies, weighted: Sequence[tuple[Case, float, Sequence[Outcome]]]
) -> list[Table]:
    """Every table of the study."""
    accuracy = [accuracy_table(case, results) for case, results in studies]
    said = [PRINTED, claims_table(studies), weight_table(weighted), iso_table(studies)]
    return [PROPERTIES, *accuracy, *said, cost_table(studies)]


def figures(studies: Studies) -> dict[str, Figure]:
    """A box chart for each robot whose data are there, by file name."""
    present = [(case, results) for case, results in studies if results[MINIMAX]]
    return {f"methods_{i}": box_chart(*each) for i, each in enumerate(present, start=1)}


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
def main(options: Study, folder: Path) -> None:
    """Calibration methods side by side, on simulated and real robots."""

    def sweep(function: Callable[[Job], Outcome], jobs: Sequence[Job]) -> list[Outcome]:
        return options.sweep(function, jobs, "methods")

    studies = run(options.quick, options.seed, folder, sweep)
    weighted = run_weights(options.quick, options.seed, folder, sweep)
    content = {"figures": numbers(studies)}
    options.save(tables(studies, weighted), content, figures(studies), ("matplotlib",))


if __name__ == "__main__":
    start(__file__)
