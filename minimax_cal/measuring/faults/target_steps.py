"""Nests that shifted: steps in the distances of one target over the visits, or over the file.

The distances need no robot: their own scatter, as its median absolute deviation tells it, is the
noise that a step is judged by.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri

from minimax_cal.core.arrays import Array, nanmedian_last_axis
from minimax_cal.measuring.faults.data_fault import (
    FAULT_FALSE_ALARM_RATE,
    MAX_EQUAL_TARGET_SCORE,
    DataFault,
    FaultAmount,
    TargetDistances,
    robust_sigmas,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import (
    has_session_time,
    rows_in_visit_order,
    session_indices,
)

MAX_STEP_MISPLACEMENT_VISITS = 8  # visits by which ranks may misplace a step
MIN_VISITS_BESIDE_STEP = 4  # visits on each side of a step
MIN_STEP_OVER_SCATTER = 1.5  # steps below so many times the scatter of a distance change nothing
# A file in no order of visits may be sorted by where its poses are: distances that depend on the
# pose, as those of a plate that bends, then look like a small step.
MIN_UNTIMED_STEP_OVER_SCATTER = 4.0
MAX_TARGET_STEPS = 5  # shifts of nests in one data set
SCATTER_WIDENING = (
    2.5 * 1.65
)  # over the root of m: what a scatter by differences of m values may be wrong
MAX_STANDARD_SCORE = (
    5.0  # standard scores of a distance count no more than this: one outlier is no step
)
MIN_CONSISTENT_VISIT_SHARE = (
    0.75  # share of the fewer visits that are alike: else they are outliers, no step
)
TARGET_SHIFT_EFFECT, TARGET_RESEAT_EFFECT = "target_shift", "target_reseat"


@dataclass(frozen=True, eq=False)
class DistanceStep:
    """A step in the distances of one target: `first_guess` is the first visit after it.

    change, sigma: (p,) of every pair [m].  targets: any one of these explains it, the best first.
    """

    at: int
    targets: Array
    change: Array
    sigma: Array


def find_target_shifts(data: Measurements, distances: TargetDistances) -> tuple[DataFault, ...]:
    """Nests that moved during the session, as steps of their distances over the visits.

    Where nothing tells the visits, over the rows of the file: it is then a re-seat, which no effect
    of time can hold.  Sessions follow each other.  distances: the distances of these data,
    `between`.
    """
    timed = has_session_time(data)
    order = rows_in_visit_order(data)
    order = order[np.argsort(session_indices(data)[order], kind="stable")]
    off = distances.off[:, order]
    faults: list[DataFault] = []
    matters = MIN_STEP_OVER_SCATTER if timed else MIN_UNTIMED_STEP_OVER_SCATTER
    while len(faults) < MAX_TARGET_STEPS and (step := find_clearest_step(off, distances, matters)):
        off = off.copy()
        off[:, step.at :] -= (step.change * distances.pairs_with_target(int(step.targets[0])))[
            :, None
        ]
        faults.append(
            build_shift_fault(
                data, order, distances, step, TARGET_SHIFT_EFFECT if timed else TARGET_RESEAT_EFFECT
            )
        )
    return tuple(faults)


def find_clearest_step(
    deviations: Array, distances: TargetDistances, min_step_over_scatter: float
) -> DistanceStep | None:
    """The clearest step, if one is unlikely by noise.  deviations: (p, m) by visit, NaN unknown
    [m].

    Each pair's scans over all places are judged by a Bonferroni bound.  min_step_over_scatter:
    times the scatter of a distance that a step is at least.
    """
    pairs, m = deviations.shape
    best, place, known = np.zeros(pairs), np.zeros(pairs, dtype=int), np.isfinite(deviations)
    for pattern in {row.tobytes(): row for row in known}.values():
        alike, visited = (known == pattern).all(axis=1), np.flatnonzero(pattern)
        if len(visited) >= 2 * MIN_VISITS_BESIDE_STEP:
            best[alike], first = scan_for_steps(deviations[alike][:, visited])
            place[alike] = visited[first]
    limit = float(chdtri(1.0, FAULT_FALSE_ALARM_RATE / max(2 * pairs * m, 1)))
    if not pairs or best.max() < limit:
        return None
    at = int(place[best.argmax()])
    before, after = deviations[:, :at], deviations[:, at:]
    many = np.isfinite(before).sum(axis=1), np.isfinite(after).sum(axis=1)
    told = np.minimum(*many) >= 2
    change, sigma = np.zeros(pairs), np.full(pairs, np.inf)
    change[told] = nanmedian_last_axis(after[told]) - nanmedian_last_axis(before[told])
    inside = np.concatenate(
        [
            before[told] - nanmedian_last_axis(before[told])[:, None],
            after[told] - nanmedian_last_axis(after[told])[:, None],
        ],
        axis=1,
    )
    share = 1.0 / many[0][told] + 1.0 / many[1][told]
    sigma[told] = 1.2533 * robust_sigmas(inside) * np.sqrt(share)  # of a median
    strength = (change / sigma) ** 2
    rest = np.array(
        [
            strength[~distances.pairs_with_target(i)].sum()
            for i in range(int(distances.pairs.max()) + 1)
        ]
    )
    sides = np.split(np.arange(inside.shape[1]), [at])
    away = np.abs(inside[:, min(sides, key=len)]) / robust_sigmas(inside)[:, None]
    together = np.nanmean(np.where(np.isfinite(away), away < MAX_STANDARD_SCORE, np.nan), axis=1)
    sure = (together >= MIN_CONSISTENT_VISIT_SHARE) & (
        np.abs(change[told]) >= min_step_over_scatter * np.median(robust_sigmas(inside))
    )
    if not sure.any():
        return None
    order = np.argsort(rest, kind="stable")
    targets = order[rest[order] <= rest.min() + MAX_EQUAL_TARGET_SCORE]
    at = locate_step(deviations[told], change[told], robust_sigmas(inside), at)
    return DistanceStep(at, targets, change, sigma)


def locate_step(deviations: Array, changes: Array, sigmas: Array, first_guess: int) -> int:
    """First visit after a step, near a first guess, by least squares that outliers do not sway.

    deviations: (p, m) by visit [m].  changes, sigmas: (p,) of the step and of one distance [m].
    """
    middle = nanmedian_last_axis(deviations[:, :first_guess])
    z = (deviations - middle[:, None]) / sigmas[:, None]
    gain = np.clip(z**2, 0, 25.0) - np.clip((z - (changes / sigmas)[:, None]) ** 2, 0, 25.0)
    before = np.cumsum(np.nansum(gain, axis=0))  # lost by a later start
    low, high = (
        max(first_guess - MAX_STEP_MISPLACEMENT_VISITS, MIN_VISITS_BESIDE_STEP),
        min(
            first_guess + MAX_STEP_MISPLACEMENT_VISITS, deviations.shape[1] - MIN_VISITS_BESIDE_STEP
        ),
    )
    return low + int(before[low - 1 : high].argmin())


class StepScan(NamedTuple):
    """Squared standard score (p,) of each series' best step, the first entry (p,) after it."""

    squared_scores: Array
    first_entries_after: Array


def scan_for_steps(values: Array) -> StepScan:
    """Largest squared standard score of a step in each series, and the first entry after it.

    By ranks, so that no outlier counts for more than one visit; and by clipped standard scores,
    which show a large step of few visits that ranks cannot.  values: (p, m).
    """
    (strength, first), (other, late) = (
        step_strengths(f(values)) for f in (normal_scores_of_ranks, clipped_standard_scores)
    )
    return StepScan(np.maximum(strength, other), np.where(strength >= other, first, late))


def normal_scores_of_ranks(values: Array) -> Array:
    """(..., m) normal scores of the ranks of each series, of mean 0 and variance 1."""
    m = values.shape[-1]
    order = np.argsort(values, axis=-1, kind="stable")
    rank = np.empty(values.shape)
    np.put_along_axis(rank, order, np.broadcast_to(np.arange(1.0, m + 1.0), values.shape), -1)
    if not np.diff(np.take_along_axis(values, order, -1), axis=-1).all():
        rank = np.apply_along_axis(mean_ranks, -1, values)
    score = ndtri((rank - 0.5) / m)
    spread = np.maximum(score.std(axis=-1, keepdims=True), 1e-12)
    return np.asarray((score - score.mean(axis=-1, keepdims=True)) / spread)


def mean_ranks(values: Array) -> Array:
    """(m,) ranks as scipy.stats.rankdata gives them, of ties the mean."""
    _, place, alike = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(alike) - 0.5 * (alike - 1))[place])


def clipped_standard_scores(values: Array) -> Array:
    """(p, m) standard scores about the median of each series, clipped, of mean 0.

    Sigma by neighbours: the scatter of their differences knows no step, however many visits are
    after it; it is widened by what it may be wrong.
    """
    sigma = robust_sigmas(np.diff(values, axis=1)) / np.sqrt(2.0)
    wider = sigma * (1.0 + SCATTER_WIDENING / np.sqrt(values.shape[1]))
    score = (values - np.median(values, axis=1, keepdims=True)) / wider[:, None]
    score = np.clip(score, -MAX_STANDARD_SCORE, MAX_STANDARD_SCORE)
    return np.asarray(score - score.mean(axis=1, keepdims=True))


def step_strengths(scores: Array) -> StepScan:
    """(p,) squared standard score of the best step in scores (p, m), and the first entry after it.

    Less where neighbours are alike; 0 where a steady drift explains the series as well.
    """
    m = scores.shape[1]
    count = np.arange(MIN_VISITS_BESIDE_STEP, m - MIN_VISITS_BESIDE_STEP + 1)
    gain = np.cumsum(scores, axis=1)[:, count - 1] ** 2 * m / (count * (m - count))
    first = count[gain.argmax(axis=1)]
    late = np.arange(m) >= first[:, None]
    before = np.where(late, 0.0, scores).sum(axis=1) / first
    after = np.where(late, scores, 0.0).sum(axis=1) / (m - first)
    inside = scores - np.where(late, after[:, None], before[:, None])
    alike = (inside[:, 1:] * inside[:, :-1]).sum(axis=1)
    alike = np.maximum(alike / np.maximum((inside**2).sum(axis=1), 1e-12), 0.0)
    wider = (1.0 + alike) / np.maximum(1.0 - alike, 1e-3)
    time = np.linspace(-1.0, 1.0, m)
    drift, strength = (scores @ time) ** 2 / (time @ time), gain.max(axis=1)
    return StepScan(np.where(strength - drift < 0.1 * strength, 0.0, strength / wider), first)


def build_shift_fault(
    data: Measurements,
    visit_rows: Array,
    distances: TargetDistances,
    step: DistanceStep,
    effect: str,
) -> DataFault:
    """The fault that a step stands for."""
    first = int(step.targets[0])
    own = np.flatnonzero(distances.pairs_with_target(first) & np.isfinite(step.sigma))
    size = min_shift_for_distance_changes(distances, own, first, step.change[own])
    rows = visit_rows[step.at :]
    amounts = [FaultAmount("size", size, "m", float(step.sigma[own].max()))]
    for pair in own:
        a, b = (data.target_names[i] for i in distances.pairs[pair])
        amounts.append(
            FaultAmount(f"{a}-{b}", float(step.change[pair]), "m", float(step.sigma[pair]))
        )
    place = " or ".join(data.target_names[i] for i in step.targets)
    where = data.called(data.line[rows[0]])
    if effect == TARGET_SHIFT_EFFECT:
        where += f" (visit {step.at + 1} of {len(visit_rows)})"
    text = (
        f"{data.source}: the distances between the reflectors change: {place} was re-seated, or "
        f"exchanged for one of another radius, by {1e3 * size:.3g} mm or more before {where}"
    )
    return DataFault(effect, place, text, rows, step.targets, tuple(amounts))


def min_shift_for_distance_changes(
    distances: TargetDistances, pairs: Array, target: int, changes: Array
) -> float:
    """Least shift of a target that changes its distances as seen [m].

    pairs: its pairs.  changes: of each [m].
    """
    others = [int(distances.pairs[pair].sum() - target) for pair in pairs]
    cosine = np.eye(len(pairs))
    for i, j in combinations(range(len(pairs)), 2):
        both = np.isin(distances.pairs, (others[i], others[j])).all(axis=1)
        if both.any():
            a, b, c = (
                distances.centre[pairs[i]],
                distances.centre[pairs[j]],
                distances.centre[both][0],
            )
            cosine[i, j] = cosine[j, i] = np.clip((a * a + b * b - c * c) / (2 * a * b), -1, 1)
    return float(np.sqrt(max(changes @ np.linalg.pinv(cosine, rcond=0.05) @ changes, 0.0)))
