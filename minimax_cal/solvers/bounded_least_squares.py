"""Least squares between bounds, from their normal equations."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import scipy

from minimax_cal.core.arrays import Array

BOUNDED_STEP_RIDGE = 1e-12  # of a parameter's own weight: what nothing tells stays where it is


def solve_bounded_normal_equations(
    gram: Array, gradient: Array, lower: Array, upper: Array
) -> Array:
    """The step x (p,) that minimises x'Hx - 2 g'x between bounds."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    unit = gram * np.outer(scale, scale) + BOUNDED_STEP_RIDGE * np.eye(len(gram))
    free = np.isinf(lower) & np.isinf(upper)
    x = np.linalg.solve(unit, gradient * scale)
    if np.all((x >= lower / scale) & (x <= upper / scale)):
        return np.asarray(scale * x)
    # of the others what the free ones do not take over, and then the free ones
    across = np.linalg.solve(unit[np.ix_(free, free)], unit[np.ix_(free, ~free)])
    rest = unit[np.ix_(~free, ~free)] - unit[np.ix_(~free, free)] @ across
    values, vectors = np.linalg.eigh(0.5 * (rest + rest.T))
    root = np.sqrt(
        np.maximum(values, BOUNDED_STEP_RIDGE)
    )  # columns that are the same leave rounding
    target = vectors.T @ ((gradient * scale)[~free] - across.T @ (gradient * scale)[free]) / root
    held = solve_bounded_least_squares(
        root[:, None] * vectors.T, target, (lower / scale)[~free], (upper / scale)[~free]
    )
    x[free] += across @ (x[~free] - held)
    x[~free] = held
    return np.asarray(scale * x)


def solve_bounded_least_squares(matrix: Array, target: Array, lower: Array, upper: Array) -> Array:
    """The x (p,) between bounds that minimises |Ax - b|; A: (p, p), regular.

    Bounds below alone have a compiled solver, which is some 30 times faster.
    """
    if np.isfinite(lower).all() and np.isinf(upper).all():
        rounds = 100 * len(lower)
        with suppress(RuntimeError):  # columns almost the same may make it go in circles
            found = scipy.optimize.nnls(matrix, target - matrix @ lower, maxiter=rounds)[0]
            return np.asarray(lower + found)
    ends = lower, upper
    return np.asarray(scipy.optimize.lsq_linear(matrix, target, ends, method="bvls", tol=1e-12).x)
