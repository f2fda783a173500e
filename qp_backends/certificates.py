"""Proofs that a problem has no solution, found without the backend that claims it."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from .problem import EMPTY, Status

if TYPE_CHECKING:
    from .problem import Array, Matrix, Problem

ROUNDING = 8 * float(np.finfo(float).eps)  # of a sum, relative to its terms
CLEAR = 1e-7  # how clearly a proof must hold, relative to the size of its terms


def proof(problem: Problem, time_limit: float = np.inf) -> tuple[Status, Array]:
    """INFEASIBLE or UNBOUNDED with its certificate, or FAILED and nothing when neither is proven.

    Infeasible: multipliers y (m,), > 0 at u and < 0 at l, with Aᵀy = 0 and uᵀy⁺ - lᵀy⁻ < 0; no x
    can meet all rows, for yᵀAx would be both 0 and negative [Farkas].  Where a lower bound lies
    above its upper bound, 1 at these rows.
    Unbounded: a ray d (n,) with Pd = 0 and qᵀd < 0 along which no row is ever left, at a problem
    that no such y proves infeasible.

    Both are linear programs, which HiGHS solves; what it answers is checked here, not believed.
    """
    crossed = (problem.l > problem.u) | (problem.u == -np.inf) | (problem.l == np.inf)
    if crossed.any():
        return Status.INFEASIBLE, crossed.astype(np.float64)
    y = _farkas(problem, time_limit)
    if y.size:
        return Status.INFEASIBLE, y
    d = _ray(problem, time_limit)
    return (Status.UNBOUNDED, d) if d.size else (Status.FAILED, EMPTY)


def _program(
    cost: Array, rows: Matrix, lower: Array, upper: Array, box: tuple[float, float], limit: float
) -> Array:
    """argmin cost'z with lower ≤ rows z ≤ upper and every z in the box; empty when not found."""
    same, above, below = lower == upper, upper < np.inf, lower > -np.inf
    above, below = above & ~same, below & ~same
    options: Any = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    if limit < np.inf:
        options["time_limit"] = max(limit, 1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = scipy.optimize.linprog(
            cost,
            scipy.sparse.vstack([rows[above], -rows[below]]),
            np.concatenate([upper[above], -lower[below]]),
            rows[same],
            upper[same],
            bounds=box,
            method="highs",
            options=options,
        )
    found = result.status == 0 and result.x is not None
    return np.asarray(result.x, dtype=np.float64) if found else EMPTY


def _farkas(problem: Problem, limit: float) -> Array:
    """Multipliers that prove the rows contradictory, or nothing."""
    A: Any = scipy.sparse.csr_array(problem.A)
    norm = problem.row_norm
    A = scipy.sparse.diags_array(1.0 / norm) @ A
    u, l = problem.u / norm, problem.l / norm  # noqa: E741
    up, low = np.flatnonzero(u < np.inf), np.flatnonzero(l > -np.inf)
    if not up.size + low.size:
        return EMPTY
    cost = np.concatenate([u[up], -l[low]])
    columns = scipy.sparse.vstack([A[up], -A[low]]).T.tocsr()
    zero = np.zeros(problem.q.size)
    z = _program(cost, columns, zero, zero, (0.0, 1.0), limit)
    if not z.size:
        return EMPTY
    z = np.where(z > 1e-9, z, 0.0)
    y = np.zeros(norm.size)
    y[up] += z[: up.size]
    y[low] -= z[up.size :]
    # Aᵀy is 0 but for rounding, which an x as far away as the farthest row must not outweigh.
    reach = problem.farthest * problem.scales[0]
    rounding = ROUNDING * y.size * float(np.abs(y) @ (abs(A) @ reach))
    clear = -float(cost @ z) > max(CLEAR * float(np.abs(cost) @ z), rounding)
    return y / norm if clear and _vanishes(A.T, y) else EMPTY


def _ray(problem: Problem, limit: float) -> Array:
    """A direction in which the objective falls for ever, or nothing."""
    P: Any = scipy.sparse.csr_array(problem.P)
    A: Any = scipy.sparse.csr_array(problem.A)
    size, slope = float(abs(P).max()) if P.nnz else 0.0, float(np.abs(problem.q).max(initial=0.0))
    if slope == 0.0:
        return EMPTY
    P = P / size if size > 0 else P[:0]
    A = scipy.sparse.diags_array(1.0 / problem.row_norm) @ A
    zero = np.zeros(P.shape[0])
    low = np.where(problem.l > -np.inf, 0.0, -np.inf)
    high = np.where(problem.u < np.inf, 0.0, np.inf)
    d = _program(
        problem.q / slope,
        scipy.sparse.vstack([P, A]).tocsr(),
        np.concatenate([zero, low]),
        np.concatenate([zero, high]),
        (-1.0, 1.0),
        limit,
    )
    if not d.size:
        return EMPTY
    d = np.where(np.abs(d) > 1e-9, d, 0.0)
    clear = -float(problem.q @ d) > CLEAR * float(np.abs(problem.q) @ np.abs(d))
    Ad = A @ d
    leaves = np.flatnonzero((Ad > high) | (Ad < low))
    return d if clear and _vanishes(P, d) and _vanishes(A[leaves], d) else EMPTY


def _vanishes(matrix: Any, vector: Array) -> bool:
    """Whether each entry of matrix @ vector is the rounding of its own terms, in any units.

    What is left of x1 + a x2 along x2 is a, however small: it has nothing to cancel with.
    """
    left, terms = np.abs(matrix @ vector), abs(matrix) @ np.abs(vector)
    return bool(np.all(left <= ROUNDING * len(vector) * terms))
