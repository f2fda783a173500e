"""Measurements without faults of the data, as every fit of a diagnosis takes them.

Distances between targets show the row of a re-seat.  Which of two targets it was, and how far it
went across the line between them, the geometry shows: without the points after it an arm fits the
others better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.noise_components import (
    find_points_of_pulled_fit,
    find_rows_beyond_tails,
)
from minimax_cal.diagnosing.study import LEAST_SQUARES_OPTIONS
from minimax_cal.fitting.cell_fit import CellFit, fit_cell
from minimax_cal.fitting.data_slips import (
    NO_ROW_INDICES,
    check_plausible,
    correct_misplaced_rows,
    match_misplaced_rows,
)
from minimax_cal.fitting.jump_sizes import fit_jump_sizes
from minimax_cal.fitting.options import Options, Progress, silent_progress
from minimax_cal.measuring.faults import (
    correct_faults,
    faults_with_file_lines,
    find_data_faults,
    find_outlier_faults,
    find_points_outside_longest_seating,
)
from minimax_cal.measuring.faults.data_fault import DataFault
from minimax_cal.measuring.faults.session_faults import find_session_jumps
from minimax_cal.measuring.faults.target_steps import TARGET_RESEAT_EFFECT
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.time_effects import TARGET_SHIFT
from minimax_cal.robots.robot import Robot

ROBUST_FIT_OPTIONS = replace(
    LEAST_SQUARES_OPTIONS, trim=0.3
)  # a fit that up to so many wrong points do not pull
MEDIAN_TO_MEAN_ERROR_RATIO = (
    1.2533  # standard error of a median over that of a mean, Gaussian: sqrt(pi/2)
)


@dataclass(frozen=True, eq=False)
class CleanData:
    """Measurements with rows and points put right or left out.

    measured: as measured, but for points that stood in each other's rows.  left_out: faults whose
    points no fit counts, and faults: what is reported; both by lines of the file.  remarks: on
    them, for people.  fit: the geometric fit of the training poses, where it is that of the clean
    data.  jump_times: (j,) as `LinearisedGeometry.jump_times`.  jump_texts: what is said of these,
    where no effect says it.
    """

    data: Measurements
    measured: Measurements
    left_out: tuple[DataFault, ...]
    faults: tuple[DataFault, ...]
    remarks: tuple[str, ...]
    fit: CellFit | None
    jump_times: Array
    jump_texts: tuple[str, ...]


def clean_measurements(
    robot: Robot, measurements: Measurements, held_lines: Array, progress: Progress
) -> CleanData:
    """The measurements without the faults that can be mended.

    held_lines: lines of the file that no fit may see.
    """

    def take_training_poses(some: Measurements) -> Measurements:
        return some.take(~np.isin(some.line, held_lines))

    def fit_geometry(some: Measurements, options: Options = LEAST_SQUARES_OPTIONS) -> Cell:
        return fit_cell(robot, take_training_poses(some), options, silent_progress).cell(
            robot, some
        )

    # Points that stand in each other's rows go back where the nominal arm expects them.
    data, faults = measurements, list[DataFault]()
    exchanged, source = match_misplaced_rows(robot, measurements)
    if len(exchanged):
        data = correct_misplaced_rows(measurements, exchanged, source)
        text = (
            f"{measurements.source}: rows hold each other's points: "
            f"{measurements.format_row_names(exchanged)}"
        )
        faults.append(DataFault("swapped_rows", "all", text, measurements.line[exchanged]))

    # Distances between targets, without any arm: single points that moved, swapped targets,
    # re-seated reflectors.  Of a re-seat the geometry then finds the target and the size.
    found = find_data_faults(data)
    check_plausible(robot, correct_faults(data, found))
    progress("geometry")
    found = find_reseated_targets(found, data, fit_geometry)
    sound = correct_faults(data, found)
    fit = fit_cell(robot, take_training_poses(sound), LEAST_SQUARES_OPTIONS, progress)
    cell = fit.cell(robot, sound)
    found = tuple(measure_reseat_shift(fault, cell, data) for fault in found)

    # Outliers of the fit; of a robust fit where they may be so many that they pull a plain one.
    error = cell.error(sound)
    outliers = find_outlier_faults(cell.align_to_first_session(sound), error)
    pulling: tuple[DataFault, ...] = ()
    if not outliers and all(fault.effect != TARGET_SHIFT.name for fault in found):
        pulling = find_points_of_pulled_fit(
            error, lambda: fit_geometry(sound, ROBUST_FIT_OPTIONS).error(sound), sound
        )

    # Reported as faults are only points farther off than the tails of all others allow.
    wrong_lines = data.line[find_rows_beyond_tails(data, cell.error(data))]
    points = (
        *faults_with_file_lines(data, found, "outliers"),
        *faults_with_file_lines(sound, outliers, "outliers"),
    )
    faults += faults_with_file_lines(data, found, "swapped_rows", TARGET_RESEAT_EFFECT)
    faults += (fault for fault in points if np.isin(fault.rows, wrong_lines).any())
    faults += faults_with_file_lines(sound, pulling, "outliers")
    outliers = (*outliers, *pulling)
    sound = correct_faults(sound, outliers)
    sound = sound.take(np.asarray(sound.seen.any(axis=1)))

    # Moments at which all targets jumped together: candidates of the search for causes.
    placed, held = cell.align_to_first_session(sound), np.isin(sound.line, held_lines)
    jumps = find_session_jumps(
        placed,
        cell.error(sound),
        lambda rows: fit_jump_sizes(robot, placed, ~held, LEAST_SQUARES_OPTIONS, rows),
    )
    return CleanData(
        data=sound,
        measured=data,
        left_out=tuple(
            faults_with_file_lines(data, (*found, *outliers), "outliers", TARGET_RESEAT_EFFECT)
        ),
        faults=tuple(faults),
        remarks=tuple(f.text for f in (*found, *outliers) if f.effect != TARGET_SHIFT.name),
        fit=None if outliers else fit,
        jump_times=sound.columns["clock"][
            np.concatenate([NO_ROW_INDICES, *(j.rows for j in jumps)])
        ],
        jump_texts=tuple(jump.text for jump in jumps),
    )


def find_reseated_targets(
    faults: Sequence[DataFault], data: Measurements, fit_geometry: Callable[[Measurements], Cell]
) -> tuple[DataFault, ...]:
    """The faults, each re-seat at the one target without whose points an arm fits best.

    fit_geometry: the calibrated arm of the training poses among some.
    """
    out = list(faults)
    for i, fault in enumerate(faults):
        if fault.effect != TARGET_RESEAT_EFFECT or len(fault.targets) == 1:
            continue
        trials = [
            replace(fault, place=data.target_names[target], targets=np.array([target]))
            for target in fault.targets
        ]
        squares = []
        for trial in trials:
            some = correct_faults(data, (*out[:i], trial, *out[i + 1 :]))
            squares.append(float(np.nanmean(fit_geometry(some).error(some) ** 2)))
        out[i] = trials[int(np.argmin(squares))]
    return tuple(out)


def measure_reseat_shift(fault: DataFault, cell: Cell, data: Measurements) -> DataFault:
    """A re-seat with how far the target moved on the flange, the median over its poses [m].

    cell: fitted without the points of the shorter part.  data: with them.
    """
    if fault.effect != TARGET_RESEAT_EFFECT:
        return fault
    (rows, target), *_ = find_points_outside_longest_seating(data, [fault])
    error = cell.error(data)[rows, target]
    flange = cell.robot.pose(data.q[rows])[:, :3, :3]
    moves = np.einsum("mji,mj->mi", flange, error @ cell.base[:3, :3])
    size = float(np.linalg.norm(np.median(moves, axis=0)))
    sigma = float(MEDIAN_TO_MEAN_ERROR_RATIO * np.std(moves, axis=0).max() / np.sqrt(len(moves)))
    first, *others = fault.parameters
    return replace(fault, parameters=(replace(first, value=size, sigma=sigma), *others))
