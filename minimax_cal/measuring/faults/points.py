"""Points that are elsewhere, rows under other names, and noise that is not the declared one.

What lies across the plane of the targets the distances cannot show; there, and with one or two
targets, the residual of a fit must stand out grossly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from minimax_cal.ground.arrays import Array, known_median
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.checks import orders_of
from minimax_cal.measuring.faults.fault import (
    ALIKE,
    FAINT,
    FEWEST,
    NO_ERROR,
    Amount,
    Between,
    Fault,
    between,
    outlier_limit,
    scatter,
)
from minimax_cal.measuring.faults.nests import target_shifts
from minimax_cal.measuring.grouping import visits
from minimax_cal.measuring.measurements import Measurements

GROSS, GROSS_TYPICAL = 7.5, 12.0  # times what 90 % of errors keep to, and the typical one
PART = 0.9
# As far by a Gaussian, where up to a quarter of the points may be wrong: of a fit that these do not
# pull.
ROBUST_GROSS, ROBUST_PART = 9.2, 0.75
TAIL = 1.6  # sigma: what 95 % of a fit's errors keep to (1.96 were they Gaussian)
ANOTHER = 100.0  # times as much or as little: um or m for mm make a thousand, no noise so much
OTHER_UNIT = "; is it in mm? u95_m is in metres"
TINY = 1e-300
OF_MEDIAN = 1.17  # over the root of m: relative standard error of a median deviation of m values


def outlying(
    data: Measurements, apart: Between, error: Array = NO_ERROR, shifts: tuple[Fault, ...] = ()
) -> tuple[Fault, ...]:
    """Single points that are elsewhere, by their distances and by the residual of a fit.

    apart: the distances of these data, `between`.  error: (m, k, 3) [m], or of length 0.  shifts:
    nests that moved, so that the points after it are not taken for outliers.
    """
    found = dict.fromkeys(off_shape(data, apart, error, shifts), "its distances to the others")
    if len(error):
        error = error.copy()
        for row, target in found:
            error[row, target] = np.nan
        found |= dict.fromkeys(off_fit(error), "the fit")
    return told(data, found)


def far_off(data: Measurements, error: Array, rows: Array) -> tuple[Fault, ...]:
    """Points that are elsewhere by a fit that up to a quarter of wrong points do not pull.

    error: (m, k, 3) of it [m].  rows: (m,) True where points may be named.
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
    """(row, target) of points that a fit misses grossly.  error: (m, k, 3) [m].

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
    return [(int(row), int(target)) for row, target in far]


def off_shape(
    data: Measurements, apart: Between, error: Array, shifts: tuple[Fault, ...] = ()
) -> list[tuple[int, int]]:
    """(row, target) of points that do not fit the shape of the targets.

    Without the guilty point of a row the others are judged anew.
    """
    apart = level(apart, data, shifts)
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
            if len(which) > 1 and len(error) and np.isfinite(error[row, every[:, row]]).all():
                which = which[[relative(error[row], every[:, row])[which].argmax()]]
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


def heights(data: Measurements, error: Array) -> Array:
    """(k, m) residual of each of three or more targets, across their plane, above the others [m].

    NaN where a target is missing.  Along the plane the distances say more: no turn of the flange
    changes them.
    """
    k = len(data.target_names)
    if k < 3 or not len(error):
        return np.full((k, data.poses), np.nan)
    whole = data.seen.all(axis=1) & np.isfinite(error).all(axis=(1, 2))
    arm = data.y[whole] - data.y[whole].mean(axis=1, keepdims=True)
    across = np.linalg.svd(arm, full_matrices=False)[2][:, 2]
    sense = np.cross(arm[:, 0], arm[:, 1])
    across *= np.where((across * sense).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    up = np.einsum("mkc,mc->km", error[whole], across)
    out = np.full((k, data.poses), np.nan)
    out[:, whole] = (up - up.mean(axis=0)) * k / (k - 1)
    return out


def unlikely(apart: Between, up: Array, every: Array) -> Array:
    """(k, m) squared Mahalanobis distance of what is known of each point, over its limit.

    up: (k, m) heights, NaN unknown [m].  every: (k, m) False for points already found.
    """
    k, m = up.shape
    out = np.zeros((k, m))
    for target in range(k):
        own = np.flatnonzero(apart.of(target))
        features = np.concatenate([apart.off[own], up[[target]]])
        others = apart.pairs[own].sum(axis=1) - target
        features[:-1][~(every[others] & every[target])] = np.nan
        usable = np.isfinite(apart.off[own]).sum(axis=1) >= FEWEST
        tall = np.isfinite(up[target]).sum() >= FEWEST
        features = features[np.append(usable, tall)]
        sigma = np.concatenate([apart.sigma[own][usable], [tilt(up[target])] if tall else []])
        if len(features):
            out[target] = mahalanobis(features / sigma[:, None], m)
    return out


def tilt(up: Array) -> float:
    """Scatter of heights, which hold the fit's errors too: wider where their tails are [m]."""
    known = np.abs(up[np.isfinite(up)])
    tail = float(np.quantile(known, 0.95)) / TAIL
    return max(float(scatter(up[None])[0]), tail)


def mahalanobis(z: Array, m: int) -> Array:
    """(m,) squared length of standard scores, correlation taken out, over the outlier limit.

    z: (f, m), NaN unknown.  Rows are judged by those scores they have.
    """
    known = np.isfinite(z)
    calm = np.where(known, np.clip(z, -2.5, 2.5), 0.0)
    both = known.astype(float) @ known.T
    correlation = calm @ calm.T / np.maximum(both, 1.0)
    size = np.sqrt(np.maximum(np.diag(correlation), 1e-12))
    correlation = np.clip(correlation / size[:, None] / size, -0.9, 0.9)
    np.fill_diagonal(correlation, 1.0)
    out = np.zeros(z.shape[1])
    for pattern in {column.tobytes(): column for column in known.T}.values():
        rows = (known == pattern[:, None]).all(axis=0)
        count = int(pattern.sum())
        if count:
            some = z[np.ix_(pattern, rows)]
            part = floored(correlation[np.ix_(pattern, pattern)])
            length = (some * np.linalg.solve(part, some)).sum(axis=0)
            out[rows] = length / outlier_limit(count, 3 * m, m)
    return out


def floored(correlation: Array) -> Array:
    """A correlation matrix without directions of no scatter, in which any point would be far."""
    value, vector = np.linalg.eigh(correlation)
    return np.asarray((vector * np.maximum(value, 0.1)) @ vector.T)


def swapped_rows(data: Measurements, apart: Between, error: Array = NO_ERROR) -> tuple[Fault, ...]:
    """Rows whose distances fit under other names of their targets, and not under their own.

    apart: the distances of these data, `between`.  error: (m, k, 3) of a fit, in the axes of the
    data [m]; it tells orders apart whose distances are alike.
    """
    predicted = data.y - error if len(error) else np.zeros_like(data.y)
    if len(apart.pairs) < 3:
        return ()
    limit = outlier_limit(len(apart.pairs), data.poses, data.poses)
    cost = np.nansum((apart.off / apart.sigma[:, None]) ** 2, axis=0)
    orders: list[Array] = []
    rows: list[int] = []
    for row in np.flatnonzero(cost > 9.0 * limit):
        order, least = best_order(data.y[row], apart, predicted[row])
        if least < limit and np.any(order != np.arange(len(order))):
            rows.append(int(row))
            orders.append(order)
    if not rows:
        return ()
    return (
        Fault(
            "swapped_rows",
            "all",
            f"targets stand under each other's names in {len(rows)} rows: "
            f"{data.list_rows(np.array(rows))}",
            np.array(rows),
            np.stack(orders),
            (Amount("rows", float(len(rows))),),
        ),
    )


def best_order(point: Array, apart: Between, predicted: Array) -> tuple[Array, float]:
    """Where each target of a row seems to stand, and the squared deviation left over.

    point: (k, 3) [m].  predicted: (k, 3), zeros for unknown [m].  Of orders that fit alike (a
    triangle of equal sides) the one nearest to the prediction, else the least changed.
    """
    k = len(point)
    seen = np.flatnonzero(np.isfinite(point[:, 0]))
    count = len(seen)
    if count < 3:
        return np.arange(k), np.inf
    found: list[tuple[float, float, Array]] = []
    for some in orders_of(count):
        order = np.arange(k)
        order[seen] = seen[list(some)]
        moved = point[order]
        distance = np.linalg.norm(moved[apart.pairs[:, 0]] - moved[apart.pairs[:, 1]], axis=-1)
        cost = float(np.nansum(((distance - apart.centre) / apart.sigma) ** 2))
        miss = float(np.nansum((moved - predicted)[seen] ** 2))
        changed = float((order != np.arange(k)).sum())
        found.append((cost, miss if predicted.any() else changed, order))
    least = min(cost for cost, _, _ in found)
    alike = [entry for entry in found if entry[0] < least + 4.0 * count]
    return min(alike, key=lambda entry: entry[1])[2], least


def noise_between(data: Measurements) -> tuple[float, float] | None:
    """Noise of a coordinate [m] by the targets' distances, and its relative standard error.

    None where too few were measured together.  Steps of nests are taken out; a few points that are
    elsewhere do not count in a median.  What moves all targets alike, as the joints' repeatability,
    is not in it.
    """
    apart = between(data)
    apart = level(apart, data, target_shifts(data, apart))
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
