"""Algebra that several rooms need, by the names of its field."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array


def project_out(basis: Array, columns: Array) -> Array:
    """Columns (N, ...) less their projection on a basis (N, r) of orthonormal columns."""
    return np.asarray(columns - basis @ (basis.T @ columns))
