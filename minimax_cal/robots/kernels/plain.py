"""The kernels by NumPy: the reference that the compiled ones of `fast` are tested against.

A leading ``B`` is a batch of robots, or of iterates; the pose is the last axis, so that sums over
poses run through memory in order.  Normal equations are taken in the axes of the flange: there a
target t stands still, each parameter turns it about an axis or slides it along one, and its own
columns are unit vectors.  The Jacobian of all points is never stored: poses go in blocks that fit
the cache.
"""

from __future__ import annotations

import itertools

import numpy as np

from minimax_cal.ground.arrays import Array

A, D, THETA, ALPHA, BETA = range(5)  # columns of an MDH table
BLOCK = 768  # points of a target in all robots: its Jacobian then fits the second-level cache
CYCLE = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
RISE = 1e-12  # relative: a cost that grows by more did not come from rounding
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


def unwound(mdh: Array, q: Array, prismatic: Array) -> tuple[Array, Array, Array, Array]:
    """The arm as seen from the flange.

    mdh: (B, n, 5).  q: (c, n).  Returns the base's axes (B, 3, 3, c), one a row, and origin
    (B, 3, c), and what each link parameter and the base's pose do (B, 5n + 6, 3, c): the axis along
    which it slides or about which it turns, and a point on that axis.
    """
    B, n, c = len(mdh), mdh.shape[1], len(q)
    a, d, theta, alpha, beta = np.moveaxis(mdh, -1, 0)[..., None, None]
    axis, through = np.empty((2, B, 5 * n + 6, 3, c))
    x, y, z = np.broadcast_to(np.eye(3)[:, None, :, None], (3, B, 3, c))
    o = np.zeros((B, 3, c))
    turn = theta[..., 0] + turned_by(q, prismatic)
    cos, sin = np.cos(turn)[:, :, None], np.sin(turn)[:, :, None]
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    bent, slides = beta.any(axis=(0, 2, 3)), prismatic.any()
    for j in range(n - 1, -1, -1):
        axis[:, 4 * n + j], through[:, 3 * n + j] = y, o
        if bent[j]:
            x, z = turn_pair(cb[:, j], sb[:, j], x, z)
        axis[:, j] = x
        z, y = turn_pair(ca[:, j], sa[:, j], z, y, axis[:, n + j])
        o = o - a[:, j] * x - (d[:, j] + q[:, j] * prismatic[j] if slides else d[:, j]) * z
        through[:, 2 * n + j] = o
        y, x = turn_pair(cos[:, j], sin[:, j], y, x)
    axis[:, 2 * n : 3 * n], axis[:, 3 * n : 4 * n] = axis[:, n : 2 * n], axis[:, :n]
    through[:, 4 * n : 5 * n] = through[:, 3 * n : 4 * n]
    axes = axis[:, 5 * n : 5 * n + 3]
    axes[:, 0], axes[:, 1], axes[:, 2] = x, y, z
    axis[:, 5 * n + 3 :], through[:, 5 * n + 3 :] = axes, o[:, None]
    return axes, o, axis, through


def sighted(
    axes: Array, o: Array, rotation: Array, origin: Array, targets: Array, y: Array, shift: Array
) -> tuple[Array, Array]:
    """Errors of the targets and their shifts by effects, (B, k, 3, c) each, in the flange [m].

    y: (k, 3, c) measured.  shift: (B, k, 3, c) by which effects move them, in base axes; (0,) for
    none.
    """
    seen = np.swapaxes(rotation, -1, -2)[:, None] @ (y - origin[:, None, :, None])
    error = inside(axes, seen) + (o[:, None] - targets[..., None])
    if not shift.size:
        return error, shift
    swung = inside(axes, shift)
    return error - swung, swung


def inside(axes: Array, u: Array) -> Array:
    """Vectors u (B, ..., 3, c) of base axes in those of the flange.  axes: (B, 3, 3, c)."""
    i, j, k = (
        axes[:, number].reshape(len(axes), *(u.ndim - 3) * [1], 3, -1) for number in range(3)
    )
    out = u[..., 0:1, :] * i
    out += u[..., 1:2, :] * j
    out += u[..., 2:3, :] * k
    return np.asarray(out)


def shifted(effects: Array, fields: Array, moved: Array, rows: slice) -> Array:
    """(B, k, 3, c) by which effects move the targets, in base axes [m]; (0,) for none."""
    if not len(fields) + len(moved):
        return np.zeros(0)
    out = np.zeros((len(effects), 1, 1, 1))
    if len(moved):
        out = out + moved[..., rows]
    if len(fields):
        out = out + np.tensordot(effects, fields[..., rows], 1)
    return out


def blocks(m: int, points: int) -> list[slice]:
    """The poses in blocks that fit the cache.  points: at each pose, in all robots."""
    edges = np.linspace(0, m, min(-(-m * points // BLOCK), m) + 1).astype(int)
    return [slice(lo, hi) for lo, hi in itertools.pairwise(edges)]


def cost(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array,
) -> Array:  # fmt: skip
    """Weighted sums of squares F_i of each target: (B, k) [m^2].

    mdh: (B, n, 5).  rotation, origin: (B, 3, 3), (B, 3) of the base.  targets: (B, k, 3) in the
    flange [m].  effects: (B, e) values.  q: (m, n), prismatic: (n,) as `chain`.  y: (k, 3, m)
    measured [m].  weight: (k, m), 0 where not measured.  fields: (e, k, 3, m) motion of the points
    per unit of each effect, moved: (k, 3, m) besides, in base axes; (0, ...) for none.
    """
    out = np.zeros((len(mdh), len(y)))
    for rows in blocks(len(q), len(mdh) * len(y)):
        axes, o, _, _ = unwound(mdh, q[rows], prismatic)
        shift = shifted(effects, fields, moved, rows)
        error, _ = sighted(axes, o, rotation, origin, targets, y[..., rows], shift)
        out += np.einsum("bkic,bkic,kc->bk", error, error, weight[:, rows])
    return out


def normal(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Normal equations by target: F (B, k), J'We (B, k, p) and J'WJ (B, k, p, p).

    which: (p,) the parameters, ascending, in the order of `Names`.  Others as `cost`.
    """
    (B, n, _), k, p = mdh.shape, len(y), len(which)
    first, last = 5 * n + 6, 5 * n + 6 + 3 * k
    s, end = (int(at) for at in np.searchsorted(which, (first, last)))
    h = s + p - end  # columns that all targets share: screws and effects
    total, pull, both = np.zeros((B, k)), np.zeros((B, k, h)), np.zeros((B, k, h, h))
    side, own = np.zeros((B, k, h, 3)), np.zeros((B, k, 3))
    for rows in blocks(len(q), B * k):
        error, J, root = shared(mdh, rotation, origin, targets, effects, q, prismatic, y, weight,
                                fields, moved, which, rows)  # fmt: skip
        flat = J.reshape(B, k, h, -1)
        total += np.einsum("bkic,bkic->bk", error, error)
        pull += (flat @ error.reshape(B, k, -1, 1))[..., 0]
        both += flat @ np.swapaxes(flat, -1, -2)
        side += (J.reshape(B, k, 3 * h, -1) @ root[..., None]).reshape(side.shape)
        own += (error @ root[..., None])[..., 0]
    gradient, gram = np.zeros((B, k, p)), np.zeros((B, k, p, p))
    held = [(slice(0, s), slice(0, s)), (slice(end, p), slice(s, h))]  # there, and among `both`
    held = held[: 2 if end < p else 1]
    for to, at in held:
        gradient[..., to] = pull[..., at]
        for to_too, at_too in held:
            gram[..., to, to_too] = both[..., at, at_too]
    edges, square = np.searchsorted(which, first + 3 * np.arange(k + 1)).tolist(), weight.sum(1)
    for t, (lo, hi) in enumerate(itertools.pairwise(edges)):
        axis = which[lo:hi] - first - 3 * t
        gradient[:, t, lo:hi] = own[:, t, axis]
        gram[:, t, lo:hi, lo:hi] = square[t] * np.eye(hi - lo)
        for to, at in held:
            gram[:, t, to, lo:hi] = part = side[:, t, at][..., axis]
            gram[:, t, lo:hi, to] = np.swapaxes(part, -1, -2)
    return total, gradient, gram


def shared(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array,
    poses: slice,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Weighted errors (B, k, 3, c), columns that all targets share (B, k, h, 3, c), roots (k, c).

    The roots are those of the weights.  Of some poses, in the axes of the flange; as `normal`.
    """
    n, k = mdh.shape[1], len(y)
    first, last = 5 * n + 6, 5 * n + 6 + 3 * k
    s, end = (int(at) for at in np.searchsorted(which, (first, last)))
    arm, shift = unwound(mdh, q[poses], prismatic), shifted(effects, fields, moved, poses)
    error, swung = sighted(*arm[:2], rotation, origin, targets, y[..., poses], shift)
    J = sensed(arm, targets, swung, which[:s])
    if end < len(which):
        field = np.swapaxes(fields[which[end:] - last][..., poses], 0, 1)
        more = inside(arm[0], np.broadcast_to(field, (len(mdh), *field.shape)))
        J = np.concatenate([J, more], axis=2)
    root = np.sqrt(weight[:, poses])
    J *= root[:, None, None]
    error *= root[:, None]
    return error, J, root


def rows(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array, lo: int,
    hi: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Weighted errors (k, 3, c) of the poses lo to hi, and their Jacobian J (k, p, 3, c).

    In the axes of the flange, of a batch of one; the errors' derivative is -J.  As `normal`.
    """
    n, k, p = mdh.shape[1], len(y), len(which)
    first, last = 5 * n + 6, 5 * n + 6 + 3 * k
    s, end = (int(at) for at in np.searchsorted(which, (first, last)))
    error, J, root = shared(mdh, rotation, origin, targets, effects, q, prismatic, y, weight,
                            fields, moved, which, slice(lo, hi))  # fmt: skip
    out = np.zeros((k, p, *error.shape[2:]))
    out[:, :s], out[:, end:] = J[0, :, :s], J[0, :, s:]
    for row in range(s, end):
        t, axis = divmod(int(which[row]) - first, 3)
        out[t, row, axis] = root[t]
    return error[0], out


def squares(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Weighted squared distance of every point (k, m) [m^2] and its derivative (k, m, p).

    Of a batch of one, as `normal`.
    """
    k, m = weight.shape
    f, slope = np.zeros((k, m)), np.zeros((k, m, len(which)))
    for part in blocks(m, k):
        error, J = rows(mdh, rotation, origin, targets, effects, q, prismatic, y, weight, fields,
                        moved, which, part.start, part.stop)  # fmt: skip
        f[:, part] = np.einsum("kic,kic->kc", error, error)
        slope[:, part] = -2.0 * np.einsum("kpic,kic->kcp", J, error)
    return f, slope


def sensed(
    arm: tuple[Array, Array, Array, Array], targets: Array, swung: Array, which: Array
) -> Array:
    """Rows of all targets for parameters of links and base: (B, k, s, 3, c), in the flange.

    arm: as `unwound`.  swung: (B, k, 3, c) by which effects move the targets; (0,) for none.
    which: (s,) the parameters.
    """
    *_, axis, through = arm
    n = axis.shape[1] // 5 - 1
    angles, moves, turns = (int(at) for at in np.searchsorted(which, (2 * n, 5 * n, 5 * n + 3)))
    out = np.empty((len(axis), targets.shape[1], len(which), *axis.shape[2:]))
    for slide in (slice(0, angles), slice(moves, turns)):
        out[:, :, slide] = axis[:, None, which[slide]]
    turning = np.concatenate([which[angles:moves], which[turns:]])
    about = axis[:, turning]
    swing = cross(about[:, None], targets[:, :, None, :, None])
    swing += cross(through[:, turning], about)[:, None]
    out[:, :, angles:moves] = swing[:, :, : moves - angles]
    out[:, :, turns:] = swing[:, :, moves - angles :]
    if swung.size:  # the base takes along what effects have moved
        out[:, :, turns:] += cross(axis[:, None, which[turns:]], swung[:, :, None])
    return out


def descend(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, q: Array,
    prismatic: Array, y: Array, weight: Array, fields: Array, moved: Array, which: Array,
    mean: Array, hold: Array, step: float, most: int,
) -> tuple[Array, Array, Array, Array, Array, Array, bool]:  # fmt: skip
    """Plain Gauss-Newton steps from a start that is near: the sum of all F_i, and a prior.

    As `normal`, for a batch of one.  mean, hold: (p,) of the prior on `which`, hold = its weight.
    step: root mean square motion of a point that ends it [m].  most: steps.
    Returns mdh, rotation, origin, targets, effects, the cost at every iterate (t,), and whether it
    ended well: each step led down, and the last one was small.
    """
    at, costs = (mdh, rotation, origin, targets, effects), [np.inf]
    count, known = max(int(np.count_nonzero(weight)), 1), bool(hold.any())
    for _ in range(most):
        F, g, H = normal(*at, q, prismatic, y, weight, fields, moved, which)
        slope, matrix, paid = g[0].sum(axis=0), H[0].sum(axis=0), 0.0
        if known:
            off = mean - values(*at, which)
            slope, matrix, paid = slope + hold * off, matrix + np.diag(hold), hold @ (off * off)
        costs.append(F.sum() + paid)
        if not costs[-1] <= costs[-2] * (1.0 + RISE):
            return *at, np.array(costs[1:]), False
        scale = 1.0 / np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
        scaled = matrix * scale[:, None] * scale
        try:
            if np.linalg.cholesky(scaled).diagonal().min() ** 2 <= PIVOT:
                return *at, np.array(costs[1:]), False
        except np.linalg.LinAlgError:
            return *at, np.array(costs[1:]), False
        dx = scale * np.linalg.solve(scaled, scale * slope)
        at = stepped(*at, which, dx)
        gain = float(dx @ slope)
        if gain <= count * step**2:
            return *at, np.array([*costs[1:], costs[-1] - gain]), True
    return *at, np.array(costs[1:]), False


def values(
    mdh: Array, rotation: Array, origin: Array, targets: Array, effects: Array, which: Array
) -> Array:
    """(p,) the parameters of a batch of one; those of the base's turn are 0, as steps are."""
    every = (mdh[0].T.reshape(-1), origin[0], np.zeros(3), targets[0].reshape(-1), effects[0])
    return np.concatenate(every)[which]


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


def polish(matrix: Array, right: Array, starts: Array, signs: Array) -> tuple[Array, Array]:
    """Rotations S that minimise |sign matrix vec(S) - right|^2, by damped steps from each start.

    matrix: (r, 9).  right: (r,).  starts: (s, 3, 3).  signs: (s,) 1 or -1.  Returns the rotations
    and the costs (s,).
    """
    turn = starts.copy()
    damping = np.full(len(starts), FIRST)
    error = signs[:, None] * (turn.reshape(-1, 9) @ matrix.T) - right
    cost = (error**2).sum(-1)
    alive = np.arange(len(starts))
    for _ in range(ROUNDS):
        if not len(alive):
            break
        at, old, sign = turn[alive], cost[alive], signs[alive, None]
        slopes = sign[..., None] * ((at[:, None] @ HATS).reshape(-1, 3, 9) @ matrix.T)
        gram = slopes @ np.swapaxes(slopes, -1, -2)
        size = np.trace(gram, axis1=-2, axis2=-1) + 1e-300
        pull = -(slopes @ error[alive][..., None])
        damped = gram + (damping[alive] * size)[:, None, None] * np.eye(3)
        step = np.linalg.solve(damped, pull)[..., 0]
        trial = at @ np.stack([turned(w) for w in step])
        after = sign * (trial.reshape(-1, 9) @ matrix.T) - right
        new = (after**2).sum(-1)
        gain = (step * pull[..., 0]).sum(-1)
        better = (new < old) | (gain <= TRUST * old)
        turn[alive[better]], error[alive[better]] = trial[better], after[better]
        cost[alive[better]] = new[better]
        damping[alive] *= np.where(better, 0.1, 4.0)
        alive = alive[((step**2).sum(-1) > STILL**2) & (damping[alive] <= STUCK)]
    return turn, cost
