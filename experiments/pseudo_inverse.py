"""Paper S's Algorithm 1 to the letter: all parameters, redundant ones too, and pseudo-inverses.

The library frees only identifiable parameters and works on normal equations; this is the paper's
way, on explicit Jacobians and singular value decompositions, for comparison.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.least_squares import Method

CUT = 1e-10  # singular values below this, relative to the largest, are zero


@dataclass(frozen=True)
class Ended:
    """How one start ended."""

    iterations: int
    cost: float
    converged: bool


def solve(model: Model, start: State, method: Method, step: float, cap: int) -> Ended:
    """Iterate from one start until the points move less than step [m], or cap is reached."""
    points = float(model.counts.sum())
    x = best_lengths(model, start) if method.separable else start
    cost = float(model.cost(x).sum())
    damping, growth = -1.0, 2.0
    for iteration in range(1, cap + 1):
        jacobian, error = slopes(model, x, method)
        if not (np.all(np.isfinite(jacobian)) and np.isfinite(cost)):
            return Ended(iteration, cost, False)
        if method.damped:
            if damping < 0.0:  # Nielsen's first value, on the largest diagonal entry
                damping = 1e-3 * float((jacobian**2).sum(axis=0).max())
            gram = jacobian.T @ jacobian
            short = np.linalg.solve(gram + damping * np.eye(len(gram)), jacobian.T @ error)
        else:
            short = np.linalg.lstsq(jacobian, error, rcond=CUT)[0]
        moved = jacobian @ short
        if np.linalg.norm(moved) / np.sqrt(points) <= step:
            return Ended(iteration, cost, True)
        trial = x.step(spread(model, short, method))
        trial = best_lengths(model, trial) if method.separable else trial
        after = float(model.cost(trial).sum())
        if method.damped:
            gain = float(short @ (damping * short + jacobian.T @ error))
            ratio = (cost - after) / gain if gain > 0 and np.isfinite(after) else -1.0
            if ratio <= 0.0:
                damping, growth = damping * growth, growth * 2.0
                if damping > 1e20:
                    return Ended(iteration, cost, False)
                continue
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
            growth = 2.0
        x, cost = trial, after
    return Ended(cap, cost, False)


def spread(model: Model, short: Array, method: Method) -> Array:
    """A step in the angles, or in all parameters, as one in all."""
    if not method.separable:
        return short
    full = np.zeros(model.names.count)
    full[~model.names.linear] = short
    return full


def best_lengths(model: Model, x: State) -> State:
    """All lengths by the pseudo-inverse [paper S, eq. 18]."""
    linear = model.names.linear
    matrix = model.jacobian(x)[..., linear].reshape(-1, linear.sum())
    full = np.zeros(model.names.count)
    if np.all(np.isfinite(matrix)):
        full[linear] = np.linalg.lstsq(matrix, model.error(x).reshape(-1), rcond=CUT)[0]
    return x.step(full)


def slopes(model: Model, x: State, method: Method) -> tuple[Array, Array]:
    """The Jacobian that the method steps by, and the error [paper S, eq. 24, Golub and Pereyra]."""
    linear = model.names.linear
    whole = model.jacobian(x).reshape(-1, model.names.count)
    error = model.error(x).reshape(-1)
    if not method.separable or not np.all(np.isfinite(whole)):
        return whole, error
    u, s, vt = np.linalg.svd(whole[:, linear], full_matrices=False)
    kept = s > CUT * s[0]
    u, s, vt = u[:, kept], s[kept], vt[kept]
    angles = whole[:, ~linear]
    across = angles - u @ (u.T @ angles)
    return across + u @ ((vt @ model.coupling_on(x, model.blocks(x))) / s[:, None]), error
