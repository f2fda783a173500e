"""Make an almost right answer exact: solve for the rows that hold with equality."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from .accuracy import accuracy
from .problem import dense

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from .accuracy import Accuracy
    from .problem import Array, Matrix, Problem, Solution

LARGEST_DENSE = 600  # unknowns up to which dense elimination is faster


def polish(
    problem: Problem,
    solution: Solution,
    tolerance: float = 0.0,
    judged: Accuracy | None = None,
) -> Solution:
    """The better of a solution and what the rows it holds with equality make of it.

    Which rows these are is read from x and y (a row is active when its multiplier outweighs its
    slack); then P x + q + A_aᵀ y_a = 0, A_a x = b_a is one linear system.  Rows that come out with
    the wrong sign are dropped and rows that are left are added, a few times, and the most accurate
    answer on the way is returned, with its `residual`.  It serves every backend that stops near
    the solution.  judged: the solution's accuracy, where it is known.
    """
    worst = (judged or accuracy(problem, solution)).worst
    best = replace(solution, residual=worst)
    if not np.isfinite(worst):
        return best
    with np.errstate(all="ignore"):  # an answer may be infinitely wrong
        side = _active(problem, solution)
        for _ in range(6):
            trial = _solve_active(problem, solution, side)
            worst = accuracy(problem, trial).worst
            if worst < best.residual:
                best = replace(trial, residual=worst)
            if best.residual <= tolerance or not np.isfinite(worst):
                break
            changed = _corrected(problem, trial, side)
            if (changed == side).all():
                break
            side = changed
    return best


def _active(problem: Problem, solution: Solution) -> NDArray[np.int8]:
    """Which side of each row holds with equality: 1 for u, -1 for l, 0 for none.  Returns (m,)."""
    Ax, norm = problem.A @ solution.x, problem.row_norm
    size = max(1e-300, float(np.abs(problem.A.T @ solution.y).max(initial=0.0)))
    length = max(1e-300, float(np.abs(Ax / norm).max(initial=0.0)))
    weight = solution.y * norm / size
    side = np.zeros(norm.shape, dtype=np.int8)
    side[weight > np.abs(problem.u - Ax) / norm / length] = 1
    side[-weight > np.abs(Ax - problem.l) / norm / length] = -1
    side[problem.l == problem.u] = 1
    return side


def _corrected(problem: Problem, trial: Solution, side: NDArray[np.int8]) -> NDArray[np.int8]:
    """The active rows after dropping wrong signs and adding rows that x has left."""
    Ax, changed = problem.A @ trial.x, side.copy()
    room = 1e-12 * problem.row_norm * max(1e-300, float(np.abs(trial.x).max(initial=0.0)))
    changed[(trial.y * side < 0) & (problem.l < problem.u)] = 0
    changed[Ax > problem.u + room] = 1
    changed[Ax < problem.l - room] = -1
    return changed


def _solve_active(problem: Problem, solution: Solution, side: NDArray[np.int8]) -> Solution:
    """x and y for given active rows."""
    rows = np.flatnonzero(side)
    b = np.where(side > 0, problem.u, problem.l)[rows]
    x, y_active = _equality(problem.P, problem.q, problem.A[rows], b, solution, rows)
    y = np.zeros(side.shape)
    y[rows] = y_active
    return replace(solution, x=x, y=y)


def _equality(
    P: Matrix, q: Array, E: Matrix, b: Array, guess: Solution, rows: NDArray[np.intp]
) -> tuple[Array, Array]:
    """argmin ½xᵀPx + qᵀx with Ex = b and its multipliers, near a guess.

    The system is made regular by a shift of ±δ and the shift is worked off by refinement, so that
    dependent rows and a singular P do no harm.
    """
    n = q.size
    norm = np.sqrt(np.asarray((E * E).sum(axis=1)).ravel()) if E.shape[0] else np.zeros(0)
    norm = np.where(norm > 0, norm, 1.0)
    scale = float(P.diagonal().max(initial=0.0)) or 1.0
    solve = _factor(P / scale, E, norm)
    x, y = guess.x, guess.y[rows]
    best, least = (x, y), np.inf
    for _ in range(12):
        dual, primal = P @ x + q + E.T @ y, b - E @ x
        error = float(np.abs(dual).max(initial=0.0)) / scale
        error = max(error, float(np.abs(primal / norm).max(initial=0.0)))
        if not error < 0.9 * least:
            break
        best, least = (x, y), error
        step = solve(np.concatenate([-dual / scale, primal / norm]))
        x, y = x + step[:n], y + scale * step[n:] / norm
    return best


def _factor(P: Matrix, E: Matrix, norm: Array) -> Callable[[Array], Array]:
    """A solver of [P + δ, Fᵀ; F, -δ] with F the rows of E at length 1."""
    n, k, delta = P.shape[0], E.shape[0], 1e-9
    if n + k <= LARGEST_DENSE:
        F = dense(E) / norm[:, None]
        full = np.block([[dense(P) + delta * np.eye(n), F.T], [F, -delta * np.eye(k)]])
        factors = scipy.linalg.lu_factor(full, check_finite=False)
        return lambda right: np.asarray(scipy.linalg.lu_solve(factors, right, check_finite=False))
    S: Any = scipy.sparse.diags_array(1.0 / norm) @ scipy.sparse.csc_array(E)
    shift = scipy.sparse.diags_array(np.concatenate([np.full(n, delta), np.full(k, -delta)]))
    kkt: Any = scipy.sparse.block_array([[scipy.sparse.csc_array(P), S.T], [S, None]]) if k else P
    lu: Any = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(kkt + shift))
    return lambda right: np.asarray(lu.solve(right))
