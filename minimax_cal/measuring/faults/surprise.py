"""How unlikely each point is, by its distances and by its height across the targets' plane."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.distances import FEWEST, Between, scatter
from minimax_cal.measuring.faults.limits import outlier_limit
from minimax_cal.measuring.measurements import Measurements

TAIL = 1.6  # sigma: what 95 % of a fit's errors keep to (1.96 were they Gaussian)


def heights(data: Measurements, error: Array) -> Array:
    """(k, m) residual of each of three or more targets, across their plane, above the others [m].

    NaN where a target is missing.  Along the plane the distances say more: no turn of the flange
    changes them.
    """
    k = len(data.target_names)
    if k < 3 or not len(error):
        return np.full((k, data.poses), np.nan)
    whole = data.seen.all(axis=1) & np.isfinite(error).all(axis=(0, 2))
    arm = data.y[whole] - data.y[whole].mean(axis=1, keepdims=True)
    across = np.linalg.svd(arm, full_matrices=False)[2][:, 2]
    sense = np.cross(arm[:, 0], arm[:, 1])
    across *= np.where((across * sense).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    up = np.einsum("kmc,mc->km", error[:, whole], across)
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
