"""Distances between targets, which tell of faults without any model."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from minimax_cal.ground.arrays import Array, known_median
from minimax_cal.measuring.measurements import Measurements

FEWEST = 8  # distances that give a centre and a scatter
NORMAL = 1.4826  # times the median deviation is sigma
FAINT = 1e-6  # no instrument measures a coordinate better [m]


@dataclass(frozen=True, eq=False)
class Between:
    """Distances between targets, less their usual value.

    pairs: (p, 2).  centre, sigma: (p,) median and robust scatter [m].
    off: (p, m) distance less centre, NaN where not both were measured [m].
    """

    pairs: Array
    centre: Array
    sigma: Array
    off: Array

    def of(self, target: int) -> Array:
        """(p,) True for the pairs with a target."""
        return np.asarray((self.pairs == target).any(axis=1))


def between(data: Measurements) -> Between:
    """The distances of all pairs of targets that were measured together often enough."""
    pairs, centre, off = [], [], []
    for a, b in combinations(range(len(data.target_names)), 2):
        distance = np.linalg.norm(data.y[:, a] - data.y[:, b], axis=-1)
        if np.isfinite(distance).sum() >= FEWEST:
            pairs.append((a, b))
            centre.append(float(known_median(distance)))
            off.append(distance - centre[-1])
    deviation = np.array(off).reshape(len(pairs), data.poses)
    return Between(
        np.array(pairs, dtype=int).reshape(-1, 2), np.array(centre), scatter(deviation), deviation
    )


def scatter(off: Array) -> Array:
    """(p,) robust standard deviation about the median of rows with NaN.  off: (p, m) [m]."""
    if not len(off):
        return np.zeros(0)
    middle = known_median(off)[:, None]
    return np.asarray(np.maximum(NORMAL * known_median(np.abs(off - middle)), FAINT))
