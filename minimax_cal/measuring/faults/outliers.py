"""Single points that are elsewhere.

What lies across the plane of the targets the distances cannot show; there, and with one or two
targets, the residual of a fit must stand out grossly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array, known_median
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.faults.distances import FAINT, FEWEST, Between, between, scatter
from minimax_cal.measuring.faults.fault import NO_ERROR, Amount, Fault
from minimax_cal.measuring.faults.limits import ALIKE
from minimax_cal.measuring.faults.surprise import heights, unlikely
from minimax_cal.measuring.measurements import Measurements

GROSS, GROSS_TYPICAL = 7.5, 12.0  # times what 90 % of errors keep to, and the typical one
PART = 0.9
# As far by a Gaussian, where up to a quarter of the points may be wrong: of a fit that these do not
# pull.
ROBUST_GROSS, ROBUST_PART = 9.2, 0.75


def outlying(
    data: Measurements, error: Array = NO_ERROR, shifts: tuple[Fault, ...] = ()
) -> tuple[Fault, ...]:
    """Single points that are elsewhere, by their distances and by the residual of a fit.

    error: (k, m, 3) [m], or of length 0.  shifts: nests that moved, so that the points after it
    are not taken for outliers.
    """
    found = dict.fromkeys(off_shape(data, error, shifts), "its distances to the others")
    if len(error):
        error = error.copy()
        for row, target in found:
            error[target, row] = np.nan
        found |= dict.fromkeys(off_fit(error), "the fit")
    return told(data, found)


def far_off(data: Measurements, error: Array, rows: Array) -> tuple[Fault, ...]:
    """Points that are elsewhere by a fit that up to a quarter of wrong points do not pull.

    error: (k, m, 3) of it [m].  rows: (m,) True where points may be named.
    """
    found = [at for at in off_fit(error, ROBUST_GROSS, ROBUST_PART) if rows[at[0]]]
    return told(data, dict.fromkeys(found, "a robust fit"))


def told(data: Measurements, found: Mapping[tuple[int, int], str]) -> tuple[Fault, ...]:
    """The fault of points (row, target), with what showed each; none without any."""
    if not found:
        return ()
    points = sorted(found)
    rows, targets = np.array(points).T
    named = name_first(
        [f"{data.called(data.line[row])} {data.target_names[target]}" for row, target in points]
    )
    by = " and by ".join(sorted(set(found.values())))
    places = sorted({data.target_names[target] for target in targets})
    return (
        Fault(
            "outliers",
            places[0] if len(places) == 1 else "all",
            f"points that are elsewhere, by {by}: {named}",
            rows,
            targets,
            (Amount("points", float(len(points))),),
        ),
    )


def off_fit(error: Array, gross: float = GROSS, part: float = PART) -> list[tuple[int, int]]:
    """(row, target) of points that a fit misses grossly.  error: (k, m, 3) [m].

    A real arm's errors have tails, but bounded ones: far beyond what a part of them keeps to, and
    the typical.
    """
    size = np.linalg.norm(error, axis=-1)
    known = size[np.isfinite(size)]
    if len(known) < FEWEST:
        return []
    limit = max(gross * float(np.quantile(known, part)), GROSS_TYPICAL * float(np.median(known)))
    with np.errstate(invalid="ignore"):
        far = np.argwhere(size > max(limit, FAINT))
    return [(int(row), int(target)) for target, row in far]


def off_shape(
    data: Measurements, error: Array, shifts: tuple[Fault, ...] = ()
) -> list[tuple[int, int]]:
    """(row, target) of points that do not fit the shape of the targets.

    Without the guilty point of a row the others are judged anew.
    """
    apart = level(between(data), data, shifts)
    if not len(apart.pairs):
        return []
    up = heights(data, error)
    every = data.seen.T.copy()
    far = unlikely(apart, up, every)
    found: list[tuple[int, int]] = []
    while (far > 1.0).any():
        rows = np.flatnonzero(far.max(axis=0) > 1.0)
        for row in rows:
            which = guilty(apart, far[:, row], every[:, row], int(row))
            if len(which) > 1 and len(error) and np.isfinite(error[every[:, row], row]).all():
                which = which[[relative(error[:, row], every[:, row])[which].argmax()]]
            found += [(int(row), int(target)) for target in which]
            every[which, row] = False
        judged = np.isin(np.arange(data.poses), rows)
        up = np.where(judged, np.nan, up)  # a height is one over the others, the guilty among them
        far = np.where(judged, unlikely(apart, up, every), 0.0)
    return found


def guilty(apart: Between, far: Array, every: Array, row: int) -> Array:
    """The target that explains an unlikely row, or those that explain it alike.

    Its distances are off and the rest is not.  A point that moved across one of its edges changes
    one distance only; its neighbour might as well have moved.
    far: (k,) as `unlikely`.  every: (k,) the targets still believed.
    """
    squared = (apart.off[:, row] / apart.sigma) ** 2
    squared = np.where(every[apart.pairs].all(axis=1), squared, 0.0)
    rest = np.array([np.nansum(squared[~apart.of(i)]) for i in range(len(far))])
    rest = np.where(far > 1.0, rest, np.inf)
    return np.flatnonzero(rest <= rest.min() + ALIKE)


def relative(error: Array, every: Array) -> Array:
    """(k,) how far the error of each target is from the mean of the others.  error: (k, 3)."""
    count = int(every.sum())
    if count < 3:  # two differ by the same: the one that misses by more
        return np.where(every, np.linalg.norm(error, axis=1), -np.inf)
    mean = error[every].mean(axis=0)
    return np.where(every, np.linalg.norm(error - mean, axis=1), -np.inf)


def level(apart: Between, data: Measurements, shifts: tuple[Fault, ...]) -> Between:
    """The distances with the steps of shifted nests taken out."""
    off = apart.off.copy()
    for fault in shifts:
        later = np.zeros(data.poses, dtype=bool)
        later[fault.rows] = True
        if fault.rows.size == 0:
            continue
        for pair in np.flatnonzero(apart.of(int(fault.targets[0]))):
            a, b = (data.target_names[i] for i in apart.pairs[pair])
            for amount in fault.parameters:
                if amount.name == f"{a}-{b}":
                    off[pair, later] -= amount.value
    if len(off):
        off -= known_median(off)[:, None]
    return replace(apart, off=off, sigma=scatter(off))
