"""Do the claims hold on poses that were set aside first?

    python -m experiments.external [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

Poses are set aside before anything is done: random halves, the first and the last fifth, the ends
of joints 1 to 3.  The rest is calibrated, and diagnosed; what is claimed (*within*: held out at
random; *beyond*: whole parts left out, typical and worst) is set beside the RMS on the poses set
aside.  Real arms where their measurements are on this machine, and simulated ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import click
import numpy as np

import minimax_cal as mc
from experiments import gap_cases
from experiments.real_arms import has_measurements, read_real_arm
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.tables import Table
from minimax_cal.core.tables import TableCell as Entry
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.measuring.faults import correct_faults, find_outlier_faults
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.measuring.visit_history import (
    add_history_columns,
    has_order_numbers,
    session_clock_values,
)
from minimax_cal.modelling.cell import Cell
from minimax_cal.robots.robot import Robot

REAL_EXTERNAL_ARMS = ("irb120", "ur10_b", "meca500_r", "fanuc_r2000", "qkm_hl6")
SIMULATED_EXTERNAL_ARMS = ("simulated play", "simulated compliance")
RANDOM_HALVES_PER_ARM = 10  # random halves an arm
TIME_HOLDOUT_FRACTION, RANGE_HOLDOUT_FRACTION = 0.2, 0.25
EXTERNAL_METHODS = ("calibrate", "diagnose")
RANDOM_SPLIT_NAME = "random half"


@dataclass(frozen=True)
class ExternalJob:
    """One arm, the poses set aside, and what is done with the others.

    every: of so many rows of the file one is used.
    """

    arm: str
    split: str
    way: str
    seed: int
    every: int = 1


@dataclass(frozen=True)
class ExternalClaim:
    """What was claimed, and what poses set aside show [mm].

    trusted, sound: within and external without the points that stand out.
    """

    within: float
    typical: float
    worst: float
    external: float
    geometric: float
    trusted: float
    sound: float


def load_or_simulate_arm(name: str) -> tuple[Robot, Measurements]:
    """A robot as drawn and its measurements."""
    if name in REAL_EXTERNAL_ARMS:
        return read_real_arm(name)
    effect, place, size = {
        "simulated play": ("backlash", "J2", 2000.0),
        "simulated compliance": ("joint_compliance", "all", 2000.0),
    }[name]
    made = gap_cases.build_and_measure_arm(
        gap_cases.GapCase("irb2600", "single", (gap_cases.GapCause(effect, place, size),), seed=11)
    )
    columns = {key: value for key, value in made.data.columns.items() if key != "split"}
    return made.robot, replace(made.data, columns=columns)


def parse_arm_names(arm_list_text: str) -> list[str]:
    """The arms of a list that are simulated, or on this machine.  Raises OptionError."""
    named = arm_list_text.split(",")
    for arm in named:
        if arm not in (*REAL_EXTERNAL_ARMS, *SIMULATED_EXTERNAL_ARMS):
            raise OptionError(
                f"--arms {arm}: choose {', '.join((*REAL_EXTERNAL_ARMS, *SIMULATED_EXTERNAL_ARMS))}"
            )
    return [arm for arm in named if arm not in REAL_EXTERNAL_ARMS or has_measurements(arm)]


def list_splits(arm: str, random_halves: int) -> Iterator[tuple[str, int]]:
    """Names of the splits of an arm, with their seeds."""
    yield from ((RANDOM_SPLIT_NAME, seed) for seed in range(random_halves))
    yield from (("first fifth", 0), ("last fifth", 0))
    yield from ((f"{end} q{joint}", 0) for joint in (1, 2, 3) for end in ("low", "high"))


def find_set_aside_poses(data: Measurements, split: str, seed: int) -> Array:
    """(m,) True for the poses that a split sets aside; repeats are on one side."""
    group = group_repeated_poses(data)
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    if split == RANDOM_SPLIT_NAME:
        order = np.random.default_rng(seed).permutation(len(first))
        return np.asarray((order < len(first) // 2)[inverse])
    if split.endswith("fifth"):
        when = (
            session_clock_values(data)
            if has_order_numbers(data)
            else np.arange(data.poses) / data.poses
        )
        rows = (
            when < TIME_HOLDOUT_FRACTION
            if split.startswith("first")
            else when > 1.0 - TIME_HOLDOUT_FRACTION
        )
    else:
        q = data.q[:, int(split[-1]) - 1]
        low = split.startswith("low")
        rows = (
            q < np.quantile(q, RANGE_HOLDOUT_FRACTION)
            if low
            else q > np.quantile(q, 1.0 - RANGE_HOLDOUT_FRACTION)
        )
    return np.asarray(rows[first][inverse])


def run_split(job: ExternalJob) -> ExternalClaim | None:
    """The claim of one job; None where the other poses are too few."""
    robot, data = load_or_simulate_arm(job.arm)
    data = add_history_columns(data.take(np.arange(0, data.poses, job.every)))
    away = find_set_aside_poses(data, job.split, job.seed)
    rest, outside = data.take(~away), data.take(away)
    try:
        if job.way == "calibrate":
            fit = mc.calibrate(robot, rest, "sum", seed=job.seed)
            held, beyond = fit.accuracy["holdout"], fit.beyond
            first, last, unseen = fit.cell, fit.cell, fit.data.take(fit.held)
        else:
            inside = job.split == RANDOM_SPLIT_NAME  # asked of the claim within alone
            found = mc.diagnose(robot, rest, seed=job.seed, quick=inside)
            held, beyond = found.ladder[-1].holdout, found.beyond
            first, last, unseen = found.cells[0], found.cells[-1], found.data.take(found.held)
    except mc.CalibrationError:
        return None
    known = outside.keep(np.isin(outside.target_names, last.target_names))
    return ExternalClaim(
        held.rms_mm,
        beyond.typical_mm,
        beyond.worst_mm,
        summarise_point_errors(last.error(known)).rms_mm,
        summarise_point_errors(first.error(known)).rms_mm,
        *(
            summarise_point_errors(last.error(drop_outliers(last, part))).rms_mm
            for part in (unseen, known)
        ),
    )


def drop_outliers(cell: Cell, data: Measurements) -> Measurements:
    """Measurements without the points that stand out from a fit."""
    return correct_faults(
        data, find_outlier_faults(cell.align_to_first_session(data), cell.error(data))
    )


def build_claim_rows(
    jobs: Sequence[ExternalJob], claims: Sequence[ExternalClaim | None]
) -> list[tuple[Entry, ...]]:
    """Every claim beside what came of it."""
    return [
        (job.arm, job.way, job.split, job.seed, c.within, c.typical, c.worst, c.external,
         c.geometric, c.external / c.within, c.sound / c.trusted, c.external / c.typical,
         c.external / c.worst, c.external / c.geometric)
        for job, c in zip(jobs, claims, strict=True) if c
    ]  # fmt: skip


EXTERNAL_COLUMNS = (
    "arm | way | split | seed d | within_mm .4f | typical_mm .4f | worst_mm .4f | "
    "external_mm .4f | geometric_mm .4f | over_within .2f | over_within_sound .2f | "
    "over_typical .2f | over_worst .2f | over_geometric .2f"
)


def build_claim_summary(
    jobs: Sequence[ExternalJob], claims: Sequence[ExternalClaim | None]
) -> Table:
    """How far the claims hold: shares [%] and medians of the ratios."""
    rows = []
    pairs = [(job, c) for job, c in zip(jobs, claims, strict=True) if c]
    for arm, way in dict.fromkeys((job.arm, job.way) for job, _ in pairs):
        own = [(job, c) for job, c in pairs if (job.arm, job.way) == (arm, way)]
        halves = [c for job, c in own if job.split == RANDOM_SPLIT_NAME]
        inside = np.array([c.external / c.within for c in halves])
        sure = np.array([c.sound / c.trusted for c in halves])
        new = [c for job, c in own if job.split != RANDOM_SPLIT_NAME]
        typical, worst, plain = (
            np.array([c.external / getattr(c, name) for c in new])
            for name in ("typical", "worst", "geometric")
        )
        rows.append(
            (
                arm,
                way,
                len(inside),
                share_of_ratios_near_one(inside),
                share_of_ratios_near_one(sure),
                float(np.median([c.external for c in halves])) if halves else np.nan,
                len(new),
                float(np.nanmedian(typical)) if len(new) else np.nan,
                float(np.nanmedian(worst)) if len(new) else np.nan,
                float(np.nanmax(worst)) if len(new) else np.nan,
                100.0 * mean_or_nan(worst <= 1.25),
                100.0 * mean_or_nan(plain <= 1.05),
            )
        )
    return Table.from_rows(
        "external over claimed",
        rows,
        "arm | way | random halves d | over within 0.8-1.25 % .0f | of sound points % .0f | "
        "external mm .4f | regions, ends d | over typical, median .2f | "
        "over worst, median .2f | over worst, most .2f | worst <= 1.25 % .0f | "
        "geometry <= 1.05 % .0f",
    )


def share_of_ratios_near_one(ratios: Array) -> float:
    """Share of ratios about 1 [%]."""
    return 100.0 * mean_or_nan((ratios > 0.8) & (ratios < 1.25))


def mean_or_nan(values: Array) -> float:
    """Mean, NaN of nothing."""
    return float(np.mean(values)) if len(values) else float("nan")


@study_options("external")
@click.option(
    "--arms", default=",".join((*REAL_EXTERNAL_ARMS, *SIMULATED_EXTERNAL_ARMS)), show_default=True
)
@click.option(
    "--halves", type=int, default=RANDOM_HALVES_PER_ARM, show_default=True, help="Of each arm."
)
def main(study: Study, arms: str, halves: int) -> None:
    """Claimed accuracy beside that on poses set aside."""
    named, halves = (
        ([SIMULATED_EXTERNAL_ARMS[0]], 1) if study.quick else (parse_arm_names(arms), halves)
    )
    jobs = [
        ExternalJob(arm, split, way, study.seed + seed)
        for arm in named
        for way in EXTERNAL_METHODS
        for split, seed in list(list_splits(arm, halves))[:: 4 if study.quick else 1]
    ]
    claims = study.sweep(run_split, jobs, "poses set aside")
    every = Table.from_rows("every split", build_claim_rows(jobs, claims), EXTERNAL_COLUMNS)
    study.save([build_claim_summary(jobs, claims), every], {"rows": every.to_records()})
