"""Faults of the data, found before any effect is fitted: points, rows, nests, sessions, joints.

Distances between targets tell without any model: a point that moved, rows with exchanged names, a
nest that shifted.  What lies across the plane of the targets they cannot show; there, and with one
or two targets, the residual of a fit must stand out grossly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.faults.data_fault import (
    NO_POINT_ERRORS,
    DataFault,
    TargetDistances,
    measure_target_distances,
)
from minimax_cal.measuring.faults.point_faults import (
    find_misdeclared_noise,
    find_outliers,
    find_swapped_target_rows,
)
from minimax_cal.measuring.faults.read_back_joints import find_read_back_lag
from minimax_cal.measuring.faults.session_faults import find_mixed_unit_sessions, find_session_jumps
from minimax_cal.measuring.faults.target_steps import TARGET_RESEAT_EFFECT, find_target_shifts
from minimax_cal.measuring.measurements import Measurements


def find_data_faults(
    data: Measurements, point_errors: Array = NO_POINT_ERRORS
) -> tuple[DataFault, ...]:
    """Everything found; each test looks at data mended by those before it.

    point_errors: (m, k, 3) measured minus predicted by a fit, in the axes of the data as
    `Cell.point_errors` gives them [m]; or of length 0 for none.
    """
    swapped, mended_names, apart = restore_target_names(data, point_errors)
    if swapped and len(point_errors):
        point_errors = point_errors.copy()
        point_errors[swapped[0].rows] = np.nan  # of the names as they stood
    shifts = find_target_shifts(mended_names, apart)
    outliers = find_outliers(mended_names, apart, point_errors, shifts)
    good = correct_faults(mended_names, outliers)
    notices = (
        *find_mixed_unit_sessions(data),
        *find_session_jumps(good, point_errors),
        *find_misdeclared_noise(good),
    )
    return (*swapped, *shifts, *outliers, *find_read_back_lag(data), *notices)


def find_faults_by_distances(data: Measurements) -> tuple[DataFault, ...]:
    """What the distances between targets show without any robot: re-seated nests, single points."""
    if len(data.target_names) < 2:
        return ()
    _, good, apart = restore_target_names(data)
    shifts = find_target_shifts(good, apart)
    return (*shifts, *find_outliers(good, apart, shift_faults=shifts))


class RestoredTargetNames(NamedTuple):
    """Rows found under other targets' names, the data with names corrected, and its distances."""

    faults: tuple[DataFault, ...]
    data: Measurements
    distances: TargetDistances


def restore_target_names(
    data: Measurements, point_errors: Array = NO_POINT_ERRORS
) -> RestoredTargetNames:
    """Rows under other names, the data with these put right, and the distances of those data.

    point_errors: (m, k, 3) as `find_data_faults` takes it [m].
    """
    apart = measure_target_distances(data)
    swapped = find_swapped_target_rows(data, apart, point_errors)
    good = correct_faults(data, swapped)
    return RestoredTargetNames(swapped, good, measure_target_distances(good) if swapped else apart)


def find_outlier_faults(data: Measurements, point_errors: Array) -> tuple[DataFault, ...]:
    """Of everything found, beside a fit of these errors, the points that are elsewhere."""
    return tuple(
        fault for fault in find_data_faults(data, point_errors) if fault.effect == "outliers"
    )


def correct_faults(data: Measurements, faults: tuple[DataFault, ...]) -> Measurements:
    """Swapped rows put right, outlying points NaN; the rows stay, and so does a shifted nest.

    Of a target that was re-seated at rows of a file without visits the longest part stays.
    """
    y = data.y.copy()
    for rows, target in find_points_outside_longest_seating(data, faults):
        y[rows, target] = np.nan
    for fault in faults:
        if fault.effect == "swapped_rows":
            y[fault.rows] = y[fault.rows[:, None], fault.targets]
    for fault in faults:
        if fault.effect == "outliers":
            y[fault.rows, fault.targets] = np.nan
    return data.with_y(y)


def find_points_outside_longest_seating(
    data: Measurements, faults: Sequence[DataFault]
) -> list[tuple[Array, int]]:
    """Rows and target of the points of re-seated targets that are not of their longest part."""
    reseats = [fault for fault in faults if fault.effect == TARGET_RESEAT_EFFECT]
    out = []
    for target in dict.fromkeys(int(fault.targets[0]) for fault in reseats):
        part = np.zeros(data.poses, dtype=int)  # how often it was seated before each row
        for fault in reseats:
            part[fault.rows] += int(fault.targets[0]) == target
        count = np.bincount(part[data.seen[:, target]])
        out.append((np.flatnonzero(data.seen[:, target] & (part != count.argmax())), target))
    return out


def faults_with_file_lines(
    data: Measurements, faults: Sequence[DataFault], *effects: str
) -> list[DataFault]:
    """Faults of some kinds, their rows as lines of the file."""
    return [replace(f, rows=data.line[f.rows]) for f in faults if f.effect in effects]
