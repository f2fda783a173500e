"""`pseudo_inverse.iterate` for NLGN and NLLM, compiled: the same iterates in a tenth of the time.

All parameters together creep for thousands of iterations from each of thousands of starts.  Loops
run over the poses; a step that is turned down costs no derivative, the normal equations come from
one triangle, and those with damping are solved by Cholesky.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np
from numba import njit

from experiments.pseudo_inverse import CONVERGED, FAILED, LIMIT, MOST_DAMPING, ROUNDING
from minimax_cal.ground.arrays import Array

P = ParamSpec("P")
R = TypeVar("R")
TILE = 4  # rows are padded to a multiple of it


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function compiled when it is first called, and kept on disk; sums in any order."""
    quick: Callable[P, R] = njit(cache=True, fastmath={"reassoc", "contract", "nsz"})(function)
    return quick


@compiled
def swing(c: Array, s: Array, u: Array, v: Array) -> None:
    """Turn two axes (3, m) into c u + s v and c v - s u, in place.  c, s: (m,)."""
    for i in range(3):
        for r in range(u.shape[1]):
            first = c[r] * u[i, r] + s[r] * v[i, r]
            v[i, r] = c[r] * v[i, r] - s[r] * u[i, r]
            u[i, r] = first


@compiled
def bend(angle: float, u: Array, v: Array) -> None:
    """As `swing`, by the same angle at all poses."""
    c, s = np.cos(angle), np.sin(angle)
    for i in range(3):
        for r in range(u.shape[1]):
            first = c * u[i, r] + s * v[i, r]
            v[i, r] = c * v[i, r] - s * u[i, r]
            u[i, r] = first


@compiled
def shift(o: Array, by: float, axis: Array) -> None:
    """Move points o (3, m) along an axis (3, m), in place."""
    for i in range(3):
        for r in range(o.shape[1]):
            o[i, r] += by * axis[i, r]


@compiled
def walk(at: Array, cq: Array, sq: Array, y: Array, rows: Array, origin: Array) -> float:
    """The cost; fills the rows of lengths, axes in those of beta and the base's angles, the error.

    cq, sq: (n, m) cosines and sines of the joints.  y: (3, m).  rows: (5n + 10 or more, 3, m), the
    error after those of the parameters.  origin: (n + 1, 3, m) of base and links.
    """
    n, m = cq.shape
    base, target, last = 5 * n + 3, 5 * n + 6, 5 * n + 9
    ex, ey, ez, o = rows[target], rows[target + 1], rows[target + 2], np.empty((3, m))
    rows[target : target + 3] = 0.0
    ex[0], ey[1], ez[2] = 1.0, 1.0, 1.0
    for i in range(3):
        o[i] = at[5 * n + i]
    origin[0] = o
    rows[base] = ez
    bend(at[base], ex, ey)
    rows[base + 1] = ey
    bend(at[base + 1], ez, ex)
    rows[base + 2] = ex
    bend(at[base + 2], ey, ez)
    for j in range(n):
        rows[n + j] = ez
        c, s = np.cos(at[2 * n + j]), np.sin(at[2 * n + j])
        swing(c * cq[j] - s * sq[j], s * cq[j] + c * sq[j], ex, ey)
        rows[j] = ex
        shift(o, at[j], ex)
        shift(o, at[n + j], ez)
        origin[j + 1] = o
        bend(at[3 * n + j], ey, ez)
        rows[4 * n + j] = ey
        bend(at[4 * n + j], ez, ex)
    for k in range(3):
        shift(o, at[target + k], rows[target + k])
    rows[last] = y - o
    return float(np.sum(rows[last] ** 2))


@compiled
def lever(axis: Array, pivot: Array, tip: Array, out: Array) -> None:
    """Write axis x (tip - pivot), each (3, m); axis may be out."""
    for r in range(tip.shape[1]):
        u, v, w = tip[0, r] - pivot[0, r], tip[1, r] - pivot[1, r], tip[2, r] - pivot[2, r]
        a, b, c = axis[0, r], axis[1, r], axis[2, r]
        out[0, r], out[1, r], out[2, r] = b * w - c * v, c * u - a * w, a * v - b * u


@compiled
def turns(y: Array, rows: Array, origin: Array) -> None:
    """Fill the rows of angles, after `walk`: how the point moves as each turns."""
    n = len(origin) - 1
    tip = y - rows[5 * n + 9]
    for j in range(n):
        lever(rows[n + j], origin[j], tip, rows[2 * n + j])
        lever(rows[j], origin[j + 1], tip, rows[3 * n + j])
        lever(rows[4 * n + j], origin[j + 1], tip, rows[4 * n + j])
    for k in range(5 * n + 3, 5 * n + 6):
        lever(rows[k], origin[0], tip, rows[k])


@compiled
def gram(rows: Array, out: Array) -> None:
    """Write rows rows', (p, p), by tiles of two by four; p is a multiple of four."""
    p, m = rows.shape
    for i in range(0, p, 2):
        for j in range(i - i % TILE, p, TILE):
            a = b = c = d = e = f = g = h = 0.0
            for k in range(m):
                u, v = rows[i, k], rows[i + 1, k]
                w, x, y, z = rows[j, k], rows[j + 1, k], rows[j + 2, k], rows[j + 3, k]
                a, b, c, d = a + u * w, b + u * x, c + u * y, d + u * z
                e, f, g, h = e + v * w, f + v * x, g + v * y, h + v * z
            out[i, j], out[i, j + 1], out[i, j + 2], out[i, j + 3] = a, b, c, d
            out[i + 1, j], out[i + 1, j + 1], out[i + 1, j + 2], out[i + 1, j + 3] = e, f, g, h
    for i in range(p):
        for j in range(i):
            out[i, j] = out[j, i]


@compiled
def reduce(L: Array, r: int, k: int, first: int) -> None:
    """Take from row r of a factor, from entry `first` on, what the rows above have: column k."""
    s = 0
    while s < r:
        if s + 3 < r:  # four rows at once: each entry is loaded once
            a, b, c, d = L[s, k], L[s + 1, k], L[s + 2, k], L[s + 3, k]
            for j in range(first, L.shape[1]):
                L[r, j] -= a * L[s, j] + b * L[s + 1, j] + c * L[s + 2, j] + d * L[s + 3, j]
            s += 4
        else:
            a = L[s, k]
            for j in range(first, L.shape[1]):
                L[r, j] -= a * L[s, j]
            s += 1


@compiled
def solved(H: Array, mu: float, g: Array) -> Array:
    """(H + mu I)^-1 g by Cholesky; by elimination where rounding leaves no Cholesky factor."""
    p = len(g)
    U, d = np.empty((p, p + 1)), np.empty(p)
    U[:, :p], U[:, p] = H, g  # the right-hand side goes along
    for k in range(p):
        U[k, k] += mu
        reduce(U, k, k, k)
        if not U[k, k] > 0.0:
            return np.linalg.solve(H + mu * np.eye(p), g)
        U[k, k:] /= np.sqrt(U[k, k])
    for k in range(p - 1, -1, -1):
        d[k] = (U[k, p] - np.sum(U[k, k + 1 : p] * d[k + 1 :])) / U[k, k]
    return d


@compiled
def least_step(H: Array, g: Array) -> Array:
    """See `pseudo_inverse.least_step`; the factor is transposed here."""
    p = len(g)
    L, left = np.zeros((p, p)), np.diag(H).copy()
    largest, rank = left.max(), p
    for r in range(p):
        k = int(np.argmax(left))
        if left[k] <= p * ROUNDING * largest:
            rank = r
            break
        L[r] = H[k]
        reduce(L, r, k, 0)
        L[r] /= np.sqrt(left[k])
        left -= L[r] ** 2
        left[k] = 0.0
    L = L[:rank]
    M = L @ L.T
    return (solved(M, 0.0, solved(M, 0.0, L @ g)) @ L).copy()


@compiled
def iterate(
    at: Array, q: Array, y: Array, damping: float, by: float, small: float, cap: int, course: Array
) -> tuple[int, float, int]:
    """See `pseudo_inverse.iterate`, of which this is the part that is not separable."""
    m, n = q.shape
    p = 5 * n + 9
    size = (p + TILE) // TILE * TILE  # the error is a row too: its products are J'e
    cq, sq = np.cos(q.T).copy(), np.sin(q.T).copy()
    rows, origin, both = np.zeros((size, 3, m)), np.zeros((n + 1, 3, m)), np.zeros((size, size))
    for i in range(3):
        rows[5 * n + i, i] = 1.0
    flat, points = rows.reshape(size, 3 * m), y.reshape(3, m)
    mu, growth, cost = damping, 2.0, np.inf
    H, g, trial, d = both[:p, :p].copy(), both[p, :p].copy(), at, np.zeros(p)
    for iteration in range(cap + 1):
        after = walk(trial, cq, sq, points, rows, origin)
        if not np.isfinite(after) and (damping == 0.0 or iteration == 0):
            return iteration, after, FAILED
        accept = damping == 0.0 or iteration == 0 or after < cost
        if damping != 0.0 and iteration > 0:
            gain = (cost - after) / float(d @ (mu * d + g)) if accept else 0.0
            if damping > 0.0:
                mu = mu / by if accept else mu * by
            elif accept:
                mu, growth = mu * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
            else:
                mu, growth = mu * growth, 2.0 * growth
            if mu > MOST_DAMPING:
                return iteration, cost, FAILED
        if accept:
            at, cost = trial, after
            turns(points, rows, origin)
            gram(flat, both)
            H[:], g[:] = both[:p, :p], both[p, :p]
            if iteration == 0 and damping < 0.0:
                mu = -damping * float(np.diag(H).max())
        if iteration < course.size:
            course[iteration] = cost
        if iteration == cap:
            break
        if not np.isfinite(H.sum()):
            return iteration, cost, FAILED
        if mu > p * ROUNDING * np.diag(H).max():
            d = solved(H, mu, g)
        elif mu > 0.0:
            d = least_step(H + mu * np.eye(p), g)
        else:
            d = least_step(H, g)
        if np.sqrt(d @ d) <= small:
            return iteration + 1, cost, CONVERGED
        trial = at + d
    return cap, cost, LIMIT
