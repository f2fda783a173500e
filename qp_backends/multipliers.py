"""Multipliers for an x that came without them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .problem import dense

if TYPE_CHECKING:
    from .problem import Array, Problem


def estimate_multipliers(problem: Problem, x: Array) -> Array:
    """y (m,) with which stationarity and complementarity at x (n,) are met best.

    Non-negative least squares over the rows' closed sides, each with its slack as a price, in
    units in which P and A are well scaled.  NaN where x is no number.
    """
    from scipy.optimize import nnls

    if not np.isfinite(x).all():
        return np.full(problem.l.shape, np.nan)
    s, t = problem.scales
    A = dense(problem.A)
    rows = t[:, None] * A * s
    gradient = s * (problem.P @ x + problem.q)
    size = float(np.abs(gradient).max(initial=0.0)) or 1.0
    c, reach = A @ x, float(np.abs(x / s).max(initial=0.0)) or 1.0
    above, below = np.flatnonzero(problem.u < np.inf), np.flatnonzero(problem.l > -np.inf)
    slack = np.concatenate([(t * (problem.u - c))[above], (t * (c - problem.l))[below]])
    columns = np.concatenate([rows[above], -rows[below]]).T
    system = np.vstack([columns, np.diag(np.maximum(slack, 0.0) / reach)])
    found, _ = nnls(system, np.concatenate([-gradient / size, np.zeros(len(slack))]))
    y = np.zeros(len(c))
    y[above] += size * found[: len(above)]
    y[below] -= size * found[len(above) :]
    return t * y
