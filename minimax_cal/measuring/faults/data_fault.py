"""What is wrong with data: a `DataFault` and its numbers, and the distances that tell of faults."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.special import chdtri

from minimax_cal.core.arrays import Array, nanmedian_last_axis
from minimax_cal.measuring.measurements import Measurements

NO_POINT_ERRORS: Array = np.zeros((0, 0, 3))
NO_FAULT_ROWS: Array = np.zeros(0, dtype=int)
FAULT_FALSE_ALARM_RATE = 0.002  # of each test, over a whole data set
MAX_EQUAL_TARGET_SCORE = (
    9.0  # squared standard scores that are no reason to prefer one target to another
)
MIN_DISTANCE_COUNT = 8  # distances that give a centre and a scatter
SIGMA_PER_MEDIAN_DEVIATION = 1.4826  # times the median deviation is sigma
MIN_INSTRUMENT_NOISE = 1e-6  # no instrument measures a coordinate better [m]


@dataclass(frozen=True)
class FaultAmount:
    """A number of a fault or an effect.  value, sigma: in `unit`, SI; sigma NaN if not known."""

    name: str
    value: float
    unit: str = ""
    sigma: float = np.nan


@dataclass(frozen=True, eq=False)
class DataFault:
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
    rows: Array = field(default_factory=lambda: NO_FAULT_ROWS)
    targets: Array = field(default_factory=lambda: NO_FAULT_ROWS)
    parameters: tuple[FaultAmount, ...] = ()


def outlier_score_limit(score_count: int, test_count: int, value_count: int) -> float:
    """Squared standard score of `score_count` numbers that one of `test_count` exceeds by a rare
    chance.

    Widened by what the robust scatter of m values may be wrong.
    """
    wider = 1.0 + 2.5 * 1.17 / np.sqrt(value_count)
    return float(chdtri(score_count, FAULT_FALSE_ALARM_RATE / test_count) * wider**2)


@dataclass(frozen=True, eq=False)
class TargetDistances:
    """Distances between targets, less their usual value.

    pairs: (p, 2).  centre, sigma: (p,) median and robust scatter [m].
    off: (p, m) distance less centre, NaN where not both were measured [m].
    """

    pairs: Array
    centre: Array
    sigma: Array
    off: Array

    def pairs_with_target(self, target: int) -> Array:
        """(p,) True for the pairs with a target."""
        return np.asarray((self.pairs == target).any(axis=1))


def measure_target_distances(data: Measurements) -> TargetDistances:
    """The distances of all pairs of targets that were measured together often enough."""
    pairs, centre, off = [], [], []
    for a, b in combinations(range(len(data.target_names)), 2):
        distance = np.linalg.norm(data.y[:, a] - data.y[:, b], axis=-1)
        if np.isfinite(distance).sum() >= MIN_DISTANCE_COUNT:
            pairs.append((a, b))
            centre.append(float(nanmedian_last_axis(distance)))
            off.append(distance - centre[-1])
    deviation = np.array(off).reshape(len(pairs), data.poses)
    return TargetDistances(
        np.array(pairs, dtype=int).reshape(-1, 2),
        np.array(centre),
        robust_sigmas(deviation),
        deviation,
    )


def robust_sigmas(deviations: Array) -> Array:
    """(p,) robust standard deviation about the median of rows with NaN.  deviations: (p, m) [m]."""
    if not len(deviations):
        return np.zeros(0)
    middle = nanmedian_last_axis(deviations)[:, None]
    return np.asarray(
        np.maximum(
            SIGMA_PER_MEDIAN_DEVIATION * nanmedian_last_axis(np.abs(deviations - middle)),
            MIN_INSTRUMENT_NOISE,
        )
    )
