"""Joint ranges of a size that can be drawn from."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array

SLIDE = 0.5  # how far a slide without limits goes to either side [m]


def near_zero(lower: Array, upper: Array, most: Array | float = np.pi) -> tuple[Array, Array]:
    """(n,) ends of the part of joint ranges within `most` of zero.

    Of a range that lies beyond, its nearest part that is as wide.  lower, upper: (n,) limits,
    infinite where unknown [rad, m].
    """
    low = np.where(upper > -most, -most, upper - 2.0 * most)
    high = np.where(lower < most, most, lower + 2.0 * most)
    return np.maximum(lower, low), np.minimum(upper, high)
