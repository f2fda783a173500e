"""Paper S's Algorithms 1 and 2 to the letter: all parameters, Euler angles, and pseudo-inverses.

The library frees only identifiable parameters and works on normal equations; this is the papers'
way, written for itself, without a line of the library.  Where numba is installed it is compiled
(pip install 'minimax-cal[fast]'), which makes it several times as fast; the results agree.

The parameters, `at`: (5n + 9,), are all a, d, theta, alpha, beta, then the base X_b, Y_b, Z_b, Phi,
Theta, Psi, then the target.  Lengths are in the unit of y, and that unit matters: (J'J + mu I) adds
the same mu to square radians and to square lengths, and a least step is the least in these units.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from minimax_cal.core.arrays import Array

F = TypeVar("F", bound=Callable[..., Any])
MACHINE_EPSILON = float(np.finfo(float).eps)
ENDED_AT_ITERATION_LIMIT, ENDED_CONVERGED, ENDED_FAILED = 0, 1, 2  # how an iteration ended
MAX_LETTER_DAMPING = 1e30
LOOPS_ENVIRONMENT_VARIABLE = (
    "MINIMAX_CAL_LOOPS"  # plain in the environment: short ways end before they were compiled
)


def compile_if_numba_available(function: F) -> F:
    """The function compiled by numba where that is installed, unless the environment forbids it."""
    if os.environ.get(LOOPS_ENVIRONMENT_VARIABLE) == "plain":
        return function
    try:
        from numba import njit
    except ImportError:
        return function
    return cast(F, njit(cache=True)(function))


@compile_if_numba_available
def rotate_axis_pair(u: Array, v: Array, angle: Any) -> tuple[Array, Array]:
    """Axes u, v (3, m) turned towards each other by an angle, one or (m,) of them."""
    c, s = np.cos(angle), np.sin(angle)
    return c * u + s * v, c * v - s * u


@compile_if_numba_available
def cross_products(u: Array, v: Array) -> Array:
    """u x v: (k, 3, m)."""
    out = np.empty_like(u)
    out[:, 0] = u[:, 1] * v[:, 2] - u[:, 2] * v[:, 1]
    out[:, 1] = u[:, 2] * v[:, 0] - u[:, 0] * v[:, 2]
    out[:, 2] = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return out


@compile_if_numba_available
def arm_points_and_axes(at: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    """Points (3, m), and what moves them [paper S, eq. 1-16].

    q: (m, n).  Returns also, for a, d, base and target, the directions g (2n + 6, 3, m) with
    points = sum g r; and for theta, alpha, beta, Phi, Theta, Psi the axes and a point on each
    (3n + 3, 3, m).
    """
    m, n = q.shape
    length = np.zeros((2 * n + 6, 3, m))
    axis, pivot = np.zeros((3 * n + 3, 3, m)), np.zeros((3 * n + 3, 3, m))
    ex, ey, ez, origin = np.zeros((3, m)), np.zeros((3, m)), np.zeros((3, m)), np.zeros((3, m))
    ex[0], ey[1], ez[2] = 1.0, 1.0, 1.0
    for k in range(3):
        length[2 * n + k, k] = 1.0
        origin[k] = at[5 * n + k]
    pivot[3 * n :] = origin
    axis[3 * n] = ez
    ex, ey = rotate_axis_pair(ex, ey, at[5 * n + 3])
    axis[3 * n + 1] = ey
    ez, ex = rotate_axis_pair(ez, ex, at[5 * n + 4])
    axis[3 * n + 2] = ex
    ey, ez = rotate_axis_pair(ey, ez, at[5 * n + 5])
    for i in range(n):
        length[n + i], axis[i], pivot[i] = ez, ez, origin
        ex, ey = rotate_axis_pair(ex, ey, q[:, i] + at[2 * n + i])
        length[i], axis[n + i] = ex, ex
        origin = origin + at[i] * ex + at[n + i] * ez
        pivot[n + i], pivot[2 * n + i] = origin, origin
        ey, ez = rotate_axis_pair(ey, ez, at[3 * n + i])
        axis[2 * n + i] = ey
        ez, ex = rotate_axis_pair(ez, ex, at[4 * n + i])
    length[2 * n + 3], length[2 * n + 4], length[2 * n + 5] = ex, ey, ez
    x = origin + at[5 * n + 6] * ex + at[5 * n + 7] * ey + at[5 * n + 8] * ez
    return x, length, axis, pivot


@compile_if_numba_available
def joint_jacobian_and_error(at: Array, q: Array, y: Array) -> tuple[Array, Array]:
    """The transposed Jacobian (5n + 9, 3m) of all parameters, and the error (3m,) [Algorithm 2]."""
    m, n = q.shape
    x, length, axis, pivot = arm_points_and_axes(at, q)
    swung = cross_products(axis, x - pivot)
    rows = np.empty((5 * n + 9, 3, m))
    rows[: 2 * n], rows[2 * n : 5 * n] = length[: 2 * n], swung[: 3 * n]
    rows[5 * n : 5 * n + 3], rows[5 * n + 3 : 5 * n + 6] = length[2 * n : 2 * n + 3], swung[3 * n :]
    rows[5 * n + 6 :] = length[2 * n + 3 :]
    return rows.reshape(5 * n + 9, 3 * m), y - x.reshape(3 * m)


@compile_if_numba_available
def separable_jacobian_and_error(at: Array, q: Array, y: Array) -> tuple[Array, Array, Array]:
    """The best lengths, -J transposed (3n + 3, 3m) in the angles, and c (3m,) [eq. 18, 19, 24].

    J = -P DG G+ y - (P DG G+)' y, the second term by (G+)' (DG' c) with c = P y.
    """
    m, n = q.shape
    _, length, axis, _ = arm_points_and_axes(at, q)
    G = length.reshape(2 * n + 6, 3 * m)
    u, s, v = np.linalg.svd(G, False)
    rank = np.sum(s > 3 * m * MACHINE_EPSILON * s[0])  # the usual tolerance of a pseudo-inverse
    left = np.ascontiguousarray(u[:, :rank] / s[:rank])
    v = np.ascontiguousarray(v[:rank])
    r = left @ (v @ y)
    best = at.copy()
    best[: 2 * n], best[5 * n : 5 * n + 3] = r[: 2 * n], r[2 * n : 2 * n + 3]
    best[5 * n + 6 :] = r[2 * n + 3 :]
    x, length, axis, pivot = arm_points_and_axes(best, q)
    c = y - x.reshape(3 * m)
    moved = cross_products(axis, x - pivot).reshape(3 * n + 3, 3 * m)  # DG G+ y
    pulled = cross_products(np.zeros_like(axis) + c.reshape(3, m), axis)
    coupling = G @ pulled.reshape(3 * n + 3, 3 * m).T  # DG' c where the angle moves the length
    for k in range(3 * n):
        i = k % n
        first = i if k < n else i + 1  # theta_i turns a_i, the others of a joint come after it
        coupling[:first, k], coupling[n : n + first, k] = 0.0, 0.0
    coupling[2 * n : 2 * n + 3] = 0.0
    return best, moved - (moved @ v.T) @ v + (coupling.T @ left) @ v, c


@compile_if_numba_available
def pseudo_inverse_step(H: Array, g: Array) -> Array:
    """H+ g of a positive semi-definite H, by H = L L' with as many columns as H has rank.

    Then H+ = L (L'L)^-2 L': several times as fast as an eigenvalue decomposition.  The rank ends
    at the usual tolerance of a pseudo-inverse.
    """
    p = len(g)
    L, left = np.zeros((p, p)), np.diag(H).copy()
    largest, rank = left.max(), p
    for r in range(p):
        k = np.argmax(left)
        if left[k] <= p * MACHINE_EPSILON * largest:
            rank = r
            break
        L[:, r] = (H[k] - L @ L[k]) / np.sqrt(left[k])
        left = left - L[:, r] ** 2
        left[k] = 0.0
    L = np.ascontiguousarray(L[:, :rank])
    M = L.T @ L
    return L @ np.linalg.solve(M, np.linalg.solve(M, L.T @ g))


@compile_if_numba_available
def damped_pseudo_inverse_step(H: Array, g: Array, mu: float) -> Array:
    """(H + mu I)+ g [eq. 22, 23]."""
    if mu <= len(g) * MACHINE_EPSILON * np.diag(H).max():
        return pseudo_inverse_step(H + mu * np.eye(len(g)), g)
    return np.linalg.solve(H + mu * np.eye(len(g)), g)


@compile_if_numba_available
def iterate_to_the_letter(
    at: Array, q: Array, y: Array, separable: bool, damping: float, by: float, small: float,
    cap: int, course: Array,
) -> tuple[int, float, int]:  # fmt: skip
    """Iterate from one start; returns the iterations, the cost at the end, and how it ended.

    damping: 0 for Gauss-Newton; below 0 for Nielsen's rule with that share of the largest diagonal
    entry first; above 0 for Marquardt's, which multiplies or divides it by `by`.
    small: length of a step at which it has converged.  course: takes the cost of each iterate.
    """
    n = q.shape[1]
    mu, growth = damping, 2.0
    cost: Any = np.inf
    H: Array = np.zeros((1, 1))
    g, trial, d = y, at, np.zeros(0)
    for iteration in range(cap + 1):
        if separable:
            best, J, e = separable_jacobian_and_error(trial, q, y)
        else:
            best = trial
            J, e = joint_jacobian_and_error(trial, q, y)
        after: Any = e @ e
        if not np.isfinite(after) and (damping == 0.0 or iteration == 0):
            return iteration, after, ENDED_FAILED
        accept = damping == 0.0 or iteration == 0 or after < cost
        if damping != 0.0 and iteration > 0:
            gain = (cost - after) / (d @ (mu * d + g)) if accept else 0.0
            if damping > 0.0:
                mu = mu / by if accept else mu * by
            elif accept:
                mu, growth = mu * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
            else:
                mu, growth = mu * growth, 2.0 * growth
            if mu > MAX_LETTER_DAMPING:
                return iteration, cost, ENDED_FAILED
        if accept:
            at, cost = best, after
            H, g = J @ J.T, J @ e
            if iteration == 0 and damping < 0.0:
                mu = -damping * np.diag(H).max()
        if iteration < course.size:
            course[iteration] = cost
        if iteration == cap:
            break
        if not np.isfinite(H.sum()):
            return iteration, cost, ENDED_FAILED
        d = damped_pseudo_inverse_step(H, g, mu)
        if np.sqrt(d @ d) <= small:
            return iteration + 1, cost, ENDED_CONVERGED
        trial = at.copy()
        if separable:
            trial[2 * n : 5 * n] += d[: 3 * n]
            trial[5 * n + 3 : 5 * n + 6] += d[3 * n :]
        else:
            trial += d
    return cap, cost, ENDED_AT_ITERATION_LIMIT
