"""Arrays, as every room names them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def rms(values: Array) -> float:
    """Root of the mean square, NaN left out; NaN if nothing is left."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
