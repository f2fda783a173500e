"""What goes into a QP backend and what comes out of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Matrix: TypeAlias = Any  # a dense Array or a csc_array; both know @, .T and .shape

OPEN = 1e20  # what QP files write for infinity
RIDGE = 1e-10  # of the diagonal of P: rounding, by which an eigenvalue may be below 0
EMPTY: Array = np.zeros(0)
EMPTY.flags.writeable = False


class BackendError(ValueError):
    """A mistake of the caller: a wrong name, a missing package, data of the wrong shape."""


class ProblemError(BackendError):
    """Data of a problem that cannot be meant."""


class Status(Enum):
    """How a solve ended; the text says what it means and what to try."""

    SOLVED = "solved"
    INACCURATE = (
        "stopped short of the tolerance: use x with care, "
        "or scale the problem, loosen the tolerance or try another backend"
    )
    INFEASIBLE = (
        "infeasible: no x meets all rows; relax the rows at which the certificate is not zero"
    )
    UNBOUNDED = (
        "unbounded: the objective falls for ever along the certificate; "
        "bound that direction or add curvature to P"
    )
    ITERATION_LIMIT = "iteration limit: loosen the tolerance or try another backend"
    TIME_LIMIT = "time limit: allow more time, loosen the tolerance or try a faster backend"
    FAILED = "failed: the backend gave no usable answer; the notes say why; try another backend"


def is_sparse(matrix: Any) -> bool:
    """Whether a matrix is one of SciPy's sparse ones."""
    return not isinstance(matrix, np.ndarray) and bool(scipy.sparse.issparse(matrix))


def dense(matrix: Matrix) -> Array:
    """A matrix as a dense array."""
    array: Array = matrix.toarray() if is_sparse(matrix) else matrix
    return array


def _matrix(value: Any, name: str) -> Matrix:
    """A float64 dense array, or a CSC array when the value is scipy.sparse."""
    if is_sparse(value):
        matrix: Any = scipy.sparse.csc_array(value, dtype=np.float64)
        entries = matrix.data
    else:
        matrix = entries = _array(value)
    if matrix.ndim != 2:
        raise ProblemError(f"{name} must have two dimensions, not {matrix.ndim}")
    if not np.isfinite(entries).all():
        raise ProblemError(f"{name} holds NaN or infinite entries")
    return matrix


def _array(value: Any) -> Array:
    """A contiguous float64 array; writeable, because some solvers insist on it."""
    array = np.ascontiguousarray(value, dtype=np.float64)
    return array if array.flags.writeable else array.copy()


def _vector(value: Any, name: str, size: int) -> Array:
    """A float64 vector of the given size."""
    vector = _array(value)
    if vector.shape != (size,):
        raise ProblemError(f"{name} has shape {vector.shape}, expected ({size},)")
    return vector


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimise ½xᵀPx + qᵀx subject to l ≤ Ax ≤ u.

    P: (n, n) symmetric positive semi-definite, dense or sparse; both triangles are given.
    q: (n,).
    A: (m, n) dense or sparse; m may be 0.
    l, u: (m,) equal for an equality, ±inf where open; 1e20 and beyond counts as open.
    """

    P: Matrix
    q: Array
    A: Matrix
    l: Array  # noqa: E741  the papers' letter
    u: Array

    def __post_init__(self) -> None:
        """Bring the data to float64 and refuse what cannot be meant."""
        P, A = _matrix(self.P, "P"), _matrix(self.A, "A")
        n, m = P.shape[0], A.shape[0]
        if P.shape != (n, n):
            raise ProblemError(f"P has shape {P.shape}, expected a square matrix")
        if A.shape[1] != n:
            raise ProblemError(f"A has {A.shape[1]} columns, but P has {n}")
        q = _vector(self.q, "q", n)
        l, u = _vector(self.l, "l", m), _vector(self.u, "u", m)  # noqa: E741
        if not np.isfinite(q).all():
            raise ProblemError("q holds NaN or infinite entries")
        if (l != l).any() or (u != u).any():  # NaN
            raise ProblemError("l or u holds NaN; an open side is -inf or inf")
        l, u = np.where(l > -OPEN, l, -np.inf), np.where(u < OPEN, u, np.inf)  # noqa: E741
        if not symmetric(P):
            raise ProblemError("P is not symmetric; give both triangles, for example (P + P.T) / 2")
        if not convex(P):
            raise ProblemError(
                "P is not positive semidefinite: along some direction the objective curves down, "
                "and what a solver finds is no minimum; add curvature to the diagonal of P"
            )
        vars(self).update(P=P, q=q, A=A, l=l, u=u)

    @staticmethod
    def from_qpsolvers(
        P: Matrix,
        q: Any,
        G: Matrix | None = None,
        h: Any = None,
        A: Matrix | None = None,
        b: Any = None,
        lb: Any = None,
        ub: Any = None,
    ) -> Problem:
        """From what `qpsolvers.solve_qp` takes: Gx ≤ h, Ax = b, lb ≤ x ≤ ub, each if given.

        The rows are those of G, of A, and of the variables that have a bound given.  Raises
        ProblemError.
        """
        n = len(q)
        box = None if lb is None and ub is None else np.eye(n)
        low = np.full(n, -np.inf) if lb is None else lb
        high = np.full(n, np.inf) if ub is None else ub
        sides = ((G, np.full(np.shape(h), -np.inf), h), (A, b, b), (box, low, high))
        given: list[Any] = [side for side in sides if side[0] is not None]
        if (G is None, A is None) != (h is None, b is None):
            raise ProblemError("G needs h, and A needs b")
        for name, (matrix, _, end) in zip(("G", "A", "lb and ub"), sides, strict=True):
            if matrix is not None and np.shape(matrix) not in {(np.size(end), n), (n,)}:
                raise ProblemError(f"{name}: rows of {n} numbers, one for each of its bounds")
        thin = any(is_sparse(matrix) for matrix, _, _ in given)
        stack: Any = scipy.sparse.vstack if thin else np.vstack
        rows = stack([matrix for matrix, _, _ in given]) if given else np.zeros((0, n))
        l, u = (np.concatenate([[], *(np.atleast_1d(side[i]) for side in given)]) for i in (1, 2))  # noqa: E741
        return Problem(P, q, rows, l, u)

    @cached_property
    def row_norm(self) -> Array:
        """Euclidean norm of each row of A, 1 for an empty row.  Returns (m,)."""
        if is_sparse(self.A):
            norm = np.sqrt(np.asarray(self.A.multiply(self.A).sum(axis=1)).ravel())
        else:
            norm = np.sqrt(np.einsum("ij,ij->i", self.A, self.A))
        return np.where(norm > 0, norm, 1.0)

    @cached_property
    def magnitudes(self) -> tuple[Matrix, Matrix]:
        """Absolute entries of P and A."""
        return abs(self.P), abs(self.A)

    @cached_property
    def scales(self) -> tuple[Array, Array]:
        """Units of x and of the rows in which P and A are well scaled: s (n,) and t (m,)."""
        from .scaling import factors

        return factors(*self.magnitudes)

    @cached_property
    def farthest(self) -> float:
        """Distance from 0 to the farthest finite bound in these units, 1 if all are 0 or open."""
        ends = np.abs((self.l, self.u)) * self.scales[1]
        return float(np.where(np.isfinite(ends), ends, 0.0).max(initial=0.0)) or 1.0

    @cached_property
    def above(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """The rows as Gx ≥ g, for solvers that know no other: G (r, n), g (r,), low (m,).

        First -Ax ≥ -u for all rows, then Ax ≥ l for those with low = True; A must be dense.
        """
        low = self.l > -np.inf
        rows = np.concatenate([-self.A, self.A[low]])
        return rows, np.concatenate([-self.u, self.l[low]]), low

    @cached_property
    def boxed(self) -> bool:
        """Whether every row is closed above and none is an equality."""
        return bool(self.u.max(initial=-np.inf) < np.inf and not (self.l == self.u).any())

    @cached_property
    def has_sparse(self) -> bool:
        """Whether P or A came as a sparse matrix."""
        return is_sparse(self.P) or is_sparse(self.A)


def symmetric(P: Matrix) -> bool:
    """Whether P equals its transpose but for rounding.  P: (n, n)."""
    if is_sparse(P):
        return bool(abs(P - P.T).max() <= 1e-9 * abs(P).max()) if P.nnz else True
    return bool((P == P.T).all()) or bool(np.abs(P - P.T).max() <= 1e-9 * np.abs(P).max())


def convex(P: Matrix) -> bool:
    """Whether P is positive semidefinite but for rounding.  P: (n, n) symmetric.

    A Cholesky factorisation, which no unit of a variable changes, with RIDGE on the diagonal.
    """
    diagonal = P.diagonal()
    lowest = diagonal.min(initial=np.inf)
    if lowest < 0.0:
        return False
    if lowest == 0.0 and abs(P).sum(axis=0)[diagonal == 0.0].any():
        return False
    ridged = (1.0 + RIDGE) * diagonal
    if lowest == 0.0:
        ridged[diagonal == 0.0] = 1.0
    if not is_sparse(P):
        factor = P.copy()
        factor.flat[:: len(P) + 1] = ridged
        try:  # of NumPy, since `scipy.linalg` is slow to import
            np.linalg.cholesky(factor)
        except np.linalg.LinAlgError:
            return False
        return True
    if P.nnz == np.count_nonzero(diagonal):
        return True
    matrix: Any = scipy.sparse.csc_matrix(P, copy=True)
    matrix.setdiag(ridged)
    try:  # without exchanges of rows this is the factorisation of a symmetric matrix
        factors: Any = scipy.sparse.linalg.splu(
            matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError:  # a pivot is exactly 0
        return False
    kept = bool((factors.perm_r == factors.perm_c).all())
    return kept and bool(factors.U.diagonal().min() > 0.0)


@dataclass(frozen=True, eq=False)
class Solution:
    """An answer and how it was come by.

    x: (n,) minimiser; NaN where there is none.
    y: (m,) multipliers, > 0 at u and < 0 at l, so that Px + q + Aᵀy = 0; NaN where there is none.
    status: how it ended; its value is a text that says what to try.
    seconds: wall time of the whole solve, fallbacks and checks included [s].
    backend: the backend whose answer this is.
    residual: the largest relative residual, as `accuracy` judged it; infinite where it did not.
    notes: one line for each answer that was not good enough: a backend, what it said and what was
    wrong with it, so that the next one took over or the answer had to be improved.
    certificate: (m,) multipliers that prove INFEASIBLE, (n,) ray that proves UNBOUNDED, else (0,).
    iterations: the backend's own count, 0 where it tells none.
    warm: whether the backend began at the start that it was given.
    as_is: whether it is to be used though it did not keep the tolerance (`judge.AS_THEY_ARE`).
    """

    x: Array
    y: Array
    status: Status
    seconds: float
    backend: str = ""
    residual: float = math.inf
    notes: tuple[str, ...] = ()
    certificate: Array = field(default_factory=lambda: EMPTY)
    iterations: int = 0
    warm: bool = False
    as_is: bool = False

    @property
    def solved(self) -> bool:
        """Whether x is an answer that kept the tolerance."""
        return self.status is Status.SOLVED

    @property
    def usable(self) -> bool:
        """Whether x kept the tolerance, or comes from a method that is used as it is."""
        return self.solved or self.as_is


COLD = Solution(EMPTY, EMPTY, Status.FAILED, 0.0)  # "no warm start"


def nothing(problem: Problem, status: Status, *notes: str) -> Solution:
    """A solution without x and y."""
    x, y = np.full(problem.q.shape, np.nan), np.full(problem.l.shape, np.nan)
    return Solution(x, y, status, 0.0, notes=notes)
