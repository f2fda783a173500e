"""Errors that change slowly, with the visit order or the temperature."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.diagnosing.where.features import products, scaled, waves
from minimax_cal.diagnosing.where.gaps import Trend
from minimax_cal.diagnosing.where.residual import Residual
from minimax_cal.diagnosing.where.significance import explained
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements

SLOW = 2  # half-waves over the session that count as a drift


def trend(rest: Residual, shared: Array, against: Array) -> Trend:
    """What slow changes of base frame and size with `against` (m,) explain; NaN rows left out."""
    known = np.isfinite(against)
    if known.sum() < 8 or np.ptp(against[known]) == 0.0:
        return Trend(math.nan, math.nan)
    slow = np.where(known[:, None], waves(against, SLOW, start=1), 0.0)
    share, p = explained(rest, rest.without_fit(products(shared, slow)), float((shared**2).sum()))
    return Trend(share, p)


def clock(data: Measurements) -> Array:
    """(m,) when each row was visited, in [0, 1]: by `clock`, time, order or the row's place."""
    for name in ("clock", "time", "order"):
        if name in data.columns and np.isfinite(data.columns[name]).any():
            return scaled(data.columns[name].astype(float))
    return scaled(np.arange(data.poses, dtype=float))
