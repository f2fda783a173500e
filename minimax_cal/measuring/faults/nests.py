"""Nests that shifted: steps in the distances of one target over the visits, or over the file.

The distances need no robot: their own scatter, as its median absolute deviation tells it, is the
noise that a step is judged by.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtri, ndtri

from minimax_cal.ground.arrays import Array, known_median
from minimax_cal.measuring.faults.fault import (
    ALIKE,
    FALSE_ALARM,
    Amount,
    Between,
    Fault,
    scatter,
)
from minimax_cal.measuring.history import is_timed, sessions, visits
from minimax_cal.measuring.measurements import Measurements

NEAR = 8  # visits by which ranks may misplace a step
SHORTEST = 4  # visits on each side of a step
MATTERS = 1.5  # steps below so many times the scatter of a distance change nothing
# A file in no order of visits may be sorted by where its poses are: distances that depend on the
# pose, as those of a plate that bends, then look like a small step.
MATTERS_UNTIMED = 4.0
MOST_STEPS = 5  # shifts of nests in one data set
WIDER = 2.5 * 1.65  # over the root of m: what a scatter by differences of m values may be wrong
CLIP = 5.0  # standard scores of a distance count no more than this: one outlier is no step
TOGETHER = 0.75  # share of the fewer visits that are alike: else they are outliers, no step
SHIFT, RESEAT = "target_shift", "target_reseat"


@dataclass(frozen=True, eq=False)
class Step:
    """A step in the distances of one target: `at` is the first visit after it.

    change, sigma: (p,) of every pair [m].  targets: any one of these explains it, the best first.
    """

    at: int
    targets: Array
    change: Array
    sigma: Array


def target_shifts(data: Measurements, apart: Between) -> tuple[Fault, ...]:
    """Nests that moved during the session, as steps of their distances over the visits.

    Where nothing tells the visits, over the rows of the file: it is then a re-seat, which no effect
    of time can hold.  Sessions follow each other.  apart: the distances of these data, `between`.
    """
    timed = is_timed(data)
    order = visits(data)
    order = order[np.argsort(sessions(data)[order], kind="stable")]
    off = apart.off[:, order]
    faults: list[Fault] = []
    matters = MATTERS if timed else MATTERS_UNTIMED
    while len(faults) < MOST_STEPS and (step := find_step(off, apart, matters)):
        off = off.copy()
        off[:, step.at :] -= (step.change * apart.of(int(step.targets[0])))[:, None]
        faults.append(shift_of(data, order, apart, step, SHIFT if timed else RESEAT))
    return tuple(faults)


def find_step(off: Array, apart: Between, matters: float) -> Step | None:
    """The clearest step, if one is unlikely by noise.  off: (p, m) by visit, NaN unknown [m].

    Each pair's scans over all places are judged by a Bonferroni bound.  matters: times the scatter
    of a distance that a step is at least.
    """
    pairs, m = off.shape
    best, place, known = np.zeros(pairs), np.zeros(pairs, dtype=int), np.isfinite(off)
    for pattern in {row.tobytes(): row for row in known}.values():
        alike, visited = (known == pattern).all(axis=1), np.flatnonzero(pattern)
        if len(visited) >= 2 * SHORTEST:
            best[alike], first = scan(off[alike][:, visited])
            place[alike] = visited[first]
    limit = float(chdtri(1.0, FALSE_ALARM / max(2 * pairs * m, 1)))
    if not pairs or best.max() < limit:
        return None
    at = int(place[best.argmax()])
    before, after = off[:, :at], off[:, at:]
    many = np.isfinite(before).sum(axis=1), np.isfinite(after).sum(axis=1)
    told = np.minimum(*many) >= 2
    change, sigma = np.zeros(pairs), np.full(pairs, np.inf)
    change[told] = known_median(after[told]) - known_median(before[told])
    inside = np.concatenate(
        [
            before[told] - known_median(before[told])[:, None],
            after[told] - known_median(after[told])[:, None],
        ],
        axis=1,
    )
    share = 1.0 / many[0][told] + 1.0 / many[1][told]
    sigma[told] = 1.2533 * scatter(inside) * np.sqrt(share)  # of a median
    strength = (change / sigma) ** 2
    rest = np.array([strength[~apart.of(i)].sum() for i in range(int(apart.pairs.max()) + 1)])
    sides = np.split(np.arange(inside.shape[1]), [at])
    away = np.abs(inside[:, min(sides, key=len)]) / scatter(inside)[:, None]
    together = np.nanmean(np.where(np.isfinite(away), away < CLIP, np.nan), axis=1)
    sure = (together >= TOGETHER) & (np.abs(change[told]) >= matters * np.median(scatter(inside)))
    if not sure.any():
        return None
    order = np.argsort(rest, kind="stable")
    targets = order[rest[order] <= rest.min() + ALIKE]
    at = place_of(off[told], change[told], scatter(inside), at)
    return Step(at, targets, change, sigma)


def place_of(off: Array, change: Array, sigma: Array, at: int) -> int:
    """First visit after a step, near a first guess, by least squares that outliers do not sway.

    off: (p, m) by visit [m].  change, sigma: (p,) of the step and of one distance [m].
    """
    middle = known_median(off[:, :at])
    z = (off - middle[:, None]) / sigma[:, None]
    gain = np.clip(z**2, 0, 25.0) - np.clip((z - (change / sigma)[:, None]) ** 2, 0, 25.0)
    before = np.cumsum(np.nansum(gain, axis=0))  # lost by a later start
    low, high = max(at - NEAR, SHORTEST), min(at + NEAR, off.shape[1] - SHORTEST)
    return low + int(before[low - 1 : high].argmin())


def scan(values: Array) -> tuple[Array, Array]:
    """Largest squared standard score of a step in each series, and the first entry after it.

    By ranks, so that no outlier counts for more than one visit; and by clipped standard scores,
    which show a large step of few visits that ranks cannot.  values: (p, m).
    """
    (strength, first), (other, late) = (strength_of(f(values)) for f in (ranked, clipped))
    return np.maximum(strength, other), np.where(strength >= other, first, late)


def ranked(values: Array) -> Array:
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


def mean_ranks(value: Array) -> Array:
    """(m,) ranks as scipy.stats.rankdata gives them, of ties the mean."""
    _, place, alike = np.unique(value, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(alike) - 0.5 * (alike - 1))[place])


def clipped(values: Array) -> Array:
    """(p, m) standard scores about the median of each series, clipped, of mean 0.

    Sigma by neighbours: the scatter of their differences knows no step, however many visits are
    after it; it is widened by what it may be wrong.
    """
    sigma = scatter(np.diff(values, axis=1)) / np.sqrt(2.0)
    wider = sigma * (1.0 + WIDER / np.sqrt(values.shape[1]))
    score = (values - np.median(values, axis=1, keepdims=True)) / wider[:, None]
    score = np.clip(score, -CLIP, CLIP)
    return np.asarray(score - score.mean(axis=1, keepdims=True))


def strength_of(score: Array) -> tuple[Array, Array]:
    """(p,) squared standard score of the best step in scores (p, m), and the first entry after it.

    Less where neighbours are alike; 0 where a steady drift explains the series as well.
    """
    m = score.shape[1]
    count = np.arange(SHORTEST, m - SHORTEST + 1)
    gain = np.cumsum(score, axis=1)[:, count - 1] ** 2 * m / (count * (m - count))
    first = count[gain.argmax(axis=1)]
    late = np.arange(m) >= first[:, None]
    before = np.where(late, 0.0, score).sum(axis=1) / first
    after = np.where(late, score, 0.0).sum(axis=1) / (m - first)
    inside = score - np.where(late, after[:, None], before[:, None])
    alike = (inside[:, 1:] * inside[:, :-1]).sum(axis=1)
    alike = np.maximum(alike / np.maximum((inside**2).sum(axis=1), 1e-12), 0.0)
    wider = (1.0 + alike) / np.maximum(1.0 - alike, 1e-3)
    time = np.linspace(-1.0, 1.0, m)
    drift, strength = (score @ time) ** 2 / (time @ time), gain.max(axis=1)
    return np.where(strength - drift < 0.1 * strength, 0.0, strength / wider), first


def shift_of(data: Measurements, order: Array, apart: Between, step: Step, effect: str) -> Fault:
    """The fault that a step stands for."""
    first = int(step.targets[0])
    own = np.flatnonzero(apart.of(first) & np.isfinite(step.sigma))
    size = in_plane(apart, own, first, step.change[own])
    rows = order[step.at :]
    amounts = [Amount("size", size, "m", float(step.sigma[own].max()))]
    for pair in own:
        a, b = (data.target_names[i] for i in apart.pairs[pair])
        amounts.append(Amount(f"{a}-{b}", float(step.change[pair]), "m", float(step.sigma[pair])))
    place = " or ".join(data.target_names[i] for i in step.targets)
    where = data.called(data.line[rows[0]])
    if effect == SHIFT:
        where += f" (visit {step.at + 1} of {len(order)})"
    text = (
        f"{data.source}: the distances between the reflectors change: {place} was re-seated, or "
        f"exchanged for one of another radius, by {1e3 * size:.3g} mm or more before {where}"
    )
    return Fault(effect, place, text, rows, step.targets, tuple(amounts))


def in_plane(apart: Between, own: Array, target: int, change: Array) -> float:
    """Least shift of a target that changes its distances as seen [m].

    own: its pairs.  change: of each [m].
    """
    others = [int(apart.pairs[pair].sum() - target) for pair in own]
    cosine = np.eye(len(own))
    for i, j in combinations(range(len(own)), 2):
        both = np.isin(apart.pairs, (others[i], others[j])).all(axis=1)
        if both.any():
            a, b, c = apart.centre[own[i]], apart.centre[own[j]], apart.centre[both][0]
            cosine[i, j] = cosine[j, i] = np.clip((a * a + b * b - c * c) / (2 * a * b), -1, 1)
    return float(np.sqrt(max(change @ np.linalg.pinv(cosine, rcond=0.05) @ change, 0.0)))
