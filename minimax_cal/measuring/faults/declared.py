"""The noise by the distances between targets, and whether it is what the data declare."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.distances import FEWEST, between
from minimax_cal.measuring.faults.fault import Amount, Fault
from minimax_cal.measuring.faults.nests import target_shifts
from minimax_cal.measuring.faults.outliers import level
from minimax_cal.measuring.grouping import visits
from minimax_cal.measuring.measurements import Measurements

ANOTHER = 100.0  # times as much or as little: um or m for mm make a thousand, no noise so much
OTHER_UNIT = "; is it in mm? u95_m is in metres"
TINY = 1e-300
OF_MEDIAN = 1.17  # over the root of m: relative standard error of a median deviation of m values


def noise_between(data: Measurements) -> tuple[float, float] | None:
    """Noise of a coordinate [m] by the targets' distances, and its relative standard error.

    None where too few were measured together.  Steps of nests are taken out; a few points that are
    elsewhere do not count in a median.  What moves all targets alike, as the joints' repeatability,
    is not in it.
    """
    apart = level(between(data), data, target_shifts(data))
    if not len(apart.pairs):
        return None
    many = float(np.isfinite(apart.off).sum(axis=1).max())
    sigma = np.sqrt(0.5 * np.mean(apart.sigma**2))  # of a distance: root 2 of a coordinate's
    return float(sigma), OF_MEDIAN / np.sqrt(many)


def noise(data: Measurements) -> tuple[Fault, ...]:
    """A notice if the scatter of the distances, or of revisits, is not what `u95` says.

    Revisits hold the robot's own repeatability too: they can only show less than declared.
    """
    if "u95" not in data.columns or not np.isfinite(data.columns["u95"].astype(float)).any():
        return ()
    declared = float(np.nanmedian(data.columns["u95"].astype(float)))
    known = noise_between(data)
    if known:
        seen, by = 1.96 * known[0], "the targets' distances"
    else:
        spread = revisit_scatter(data)
        if len(spread) < FEWEST:
            return ()
        seen, by = 1.96 * float(np.sqrt(np.median(spread) / chdtri(1.0, 0.5))), "revisits"
    ratio = seen / declared
    if ratio > 0.5 and (ratio < 2.0 or by == "revisits"):
        return ()
    return (
        Fault(
            "noise",
            "all",
            f"column u95_mm says {1e3 * declared:.3g} mm, {by} say {1e3 * seen:.3g} mm"
            + (OTHER_UNIT if max(ratio, 1.0 / max(ratio, TINY)) > ANOTHER else ""),
            parameters=(Amount("u95", seen, "m"), Amount("declared", declared, "m")),
        ),
    )


def revisit_scatter(data: Measurements) -> Array:
    """Squared differences of coordinates at poses visited again, halved: variances [m^2]."""
    group = visits(data)
    order = np.argsort(group, kind="stable")
    again = np.flatnonzero(np.diff(group[order]) == 0)[::2]
    change = data.y[order[again + 1]] - data.y[order[again]]
    return np.asarray(0.5 * change[np.isfinite(change)] ** 2)
