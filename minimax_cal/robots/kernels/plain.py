"""The kernels by NumPy: the reference that the compiled ones of `fast` are tested against.

A leading ``B`` is a batch of robots, or of iterates; the pose is the last axis, so that sums over
poses run through memory in order.  Errors and their derivatives are taken in the axes of the
flange: there a target t stands still, each parameter turns it about an axis or slides it along one,
and its own columns are unit vectors.  `sums` puts the kernels together.
"""

from __future__ import annotations

import numpy as np

from minimax_cal.core.arrays import Array

A, D, THETA, ALPHA, BETA = range(5)  # columns of an MDH table
MAX_POINTS_PER_BLOCK = 768  # points, in all robots: their Jacobian then fits the second-level cache
CYCLIC_AXES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
FIRST_ROTATION_DAMPING, MAX_ROTATION_DAMPING = (
    1e-3,
    1e6,
)  # damping of `refine_rotations`, relative: the first, and where it gives up
MAX_ROTATION_STEPS, MIN_ROTATION_STEP = (
    100,
    1e-12,
)  # at most so many steps; a turn that ends them [rad]
MIN_RELATIVE_ROTATION_GAIN = (
    1e-13  # of the cost: a predicted gain below it is not seen through rounding
)
SKEW_BASIS_MATRICES: Array = np.array(
    [
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ],
    dtype=float,
)
MIN_SCALED_PIVOT = 1e-12  # of a scaled Gram matrix: below it a parameter is not told


def link_axes_and_origins(
    mdh: Array, q: Array, prismatic: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Axes and origins of all links in the base [paper S, eq. 6-11].

    mdh: (..., n, 5) as a, d, theta, alpha, beta [m, rad].  q: (..., m, n) joint values, signs
    applied [rad, or m where prismatic].  prismatic: (n,).
    Returns x, y, z (..., n, 3, m): directions of a_i and alpha_i, of beta_i, of d_i and theta_i;
    after (..., n, 3, m): origin of frame i [m]; axes (..., 3, 3, m) of the last frame, one a row.
    """
    theta, alpha, beta = (mdh[..., i] for i in (THETA, ALPHA, BETA))
    turn = theta[..., None] + revolute_joint_angles(q, prismatic)
    cos, sin = np.cos(turn), np.sin(turn)
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    bent = (beta != 0.0).reshape(-1, beta.shape[-1]).any(axis=0)
    *batch, n, m = turn.shape
    x, y, z = np.empty((3, *batch, n, 3, m), dtype=turn.dtype)
    ex, ey, ez = np.broadcast_to(np.eye(3, dtype=turn.dtype)[:, :, None], (3, 3, m))
    for i in range(n):
        z[..., i, :, :] = ez
        ex, ey = rotate_axis_pair(
            cos[..., i, None, :], sin[..., i, None, :], ex, ey, x[..., i, :, :]
        )
        # alpha turns y and z about x, then beta turns z and x about y
        ey, ez = rotate_axis_pair(
            ca[..., i, None, None], sa[..., i, None, None], ey, ez, y[..., i, :, :]
        )
        if bent[i]:
            ez, ex = rotate_axis_pair(cb[..., i, None, None], sb[..., i, None, None], ez, ex)
    axes = np.stack(np.broadcast_arrays(ex, ey, ez), axis=-3)
    return x, y, z, link_origins(x, z, mdh, q, prismatic), axes


def rotate_axis_pair(
    cosine: Array, sine: Array, u: Array, v: Array, out: Array | None = None
) -> tuple[Array, Array]:
    """Axes u, v turned towards each other: c u + s v (into out), c v - s u."""
    first = np.multiply(cosine, u, out=out)
    first += sine * v
    second = cosine * v
    second -= sine * u
    return first, second


def revolute_joint_angles(q: Array, prismatic: Array) -> Array:
    """The joint values that turn, (..., n, m) [rad]; 0 at a prismatic joint."""
    flipped = np.ascontiguousarray(np.swapaxes(q, -1, -2))
    return np.where(prismatic[:, None], 0.0, flipped) if prismatic.any() else flipped


def link_origins(x_axes: Array, z_axes: Array, mdh: Array, q: Array, prismatic: Array) -> Array:
    """Origins of the frames, (..., n, 3, m) [m], from the directions of `link_axes_and_origins` and
    the lengths.
    """
    a, d = mdh[..., A, None, None], mdh[..., D, None, None]
    if prismatic.any():
        slide = np.where(prismatic[:, None], np.swapaxes(q, -1, -2), 0.0)
        step = a * x_axes + (d + slide[..., :, None, :]) * z_axes
    else:
        step = a * x_axes + d * z_axes
    return np.asarray(np.cumsum(step, axis=-3))


def targets_in_base(flange_axes: Array, flange_origin: Array, targets: Array) -> Array:
    """Targets in the base: (..., k, 3, m) [m].

    axes (..., 3, 3, m), origin (..., 3, m): the last frame, as `link_axes_and_origins` gives it.
    targets: (..., k, 3) in that frame [m].
    """
    *batch, _, _, m = flange_axes.shape
    turned = targets @ flange_axes.reshape(*batch, 3, 3 * m)
    return np.asarray(turned.reshape(*turned.shape[:-1], 3, m) + flange_origin[..., None, :, :])


def cross(u: Array, v: Array) -> Array:
    """u x v along the last axis but one: (..., 3, m).  (Faster than np.cross on short arrays.)"""
    out = np.empty(np.broadcast_shapes(u.shape, v.shape), dtype=np.result_type(u, v))
    for i, j, k in CYCLIC_AXES:
        np.multiply(u[..., j, :], v[..., k, :], out=out[..., i, :])
        out[..., i, :] -= u[..., k, :] * v[..., j, :]
    return out


def link_frames_in_flange(
    mdh: Array, q: Array, prismatic: Array, first_pose: int, end_pose: int
) -> Array:
    """The arm as seen from the flange, at the poses first_pose to end_pose: (B, 8n + 4, 3, c) [m].

    mdh: (B, n, 5).  q: (m, n).  In fours, first the frames from the base (0) to the flange (n):
    three axes and the origin.  Then of each joint the axes of the frame before it, turned by theta
    (a and alpha go along or about the first, d and theta the third), and the way to the next.
    """
    B, n, c = len(mdh), mdh.shape[1], end_pose - first_pose
    out = np.empty((B, 2 * n + 1, 4, 3, c))
    frames, turned = out[:, : n + 1], out[:, n + 1 :]
    frames[:, n, :3], frames[:, n, 3] = np.eye(3)[..., None], 0.0
    turn = mdh[..., THETA, None] + revolute_joint_angles(q[first_pose:end_pose], prismatic)
    cos, sin = np.cos(turn)[:, :, None, None], np.sin(turn)[:, :, None, None]
    sin = np.concatenate([-sin, sin], axis=2)
    fixed, slides = fixed_link_transforms(mdh), prismatic.any()
    for j in range(n - 1, -1, -1):
        own, here = turned[:, j], frames[:, j]
        beyond = frames[:, j + 1, :3].reshape(B, 3, 3 * c)
        np.matmul(fixed[:, j], beyond, out=own.reshape(B, 4, 3 * c))
        if slides:
            own[:, 3] += prismatic[j] * q[first_pose:end_pose, j] * own[:, 2]
        np.subtract(frames[:, j + 1, 3], own[:, 3], out=here[:, 3])
        axes = np.multiply(cos[:, j], own[:, :2], out=here[:, :2])
        axes += sin[:, j] * own[:, 1::-1]
        here[:, 2] = own[:, 2]
    return out.reshape(B, -1, 3, c)


def fixed_link_transforms(mdh: Array) -> Array:
    """(B, n, 4, 3) what takes the axes of a frame over beta and alpha, and the way a, d then."""
    a, d, _, alpha, beta = np.moveaxis(mdh, -1, 0)
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    out = np.empty((*mdh.shape[:2], 4, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cb, 0.0, sb
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sa * sb, ca, -sa * cb
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -ca * sb, sa, ca * cb
    out[..., 3, :] = a[..., None] * out[..., 0, :] + d[..., None] * out[..., 2, :]
    return out


def weighted_target_errors(
    flange_frames: Array,
    rotation: Array,
    origin: Array,
    targets: Array,
    effects: Array,
    measured_points: Array,
    point_weights: Array,
    effect_fields: Array,
    known_shifts: Array,
    first_pose: int,
) -> tuple[Array, Array, Array]:
    """Weighted errors (B, k, 3, c) of the targets in the flange, their shift, roots of weights.

    flange_frames: as `link_frames_in_flange`, from the pose lo on.  Others as `sums.cost`.  The
    shift by effects, in the flange and not weighted: (B, k, 3, c), or (0, k, 3, c) without any.
    Roots: (k, c).
    """
    c, k = flange_frames.shape[3], len(measured_points)
    axes, o, poses = flange_frames[:, :3], flange_frames[:, 3], slice(first_pose, first_pose + c)
    seen = np.swapaxes(rotation, -1, -2)[:, None] @ (
        measured_points[..., poses] - origin[:, None, :, None]
    )
    error = express_in_flange_axes(axes, seen) + (o[:, None] - targets[..., None])
    swung, root = np.zeros((0, k, 3, c)), np.sqrt(point_weights[:, poses])
    if len(effect_fields) + len(known_shifts):
        shift = np.zeros((len(flange_frames), k, 3, c))
        if len(known_shifts):
            shift += known_shifts[..., poses]
        if len(effect_fields):
            shift += np.tensordot(effects, effect_fields[..., poses], 1)
        swung = express_in_flange_axes(axes, shift)
        error -= swung
    error *= root[:, None]
    return error, swung, root


def express_in_flange_axes(flange_axes: Array, base_vectors: Array) -> Array:
    """Vectors u (B, ..., 3, c) of base axes in those of the flange.  flange_axes: (B, 3, 3, c)."""
    i, j, k = (
        flange_axes[:, number].reshape(len(flange_axes), *(base_vectors.ndim - 3) * [1], 3, -1)
        for number in range(3)
    )
    out = base_vectors[..., 0:1, :] * i
    out += base_vectors[..., 1:2, :] * j
    out += base_vectors[..., 2:3, :] * k
    return np.asarray(out)


def weighted_shared_jacobian(
    flange_frames: Array,
    axis_rows: Array,
    point_rows: Array,
    targets: Array,
    effect_shifts: Array,
    sqrt_weights: Array,
    effect_fields: Array,
) -> Array:
    """Weighted derivatives of the targets by what moves them all: (B, k, h, 3, c), in the flange.

    axis_rows, point_rows: (s,) rows of the arm, see `sums.flange_axes`.  effect_fields: (h - s, k,
    3, c) of the effects. flange_frames, effect_shifts, sqrt_weights: as `weighted_target_errors`.
    """
    (B, _, _, c), s = flange_frames.shape, len(axis_rows)
    slides, turns = np.flatnonzero(point_rows < 0), np.flatnonzero(point_rows >= 0)
    out = np.empty((B, targets.shape[1], s + len(effect_fields), 3, c))
    out[:, :, slides] = flange_frames[:, None, axis_rows[slides]]
    about, at = flange_frames[:, None, axis_rows[turns]], flange_frames[:, None, point_rows[turns]]
    reach = [targets[:, :, i, None, None] - at[:, :, :, i] for i in range(3)]
    if len(effect_shifts):  # the base takes along what effects have moved
        for i in range(3):
            reach[i][:, :, axis_rows[turns] < 3] += effect_shifts[:, :, None, i]
    for i, j, k in CYCLIC_AXES:
        move = about[:, :, :, j] * reach[k]
        move -= about[:, :, :, k] * reach[j]
        out[:, :, turns, i] = move
    if len(effect_fields):
        field = np.swapaxes(effect_fields, 0, 1)
        out[:, :, s:] = express_in_flange_axes(
            flange_frames[:, :3], np.broadcast_to(field, (B, *field.shape))
        )
    out *= sqrt_weights[:, None, None]
    return out


def add_to_normal_equations(
    errors: Array,
    jacobian: Array,
    sqrt_weights: Array,
    parameter_indices: Array,
    target_start: int,
    target_end: int,
    first_target_parameter: int,
    cost: Array,
    gradient: Array,
    gram: Array,
) -> None:
    """Add to the normal equations by target: cost (B, k), gradient (B, k, p), gram (B, k, p, p).

    errors: (B, k, 3 c), jacobian: (B, k, h, 3 c), sqrt_weights: (k, c), target_start, target_end:
    as `weighted_target_errors` and `weighted_shared_jacobian`.  A target's own coordinates are
    which[s:end], of all that begin with the parameter `first_target_parameter`.
    """
    (B, k, h, _), c = jacobian.shape, sqrt_weights.shape[1]
    cost += np.einsum("bkr,bkr->bk", errors, errors)
    pull, both = (jacobian @ errors[..., None])[..., 0], jacobian @ np.swapaxes(jacobian, -1, -2)
    side = (jacobian.reshape(B, k, 3 * h, c) @ sqrt_weights[..., None]).reshape(B, k, h, 3)
    own, square = (
        (errors.reshape(B, k, 3, c) @ sqrt_weights[..., None])[..., 0],
        (sqrt_weights**2).sum(axis=1),
    )
    held = [
        (slice(0, target_start), slice(0, target_start)),
        (slice(target_end, len(parameter_indices)), slice(target_start, h)),
    ]  # and in `both`
    held = held[: 2 if target_end < len(parameter_indices) else 1]
    row = np.arange(target_start, target_end)
    t, axis = np.divmod(parameter_indices[target_start:target_end] - first_target_parameter, 3)
    for to, at in held:
        gradient[..., to] += pull[..., at]
        for to_too, at_too in held:
            gram[..., to, to_too] += both[..., at, at_too]
        part = side[:, t, at, axis]  # the rows come first
        gram[:, t, to, row] += part
        gram[:, t, row, to] += np.swapaxes(part, 0, 1)
    gradient[:, t, row] += own[:, t, axis]
    gram[:, t, row, row] += square[t]


def squared_errors_and_gradients(
    errors: Array,
    jacobian: Array,
    sqrt_weights: Array,
    parameter_indices: Array,
    target_start: int,
    target_end: int,
    first_target_parameter: int,
) -> tuple[Array, Array]:
    """Square of every point's error (k, c), and its derivative (k, c, p).

    errors: (k, 3, c), jacobian: (k, h, 3, c) of one robot, as `weighted_target_errors` and
    `weighted_shared_jacobian`.  Others as `add_to_normal_equations`.
    """
    slope = np.zeros((*sqrt_weights.shape, len(parameter_indices)))
    pull = -2.0 * np.einsum("khic,kic->kch", jacobian, errors)
    slope[..., :target_start], slope[..., target_end:] = (
        pull[..., :target_start],
        pull[..., target_start:],
    )
    t, axis = np.divmod(parameter_indices[target_start:target_end] - first_target_parameter, 3)
    slope[t, :, np.arange(target_start, target_end)] = -2.0 * sqrt_weights[t] * errors[t, axis]
    return np.einsum("kic,kic->kc", errors, errors), slope


def solve_gauss_newton_step(
    cost: Array, gradient: Array, gram: Array, prior_offset: Array, prior_weight: Array
) -> tuple[Array, float, float, bool]:
    """A Gauss-Newton step dx (p,) of the sum of all targets' squares and of hold (off - dx)^2.

    cost: (1, k), gradient: (1, k, p), gram: (1, k, p, p) as `add_to_normal_equations`.
    prior_offset: (p,) from the parameters to the prior's mean, prior_weight: (p,) its weight.
    Returns the cost before the step and what it promises to gain too, and whether the matrix was
    definite enough to be solved.
    """
    slope, matrix = gradient[0].sum(axis=0) + prior_weight * prior_offset, gram[0].sum(axis=0)
    matrix.flat[:: len(matrix) + 1] += prior_weight
    before = float(cost.sum() + prior_weight @ (prior_offset * prior_offset))
    scale = 1.0 / np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    matrix *= scale[:, None] * scale
    try:
        definite = np.linalg.cholesky(matrix).diagonal().min() ** 2 > MIN_SCALED_PIVOT
    except np.linalg.LinAlgError:
        definite = False
    if not definite:
        return np.zeros(len(slope)), before, 0.0, False
    dx = scale * np.linalg.solve(matrix, scale * slope)
    return dx, before, float(dx @ slope), True


def apply_parameter_step(
    mdh: Array,
    rotation: Array,
    origin: Array,
    targets: Array,
    effects: Array,
    parameter_indices: Array,
    step: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """A batch of one after a step dx (p,), the base's along its own axes."""
    n, k = mdh.shape[1], targets.shape[1]
    full = np.zeros(5 * n + 6 + 3 * k + effects.shape[1])
    full[parameter_indices] = step
    base, spots = full[5 * n : 5 * n + 6], full[5 * n + 6 : 5 * n + 6 + 3 * k]
    return (
        mdh + full[: 5 * n].reshape(5, n).T,
        rotation @ rotation_from_vector(base[3:]),
        origin + rotation[0] @ base[:3],
        targets + spots.reshape(k, 3),
        effects + full[5 * n + 6 + 3 * k :],
    )


def rotation_from_vector(rotation_vector: Array) -> Array:
    """Rotation by the rotation vector w (3,) [rad] (Rodrigues): (3, 3)."""
    square = rotation_vector @ rotation_vector
    angle = np.sqrt(square)
    first = np.sin(angle) / angle if square > 1e-8 else 1.0 - square / 6.0
    second = (1.0 - np.cos(angle)) / square if square > 1e-8 else 0.5 - square / 24.0
    k = np.array(
        [
            [0.0, -rotation_vector[2], rotation_vector[1]],
            [rotation_vector[2], 0.0, -rotation_vector[0]],
            [-rotation_vector[1], rotation_vector[0], 0.0],
        ]
    )
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def refine_rotations(
    matrix: Array, right_side: Array, start_rotations: Array
) -> tuple[Array, Array]:
    """Rotations S that minimise |matrix vec(S) - right|^2, by damped steps from each start.

    matrix: (r, 9).  right_side: (r,).  start_rotations: (s, 3, 3).  Returns the rotations and the
    costs (s,).
    """
    turn = start_rotations.copy()
    damping = np.full(len(start_rotations), FIRST_ROTATION_DAMPING)
    error = turn.reshape(-1, 9) @ matrix.T - right_side
    cost = (error**2).sum(-1)
    alive = np.arange(len(start_rotations))
    for _ in range(MAX_ROTATION_STEPS):
        if not len(alive):
            break
        at, old = turn[alive], cost[alive]
        slopes = (at[:, None] @ SKEW_BASIS_MATRICES).reshape(-1, 3, 9) @ matrix.T
        gram = slopes @ np.swapaxes(slopes, -1, -2)
        size = np.trace(gram, axis1=-2, axis2=-1) + 1e-300
        pull = -(slopes @ error[alive][..., None])
        damped = gram + (damping[alive] * size)[:, None, None] * np.eye(3)
        step = np.linalg.solve(damped, pull)[..., 0]
        trial = at @ np.stack([rotation_from_vector(w) for w in step])
        after = trial.reshape(-1, 9) @ matrix.T - right_side
        new = (after**2).sum(-1)
        gain = (step * pull[..., 0]).sum(-1)
        better = (new < old) | (gain <= MIN_RELATIVE_ROTATION_GAIN * old)
        turn[alive[better]], error[alive[better]] = trial[better], after[better]
        cost[alive[better]] = new[better]
        damping[alive] *= np.where(better, 0.1, 4.0)
        alive = alive[
            ((step**2).sum(-1) > MIN_ROTATION_STEP**2) & (damping[alive] <= MAX_ROTATION_DAMPING)
        ]
    return turn, cost
