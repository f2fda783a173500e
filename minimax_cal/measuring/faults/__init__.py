"""Faults of the data, found before any effect is fitted: points, rows, nests, sessions, joints.

Distances between targets tell without any model: a point that moved, rows with exchanged names, a
nest that shifted.  What lies across the plane of the targets they cannot show; there, and with one
or two targets, the residual of a fit must stand out grossly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.fault import NO_ERROR, Between, Fault, between
from minimax_cal.measuring.faults.joints import unsettled
from minimax_cal.measuring.faults.nests import RESEAT, target_shifts
from minimax_cal.measuring.faults.points import noise, outlying, swapped_rows
from minimax_cal.measuring.faults.sessions import mixed_units, session_jumps
from minimax_cal.measuring.measurements import Measurements


def find_faults(data: Measurements, error: Array = NO_ERROR) -> tuple[Fault, ...]:
    """Everything found; each test looks at data mended by those before it.

    error: (m, k, 3) measured minus predicted by a fit, in the axes of the data as `Cell.error`
    gives them [m]; or of length 0 for none.
    """
    swapped, mended_names, apart = with_own_names(data, error)
    if swapped and len(error):
        error = error.copy()
        error[swapped[0].rows] = np.nan  # of the names as they stood
    shifts = target_shifts(mended_names, apart)
    outliers = outlying(mended_names, apart, error, shifts)
    good = mended(mended_names, outliers)
    notices = (*mixed_units(data), *session_jumps(good, error), *noise(good))
    return (*swapped, *shifts, *outliers, *unsettled(data), *notices)


def distance_faults(data: Measurements) -> tuple[Fault, ...]:
    """What the distances between targets show without any robot: re-seated nests, single points."""
    if len(data.target_names) < 2:
        return ()
    _, good, apart = with_own_names(data)
    shifts = target_shifts(good, apart)
    return (*shifts, *outlying(good, apart, shifts=shifts))


def with_own_names(
    data: Measurements, error: Array = NO_ERROR
) -> tuple[tuple[Fault, ...], Measurements, Between]:
    """Rows under other names, the data with these put right, and the distances of those data.

    error: (m, k, 3) as `find_faults` takes it [m].
    """
    apart = between(data)
    swapped = swapped_rows(data, apart, error)
    good = mended(data, swapped)
    return swapped, good, between(good) if swapped else apart


def standing_out(data: Measurements, error: Array) -> tuple[Fault, ...]:
    """Of everything found, beside a fit of these errors, the points that are elsewhere."""
    return tuple(fault for fault in find_faults(data, error) if fault.effect == "outliers")


def mended(data: Measurements, faults: tuple[Fault, ...]) -> Measurements:
    """Swapped rows put right, outlying points NaN; the rows stay, and so does a shifted nest.

    Of a target that was re-seated at rows of a file without visits the longest part stays.
    """
    y = data.y.copy()
    for rows, target in spoilt(data, faults):
        y[rows, target] = np.nan
    for fault in faults:
        if fault.effect == "swapped_rows":
            y[fault.rows] = y[fault.rows[:, None], fault.targets]
    for fault in faults:
        if fault.effect == "outliers":
            y[fault.rows, fault.targets] = np.nan
    return data.with_y(y)


def spoilt(data: Measurements, faults: Sequence[Fault]) -> list[tuple[Array, int]]:
    """Rows and target of the points of re-seated targets that are not of their longest part."""
    reseats = [fault for fault in faults if fault.effect == RESEAT]
    out = []
    for target in dict.fromkeys(int(fault.targets[0]) for fault in reseats):
        part = np.zeros(data.poses, dtype=int)  # how often it was seated before each row
        for fault in reseats:
            part[fault.rows] += int(fault.targets[0]) == target
        count = np.bincount(part[data.seen[:, target]])
        out.append((np.flatnonzero(data.seen[:, target] & (part != count.argmax())), target))
    return out


def in_lines(data: Measurements, faults: Sequence[Fault], *effects: str) -> list[Fault]:
    """Faults of some kinds, their rows as lines of the file."""
    return [replace(f, rows=data.line[f.rows]) for f in faults if f.effect in effects]
