"""Arrays, as every room names them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def rms(values: Array) -> float:
    """Root of the mean square, NaN left out; NaN if nothing is left."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def nanmedian_last_axis(values: Array) -> Array:
    """(...,) median along the last axis, NaN left out; NaN where nothing is left.

    To the bit what `np.nanmedian` gives, which takes 20 times as long on arrays of a session's size
    by way of masked arrays.  values: (..., m), m > 0.
    """
    ordered = np.sort(values, axis=-1)  # NaN last
    count = np.asarray((~np.isnan(values)).sum(axis=-1))
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2 % values.shape[-1]], axis=-1)
    return np.asarray(0.5 * np.take_along_axis(ordered, middle, axis=-1).sum(axis=-1))
