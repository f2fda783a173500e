"""Least squares between bounds, from their normal equations."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array

RIDGE = 1e-12  # of a parameter's own weight: what nothing tells stays where it is


def bounded(gram: Array, pull: Array, low: Array, high: Array) -> Array:
    """The step x (p,) that minimises x'Hx - 2 g'x between bounds."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    unit = gram * np.outer(scale, scale) + RIDGE * np.eye(len(gram))
    free = np.isinf(low) & np.isinf(high)
    x = np.linalg.solve(unit, pull * scale)
    if np.all((x >= low / scale) & (x <= high / scale)):
        return np.asarray(scale * x)
    # of the others what the free ones do not take over, and then the free ones
    across = np.linalg.solve(unit[np.ix_(free, free)], unit[np.ix_(free, ~free)])
    rest = unit[np.ix_(~free, ~free)] - unit[np.ix_(~free, free)] @ across
    values, vectors = np.linalg.eigh(0.5 * (rest + rest.T))
    root = np.sqrt(np.maximum(values, RIDGE))  # columns that are the same leave rounding
    target = vectors.T @ ((pull * scale)[~free] - across.T @ (pull * scale)[free]) / root
    held = nearest(root[:, None] * vectors.T, target, (low / scale)[~free], (high / scale)[~free])
    x[free] += across @ (x[~free] - held)
    x[~free] = held
    return np.asarray(scale * x)


def nearest(matrix: Array, target: Array, low: Array, high: Array) -> Array:
    """The x (p,) between bounds that minimises |Ax - b|; A: (p, p), regular.

    Bounds below alone have a compiled solver, which is some 30 times faster.
    """
    if np.isfinite(low).all() and np.isinf(high).all():
        rounds = 100 * len(low)
        with suppress(RuntimeError):  # columns almost the same may make it go in circles
            found = scipy.optimize.nnls(matrix, target - matrix @ low, maxiter=rounds)[0]
            return np.asarray(low + found)
    ends = low, high
    return np.asarray(scipy.optimize.lsq_linear(matrix, target, ends, method="bvls", tol=1e-12).x)
