"""Linear algebra that several rooms use: projection, Schur complement, scaling, jackknife."""

from __future__ import annotations

import numpy as np

from minimax_cal.core.arrays import Array

SMALLEST_SQUARE = 1e-300  # of a column: what is divided by less overflows


def project_out(columns: Array, basis: Array) -> Array:
    """Columns (N, ...) less their projection on an orthonormal basis (N, p)."""
    return np.asarray(columns - basis @ (basis.T @ columns))


def column_norms_from_gram(gram: Array) -> Array:
    """(..., d) lengths of the columns that have a Gram matrix (..., d, d); never 0."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("...dd->...d", gram), SMALLEST_SQUARE)))


def divide_by_scales(matrix: Array, scale: Array) -> Array:
    """D^-1 M D^-1 of a matrix (..., d, d) with D the diagonal matrix of scales (..., d)."""
    return np.asarray(matrix / (scale[..., :, None] * scale[..., None, :]))


def schur_complement(gram: Array, projected_count: int, ridge: float = 0.0) -> Array:
    """(d - n, d - n) Gram matrix (d, d) of columns with the first n projected out.

    ridge: added to the squares of the first ones, which are scaled to 1.
    """
    scale = 1.0 / column_norms_from_gram(gram)
    gram = gram * scale * scale[:, None]
    across = gram[:projected_count, projected_count:]
    solved = np.linalg.solve(
        gram[:projected_count, :projected_count] + ridge * np.eye(projected_count), across
    )
    rest = gram[projected_count:, projected_count:] - across.T @ solved
    return np.asarray(rest / scale[projected_count:] / scale[projected_count:, None])


def jackknife_variance(leave_one_out_estimates: Array) -> Array:
    """(...) variance of an estimate from those (n, ...) without each of n groups [Tukey 1958]."""
    return np.asarray((len(leave_one_out_estimates) - 1) * np.var(leave_one_out_estimates, axis=0))
