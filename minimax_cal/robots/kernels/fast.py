"""The kernels compiled by numba: the names, arguments and results of `plain`.

A kernel that calls another one compiles it once more: `sums` calls the large ones in turn.  Loops
on single numbers compile several times as fast as what NumPy does to whole arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np
from numba import njit

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.kernels.plain import (
    FIRST,
    PIVOT,
    ROUNDS,
    STILL,
    STUCK,
    TRUST,
)

BLOCK = 384  # points, in all robots: their Jacobian then fits the second-level cache

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function compiled when it is first called, and kept on disk; sums in any order."""
    quick: Callable[P, R] = njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})(
        function
    )
    return quick


@compiled
def chain(mdh: Array, q: Array, prismatic: Array) -> tuple[Array, Array, Array, Array, Array]:
    """See `plain.chain`."""
    B, n, m = len(mdh), mdh.shape[1], len(q)
    x, y, z = np.empty((B, n, 3, m)), np.empty((B, n, 3, m)), np.empty((B, n, 3, m))
    after, axes = np.empty((B, n, 3, m)), np.zeros((B, 3, 3, m))
    for b in range(B):
        ex, ey, ez = axes[b, 0], axes[b, 1], axes[b, 2]
        ex[0], ey[1], ez[2] = 1.0, 1.0, 1.0
        for j in range(n):
            a, d, theta, alpha, beta = mdh[b, j]
            ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
            for r in range(m):
                turn, slide = theta, d
                if prismatic[j]:
                    slide += q[r, j]
                else:
                    turn += q[r, j]
                c, s = np.cos(turn), np.sin(turn)
                for i in range(3):
                    u = c * ex[i, r] + s * ey[i, r]
                    v = c * ey[i, r] - s * ex[i, r]
                    w = ez[i, r]
                    x[b, j, i, r], z[b, j, i, r] = u, w
                    start = after[b, j - 1, i, r] if j else 0.0
                    after[b, j, i, r] = start + (a * u + slide * w)
                    bent = ca * v + sa * w
                    y[b, j, i, r] = bent
                    w = ca * w - sa * v
                    ex[i, r], ey[i, r], ez[i, r] = cb * u - sb * w, bent, cb * w + sb * u
    return x, y, z, after, axes


@compiled
def unwound(mdh: Array, q: Array, prismatic: Array, lo: int, hi: int) -> Array:
    """See `plain.unwound`."""
    B, n, c = len(mdh), mdh.shape[1], hi - lo
    out = np.empty((B, 8 * n + 4, 3, c))
    for b in range(B):
        for row in range(4):
            for i in range(3):
                for r in range(c):
                    out[b, 4 * n + row, i, r] = 1.0 if i == row else 0.0
        for j in range(n - 1, -1, -1):
            a, d, theta, alpha, beta = mdh[b, j]
            ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
            own, here, beyond = 4 * (n + 1 + j), 4 * j, 4 * (j + 1)
            for r in range(c):
                turn, slide = theta, d
                if prismatic[j]:
                    slide += q[lo + r, j]
                else:
                    turn += q[lo + r, j]
                cos, sin = np.cos(turn), np.sin(turn)
                for i in range(3):
                    x, y = out[b, beyond, i, r], out[b, beyond + 1, i, r]
                    z = out[b, beyond + 2, i, r]
                    u, bent = cb * x + sb * z, cb * z - sb * x
                    v, w = ca * y - sa * bent, ca * bent + sa * y
                    way = a * u + slide * w
                    out[b, own, i, r], out[b, own + 1, i, r] = u, v
                    out[b, own + 2, i, r], out[b, own + 3, i, r] = w, way
                    out[b, here, i, r] = cos * u - sin * v
                    out[b, here + 1, i, r] = cos * v + sin * u
                    out[b, here + 2, i, r] = w
                    out[b, here + 3, i, r] = out[b, beyond + 3, i, r] - way
    return out


@compiled
def sighted(
    arm: Array, rotation: Array, origin: Array, targets: Array, effects: Array, y: Array,
    weight: Array, fields: Array, moved: Array, lo: int,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """See `plain.sighted`."""
    B, c, k = len(arm), arm.shape[3], len(y)
    some = 1 if len(fields) + len(moved) else 0
    error, swung, root = np.empty((B, k, 3, c)), np.empty((B * some, k, 3, c)), np.empty((k, c))
    for t in range(k):
        for r in range(c):
            root[t, r] = np.sqrt(weight[t, lo + r])
    seen = np.empty(3)
    for b in range(B):
        for t in range(k):
            for r in range(c):
                u = y[t, 0, lo + r] - origin[b, 0]
                v = y[t, 1, lo + r] - origin[b, 1]
                w = y[t, 2, lo + r] - origin[b, 2]
                for j in range(3):
                    seen[j] = rotation[b, 0, j] * u + rotation[b, 1, j] * v + rotation[b, 2, j] * w
                    if some:
                        shift = moved[t, j, lo + r] if len(moved) else 0.0
                        for e in range(len(fields)):
                            shift += effects[b, e] * fields[e, t, j, lo + r]
                        seen[j] -= shift
                        for i in range(3):
                            before = swung[b, t, i, r] if j else 0.0
                            swung[b, t, i, r] = before + arm[b, j, i, r] * shift
                for i in range(3):
                    total = arm[b, 3, i, r] - targets[b, t, i]
                    for j in range(3):
                        total += arm[b, j, i, r] * seen[j]
                    error[b, t, i, r] = root[t, r] * total
    return error, swung, root


@compiled
def sensed(
    arm: Array, axis: Array, point: Array, targets: Array, swung: Array, root: Array, fields: Array
) -> Array:  # fmt: skip
    """See `plain.sensed`."""
    B, c, k, s = len(arm), arm.shape[3], targets.shape[1], len(axis)
    out = np.empty((B, k, s + len(fields), 3, c))
    for b in range(B):
        for t in range(k):
            for row in range(s):
                at, about, along = point[row], axis[row], len(swung) > 0 and axis[row] < 3
                for i in range(3):
                    u, v = (i + 1) % 3, (i + 2) % 3
                    for r in range(c):
                        move = arm[b, about, i, r]
                        if at >= 0:
                            p = targets[b, t, u] - arm[b, at, u, r]
                            q = targets[b, t, v] - arm[b, at, v, r]
                            if along:  # the base takes along what effects have moved
                                p += swung[b, t, u, r]
                                q += swung[b, t, v, r]
                            move = arm[b, about, u, r] * q - arm[b, about, v, r] * p
                        out[b, t, row, i, r] = root[t, r] * move
            for e in range(len(fields)):
                for i in range(3):
                    for r in range(c):
                        total = 0.0
                        for j in range(3):
                            total += arm[b, j, i, r] * fields[e, t, j, r]
                        out[b, t, s + e, i, r] = root[t, r] * total
    return out


@compiled
def products(rows: Array, out: Array) -> None:
    """Write rows rows' (h, h), its lower half: two by two, which loads half as often."""
    h = len(rows)
    for i in range(0, h, 2):
        k = min(i + 1, h - 1)
        for j in range(0, i + 1, 2):
            m = min(j + 1, h - 1)
            ij, im, kj, km = 0.0, 0.0, 0.0, 0.0
            for r in range(rows.shape[1]):
                ij += rows[i, r] * rows[j, r]
                im += rows[i, r] * rows[m, r]
                kj += rows[k, r] * rows[j, r]
                km += rows[k, r] * rows[m, r]
            out[i, j], out[i, m], out[k, j], out[k, m] = ij, im, kj, km


@compiled
def summed(
    error: Array, J: Array, root: Array, which: Array, s: int, end: int, first: int, cost: Array,
    gradient: Array, gram: Array,
) -> None:  # fmt: skip
    """See `plain.summed`."""
    (B, k, h, c3), c = J.shape, root.shape[1]
    both = np.empty((h, h))
    for b in range(B):
        for t in range(k):
            total, square = 0.0, 0.0
            for r in range(c3):
                total += error[b, t, r] * error[b, t, r]
            for r in range(c):
                square += root[t, r] * root[t, r]
            cost[b, t] += total
            products(J[b, t], both)
            for i in range(h):
                to, pull = i if i < s else i - s + end, 0.0
                for r in range(c3):
                    pull += J[b, t, i, r] * error[b, t, r]
                gradient[b, t, to] += pull
                for j in range(h):
                    gram[b, t, to, j if j < s else j - s + end] += both[max(i, j), min(i, j)]
            for row in range(s, end):
                axis = which[row] - first - 3 * t
                if 0 <= axis < 3:
                    gram[b, t, row, row] += square
                    pull = 0.0
                    for r in range(c):
                        pull += error[b, t, axis * c + r] * root[t, r]
                    gradient[b, t, row] += pull
                    for i in range(h):
                        to, side = i if i < s else i - s + end, 0.0
                        for r in range(c):
                            side += J[b, t, i, axis * c + r] * root[t, r]
                        gram[b, t, row, to] += side
                        gram[b, t, to, row] += side


@compiled
def squared(
    error: Array, J: Array, root: Array, which: Array, s: int, end: int, first: int
) -> tuple[Array, Array]:
    """See `plain.squared`."""
    k, h, _, c = J.shape
    square, slope = np.empty((k, c)), np.zeros((k, c, len(which)))
    for t in range(k):
        for r in range(c):
            u, v, w = error[t, 0, r], error[t, 1, r], error[t, 2, r]
            square[t, r] = u * u + v * v + w * w
            for i in range(h):
                to = i if i < s else i - s + end
                pull = u * J[t, i, 0, r] + v * J[t, i, 1, r] + w * J[t, i, 2, r]
                slope[t, r, to] = -2.0 * pull
            for row in range(s, end):
                axis = which[row] - first - 3 * t
                if 0 <= axis < 3:
                    slope[t, r, row] = -2.0 * root[t, r] * error[t, axis, r]
    return square, slope


@compiled
def cholesky(matrix: Array, right: Array, x: Array) -> bool:
    """Write x (p,) of matrix x = right; False where the matrix (p, p) is not definite enough."""
    p = len(right)
    scale, L = np.empty(p), np.empty((p, p))
    for i in range(p):
        scale[i] = 1.0 / np.sqrt(max(matrix[i, i], 1e-300))
        x[i] = 0.0
    for i in range(p):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for c in range(j):
                total -= L[i, c] * L[j, c]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > PIVOT:
                L[i, i] = np.sqrt(total)
            else:
                return False
    for i in range(p):
        x[i] = right[i] * scale[i]
        for c in range(i):
            x[i] -= L[i, c] * x[c]
        x[i] /= L[i, i]
    for i in range(p - 1, -1, -1):
        x[i] /= L[i, i]
        for c in range(i):
            x[c] -= L[i, c] * x[i]
    for i in range(p):
        x[i] *= scale[i]
    return True


@compiled
def solved(
    cost: Array, gradient: Array, gram: Array, off: Array, hold: Array
) -> tuple[Array, float, float, bool]:
    """See `plain.solved`."""
    p, before, gain = len(off), 0.0, 0.0
    matrix, slope, dx = np.zeros((p, p)), np.empty(p), np.empty(p)
    for t in range(cost.shape[1]):
        before += cost[0, t]
    for i in range(p):
        slope[i] = hold[i] * off[i]
        before += slope[i] * off[i]
        for t in range(cost.shape[1]):
            slope[i] += gradient[0, t, i]
            for j in range(p):
                matrix[i, j] += gram[0, t, i, j]
        matrix[i, i] += hold[i]
    definite = cholesky(matrix, slope, dx)
    for i in range(p):
        gain += dx[i] * slope[i]
    return dx, before, gain, definite


@compiled
def turned(S: Array, w: Array, out: Array) -> None:
    """Write a rotation S (3, 3) times that by a vector w (3,), see `plain.turned`."""
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    if square > 1e-8:
        angle = np.sqrt(square)
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    for i in range(3):
        along = S[i, 0] * w[0] + S[i, 1] * w[1] + S[i, 2] * w[2]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            aside = S[i, k] * w[m] - S[i, m] * w[k]
            out[i, j] = (1.0 - second * square) * S[i, j] + first * aside + second * along * w[j]


@compiled
def stepped(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, which: Array,
    dx: Array,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """See `plain.stepped`."""
    n, k = mdh.shape[1], targets.shape[1]
    mdh, origin, targets, effects = mdh.copy(), origin.copy(), targets.copy(), effects.copy()
    w, after = np.zeros(3), np.empty((1, 3, 3))
    for row in range(len(which)):
        at, move = which[row], dx[row]
        if at < 5 * n:
            mdh[0, at % n, at // n] += move
        elif at < 5 * n + 3:
            for i in range(3):
                origin[0, i] += rotation[0, i, at - 5 * n] * move
        elif at < 5 * n + 6:
            w[at - 5 * n - 3] = move
        elif at < 5 * n + 6 + 3 * k:
            targets[0, (at - 5 * n - 6) // 3, (at - 5 * n - 6) % 3] += move
        else:
            effects[0, at - 5 * n - 6 - 3 * k] += move
    turned(rotation[0], w, after[0])
    return mdh, after, origin, targets, effects


@compiled
def misfit(matrix: Array, right: Array, S: Array, error: Array) -> float:
    """The cost of `polish` at a rotation; writes the residuals (r,)."""
    cost = 0.0
    for r in range(len(right)):
        total = 0.0
        for a in range(3):
            for b in range(3):
                total += matrix[r, 3 * a + b] * S[a, b]
        error[r] = total - right[r]
        cost += error[r] * error[r]
    return cost


@compiled
def slopes(matrix: Array, S: Array, error: Array, gram: Array, pull: Array) -> None:
    """Write gram (3, 3) and slope (3,) of the cost of `polish` for turns about S's own axes."""
    row = np.empty(3)
    for i in range(3):
        pull[i] = 0.0
        for j in range(3):
            gram[i, j] = 0.0
    for r in range(len(error)):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            row[i] = 0.0
            for a in range(3):
                row[i] += matrix[r, 3 * a + j] * S[a, k] - matrix[r, 3 * a + k] * S[a, j]
        for i in range(3):
            pull[i] -= row[i] * error[r]
            for j in range(3):
                gram[i, j] += row[i] * row[j]


@compiled
def polish(matrix: Array, right: Array, starts: Array) -> tuple[Array, Array]:
    """See `plain.polish`."""
    turns, costs = starts.copy(), np.empty(len(starts))
    error, gram, pull, step = np.empty(len(right)), np.empty((3, 3)), np.empty(3), np.empty(3)
    trial = np.empty((3, 3))
    for s in range(len(starts)):
        at, damping = turns[s], FIRST
        cost = misfit(matrix, right, at, error)
        for _ in range(ROUNDS):
            slopes(matrix, at, error, gram, pull)
            more = damping * (gram[0, 0] + gram[1, 1] + gram[2, 2] + 1e-300)
            for i in range(3):
                gram[i, i] += more
            cholesky(gram, pull, step)
            turned(at, step, trial)
            new = misfit(matrix, right, trial, error)
            gain = pull[0] * step[0] + pull[1] * step[1] + pull[2] * step[2]
            if new < cost or gain <= TRUST * cost:
                cost, damping = new, 0.1 * damping
                for i in range(3):
                    for j in range(3):
                        at[i, j] = trial[i, j]
            else:
                damping *= 4.0
                misfit(matrix, right, at, error)
            still = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
            if still <= STILL**2 or damping > STUCK:
                break
        costs[s] = cost
    return turns, costs
