"""Joint ranges of a size that can be drawn from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array

DEFAULT_SLIDE_RANGE = 0.5  # how far a slide without limits goes to either side [m]


class JointBounds(NamedTuple):
    """Lowest and highest joint values, (n,) or one row for each pose (m, n) [rad, m]."""

    lower: Array
    upper: Array


def clip_range_near_zero(
    lower: Array, upper: Array, max_distance: Array | float = np.pi
) -> JointBounds:
    """(n,) ends of the part of joint ranges within `max_distance` of zero.

    Of a range that lies beyond, its nearest part that is as wide.  lower, upper: (n,) limits,
    infinite where unknown [rad, m].
    """
    low = np.where(upper > -max_distance, -max_distance, upper - 2.0 * max_distance)
    high = np.where(lower < max_distance, max_distance, lower + 2.0 * max_distance)
    return JointBounds(np.maximum(lower, low), np.minimum(upper, high))
