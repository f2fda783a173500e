"""A bound that proves how good an answer to a problem in norms is, from its multipliers alone.

    min over x of  max_i |r_i(x)|   subject to   lower <= c(x) <= upper

The bound is by weak duality on the problem with r and c linearised; it knows no robot and trusts no
solver.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.least_squares import solve_normal_equations

INACTIVE_MULTIPLIER_SHARE = (
    1e-6  # share of the mean multiplier that every point has when stationarity is repaired
)


@dataclass(frozen=True, eq=False)
class LinearisedNorms:
    """Vectors and constraints with their first derivatives at a point.

    r: (n, w).  J: (n, w, p) of r.  c: (l,).  C: (l, p) of c.
    """

    r: Array
    J: Array
    c: Array
    C: Array

    @property
    def norms(self) -> Array:
        """(n,) |r_i|."""
        return np.asarray(np.linalg.norm(self.r, axis=1))


@dataclass(frozen=True, eq=False)
class NormMultipliers:
    """y: (n, w) one vector for each norm.  lam: (l,) > 0 at an upper bound, < 0 at a lower one.

    At a solution sum_i J_i'y_i + C'lam = 0, the |y_i| sum to one and y_i lies along r_i.
    """

    y: Array
    lam: Array


def relative_duality_gap(value: float, bound: float) -> float:
    """(value - bound) / value."""
    return (value - bound) / value if value > 0.0 else 0.0


def align_multipliers_with_residuals(
    rows: LinearisedNorms, mu: Array, lam: Array
) -> NormMultipliers:
    """Multipliers mu (n,) of the norms as vectors along r_i, brought to sum one with lam (l,)."""
    norms, total = rows.norms, max(float(mu.sum()), 1e-300)
    unit = rows.r / np.where(norms > 0.0, norms, 1.0)[:, None]
    return NormMultipliers(mu[:, None] * unit / total, lam / total)


def convert_squared_norm_multipliers(
    rows: LinearisedNorms, mu: Array, lam: Array
) -> NormMultipliers:
    """The same from the multipliers of max |r_i|^2, whose gradients are 2 |r_i| times longer."""
    return align_multipliers_with_residuals(rows, 2.0 * mu * rows.norms, lam)


def dual_lower_bound(
    rows: LinearisedNorms, lower: Array, upper: Array, multipliers: NormMultipliers
) -> float:
    """No step d brings max |r_i + J_i d| below this while lower <= c + C d <= upper.

    Weak duality, computed from the multipliers alone; nothing that a solver claims is used.  They
    need not be right: those at open bounds are dropped, what is left of stationarity is moved into
    y by weighted least squares (the active points take it), and what rounding then still leaves is
    charged over the ball of radius sqrt(sum (B + |r_i|)^2) / smallest singular value of J, outside
    of which no |r_i + J_i d| can all be below B.
    """
    lam = np.where(np.isinf(upper), np.minimum(multipliers.lam, 0.0), multipliers.lam)
    lam = np.where(np.isinf(lower), np.maximum(lam, 0.0), lam)
    y = restore_stationarity(rows, multipliers.y, lam)
    total = np.linalg.norm(y, axis=1).sum()
    if not total > 0.0:
        return 0.0
    y, lam = y / total, lam / total
    free = dual_value(rows, lower, upper, NormMultipliers(y, lam), 0.0)
    if not free > 0.0:
        return 0.0
    flat = rows.J.reshape(-1, rows.J.shape[-1])
    values = np.linalg.eigvalsh(flat.T @ flat)
    least = values[0] - 1e-14 * len(values) * values[-1]  # rounding must not make it larger
    reach = np.sqrt(((free + rows.norms) ** 2).sum() / least) if least > 0.0 else np.inf
    return max(dual_value(rows, lower, upper, NormMultipliers(y, lam), float(reach)), 0.0)


def restore_stationarity(rows: LinearisedNorms, y: Array, lam: Array) -> Array:
    """(n, w) multipliers near y with sum_i J_i'y_i + C'lam = 0, as far as J allows.

    Each may change in proportion to its size; a small share more lets others help where the active
    ones alone cannot.
    """
    flat = rows.J.reshape(-1, rows.J.shape[-1])
    size = np.linalg.norm(y, axis=1)
    weight = np.repeat(size + INACTIVE_MULTIPLIER_SHARE * size.mean(), y.shape[1])
    gram = flat.T @ (weight[:, None] * flat)
    for _ in range(3):  # twice more takes what rounding left
        rest = flat.T @ y.reshape(-1) + rows.C.T @ lam
        move = flat @ solve_normal_equations(gram, rest[:, None])[:, 0]
        y = y - (weight * move).reshape(y.shape)
    return y


def dual_value(
    rows: LinearisedNorms, lower: Array, upper: Array, multipliers: NormMultipliers, radius: float
) -> float:
    """Least of sum y_i'(r_i + J_i d) + lam'(c + C d - bound) over |d| <= radius.

    The multipliers are made smaller if the |y_i| sum to more than one.
    """
    y, lam = multipliers.y, multipliers.lam
    total = max(float(np.linalg.norm(y, axis=1).sum()), 1.0)
    edge = np.where(lam > 0.0, upper, np.where(lam < 0.0, lower, rows.c))
    rest = np.linalg.norm(np.einsum("nw,nwp->p", y, rows.J) + rows.C.T @ lam)
    slope = float(rest) * radius if rest > 0.0 else 0.0
    return float(((y * rows.r).sum() + lam @ (rows.c - edge) - slope) / total)
