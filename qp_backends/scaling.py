"""Units in which the entries of P and A have one size, so that nothing depends on the user's."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from .problem import COLD, Problem, Solution, Status, is_sparse

if TYPE_CHECKING:
    from collections.abc import Callable

    from .problem import Array, Matrix

NEAR_ONE = 3.0  # powers of 2: solvers do not mind such units
PASSES = 8  # each takes the square root of what the largest entries differ by


def equilibrate(problem: Problem) -> tuple[Problem, Array, Array]:
    """The problem in x / s with y / t, and s (n,) and t (m,); itself where its units are good.

    s and t are powers of 2, so that an answer has the same accuracy in both.
    """
    s, row = problem.scales
    P, A = _scaled(problem.P, s, s), _scaled(problem.A, row, s)
    largest = float(P.diagonal().max(initial=0.0)) or float(np.abs(s * problem.q).max(initial=0.0))
    factor = 0.5 ** round(math.log2(largest)) if largest > 0.0 else 1.0
    t = row / factor
    if np.abs(np.log2(np.concatenate([s, row, t]))).max(initial=0.0) <= NEAR_ONE:
        return problem, np.ones(s.shape), np.ones(t.shape)
    q, l, u = factor * s * problem.q, row * problem.l, row * problem.u  # noqa: E741
    scaled = Problem(factor * P, q, A, l, u)
    vars(scaled)["scales"] = np.ones(s.shape), np.ones(t.shape)  # they are found once
    return scaled, s, t


def in_units(solution: Solution, s: Array, t: Array) -> Solution:
    """A solution with x times s and y times t; as it is where it has another shape."""
    if solution.x.shape != s.shape or solution.y.shape != t.shape:
        return solution
    certificate = solution.certificate
    if certificate.size:
        certificate = certificate * (t if solution.status is Status.INFEASIBLE else s)
    with np.errstate(all="ignore"):  # an answer may be infinitely wrong
        return replace(solution, x=solution.x * s, y=solution.y * t, certificate=certificate)


def in_good_units(run: Callable[..., Solution]) -> Callable[..., Solution]:
    """A backend that is given equilibrated problems only."""

    def solve(problem: Problem, *, warm_start: Solution = COLD, **keywords: Any) -> Solution:
        scaled, s, t = equilibrate(problem)
        start = in_units(warm_start, 1.0 / s, 1.0 / t)
        return in_units(run(scaled, warm_start=start, **keywords), s, t)

    return solve


def factors(P: Matrix, A: Matrix) -> tuple[Array, Array]:
    """s (n,) and t (m,), powers of 2, with which the entries of sPs and tAs are about 1.

    P, A: absolute entries.  Variables and rows are divided by the roots of their largest entries
    in [P, A'; A, 0], P first divided by its own [Ruiz 2001].
    """
    n, m = A.shape[1], A.shape[0]
    P = P / (float(P.max()) or 1.0) if n else P
    if is_sparse(P) or is_sparse(A):
        blocks: Any = scipy.sparse.block_array
        K = blocks([[P, scipy.sparse.csc_array(A.T)], [A, None]], format="csc") if m else P
    else:
        K = np.zeros((n + m, n + m))
        K[:n, :n], K[n:, :n], K[:n, n:] = P, A, A.T
    units = np.ones(n + m)
    for _ in range(PASSES if n else 0):  # K is symmetric, its entries in these units are u K u
        largest = (K * units).max(axis=1)
        largest = largest.toarray().ravel() if is_sparse(K) else largest
        units = units / np.sqrt(np.where(largest > 0.0, largest * units, 1.0))
    units = np.exp2(np.round(np.log2(units)))
    return units[:n], units[n:]


def _scaled(matrix: Matrix, left: Array, right: Array) -> Matrix:
    """diag(left) matrix diag(right)."""
    if is_sparse(matrix):
        diagonal: Any = scipy.sparse.diags_array
        return scipy.sparse.csc_array(diagonal(left) @ matrix @ diagonal(right))
    return left[:, None] * matrix * right
