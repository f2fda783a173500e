"""Mean squares that tell the kind of cause apart, and scatter that shows without any model."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import scipy

from minimax_cal.diagnosing.where.answer import CANNOT_TELL, Part, Triage
from minimax_cal.diagnosing.where.residual import Residual
from minimax_cal.diagnosing.where.significance import flips
from minimax_cal.evidence.limits import LEAST_SCATTER_DOF, TARGETS_SCATTER
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import from_means, visits
from minimax_cal.measuring.measurements import Measurements


def lack_of_fit(rest: Residual) -> float:
    """p that residuals do not return when a pose returns; by flips of the visits' signs."""
    once, count = np.unique(rest.group, return_counts=True)
    again = np.isin(rest.group, once[count > 1])
    rows, group = rest.even[again], rest.group[again]
    gram = np.where(group[:, None] == group, rows @ rows.T, 0.0)
    return flips(float(gram.sum()), gram)


def triage(data: Measurements, rest: Residual, noise: float, known: float, dof: float) -> Triage:
    """Mean squares per point of the errors `rest`: noise + shape + repeat + pose.

    With s^2 = noise^2, per coordinate, p fitted directions and N points:
    noise: s^2 (3 - p / N).
    shape: u^2 (3 - p / N), u^2 = `shape_scatter` per degree of freedom less s^2: targets that
    scatter on their own seem to move rigidly, too, as noise does.
    repeat: `revisit_scatter` per visit less that of s^2 + u^2, less what the fit has taken.
    pose: what is left.  Negative parts are 0; shares add up to 1 over the parts that can be told,
    and what cannot (no revisits, one target) falls to pose.
    p of shape: chi^2 against s^2, F if that has finite `dof`.  p of repeat: the same, but F
    against the scatter of the shape where that is clearly larger.  p of pose: `lack_of_fit`.
    noise: as given, NaN if it was estimated from the data as `known`: then the scatter that gave it
    is noise by definition, and cannot be told.
    """
    points = float(rest.seen.sum()) / 3.0
    total = float((rest.rows**2).sum()) / points
    if not (math.isfinite(known) and total > 0.0):
        return Triage(CANNOT_TELL, CANNOT_TELL, CANNOT_TELL, CANNOT_TELL)
    given, left = math.isfinite(noise), 3.0 - rest.fitted / points
    least, behind = max(known**2, 1e-24), dof
    told = {"noise": (known**2 * left, math.nan)}
    shape, shape_free = shape_scatter(data)
    if given and shape_free >= 1.0:
        p = above(shape, shape_free, least, behind)
        told["shape"] = (max(0.0, shape / shape_free - known**2) * left, p)
        if p < TARGETS_SCATTER:
            least, behind = shape / shape_free, shape_free
    repeat, repeat_free, again = revisit_scatter(data)
    if repeat_free >= 1.0 and (given or shape_free >= 1.0):
        own = sum(square for square, _ in told.values()) / left * repeat_free
        kept = max(0.0, 1.0 - rest.fitted / (3.0 * points - shape_free))
        p = above(repeat, repeat_free, least, behind)
        told["repeat"] = (max(0.0, repeat - own) / again * kept, p)
    static = max(0.0, total - sum(square for square, _ in told.values()))
    told["pose"] = (static, lack_of_fit(rest) if repeat_free >= 1.0 else math.nan)
    whole = max(sum(square for square, _ in told.values()), 1e-300)
    parts = {name: Part(ms / whole, p, math.sqrt(ms)) for name, (ms, p) in told.items()}
    return Triage(*(parts.get(name, CANNOT_TELL) for name in ("noise", "shape", "repeat", "pose")))


def above(energy: float, free: float, variance: float, behind: float) -> float:
    """p that energy / free is that large if its expectation is variance, known from `behind`."""
    ratio = energy / variance
    return float(
        scipy.stats.f.sf(ratio / free, free, behind)
        if math.isfinite(behind)
        else scipy.stats.chi2.sf(ratio, free)
    )


def noise_of(data: Measurements) -> float:
    """Noise per coordinate from the data alone [m]: distances between targets, else revisits.

    Distances: median over pairs of the robust scatter / sqrt(2).  NaN if there are neither.
    """
    off, weight = from_means(distances(data), np.zeros(data.poses, dtype=int))
    if weight.sum() >= LEAST_SCATTER_DOF:
        spread = [np.median(np.abs(c[w > 0])) for c, w in zip(off.T, weight.T, strict=True)]
        return float(np.median(spread)) * 1.4826 / math.sqrt(2.0)
    off, weight = from_means(data.y.reshape(data.poses, -1), visits(data))
    dof = float(weight.sum())
    return math.sqrt(float((off**2).sum()) / dof) if dof >= LEAST_SCATTER_DOF else math.nan


def pairs(k: int) -> Array:
    """All pairs of k targets: (k (k - 1) / 2, 2)."""
    return np.array(list(combinations(range(k), 2)), dtype=int).reshape(-1, 2)


def distances(data: Measurements) -> Array:
    """Between all pairs of targets: (m, pairs), NaN where not both were measured [m]."""
    pair = pairs(len(data.target_names))
    return np.asarray(np.linalg.norm(data.y[:, pair[:, 0]] - data.y[:, pair[:, 1]], axis=-1))


def shape_energy(data: Measurements, off: Array) -> tuple[Array, Array]:
    """Least sum of squared target motions that changes distances by `off` (m, pairs).

    Changes are D e to first order, e (3k,) the targets' motions: |e|^2 = off' (DD')^+ off, which no
    rigid motion enters.  DD' follows from the mean distances by the law of cosines.
    Returns energy (m,) [m^2] and rank (m,), 3k - 6 for k > 2 targets in general places.
    """
    pair, seen = pairs(len(data.target_names)), data.seen
    apart = distances(data)
    known = np.isfinite(apart)
    mean = np.where(known, apart, 0.0).sum(0) / np.maximum(known.sum(0), 1)
    square = np.zeros((len(data.target_names),) * 2)
    square[pair[:, 0], pair[:, 1]] = square[pair[:, 1], pair[:, 0]] = mean**2
    (a, b), (c, d) = pair.T[:, :, None], pair.T[:, None, :]
    dot = 0.5 * (square[a, d] + square[b, c] - square[a, c] - square[b, d])
    common = (a == c).astype(float) + (b == d) - (a == d) - (b == c)
    gram = common * dot / np.maximum(np.outer(mean, mean), 1e-12)
    energy, rank = np.zeros(data.poses), np.zeros(data.poses)
    for pattern in np.unique(seen, axis=0):
        rows = (seen == pattern).all(axis=1)
        both = pattern[pair].all(axis=1)
        if both.any():
            value, vector = np.linalg.eigh(gram[np.ix_(both, both)])
            kept = value > 1e-3 * value[-1]
            part = off[np.ix_(rows, both)] @ (vector[:, kept] / np.sqrt(value[kept]))
            energy[rows], rank[rows] = (part**2).sum(1), kept.sum()
    return energy, rank


def shape_scatter(data: Measurements) -> tuple[float, float]:
    """Energy [m^2] of the targets' motion against each other, and its degrees of freedom.

    From the scatter of inter-target distances over all poses: free of model and fit.  White noise
    of s per coordinate gives s^2 times the degrees of freedom; more is instrument, nests, bracket.
    """
    off, _ = from_means(distances(data), np.zeros(data.poses, dtype=int))
    energy, rank = shape_energy(data, off)
    return float(energy.sum()), float(rank.sum() - rank.max(initial=0.0))


def revisit_scatter(data: Measurements) -> tuple[float, float, float]:
    """Energy [m^2] of rigid motion between visits to a pose, degrees of freedom, free points.

    The targets' motion against each other is taken off: it is told by `shape_scatter`.
    """
    group = visits(data)
    off, weight = from_means(data.y.reshape(data.poses, -1), group)
    apart, free = from_means(distances(data), group)
    energy, rank = shape_energy(data, apart)
    most = free.max(axis=1, initial=0.0)
    points = float(weight.sum()) / 3.0
    shape = float((rank * most).sum())
    return float((off**2).sum() - energy.sum()), 3.0 * points - shape, points
