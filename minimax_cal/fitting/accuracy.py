"""Accuracy of positions: functions of error arrays, nothing else.

The pose is the unit: errors of its targets belong together.  Both intervals speak of poses drawn
as these were, and of this one fit.  Nothing can be told of faults that the poses do not show: where
one pose in a hundred misses by ten times as much, a few dozen poses without one promise too much.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from scipy.special import ndtri

from minimax_cal.core.arrays import Array
from minimax_cal.core.record_fields import SEPARATE_FIELD_FORMAT, FieldFormat, scale_numbers
from minimax_cal.core.results import JsonRecord
from minimax_cal.core.tables import Table

# the accuracies of a result, and whether they are of held-out poses
Ends = tuple[float, float]
UNKNOWN_ENDS = (math.nan, math.nan)
IS_HELD_BY_KEY = {"nominal": True, "train": False, "holdout": True, "nominal_train": False}


@dataclass(frozen=True)
class Accuracy(JsonRecord):
    """Distances between measured and predicted points, over all measured points.

    sse_mm2, counts: per target, the sum of squares F_i and at how many poses it was measured.
    rms_ci95_mm, max_ci95_mm: 95 % intervals of RMS and largest, where they were worked out.
    worst: (pose, target) of the largest distance, (-1, -1) without points.
    means_mm, largest_mm: per target, empty where a file does not tell them.
    """

    rms_mm: float
    max_mm: float
    mean_mm: float
    poses: Annotated[int, FieldFormat(least=0)]
    sse_mm2: Annotated[tuple[float, ...], FieldFormat(least=0.0)]
    counts: Annotated[tuple[int, ...], FieldFormat(key="points", least=0)]
    worst: Annotated[tuple[int, int], SEPARATE_FIELD_FORMAT] = (-1, -1)
    means_mm: Annotated[tuple[float, ...], SEPARATE_FIELD_FORMAT] = field(default=(), compare=False)
    largest_mm: Annotated[tuple[float, ...], SEPARATE_FIELD_FORMAT] = field(
        default=(), compare=False
    )
    rms_ci95_mm: Annotated[Ends | None, FieldFormat(brief=True)] = field(
        default=None, compare=False
    )
    max_ci95_mm: Annotated[Ends | None, FieldFormat(brief=True)] = field(
        default=None, compare=False
    )

    def rms_by_target(self) -> tuple[float, ...]:
        """RMS of each target, NaN where it was not measured [mm]."""
        return tuple(
            math.sqrt(square / count) if count else math.nan
            for square, count in zip(self.sse_mm2, self.counts, strict=True)
        )

    def table(self, title: str, targets: tuple[str, ...]) -> Table:
        """As a table, a row a target and one for all."""
        untold = (math.nan,) * len(targets)
        means, largest = self.means_mm or untold, self.largest_mm or untold
        columns = (targets, self.counts, self.rms_by_target(), means, largest, self.sse_mm2)
        total = (sum(self.counts), self.rms_mm, self.mean_mm, self.max_mm, sum(self.sse_mm2))
        heads = "target | points d | RMS mm .4f | mean mm .4f | max mm .4f | sum mm^2 .4f"
        return Table.from_rows(title, zip(*columns, strict=True), heads).with_rows(("all", *total))


def summarise_point_errors(point_errors: Array) -> Accuracy:
    """Summary of point errors (m, k, 3), NaN where not measured [m]; NaN without any point."""
    # sums target by target, pose by pose: the same however the errors are stored
    point_errors = np.ascontiguousarray(np.swapaxes(point_errors, 0, 1))
    distance = 1e3 * np.sqrt(np.einsum("kmi,kmi->km", point_errors, point_errors))
    seen = np.isfinite(distance)
    known = np.where(seen, distance, 0.0)
    sse, counts = tuple((known**2).sum(axis=1).tolist()), tuple(seen.sum(axis=1).tolist())
    total = sum(counts)
    if not total:
        return Accuracy(math.nan, math.nan, math.nan, 0, sse, counts)
    target, pose = divmod(int(np.argmax(np.where(seen, distance, -1.0))), distance.shape[1])
    return Accuracy(
        rms_mm=math.sqrt(sum(sse) / total),
        max_mm=float(distance[target, pose]),
        mean_mm=float(known.sum()) / total,
        poses=int(np.count_nonzero(seen.any(axis=0))),
        sse_mm2=sse,
        counts=counts,
        worst=(pose, target),
        means_mm=tuple((known.sum(axis=1) / np.where(counts, counts, np.nan)).tolist()),
        largest_mm=tuple(np.where(counts, known.max(axis=1), np.nan).tolist()),
    )


def split_errors_by_key(
    nominal_errors: Array, calibrated_errors: Array, held: Array
) -> dict[str, Array]:
    """Errors (m, ...) of all poses by the keys of a result.  held: (m,)."""
    return {
        key: (nominal_errors if key.startswith("nominal") else calibrated_errors)[held == is_held]
        for key, is_held in IS_HELD_BY_KEY.items()
    }


A = TypeVar("A", bound=Accuracy)


def accuracy_before_and_after(accuracies: Mapping[str, A]) -> tuple[A, A, str]:
    """Before and after a fit, at held-out poses where there are any, and which poses those are."""
    held, train = accuracies["holdout"], accuracies["train"]
    if held.poses:
        where = f"{held.poses} poses that were not used for the fit"
        return accuracies["nominal"], held, where
    where = f"the {train.poses} poses of the fit itself (none was held out)"
    return accuracies["nominal_train"], train, where


# ---- intervals -----------------------------------------------------------------------------------


MIN_INTERVAL_POSES = 3  # poses; fewer say nothing about their spread
MEAN_RESAMPLES = 2000  # bootstrap samples: the ends are then sure to about 2 % of the width
NORMAL_PIVOT_COUNT = 4000  # simulated samples behind the interval of the largest error
MAX_TAIL_ERRORS = 100  # no more than so many of the largest errors tell the tail
RESAMPLED_BUNDLES = 2000  # more poses than these are drawn in bundles
MAX_INTERVAL_RATIO = (
    10.0  # times what was seen: an end beyond it is of the assumed law, not of the poses
)
MIN_ERROR_MM = 1e-9  # of the mean square: an error that is exactly zero has no logarithm


class Interval(NamedTuple):
    """Two ends, NaN each where too little is known."""

    low: float
    high: float


UNKNOWN_INTERVAL = Interval(math.nan, math.nan)


def interval_for_display(interval: Interval, observed_error: float) -> Interval:
    """An interval as it is told to people: never ending below what was seen, and open above where
    the poses give no upper end.

    Of few poses, or where one is nearly all of the error, the samples that lack it leave the end to
    the tail of an assumed law: it covers, and says nothing.  observed_error: the value itself [m].
    """
    high = (
        max(interval.high, observed_error)
        if interval.high <= MAX_INTERVAL_RATIO * observed_error
        else math.nan
    )
    return Interval(interval.low, high)


def with_intervals(accuracy: Accuracy, rms_interval: Interval, max_interval: Interval) -> Accuracy:
    """An accuracy with intervals of its RMS and of its largest error [m]."""
    ends = [tuple(scale_numbers(interval, 1e3)) for interval in (rms_interval, max_interval)]
    return replace(accuracy, rms_ci95_mm=ends[0], max_ci95_mm=ends[1])


def bootstrap_rms_interval(
    point_errors: Array,
    pose_groups: Array | None = None,
    level: float = 0.95,
    *,
    rng: np.random.Generator,
) -> Interval:
    """Interval for the RMS distance over poses like these [m].

    Studentised bootstrap of the log mean square over poses [Davison and Hinkley 1997, ch. 5], its
    samples spread by a kernel in the logarithm: without it the skewness of few squares is missed.
    point_errors: (m, k, 3) measured minus predicted, NaN where not measured [m].  pose_groups: (m,)
    poses with one number are drawn together.
    """
    square = (point_errors**2).sum(axis=-1)
    seen = np.isfinite(square)
    total, count = np.where(seen, square, 0.0).sum(axis=1), seen.sum(axis=1)
    total, count = (
        np.bincount(number_pose_groups(point_errors, pose_groups), of) for of in (total, count)
    )
    total, count = total[count > 0], count[count > 0]
    bundle = np.arange(len(count)) % RESAMPLED_BUNDLES
    total, count = np.bincount(bundle, total), np.bincount(bundle, count)
    m = len(count)
    if m < MIN_INTERVAL_POSES:
        return UNKNOWN_INTERVAL
    mean = float(total.sum() / count.sum())
    if mean == 0.0:
        return Interval(0.0, 0.0)
    total = np.maximum(total, MIN_ERROR_MM * mean * count)
    logs = np.log(total / count)
    width = min(float(logs.std(ddof=1)), 1.0) * m**-0.2
    drawn = rng.integers(0, m, (MEAN_RESAMPLES, m))
    kernel = np.exp(width * rng.normal(size=drawn.shape) - 0.5 * width**2)
    log, spread = log_mean_and_error(total[drawn] * kernel, count[drawn])
    own, own_spread = log_mean_and_error(total, count)
    student = (log - math.log(mean)) / np.maximum(spread, MIN_ERROR_MM)
    low, high = np.quantile(student, (0.5 - 0.5 * level, 0.5 + 0.5 * level))
    with np.errstate(over="ignore"):  # open above where one pose is nearly all of the error
        ends = np.exp(0.5 * (own - np.array([high, low]) * own_spread))
    return Interval(*ends.tolist())


def log_mean_and_error(group_sums: Array, group_counts: Array) -> tuple[Array, Array]:
    """Logarithm of a ratio of sums over poses, and its standard error, to first order.

    group_sums, group_counts: (..., m).  Returns (...) each.
    """
    m = group_sums.shape[-1]
    mean = group_sums.sum(-1) / group_counts.sum(-1)
    off = (group_sums - mean[..., None] * group_counts) / group_counts.mean(-1)[..., None]
    return np.log(mean), np.sqrt((off**2).sum(-1) / (m * (m - 1.0))) / mean


def number_pose_groups(point_errors: Array, pose_groups: Array | None) -> Array:
    """(m,) number of each pose's group, counted from 0 in the order of their first poses."""
    if pose_groups is None:
        return np.arange(len(point_errors))
    _, first, inverse = np.unique(pose_groups, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse.reshape(-1)])


def predict_max_error_interval(
    point_errors: Array,
    pose_groups: Array | None = None,
    level: float = 0.95,
    *,
    rng: np.random.Generator,
) -> Interval:
    """Where the largest distance of equally many new poses will lie [m].

    A prediction interval: exact where the logarithms of the larger half of the poses' largest
    distances are the upper half of a normal sample; a little too wide for lighter tails, as those
    of tracker noise.  It is wide: no method without such an assumption has an upper end at all, for
    the new poses exceed the largest distance seen with probability 1/2.  point_errors: (m, k, 3)
    measured minus predicted, NaN where not measured [m].  pose_groups: (m,) poses with one number
    count as one.
    """
    distance = np.linalg.norm(point_errors, axis=-1)
    seen = np.isfinite(distance)
    pose_groups = number_pose_groups(point_errors, pose_groups)[seen.any(axis=1)]
    each = np.where(seen, distance, 0.0).max(axis=1, initial=0.0)[seen.any(axis=1)]
    largest = np.full(pose_groups.max(initial=-1) + 1, -1.0)
    np.maximum.at(largest, pose_groups, each)
    largest = largest[largest >= 0.0]
    m = len(largest)
    if m < MIN_INTERVAL_POSES:
        return UNKNOWN_INTERVAL
    size = float(np.sqrt(np.mean(largest**2)))
    if size == 0.0:
        return Interval(0.0, 0.0)
    top = min((m + 1) // 2, MAX_TAIL_ERRORS)
    logs = np.log(np.maximum(np.sort(largest)[m - top :], math.sqrt(MIN_ERROR_MM) * size))
    simulated = sample_largest_normals(m, top, rng)
    new = sample_largest_normals(m, 1, rng)[:, 0]
    pivot = (new - simulated.mean(axis=1)) / simulated.std(axis=1, ddof=1)
    low, high = np.quantile(pivot, (0.5 - 0.5 * level, 0.5 + 0.5 * level))
    middle, spread = float(logs.mean()), float(logs.std(ddof=1))
    return Interval(math.exp(middle + low * spread), math.exp(middle + high * spread))


def sample_largest_normals(sample_size: int, largest_count: int, rng: np.random.Generator) -> Array:
    """The largest of normal samples of a size: (PIVOTS, top), by Renyi's sums [Renyi 1953]."""
    gaps = rng.exponential(size=(NORMAL_PIVOT_COUNT, largest_count)) / (
        sample_size - np.arange(largest_count)
    )
    return np.asarray(-ndtri(-np.expm1(-np.cumsum(gaps, axis=1))))


def exceedance_probability(pose_count: int) -> float:
    """Probability that the next pose misses by more than all so far: 1/(n+1), whatever the law."""
    return 1.0 / (pose_count + 1.0)
