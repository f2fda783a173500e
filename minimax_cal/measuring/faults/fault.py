"""What is wrong with data: a `Fault` and its numbers, and the distances that tell of faults."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.special import chdtri

from minimax_cal.ground.arrays import Array, known_median
from minimax_cal.measuring.measurements import Measurements

NO_ERROR: Array = np.zeros((0, 0, 3))
NONE: Array = np.zeros(0, dtype=int)
FALSE_ALARM = 0.002  # of each test, over a whole data set
ALIKE = 9.0  # squared standard scores that are no reason to prefer one target to another
FEWEST = 8  # distances that give a centre and a scatter
NORMAL = 1.4826  # times the median deviation is sigma
FAINT = 1e-6  # no instrument measures a coordinate better [m]


@dataclass(frozen=True)
class Amount:
    """A number of a fault or an effect.  value, sigma: in `unit`, SI; sigma NaN if not known."""

    name: str
    value: float
    unit: str = ""
    sigma: float = np.nan


@dataclass(frozen=True, eq=False)
class Fault:
    """One thing wrong with the data, or a notice.

    effect: outliers, swapped_rows, target_shift (target_reseat where the visits are not known) or
    readback; as notices also mixed_units, session_jump and noise.  place: smr1, smr1 or smr2, all,
    frame.
    rows: (r,) rows of the data; of a shift all rows after it, as visited; of jumps the first after.
    targets: outliers (r,) the target of each row; swapped rows (r, k) in whose columns each
    target stands; shift: which nest it can be; else of length 0.
    """

    effect: str
    place: str
    text: str
    rows: Array = field(default_factory=lambda: NONE)
    targets: Array = field(default_factory=lambda: NONE)
    parameters: tuple[Amount, ...] = ()


def outlier_limit(count: int, tests: int, m: int) -> float:
    """Squared standard score of `count` numbers that one of `tests` exceeds by a rare chance.

    Widened by what the robust scatter of m values may be wrong.
    """
    wider = 1.0 + 2.5 * 1.17 / np.sqrt(m)
    return float(chdtri(count, FALSE_ALARM / tests) * wider**2)


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
