"""Smooth curves of one variable with a Gaussian prior, as a sum of sines.

A Gaussian process on an interval is nearly the sum of the interval's sines, each with a normal
factor of its own whose variance is the spectral density at its frequency [Solin and Sarkka 2020].
"""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array


def sines(x: Array, low: float, high: float, count: int) -> Array:
    """(count, m) sin(k pi (x - low) / (high - low)), k = 1 ... count, 0 outside.  x: (m,)."""
    along = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.sin(np.pi * np.arange(1, count + 1)[:, None] * along))


def spread(length: float, span: float, count: int) -> Array:
    """(count,) standard deviations of the sines' factors, for a process of unit variance.

    Matern's covariance of order 3/2, (1 + s) exp(-s) with s = sqrt(3) |x - x'| / length, has the
    spectral density 4 a^3 / (a^2 + w^2)^2, a = sqrt(3) / length.
    """
    a, w = np.sqrt(3.0) / length, np.pi * np.arange(1, count + 1) / span
    return np.asarray(np.sqrt(2.0 / span * 4.0 * a**3) / (a**2 + w**2))
