"""Tests that residuals follow features by more than chance.

They treat poses, not points, as independent: the joints' jitter moves all targets of a pose
together.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from minimax_cal.diagnosing.where.residual import Residual, flat_of
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import summed

FLAT = 1e-8  # share of a feature's energy below which the fit has taken it


def explained(rest: Residual, features: Array, size: float) -> tuple[float, float]:
    """Share of the residual's energy that features (m, 3k, r) explain, and p that it is chance.

    Share: that of the least-squares fit less what unrelated poses would give it, so that it is 0 on
    average where there is nothing.  p: as `score_flips`.  The features must be without what
    was fitted; size: energy of one before, to tell which are nothing now.
    """
    flat = flat_of(features)
    value, vector = np.linalg.eigh(flat.T @ flat)
    kept = value > FLAT * size
    total = float((rest.rows**2).sum())
    if not (kept.any() and total > 0.0):
        return 0.0, 1.0
    unit = features @ (vector[:, kept] / np.sqrt(value[kept]))
    pull, score = scores(rest, unit)
    after = rest.rows - unit @ pull
    lever = np.minimum(summed((unit**2).sum((1, 2)), rest.group), 0.9)
    left = summed(np.einsum("mrs,mr->ms", unit, after), rest.group)
    expected = float(((left**2).sum(1) / (1.0 - lever)).sum())
    share = (float(pull @ pull) - expected) / total
    return min(1.0, max(0.0, share)), score_flips(float(pull @ pull), score)


def scores(rest: Residual, features: Array) -> tuple[Array, Array]:
    """F'r (r,) and each pose's part of it (poses, r), at the covariance before the fit."""
    pull = flat_of(features).T @ rest.rows.reshape(-1)
    part = (rest.even[:, None, :] @ features)[:, 0]
    return pull, summed(part, rest.group)


def flips(total: float, gram: Array) -> float:
    """p of T = total - trace(gram) when the signs of poses are arbitrary.

    Under flips e'Ae with A = gram without its diagonal has mean 0, variance 2 tr A^2 and third
    cumulant 8 tr A^3: matched by a shifted chi^2 (Pearson III).
    gram: (g, g) inner products of the poses' scores.
    """
    off = gram - np.diag(np.diag(gram))
    squared = off @ off
    moments = float(np.trace(squared)), float((squared * off).sum())
    return pearson(total - float(np.trace(gram)), *moments)


def score_flips(total: float, score: Array) -> float:
    """`flips` with gram = score score', for fewer features than poses.  score: (g, r).

    U = |F'r|^2 sums s_g's_h over all pairs of poses, s_g = F_g'r_g.  Signs of whole poses are
    flipped in thought, so that nothing is assumed about noise or jitter but that poses are
    independent.
    """
    if len(score) <= score.shape[1]:
        return flips(total, score @ score.T)
    own = (score**2).sum(axis=1)
    gram = score.T @ score
    squared = gram @ gram
    second = float(np.trace(squared) - (own**2).sum())
    crossed = float(own @ ((score @ gram) * score).sum(axis=1))
    third = float((squared * gram).sum()) - 3.0 * crossed + 2.0 * float((own**3).sum())
    return pearson(total - float(own.sum()), second, third)


def pearson(excess: float, second: float, third: float) -> float:
    """P(T > excess) for T of mean 0, variance 2 `second` and third cumulant 8 `third`."""
    if second <= 0.0:
        return 1.0
    skew = third / second**1.5
    if skew < 1e-3:
        return float(scipy.stats.norm.sf(excess / math.sqrt(2.0 * second)))
    dof = skew**-2.0
    return float(scipy.stats.chi2.sf(dof + excess / math.sqrt(second) * math.sqrt(dof), dof))
