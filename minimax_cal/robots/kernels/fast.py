"""The kernels compiled by numba: the names, arguments and results of `plain`.

A column of the normal equations is a screw (V, W) of the pose, which moves a target t of the flange
by V + W x t.  Poses go in blocks that fit the cache; inside, loops run along the poses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np
from numba import njit

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.kernels.plain import FIRST, PIVOT, RISE, ROUNDS, STILL, STUCK, TRUST

BLOCK = 128  # poses: the Jacobian of one target then fits the second-level cache

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function compiled when it is first called, and kept on disk."""
    quick: Callable[P, R] = njit(cache=True)(function)
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
def points(axes: Array, origin: Array, targets: Array) -> Array:
    """See `plain.points`."""
    B, k, m = len(axes), targets.shape[1], axes.shape[3]
    out = np.empty((B, k, 3, m))
    for b in range(B):
        for t in range(k):
            u, v, w = targets[b, t]
            for i in range(3):
                for r in range(m):
                    turned = u * axes[b, 0, i, r] + v * axes[b, 1, i, r] + w * axes[b, 2, i, r]
                    out[b, t, i, r] = turned + origin[b, i, r]
    return out


@compiled
def screw(V: Array, W: Array, axis: Array, origin: Array) -> None:
    """Write the screw of a turn about an axis (3, c) through a point (3, c)."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for r in range(axis.shape[1]):
            W[i, r] = axis[i, r]
            V[i, r] = origin[j, r] * axis[k, r] - origin[k, r] * axis[j, r]


@compiled
def swing(c: float, s: float, u: Array, v: Array) -> None:
    """Turn two axes (3, m) into c u + s v and c v - s u, in place."""
    for i in range(3):
        for r in range(u.shape[1]):
            first = c * u[i, r] + s * v[i, r]
            v[i, r] = c * v[i, r] - s * u[i, r]
            u[i, r] = first


@compiled
def unwound(
    mdh: Array, q: Array, prismatic: Array, slot: Array, V: Array, W: Array
) -> tuple[Array, Array]:
    """Axes (3, 3, c) and origin (3, c) of the base in the flange; fills the screws V, W.

    mdh: (n, 5).  q: (c, n).  slot: (5n + 6,) row of each parameter in V and W (s, 3, c), or -1.
    """
    c, n = q.shape
    axes, o = np.zeros((3, 3, c)), np.zeros((3, c))
    x, y, z = axes[0], axes[1], axes[2]
    x[0], y[1], z[2] = 1.0, 1.0, 1.0
    for j in range(n - 1, -1, -1):
        a, d, theta, alpha, beta = mdh[j]
        if slot[4 * n + j] >= 0:
            screw(V[slot[4 * n + j]], W[slot[4 * n + j]], y, o)
        if beta != 0.0:
            swing(np.cos(beta), np.sin(beta), x, z)
        if slot[3 * n + j] >= 0:
            screw(V[slot[3 * n + j]], W[slot[3 * n + j]], x, o)
        if slot[j] >= 0:
            V[slot[j]] = x
        if alpha != 0.0:
            swing(np.cos(alpha), -np.sin(alpha), y, z)
        if slot[n + j] >= 0:
            V[slot[n + j]] = z
        for r in range(c):
            slide = d + q[r, j] if prismatic[j] else d
            for i in range(3):
                o[i, r] -= a * x[i, r] + slide * z[i, r]
        if slot[2 * n + j] >= 0:
            screw(V[slot[2 * n + j]], W[slot[2 * n + j]], z, o)
        for r in range(c):
            turn = theta if prismatic[j] else theta + q[r, j]
            cos, sin = np.cos(turn), np.sin(turn)
            for i in range(3):
                first = cos * x[i, r] - sin * y[i, r]
                y[i, r] = cos * y[i, r] + sin * x[i, r]
                x[i, r] = first
    for i in range(3):
        if slot[5 * n + i] >= 0:
            V[slot[5 * n + i]] = axes[i]
        if slot[5 * n + 3 + i] >= 0:
            screw(V[slot[5 * n + 3 + i]], W[slot[5 * n + 3 + i]], axes[i], o)
    return axes, o


@compiled
def sighted(
    axes: Array, o: Array, rotation: Array, origin: Array, spot: Array, y: Array, root: Array,
    shift: Array, error: Array, swung: Array,
) -> None:  # fmt: skip
    """Write the weighted error (3, c) of one target and its shift (3, c), both in the flange.

    shift: (3, c) by which effects move it, in base axes.
    """
    for r in range(y.shape[1]):
        u, v, w = y[0, r] - origin[0], y[1, r] - origin[1], y[2, r] - origin[2]
        for i in range(3):
            error[i, r], swung[i, r] = o[i, r] - spot[i], 0.0
        for j in range(3):
            seen = rotation[0, j] * u + rotation[1, j] * v + rotation[2, j] * w
            for i in range(3):
                error[i, r] += axes[j, i, r] * (seen - shift[j, r])
                swung[i, r] += axes[j, i, r] * shift[j, r]
        for i in range(3):
            error[i, r] *= root[r]


@compiled
def shifted(effects: Array, fields: Array, moved: Array, t: int, lo: int, hi: int) -> Array:
    """(3, c) by which effects move target t at the poses lo to hi, in base axes."""
    out = np.zeros((3, hi - lo))
    if len(moved):
        out += moved[t, :, lo:hi]
    for e in range(len(fields)):
        out += effects[e] * fields[e, t, :, lo:hi]
    return out


@compiled
def cost(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array,
) -> Array:  # fmt: skip
    """See `plain.cost`."""
    B, n, k, m = len(mdh), mdh.shape[1], len(y), len(q)
    out = np.zeros((B, k))
    slot, none = np.full(5 * n + 6, -1), np.zeros((0, 3, 0))
    for b in range(B):
        for lo in range(0, m, BLOCK):
            hi = min(lo + BLOCK, m)
            axes, o = unwound(mdh[b], q[lo:hi], prismatic, slot, none, none)
            error, swung = np.empty((3, hi - lo)), np.empty((3, hi - lo))
            for t in range(k):
                shift = shifted(effects[b], fields, moved, t, lo, hi)
                root = np.sqrt(weight[t, lo:hi])
                sighted(axes, o, rotation[b], origin[b], targets[b, t], y[t, :, lo:hi], root,
                        shift, error, swung)  # fmt: skip
                out[b, t] += np.sum(error * error)
    return out


@compiled
def sensed(
    J: Array, V: Array, W: Array, spot: Array, root: Array, turns: Array, swung: Array, axes: Array,
    fields: Array, chosen: Array, t: int, lo: int,
) -> None:  # fmt: skip
    """Write the weighted rows J (s + e, 3, c) of one target: screws, then effects.

    turns: (3,) rows of the base's turns, which take along what effects have moved, or -1.
    """
    s, c = len(V), J.shape[2]
    for row in range(s):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for r in range(c):
                swing = W[row, j, r] * spot[k] - W[row, k, r] * spot[j]
                J[row, i, r] = root[r] * (V[row, i, r] + swing)
    if len(fields):
        for row in turns:
            if row >= 0:
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    for r in range(c):
                        more = W[row, j, r] * swung[k, r] - W[row, k, r] * swung[j, r]
                        J[row, i, r] += root[r] * more
    for e in range(len(chosen)):
        for i in range(3):
            for r in range(c):
                total = 0.0
                for j in range(3):
                    total += axes[j, i, r] * fields[chosen[e], t, j, lo + r]
                J[s + e, i, r] = root[r] * total


@compiled
def normal(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """See `plain.normal`."""
    B, n, k, m, p = len(mdh), mdh.shape[1], len(y), len(q), len(which)
    cost, gradient, gram = np.zeros((B, k)), np.zeros((B, k, p)), np.zeros((B, k, p, p))
    first, last = 5 * n + 6, 5 * n + 6 + 3 * k
    slot = np.full(first, -1)
    s = int(np.searchsorted(which, first))  # screws, then targets, then effects
    slot[which[:s]] = np.arange(s)
    end = int(np.searchsorted(which, last))
    chosen = which[end:] - last
    held = np.concatenate((np.arange(s), np.arange(end, p)))  # columns that all targets share
    for b in range(B):
        for lo in range(0, m, BLOCK):
            hi = min(lo + BLOCK, m)
            c = hi - lo
            V, W = np.zeros((s, 3, c)), np.zeros((s, 3, c))
            axes, o = unwound(mdh[b], q[lo:hi], prismatic, slot, V, W)
            J, error, swung = np.empty((len(held), 3, c)), np.empty((3, c)), np.empty((3, c))
            flat, line = J.reshape(len(held), 3 * c), J.reshape(3 * len(held), c)
            for t in range(k):
                spot, root = targets[b, t], np.sqrt(weight[t, lo:hi])
                shift = shifted(effects[b], fields, moved, t, lo, hi)
                sighted(axes, o, rotation[b], origin[b], spot, y[t, :, lo:hi], root, shift, error,
                        swung)  # fmt: skip
                sensed(J, V, W, spot, root, slot[5 * n + 3 :], swung, axes, fields, chosen, t, lo)
                cost[b, t] += np.sum(error * error)
                both, pull = flat @ flat.T, flat @ error.reshape(3 * c)
                side, own = (line @ root).reshape(len(held), 3), error @ root
                for i in range(len(held)):
                    gradient[b, t, held[i]] += pull[i]
                    for j in range(len(held)):
                        gram[b, t, held[i], held[j]] += both[i, j]
                total = np.sum(root * root)
                for row in range(s, end):
                    axis = which[row] - first - 3 * t
                    if 0 <= axis < 3:
                        gradient[b, t, row] += own[axis]
                        gram[b, t, row, row] += total
                        for i in range(len(held)):
                            gram[b, t, row, held[i]] += side[i, axis]
                            gram[b, t, held[i], row] += side[i, axis]
    return cost, gradient, gram


@compiled
def rows(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array, lo: int,
    hi: int,
) -> tuple[Array, Array]:  # fmt: skip
    """See `plain.rows`."""
    n, k, p, c = mdh.shape[1], len(y), len(which), hi - lo
    first, last = 5 * n + 6, 5 * n + 6 + 3 * k
    slot = np.full(first, -1)
    s, end = int(np.searchsorted(which, first)), int(np.searchsorted(which, last))
    slot[which[:s]] = np.arange(s)
    chosen = which[end:] - last
    V, W = np.zeros((s, 3, c)), np.zeros((s, 3, c))
    axes, o = unwound(mdh[0], q[lo:hi], prismatic, slot, V, W)
    error, out = np.empty((k, 3, c)), np.zeros((k, p, 3, c))
    J, swung = np.empty((s + p - end, 3, c)), np.empty((3, c))
    for t in range(k):
        spot, root = targets[0, t], np.sqrt(weight[t, lo:hi])
        shift = shifted(effects[0], fields, moved, t, lo, hi)
        sighted(axes, o, rotation[0], origin[0], spot, y[t, :, lo:hi], root, shift, error[t],
                swung)  # fmt: skip
        sensed(J, V, W, spot, root, slot[5 * n + 3 :], swung, axes, fields, chosen, t, lo)
        out[t, :s], out[t, end:] = J[:s], J[s:]
        for row in range(s, end):
            axis = which[row] - first - 3 * t
            if 0 <= axis < 3:
                out[t, row, axis] = root
    return error, out


@compiled
def squares(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """See `plain.squares`."""
    k, m, p = len(y), len(q), len(which)
    f, slope = np.zeros((k, m)), np.zeros((k, m, p))
    for lo in range(0, m, BLOCK):
        hi = min(lo + BLOCK, m)
        error, J = rows(mdh, rotation, origin, targets, effects, q, prismatic, y, weight, fields,
                        moved, which, lo, hi)  # fmt: skip
        for t in range(k):
            for i in range(3):
                for r in range(hi - lo):
                    f[t, lo + r] += error[t, i, r] ** 2
                for row in range(p):
                    for r in range(hi - lo):
                        slope[t, lo + r, row] -= 2.0 * J[t, row, i, r] * error[t, i, r]
    return f, slope


@compiled
def solved(matrix: Array, right: Array) -> tuple[Array, bool]:
    """x (p,) of matrix x = right by Cholesky, and whether the matrix (p, p) was definite enough."""
    p = len(right)
    scale, L, x = np.empty(p), np.empty((p, p)), np.empty(p)
    for i in range(p):
        scale[i] = 1.0 / np.sqrt(max(matrix[i, i], 1e-300))
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
                return x, False
        x[i] = right[i] * scale[i]
        for c in range(i):
            x[i] -= L[i, c] * x[c]
        x[i] /= L[i, i]
    for i in range(p - 1, -1, -1):
        x[i] /= L[i, i]
        for c in range(i):
            x[c] -= L[i, c] * x[i]
    return x * scale, True


@compiled
def turned(w: Array) -> Array:
    """See `plain.turned`."""
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    if square > 1e-8:
        angle = np.sqrt(square)
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


@compiled
def values(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, which: Array
) -> Array:
    """See `plain.values`."""
    n, k, out = mdh.shape[1], targets.shape[1], np.zeros(len(which))
    for i in range(len(which)):
        w = which[i]
        if w < 5 * n:
            out[i] = mdh[0, w % n, w // n]
        elif w < 5 * n + 3:
            out[i] = origin[0, w - 5 * n]
        elif 5 * n + 6 <= w < 5 * n + 6 + 3 * k:
            out[i] = targets[0, (w - 5 * n - 6) // 3, (w - 5 * n - 6) % 3]
        elif w >= 5 * n + 6 + 3 * k:
            out[i] = effects[0, w - 5 * n - 6 - 3 * k]
    return out


@compiled
def stepped(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, which: Array,
    dx: Array,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """See `plain.stepped`."""
    n, k = mdh.shape[1], targets.shape[1]
    mdh, origin, targets, effects = mdh.copy(), origin.copy(), targets.copy(), effects.copy()
    turn = np.zeros(3)
    for i in range(len(which)):
        w, move = which[i], dx[i]
        if w < 5 * n:
            mdh[0, w % n, w // n] += move
        elif w < 5 * n + 3:
            origin[0] += rotation[0, :, w - 5 * n] * move
        elif w < 5 * n + 6:
            turn[w - 5 * n - 3] = move
        elif w < 5 * n + 6 + 3 * k:
            targets[0, (w - 5 * n - 6) // 3, (w - 5 * n - 6) % 3] += move
        else:
            effects[0, w - 5 * n - 6 - 3 * k] += move
    return mdh, (rotation[0] @ turned(turn)).reshape(1, 3, 3), origin, targets, effects


@compiled
def descend(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array,
    mean: Array, hold: Array, step: float, most: int,
) -> tuple[Array, Array, Array, Array, Array, Array, bool]:  # fmt: skip
    """See `plain.descend`."""
    costs, count = np.empty(most + 1), max(int(np.count_nonzero(weight)), 1)
    for i in range(most):
        F, g, H = normal(mdh, rotation, origin, targets, effects, q, prismatic, y, weight, fields,
                         moved, which)  # fmt: skip
        off = mean - values(mdh, rotation, origin, targets, effects, which)
        slope, matrix = g[0].sum(axis=0) + hold * off, H[0].sum(axis=0) + np.diag(hold)
        costs[i] = F.sum() + np.sum(hold * off * off)
        if not (i == 0 or costs[i] <= costs[i - 1] * (1.0 + RISE)) or not np.isfinite(costs[i]):
            return mdh, rotation, origin, targets, effects, costs[: i + 1], False
        dx, told = solved(matrix, slope)
        if not told:
            return mdh, rotation, origin, targets, effects, costs[: i + 1], False
        mdh, rotation, origin, targets, effects = stepped(
            mdh, rotation, origin, targets, effects, which, dx
        )
        gain = np.sum(dx * slope)
        if gain <= count * step**2:
            costs[i + 1] = costs[i] - gain
            return mdh, rotation, origin, targets, effects, costs[: i + 2], True
    return mdh, rotation, origin, targets, effects, costs[:most], False


@compiled
def misfit(matrix: Array, right: Array, sign: float, S: Array, error: Array) -> float:
    """The cost of `polish` at a rotation; writes the residuals (r,)."""
    cost = 0.0
    for r in range(len(right)):
        total = 0.0
        for a in range(3):
            for b in range(3):
                total += matrix[r, 3 * a + b] * S[a, b]
        error[r] = sign * total - right[r]
        cost += error[r] * error[r]
    return cost


@compiled
def slopes(matrix: Array, sign: float, S: Array, error: Array, gram: Array, pull: Array) -> None:
    """Write gram (3, 3) and slope (3,) of the cost of `polish` for turns about S's own axes."""
    gram[:], pull[:] = 0.0, 0.0
    row = np.empty(3)
    for r in range(len(error)):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            row[i] = 0.0
            for a in range(3):
                row[i] += sign * (matrix[r, 3 * a + j] * S[a, k] - matrix[r, 3 * a + k] * S[a, j])
        for i in range(3):
            pull[i] -= row[i] * error[r]
            for j in range(3):
                gram[i, j] += row[i] * row[j]


@compiled
def polish(matrix: Array, right: Array, starts: Array, signs: Array) -> tuple[Array, Array]:
    """See `plain.polish`."""
    turns, costs = starts.copy(), np.empty(len(starts))
    error, gram, pull = np.empty(len(right)), np.empty((3, 3)), np.empty(3)
    for s in range(len(starts)):
        at, sign, damping = turns[s], signs[s], FIRST
        cost = misfit(matrix, right, sign, at, error)
        for _ in range(ROUNDS):
            slopes(matrix, sign, at, error, gram, pull)
            more = damping * (gram[0, 0] + gram[1, 1] + gram[2, 2] + 1e-300)
            for i in range(3):
                gram[i, i] += more
            step, _ = solved(gram, pull)
            trial = at @ turned(step)
            new = misfit(matrix, right, sign, trial, error)
            if new < cost or np.sum(pull * step) <= TRUST * cost:
                at[:], cost, damping = trial, new, 0.1 * damping
            else:
                damping *= 4.0
                misfit(matrix, right, sign, at, error)
            if np.sum(step * step) <= STILL**2 or damping > STUCK:
                break
        costs[s] = cost
    return turns, costs
