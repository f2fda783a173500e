"""The kernels by NumPy: the reference that the compiled ones of `fast` are tested against.

A leading ``B`` is a batch of robots, or of iterates; the pose is the last axis, so that sums over
poses run through memory in order.  Errors and their derivatives are taken in the axes of the
flange: there a target t stands still, each parameter turns it about an axis or slides it along one,
and its own columns are unit vectors.  `sums` puts the kernels together.
"""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array

A, D, THETA, ALPHA, BETA = range(5)  # columns of an MDH table
BLOCK = 768  # points, in all robots: their Jacobian then fits the second-level cache
CYCLE = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
FIRST, STUCK = 1e-3, 1e6  # damping of `polish`, relative: the first, and where it gives up
ROUNDS, STILL = 100, 1e-12  # at most so many steps; a turn that ends them [rad]
TRUST = 1e-13  # of the cost: a predicted gain below it is not seen through rounding
HATS: Array = np.array([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
                        [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], dtype=float)  # fmt: skip
PIVOT = 1e-12  # of a scaled Gram matrix: below it a parameter is not told


def chain(mdh: Array, q: Array, prismatic: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Axes and origins of all links in the base [paper S, eq. 6-11].

    mdh: (..., n, 5) as a, d, theta, alpha, beta [m, rad].  q: (..., m, n) joint values, signs
    applied [rad, or m where prismatic].  prismatic: (n,).
    Returns x, y, z (..., n, 3, m): directions of a_i and alpha_i, of beta_i, of d_i and theta_i;
    after (..., n, 3, m): origin of frame i [m]; axes (..., 3, 3, m) of the last frame, one a row.
    """
    theta, alpha, beta = (mdh[..., i] for i in (THETA, ALPHA, BETA))
    turn = theta[..., None] + turned_by(q, prismatic)
    cos, sin = np.cos(turn), np.sin(turn)
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    bent = (beta != 0.0).reshape(-1, beta.shape[-1]).any(axis=0)
    *batch, n, m = turn.shape
    x, y, z = np.empty((3, *batch, n, 3, m), dtype=turn.dtype)
    ex, ey, ez = np.broadcast_to(np.eye(3, dtype=turn.dtype)[:, :, None], (3, 3, m))
    for i in range(n):
        z[..., i, :, :] = ez
        ex, ey = turn_pair(cos[..., i, None, :], sin[..., i, None, :], ex, ey, x[..., i, :, :])
        # alpha turns y and z about x, then beta turns z and x about y
        ey, ez = turn_pair(ca[..., i, None, None], sa[..., i, None, None], ey, ez, y[..., i, :, :])
        if bent[i]:
            ez, ex = turn_pair(cb[..., i, None, None], sb[..., i, None, None], ez, ex)
    axes = np.stack(np.broadcast_arrays(ex, ey, ez), axis=-3)
    return x, y, z, reached(x, z, mdh, q, prismatic), axes


def turn_pair(
    c: Array, s: Array, u: Array, v: Array, out: Array | None = None
) -> tuple[Array, Array]:
    """Axes u, v turned towards each other: c u + s v (into out), c v - s u."""
    first = np.multiply(c, u, out=out)
    first += s * v
    second = c * v
    second -= s * u
    return first, second


def turned_by(q: Array, prismatic: Array) -> Array:
    """The joint values that turn, (..., n, m) [rad]; 0 at a prismatic joint."""
    flipped = np.ascontiguousarray(np.swapaxes(q, -1, -2))
    return np.where(prismatic[:, None], 0.0, flipped) if prismatic.any() else flipped


def reached(x: Array, z: Array, mdh: Array, q: Array, prismatic: Array) -> Array:
    """Origins of the frames, (..., n, 3, m) [m], from the directions of `chain` and the lengths."""
    a, d = mdh[..., A, None, None], mdh[..., D, None, None]
    if prismatic.any():
        slide = np.where(prismatic[:, None], np.swapaxes(q, -1, -2), 0.0)
        step = a * x + (d + slide[..., :, None, :]) * z
    else:
        step = a * x + d * z
    return np.asarray(np.cumsum(step, axis=-3))


def points(axes: Array, origin: Array, targets: Array) -> Array:
    """Targets in the base: (..., k, 3, m) [m].

    axes (..., 3, 3, m), origin (..., 3, m): the last frame, as `chain` gives it.  targets:
    (..., k, 3) in that frame [m].
    """
    *batch, _, _, m = axes.shape
    turned = targets @ axes.reshape(*batch, 3, 3 * m)
    return np.asarray(turned.reshape(*turned.shape[:-1], 3, m) + origin[..., None, :, :])


def cross(u: Array, v: Array) -> Array:
    """u x v along the last axis but one: (..., 3, m).  (Faster than np.cross on short arrays.)"""
    out = np.empty(np.broadcast_shapes(u.shape, v.shape), dtype=np.result_type(u, v))
    for i, j, k in CYCLE:
        np.multiply(u[..., j, :], v[..., k, :], out=out[..., i, :])
        out[..., i, :] -= u[..., k, :] * v[..., j, :]
    return out


def unwound(mdh: Array, q: Array, prismatic: Array, lo: int, hi: int) -> Array:
    """The arm as seen from the flange, at the poses lo to hi: (B, 8n + 4, 3, c) [m].

    mdh: (B, n, 5).  q: (m, n).  In fours, first the frames from the base (0) to the flange (n):
    three axes and the origin.  Then of each joint the axes of the frame before it, turned by theta
    (a and alpha go along or about the first, d and theta the third), and the way to the next.
    """
    B, n, c = len(mdh), mdh.shape[1], hi - lo
    out = np.empty((B, 2 * n + 1, 4, 3, c))
    frames, turned = out[:, : n + 1], out[:, n + 1 :]
    frames[:, n, :3], frames[:, n, 3] = np.eye(3)[..., None], 0.0
    turn = mdh[..., THETA, None] + turned_by(q[lo:hi], prismatic)
    cos, sin = np.cos(turn)[:, :, None, None], np.sin(turn)[:, :, None, None]
    sin = np.concatenate([-sin, sin], axis=2)
    fixed, slides = fixed_turns(mdh), prismatic.any()
    for j in range(n - 1, -1, -1):
        own, here = turned[:, j], frames[:, j]
        beyond = frames[:, j + 1, :3].reshape(B, 3, 3 * c)
        np.matmul(fixed[:, j], beyond, out=own.reshape(B, 4, 3 * c))
        if slides:
            own[:, 3] += prismatic[j] * q[lo:hi, j] * own[:, 2]
        np.subtract(frames[:, j + 1, 3], own[:, 3], out=here[:, 3])
        axes = np.multiply(cos[:, j], own[:, :2], out=here[:, :2])
        axes += sin[:, j] * own[:, 1::-1]
        here[:, 2] = own[:, 2]
    return out.reshape(B, -1, 3, c)


def fixed_turns(mdh: Array) -> Array:
    """(B, n, 4, 3) what takes the axes of a frame over beta and alpha, and the way a, d then."""
    a, d, _, alpha, beta = np.moveaxis(mdh, -1, 0)
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    out = np.empty((*mdh.shape[:2], 4, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cb, 0.0, sb
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sa * sb, ca, -sa * cb
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -ca * sb, sa, ca * cb
    out[..., 3, :] = a[..., None] * out[..., 0, :] + d[..., None] * out[..., 2, :]
    return out


def sighted(
    arm: Array, rotation: Array, origin: Array, targets: Array, effects: Array, y: Array,
    weight: Array, fields: Array, moved: Array, lo: int,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Weighted errors (B, k, 3, c) of the targets in the flange, their shift, roots of weights.

    arm: as `unwound`, from the pose lo on.  Others as `sums.cost`.  The shift by effects, in the
    flange and not weighted: (B, k, 3, c), or (0, k, 3, c) without any.  Roots: (k, c).
    """
    c, k = arm.shape[3], len(y)
    axes, o, poses = arm[:, :3], arm[:, 3], slice(lo, lo + c)
    seen = np.swapaxes(rotation, -1, -2)[:, None] @ (y[..., poses] - origin[:, None, :, None])
    error = inside(axes, seen) + (o[:, None] - targets[..., None])
    swung, root = np.zeros((0, k, 3, c)), np.sqrt(weight[:, poses])
    if len(fields) + len(moved):
        shift = np.zeros((len(arm), k, 3, c))
        if len(moved):
            shift += moved[..., poses]
        if len(fields):
            shift += np.tensordot(effects, fields[..., poses], 1)
        swung = inside(axes, shift)
        error -= swung
    error *= root[:, None]
    return error, swung, root


def inside(axes: Array, u: Array) -> Array:
    """Vectors u (B, ..., 3, c) of base axes in those of the flange.  axes: (B, 3, 3, c)."""
    i, j, k = (
        axes[:, number].reshape(len(axes), *(u.ndim - 3) * [1], 3, -1) for number in range(3)
    )
    out = u[..., 0:1, :] * i
    out += u[..., 1:2, :] * j
    out += u[..., 2:3, :] * k
    return np.asarray(out)


def sensed(
    arm: Array, axis: Array, point: Array, targets: Array, swung: Array, root: Array, fields: Array
) -> Array:  # fmt: skip
    """Weighted derivatives of the targets by what moves them all: (B, k, h, 3, c), in the flange.

    axis, point: (s,) rows of the arm, see `sums.axes`.  fields: (h - s, k, 3, c) of the effects.
    arm, swung, root: as `sighted`.
    """
    (B, _, _, c), s = arm.shape, len(axis)
    slides, turns = np.flatnonzero(point < 0), np.flatnonzero(point >= 0)
    out = np.empty((B, targets.shape[1], s + len(fields), 3, c))
    out[:, :, slides] = arm[:, None, axis[slides]]
    about, at = arm[:, None, axis[turns]], arm[:, None, point[turns]]
    reach = [targets[:, :, i, None, None] - at[:, :, :, i] for i in range(3)]
    if len(swung):  # the base takes along what effects have moved
        for i in range(3):
            reach[i][:, :, axis[turns] < 3] += swung[:, :, None, i]
    for i, j, k in CYCLE:
        move = about[:, :, :, j] * reach[k]
        move -= about[:, :, :, k] * reach[j]
        out[:, :, turns, i] = move
    if len(fields):
        field = np.swapaxes(fields, 0, 1)
        out[:, :, s:] = inside(arm[:, :3], np.broadcast_to(field, (B, *field.shape)))
    out *= root[:, None, None]
    return out


def summed(
    error: Array, J: Array, root: Array, which: Array, s: int, end: int, first: int, cost: Array,
    gradient: Array, gram: Array,
) -> None:  # fmt: skip
    """Add to the normal equations by target: cost (B, k), gradient (B, k, p), gram (B, k, p, p).

    error: (B, k, 3 c), J: (B, k, h, 3 c), root: (k, c), s, end: as `sighted` and `sensed`.  A
    target's own coordinates are which[s:end], of all that begin with the parameter `first`.
    """
    (B, k, h, _), c = J.shape, root.shape[1]
    cost += np.einsum("bkr,bkr->bk", error, error)
    pull, both = (J @ error[..., None])[..., 0], J @ np.swapaxes(J, -1, -2)
    side = (J.reshape(B, k, 3 * h, c) @ root[..., None]).reshape(B, k, h, 3)
    own, square = (error.reshape(B, k, 3, c) @ root[..., None])[..., 0], (root**2).sum(axis=1)
    held = [(slice(0, s), slice(0, s)), (slice(end, len(which)), slice(s, h))]  # and in `both`
    held = held[: 2 if end < len(which) else 1]
    row = np.arange(s, end)
    t, axis = np.divmod(which[s:end] - first, 3)
    for to, at in held:
        gradient[..., to] += pull[..., at]
        for to_too, at_too in held:
            gram[..., to, to_too] += both[..., at, at_too]
        part = side[:, t, at, axis]  # the rows come first
        gram[:, t, to, row] += part
        gram[:, t, row, to] += np.swapaxes(part, 0, 1)
    gradient[:, t, row] += own[:, t, axis]
    gram[:, t, row, row] += square[t]


def squared(
    error: Array, J: Array, root: Array, which: Array, s: int, end: int, first: int
) -> tuple[Array, Array]:
    """Square of every point's error (k, c), and its derivative (k, c, p).

    error: (k, 3, c), J: (k, h, 3, c) of one robot, as `sighted` and `sensed`.  Others as `summed`.
    """
    slope = np.zeros((*root.shape, len(which)))
    pull = -2.0 * np.einsum("khic,kic->kch", J, error)
    slope[..., :s], slope[..., end:] = pull[..., :s], pull[..., s:]
    t, axis = np.divmod(which[s:end] - first, 3)
    slope[t, :, np.arange(s, end)] = -2.0 * root[t] * error[t, axis]
    return np.einsum("kic,kic->kc", error, error), slope


def solved(
    cost: Array, gradient: Array, gram: Array, off: Array, hold: Array
) -> tuple[Array, float, float, bool]:
    """A Gauss-Newton step dx (p,) of the sum of all targets' squares and of hold (off - dx)^2.

    cost: (1, k), gradient: (1, k, p), gram: (1, k, p, p) as `summed`.  off: (p,) from the
    parameters to the prior's mean, hold: (p,) its weight.  Returns the cost before the step and
    what it promises to gain too, and whether the matrix was definite enough to be solved.
    """
    slope, matrix = gradient[0].sum(axis=0) + hold * off, gram[0].sum(axis=0)
    matrix.flat[:: len(matrix) + 1] += hold
    before = float(cost.sum() + hold @ (off * off))
    scale = 1.0 / np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    matrix *= scale[:, None] * scale
    try:
        definite = np.linalg.cholesky(matrix).diagonal().min() ** 2 > PIVOT
    except np.linalg.LinAlgError:
        definite = False
    if not definite:
        return np.zeros(len(slope)), before, 0.0, False
    dx = scale * np.linalg.solve(matrix, scale * slope)
    return dx, before, float(dx @ slope), True


def stepped(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, which: Array,
    dx: Array,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """A batch of one after a step dx (p,), the base's along its own axes."""
    n, k = mdh.shape[1], targets.shape[1]
    full = np.zeros(5 * n + 6 + 3 * k + effects.shape[1])
    full[which] = dx
    base, spots = full[5 * n : 5 * n + 6], full[5 * n + 6 : 5 * n + 6 + 3 * k]
    return (
        mdh + full[: 5 * n].reshape(5, n).T,
        rotation @ turned(base[3:]),
        origin + rotation[0] @ base[:3],
        targets + spots.reshape(k, 3),
        effects + full[5 * n + 6 + 3 * k :],
    )


def turned(w: Array) -> Array:
    """Rotation by the rotation vector w (3,) [rad] (Rodrigues): (3, 3)."""
    square = w @ w
    angle = np.sqrt(square)
    first = np.sin(angle) / angle if square > 1e-8 else 1.0 - square / 6.0
    second = (1.0 - np.cos(angle)) / square if square > 1e-8 else 0.5 - square / 24.0
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def polish(matrix: Array, right: Array, starts: Array) -> tuple[Array, Array]:
    """Rotations S that minimise |matrix vec(S) - right|^2, by damped steps from each start.

    matrix: (r, 9).  right: (r,).  starts: (s, 3, 3).  Returns the rotations and the costs
    (s,).
    """
    turn = starts.copy()
    damping = np.full(len(starts), FIRST)
    error = turn.reshape(-1, 9) @ matrix.T - right
    cost = (error**2).sum(-1)
    alive = np.arange(len(starts))
    for _ in range(ROUNDS):
        if not len(alive):
            break
        at, old = turn[alive], cost[alive]
        slopes = (at[:, None] @ HATS).reshape(-1, 3, 9) @ matrix.T
        gram = slopes @ np.swapaxes(slopes, -1, -2)
        size = np.trace(gram, axis1=-2, axis2=-1) + 1e-300
        pull = -(slopes @ error[alive][..., None])
        damped = gram + (damping[alive] * size)[:, None, None] * np.eye(3)
        step = np.linalg.solve(damped, pull)[..., 0]
        trial = at @ np.stack([turned(w) for w in step])
        after = trial.reshape(-1, 9) @ matrix.T - right
        new = (after**2).sum(-1)
        gain = (step * pull[..., 0]).sum(-1)
        better = (new < old) | (gain <= TRUST * old)
        turn[alive[better]], error[alive[better]] = trial[better], after[better]
        cost[alive[better]] = new[better]
        damping[alive] *= np.where(better, 0.1, 4.0)
        alive = alive[((step**2).sum(-1) > STILL**2) & (damping[alive] <= STUCK)]
    return turn, cost
