"""Two-sided rows l ≤ Ax ≤ u in the one-sided form of other libraries, and multipliers back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from .problem import EMPTY, is_sparse

if TYPE_CHECKING:
    from .problem import Array, Matrix, Problem

Index = NDArray[np.intp]
NO_INDEX: Index = np.zeros(0, dtype=np.intp)
ALL: Index = np.zeros(0, dtype=np.intp)  # stands for "every row, as it is"


@dataclass(frozen=True, eq=False)
class Box:
    """Rows with a single entry, read as bounds on x.

    lower, upper: (n,) the tightest bounds, ±inf where open.
    below, above: (n,) the row that each bound came from; meaningless where open.
    entry: (m,) the single entry of each row that is a bound, 1 elsewhere.
    """

    lower: Array
    upper: Array
    below: Index
    above: Index
    entry: Array


@dataclass(frozen=True, eq=False)
class Rows:
    """Gx ≤ h, Ex = b and bounds on x, open sides left out.

    G: (g, n).  h: (g,).  E: (e, n).  b: (e,).
    above, below: the rows whose u, then those whose l, stand in G.
    equal: the rows that stand in E.
    box: the bounds; empty tuple without.
    """

    G: Matrix
    h: Array
    E: Matrix
    b: Array
    above: Index
    below: Index
    equal: Index
    box: tuple[Box, ...]


def split(problem: Problem, boxed: bool = False) -> Rows:
    """The rows of a problem as inequalities, equalities and, on request, bounds on x."""
    A, l, u = problem.A, problem.l, problem.u  # noqa: E741
    few = not boxed or 2 * l.size < problem.q.size
    if few and l.max(initial=-np.inf) == -np.inf and u.max(initial=-np.inf) < np.inf:
        return Rows(A, u, A[:0], EMPTY, ALL, NO_INDEX, NO_INDEX, ())  # worth no copy of A
    box, l, u = ((), l, u) if few else _box(problem)  # noqa: E741
    same = l == u
    equal, E, b = NO_INDEX, A[:0], EMPTY
    if same.any():
        equal = np.flatnonzero(same)
        E, b = A[equal], u[equal]
        l, u = np.where(same, -np.inf, l), np.where(same, np.inf, u)  # noqa: E741
    above, below = np.flatnonzero(u < np.inf), np.flatnonzero(l > -np.inf)
    top = A if above.size == u.size else A[above]
    if not below.size:
        return Rows(top, u[above], E, b, above, below, equal, box)
    both = [top, -A[below]]
    G: Matrix = scipy.sparse.vstack(both, format="csc") if is_sparse(A) else np.concatenate(both)
    return Rows(G, np.concatenate([u[above], -l[below]]), E, b, above, below, equal, box)


def _box(problem: Problem) -> tuple[tuple[Box, ...], Array, Array]:
    """The rows that are bounds, if they are many, and l and u with these rows opened."""
    n, m = problem.q.size, problem.l.size
    by_row = scipy.sparse.csr_array(problem.A)
    by_row.eliminate_zeros()
    single = np.diff(by_row.indptr) == 1
    if 2 * np.count_nonzero(single) < n:
        return (), problem.l, problem.u
    where = np.flatnonzero(single)
    column = by_row.indices[by_row.indptr[where]]
    entry = np.ones(m)
    entry[where] = by_row.data[by_row.indptr[where]]
    ends = np.stack([problem.l[where], problem.u[where]]) / entry[where]
    low, high = ends.min(axis=0), ends.max(axis=0)
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    np.maximum.at(lower, column, low)
    np.minimum.at(upper, column, high)
    below, above = np.zeros(n, dtype=np.intp), np.zeros(n, dtype=np.intp)
    for owner, tight in ((below, low == lower[column]), (above, high == upper[column])):
        owner[column[tight]] = where[tight]
    open_l, open_u = np.where(single, -np.inf, problem.l), np.where(single, np.inf, problem.u)
    return (Box(lower, upper, below, above, entry),), open_l, open_u


def multipliers(rows: Rows, size: int, z: Array, y: Array, bounds: Array) -> Array:
    """Multipliers of the two-sided rows.

    z: (g,) of Gx ≤ h.  y: (e,) of Ex = b.  bounds: (n,) of the bounds, > 0 at the upper one.
    Returns (size,), > 0 at u and < 0 at l.
    """
    if rows.above is ALL:
        return z
    both = np.zeros(size)
    k = rows.above.size
    both[rows.above] = z[:k]
    both[rows.below] -= z[k:]
    both[rows.equal] = y
    for box in rows.box:
        for owner, part in (
            (box.above, np.maximum(bounds, 0.0)),
            (box.below, np.minimum(bounds, 0.0)),
        ):
            used = np.flatnonzero(part)
            both[owner[used]] += part[used] / box.entry[owner[used]]
    return both


def parts(rows: Rows, multiplier: Array, size: int) -> tuple[Array, Array, Array]:
    """The inverse of `multipliers`, for warm starts.

    multiplier: (m,) of the two-sided rows.  size: n, the number of variables.
    Returns those of Gx ≤ h (g,), of Ex = b (e,) and of the bounds (n,).
    """
    if rows.above is ALL:
        return np.maximum(multiplier, 0.0), EMPTY, np.zeros(size)
    z = np.concatenate(
        [np.maximum(multiplier[rows.above], 0.0), np.maximum(-multiplier[rows.below], 0.0)]
    )
    bounds = np.zeros(size)
    for box in rows.box:
        scaled = multiplier * box.entry
        has_upper, has_lower = np.isfinite(box.upper), np.isfinite(box.lower)
        bounds[has_upper] += np.maximum(scaled[box.above[has_upper]], 0.0)
        bounds[has_lower] += np.minimum(scaled[box.below[has_lower]], 0.0)
    return z, multiplier[rows.equal], bounds
