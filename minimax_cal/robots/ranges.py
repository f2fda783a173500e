"""Joint ranges of a size that can be drawn from."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array


def near_zero(lower: Array, upper: Array, most: Array | float = np.pi) -> tuple[Array, Array]:
    """(n,) ends of the part of joint ranges within `most` of zero, or as wide where zero is not.

    lower, upper: (n,) limits, infinite where unknown [rad, m].
    """
    low = np.maximum(lower, np.minimum(-most, upper - 2.0 * most))
    return low, np.minimum(upper, np.maximum(most, low + 2.0 * most))
