"""Points that are elsewhere, rows under other names, and noise that is not the declared one.

What lies across the plane of the targets the distances cannot show; there, and with one or two
targets, the residual of a fit must stand out grossly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from minimax_cal.core.arrays import Array, nanmedian_last_axis
from minimax_cal.core.display_text import format_first_names
from minimax_cal.measuring.faults.data_fault import (
    MAX_EQUAL_TARGET_SCORE,
    MIN_DISTANCE_COUNT,
    MIN_INSTRUMENT_NOISE,
    NO_POINT_ERRORS,
    DataFault,
    FaultAmount,
    TargetDistances,
    measure_target_distances,
    outlier_score_limit,
    robust_sigmas,
)
from minimax_cal.measuring.faults.target_steps import find_target_shifts
from minimax_cal.measuring.measurement_checks import list_target_orders
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_agreeing_visits

MIN_OUTLIER_OVER_QUANTILE, MIN_OUTLIER_OVER_MEDIAN = (
    7.5,
    12.0,
)  # times what 90 % of errors keep to, and the typical one
OUTLIER_QUANTILE = 0.9
# As far by a Gaussian, where up to a quarter of the points may be wrong: of a fit that these do not
# pull.
MIN_ROBUST_OUTLIER_OVER_QUANTILE, ROBUST_OUTLIER_QUANTILE = 9.2, 0.75
TAIL_SIGMAS_OF_95_PERCENT = (
    1.6  # sigma: what 95 % of a fit's errors keep to (1.96 were they Gaussian)
)
MIN_UNIT_MISTAKE_RATIO = (
    100.0  # times as much or as little: um or m for mm make a thousand, no noise so much
)
U95_UNIT_QUESTION = "; is it in mm? u95_m is in metres"
MIN_NOISE_RATIO = 1e-300
RELATIVE_ERROR_OF_MEDIAN = (
    1.17  # over the root of m: relative standard error of a median deviation of m values
)


def find_outliers(
    data: Measurements,
    distances: TargetDistances,
    point_errors: Array = NO_POINT_ERRORS,
    shift_faults: tuple[DataFault, ...] = (),
) -> tuple[DataFault, ...]:
    """Single points that are elsewhere, by their distances and by the residual of a fit.

    distances: the distances of these data, `measure_target_distances`.  point_errors: (m, k, 3)
    [m], or of length 0.  shift_faults: nests that moved, so that the points after it are not taken
    for outliers.
    """
    found = dict.fromkeys(
        find_points_off_target_shape(data, distances, point_errors, shift_faults),
        "its distances to the others",
    )
    if len(point_errors):
        point_errors = point_errors.copy()
        for row, target in found:
            point_errors[row, target] = np.nan
        found |= dict.fromkeys(find_points_missed_by_fit(point_errors), "the fit")
    return build_outlier_faults(data, found)


def far_off(data: Measurements, point_errors: Array, allowed_rows: Array) -> tuple[DataFault, ...]:
    """Points that are elsewhere by a fit that up to a quarter of wrong points do not pull.

    point_errors: (m, k, 3) of it [m].  allowed_rows: (m,) True where points may be named.
    """
    found = [
        at
        for at in find_points_missed_by_fit(
            point_errors, MIN_ROBUST_OUTLIER_OVER_QUANTILE, ROBUST_OUTLIER_QUANTILE
        )
        if allowed_rows[at[0]]
    ]
    return build_outlier_faults(data, dict.fromkeys(found, "a robust fit"))


def build_outlier_faults(
    data: Measurements, evidence_by_point: Mapping[tuple[int, int], str]
) -> tuple[DataFault, ...]:
    """The fault of points (row, target), with what showed each; none without any."""
    if not evidence_by_point:
        return ()
    points = sorted(evidence_by_point)
    rows, targets = np.array(points).T
    named = format_first_names(
        [f"{data.called(data.line[row])} {data.target_names[target]}" for row, target in points]
    )
    by = " and by ".join(sorted(set(evidence_by_point.values())))
    places = sorted({data.target_names[target] for target in targets})
    return (
        DataFault(
            "outliers",
            places[0] if len(places) == 1 else "all",
            f"points that are elsewhere, by {by}: {named}",
            rows,
            targets,
            (FaultAmount("points", float(len(points))),),
        ),
    )


def find_points_missed_by_fit(
    point_errors: Array,
    min_over_quantile: float = MIN_OUTLIER_OVER_QUANTILE,
    quantile: float = OUTLIER_QUANTILE,
) -> list[tuple[int, int]]:
    """(row, target) of points that a fit misses grossly.  point_errors: (m, k, 3) [m].

    A real arm's errors have tails, but bounded ones: far beyond what a part of them keeps to, and
    the typical.
    """
    size = np.linalg.norm(point_errors, axis=-1)
    known = size[np.isfinite(size)]
    if len(known) < MIN_DISTANCE_COUNT:
        return []
    limit = max(
        min_over_quantile * float(np.quantile(known, quantile)),
        MIN_OUTLIER_OVER_MEDIAN * float(np.median(known)),
    )
    with np.errstate(invalid="ignore"):
        far = np.argwhere(size > max(limit, MIN_INSTRUMENT_NOISE))
    return [(int(row), int(target)) for row, target in far]


def find_points_off_target_shape(
    data: Measurements,
    distances: TargetDistances,
    point_errors: Array,
    shift_faults: tuple[DataFault, ...] = (),
) -> list[tuple[int, int]]:
    """(row, target) of points that do not fit the shape of the targets.

    Without the guilty point of a row the others are judged anew.
    """
    distances = remove_shift_steps(distances, data, shift_faults)
    if not len(distances.pairs):
        return []
    up = heights_above_target_plane(data, point_errors)
    every = data.seen.T.copy()
    far = point_excess_over_limit(distances, up, every)
    found: list[tuple[int, int]] = []
    while (far > 1.0).any():
        rows = np.flatnonzero(far.max(axis=0) > 1.0)
        for row in rows:
            which = find_targets_explaining_row(distances, far[:, row], every[:, row], int(row))
            if (
                len(which) > 1
                and len(point_errors)
                and np.isfinite(point_errors[row, every[:, row]]).all()
            ):
                which = which[
                    [
                        errors_relative_to_other_targets(point_errors[row], every[:, row])[
                            which
                        ].argmax()
                    ]
                ]
            found += [(int(row), int(target)) for target in which]
            every[which, row] = False
        judged = np.isin(np.arange(data.poses), rows)
        up = np.where(judged, np.nan, up)  # a height is one over the others, the guilty among them
        far = np.where(judged, point_excess_over_limit(distances, up, every), 0.0)
    return found


def find_targets_explaining_row(
    distances: TargetDistances, excess_over_limit: Array, trusted_targets: Array, row: int
) -> Array:
    """The target that explains an unlikely row, or those that explain it alike.

    Its distances are off and the rest is not.  A point that moved across one of its edges changes
    one distance only; its neighbour might as well have moved. excess_over_limit: (k,) as
    `point_excess_over_limit`.  trusted_targets: (k,) the targets still believed.
    """
    squared = (distances.off[:, row] / distances.sigma) ** 2
    squared = np.where(trusted_targets[distances.pairs].all(axis=1), squared, 0.0)
    rest = np.array(
        [np.nansum(squared[~distances.pairs_with_target(i)]) for i in range(len(excess_over_limit))]
    )
    rest = np.where(excess_over_limit > 1.0, rest, np.inf)
    return np.flatnonzero(rest <= rest.min() + MAX_EQUAL_TARGET_SCORE)


def errors_relative_to_other_targets(target_errors: Array, trusted_targets: Array) -> Array:
    """(k,) how far the error of each target is from the mean of the others.  target_errors: (k,
    3).
    """
    count = int(trusted_targets.sum())
    if count < 3:  # two differ by the same: the one that misses by more
        return np.where(trusted_targets, np.linalg.norm(target_errors, axis=1), -np.inf)
    mean = target_errors[trusted_targets].mean(axis=0)
    return np.where(trusted_targets, np.linalg.norm(target_errors - mean, axis=1), -np.inf)


def remove_shift_steps(
    distances: TargetDistances, data: Measurements, shift_faults: tuple[DataFault, ...]
) -> TargetDistances:
    """The distances with the steps of shifted nests taken out."""
    off = distances.off.copy()
    for fault in shift_faults:
        later = np.zeros(data.poses, dtype=bool)
        later[fault.rows] = True
        if fault.rows.size == 0:
            continue
        for pair in np.flatnonzero(distances.pairs_with_target(int(fault.targets[0]))):
            a, b = (data.target_names[i] for i in distances.pairs[pair])
            for amount in fault.parameters:
                if amount.name == f"{a}-{b}":
                    off[pair, later] -= amount.value
    if len(off):
        off -= nanmedian_last_axis(off)[:, None]
    return replace(distances, off=off, sigma=robust_sigmas(off))


def heights_above_target_plane(data: Measurements, point_errors: Array) -> Array:
    """(k, m) residual of each of three or more targets, across their plane, above the others [m].

    NaN where a target is missing.  Along the plane the distances say more: no turn of the flange
    changes them.
    """
    k = len(data.target_names)
    if k < 3 or not len(point_errors):
        return np.full((k, data.poses), np.nan)
    whole = data.seen.all(axis=1) & np.isfinite(point_errors).all(axis=(1, 2))
    arm = data.y[whole] - data.y[whole].mean(axis=1, keepdims=True)
    across = np.linalg.svd(arm, full_matrices=False)[2][:, 2]
    sense = np.cross(arm[:, 0], arm[:, 1])
    across *= np.where((across * sense).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    up = np.einsum("mkc,mc->km", point_errors[whole], across)
    out = np.full((k, data.poses), np.nan)
    out[:, whole] = (up - up.mean(axis=0)) * k / (k - 1)
    return out


def point_excess_over_limit(
    distances: TargetDistances, heights: Array, trusted_points: Array
) -> Array:
    """(k, m) squared Mahalanobis distance of what is known of each point, over its limit.

    heights: (k, m) heights, NaN unknown [m].  trusted_points: (k, m) False for points already
    found.
    """
    k, m = heights.shape
    out = np.zeros((k, m))
    for target in range(k):
        own = np.flatnonzero(distances.pairs_with_target(target))
        features = np.concatenate([distances.off[own], heights[[target]]])
        others = distances.pairs[own].sum(axis=1) - target
        features[:-1][~(trusted_points[others] & trusted_points[target])] = np.nan
        usable = np.isfinite(distances.off[own]).sum(axis=1) >= MIN_DISTANCE_COUNT
        tall = np.isfinite(heights[target]).sum() >= MIN_DISTANCE_COUNT
        features = features[np.append(usable, tall)]
        sigma = np.concatenate(
            [distances.sigma[own][usable], [robust_height_sigma(heights[target])] if tall else []]
        )
        if len(features):
            out[target] = squared_mahalanobis_over_limit(features / sigma[:, None], m)
    return out


def robust_height_sigma(heights: Array) -> float:
    """Scatter of heights, which hold the fit's errors too: wider where their tails are [m]."""
    known = np.abs(heights[np.isfinite(heights)])
    tail = float(np.quantile(known, 0.95)) / TAIL_SIGMAS_OF_95_PERCENT
    return max(float(robust_sigmas(heights[None])[0]), tail)


def squared_mahalanobis_over_limit(standard_scores: Array, value_count: int) -> Array:
    """(m,) squared length of standard scores, correlation taken out, over the outlier limit.

    standard_scores: (f, m), NaN unknown.  Rows are judged by those scores they have.
    """
    known = np.isfinite(standard_scores)
    calm = np.where(known, np.clip(standard_scores, -2.5, 2.5), 0.0)
    both = known.astype(float) @ known.T
    correlation = calm @ calm.T / np.maximum(both, 1.0)
    size = np.sqrt(np.maximum(np.diag(correlation), 1e-12))
    correlation = np.clip(correlation / size[:, None] / size, -0.9, 0.9)
    np.fill_diagonal(correlation, 1.0)
    out = np.zeros(standard_scores.shape[1])
    for pattern in {column.tobytes(): column for column in known.T}.values():
        rows = (known == pattern[:, None]).all(axis=0)
        count = int(pattern.sum())
        if count:
            some = standard_scores[np.ix_(pattern, rows)]
            part = floor_correlation_eigenvalues(correlation[np.ix_(pattern, pattern)])
            length = (some * np.linalg.solve(part, some)).sum(axis=0)
            out[rows] = length / outlier_score_limit(count, 3 * value_count, value_count)
    return out


def floor_correlation_eigenvalues(correlation: Array) -> Array:
    """A correlation matrix without directions of no scatter, in which any point would be far."""
    value, vector = np.linalg.eigh(correlation)
    return np.asarray((vector * np.maximum(value, 0.1)) @ vector.T)


def find_swapped_target_rows(
    data: Measurements, distances: TargetDistances, point_errors: Array = NO_POINT_ERRORS
) -> tuple[DataFault, ...]:
    """Rows whose distances fit under other names of their targets, and not under their own.

    distances: the distances of these data, `measure_target_distances`.  point_errors: (m, k, 3) of
    a fit, in the axes of the data [m]; it tells orders apart whose distances are alike.
    """
    predicted = data.y - point_errors if len(point_errors) else np.zeros_like(data.y)
    if len(distances.pairs) < 3:
        return ()
    limit = outlier_score_limit(len(distances.pairs), data.poses, data.poses)
    cost = np.nansum((distances.off / distances.sigma[:, None]) ** 2, axis=0)
    orders: list[Array] = []
    rows: list[int] = []
    for row in np.flatnonzero(cost > 9.0 * limit):
        order, least = find_best_target_order(data.y[row], distances, predicted[row])
        if least < limit and np.any(order != np.arange(len(order))):
            rows.append(int(row))
            orders.append(order)
    if not rows:
        return ()
    return (
        DataFault(
            "swapped_rows",
            "all",
            f"targets stand under each other's names in {len(rows)} rows: "
            f"{data.format_row_names(np.array(rows))}",
            np.array(rows),
            np.stack(orders),
            (FaultAmount("rows", float(len(rows))),),
        ),
    )


class BestTargetOrder(NamedTuple):
    """The target (k,) that each point of a row is of, and the squared standard deviation left."""

    target_order: Array
    squared_deviation: float


def find_best_target_order(
    points: Array, distances: TargetDistances, predicted: Array
) -> BestTargetOrder:
    """Where each target of a row seems to stand, and the squared deviation left over.

    points: (k, 3) [m].  predicted: (k, 3), zeros for unknown [m].  Of orders that fit alike (a
    triangle of equal sides) the one nearest to the prediction, else the least changed.
    """
    k = len(points)
    seen = np.flatnonzero(np.isfinite(points[:, 0]))
    count = len(seen)
    if count < 3:
        return BestTargetOrder(np.arange(k), np.inf)
    found: list[tuple[float, float, Array]] = []
    for some in list_target_orders(count):
        order = np.arange(k)
        order[seen] = seen[list(some)]
        moved = points[order]
        distance = np.linalg.norm(
            moved[distances.pairs[:, 0]] - moved[distances.pairs[:, 1]], axis=-1
        )
        cost = float(np.nansum(((distance - distances.centre) / distances.sigma) ** 2))
        miss = float(np.nansum((moved - predicted)[seen] ** 2))
        changed = float((order != np.arange(k)).sum())
        found.append((cost, miss if predicted.any() else changed, order))
    least = min(cost for cost, _, _ in found)
    alike = [entry for entry in found if entry[0] < least + 4.0 * count]
    return BestTargetOrder(min(alike, key=lambda entry: entry[1])[2], least)


class NoiseEstimate(NamedTuple):
    """Noise of a coordinate [m], and its relative standard error."""

    sigma: float
    relative_error: float


def estimate_noise_from_distances(data: Measurements) -> NoiseEstimate | None:
    """Noise of a coordinate [m] by the targets' distances, and its relative standard error.

    None where too few were measured together.  Steps of nests are taken out; a few points that are
    elsewhere do not count in a median.  What moves all targets alike, as the joints' repeatability,
    is not in it.
    """
    apart = measure_target_distances(data)
    apart = remove_shift_steps(apart, data, find_target_shifts(data, apart))
    if not len(apart.pairs):
        return None
    many = float(np.isfinite(apart.off).sum(axis=1).max())
    sigma = np.sqrt(0.5 * np.mean(apart.sigma**2))  # of a distance: root 2 of a coordinate's
    return NoiseEstimate(float(sigma), RELATIVE_ERROR_OF_MEDIAN / np.sqrt(many))


def find_misdeclared_noise(data: Measurements) -> tuple[DataFault, ...]:
    """A notice if the scatter of the distances, or of revisits, is not what `u95` says.

    Revisits hold the robot's own repeatability too: they can only show less than declared.
    """
    if "u95" not in data.columns or not np.isfinite(data.columns["u95"].astype(float)).any():
        return ()
    declared = float(np.nanmedian(data.columns["u95"].astype(float)))
    known = estimate_noise_from_distances(data)
    if known:
        seen, by = 1.96 * known[0], "the targets' distances"
    else:
        spread = revisit_coordinate_variances(data)
        if len(spread) < MIN_DISTANCE_COUNT:
            return ()
        seen, by = 1.96 * float(np.sqrt(np.median(spread) / chdtri(1.0, 0.5))), "revisits"
    ratio = seen / declared
    if ratio > 0.5 and (ratio < 2.0 or by == "revisits"):
        return ()
    return (
        DataFault(
            "noise",
            "all",
            f"column u95_mm says {1e3 * declared:.3g} mm, {by} say {1e3 * seen:.3g} mm"
            + (
                U95_UNIT_QUESTION
                if max(ratio, 1.0 / max(ratio, MIN_NOISE_RATIO)) > MIN_UNIT_MISTAKE_RATIO
                else ""
            ),
            parameters=(FaultAmount("u95", seen, "m"), FaultAmount("declared", declared, "m")),
        ),
    )


def revisit_coordinate_variances(data: Measurements) -> Array:
    """Squared differences of coordinates at poses visited again, halved: variances [m^2]."""
    group = group_agreeing_visits(data)
    order = np.argsort(group, kind="stable")
    again = np.flatnonzero(np.diff(group[order]) == 0)[::2]
    change = data.y[order[again + 1]] - data.y[order[again]]
    return np.asarray(0.5 * change[np.isfinite(change)] ** 2)
