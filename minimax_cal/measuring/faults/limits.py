"""How rarely good data raise an alarm."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

FALSE_ALARM = 0.002  # of each test, over a whole data set
ALIKE = 9.0  # squared standard scores that are no reason to prefer one target to another


def outlier_limit(count: int, tests: int, m: int) -> float:
    """Squared standard score of `count` numbers that one of `tests` exceeds by a rare chance.

    Widened by what the robust scatter of m values may be wrong.
    """
    wider = 1.0 + 2.5 * 1.17 / np.sqrt(m)
    return float(chdtri(count, FALSE_ALARM / tests) * wider**2)
