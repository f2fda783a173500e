"""The kernels compiled by numba: the names, arguments and results of `plain`.

A kernel that calls another one compiles it once more: `sums` calls the large ones in turn.  Loops
on single numbers compile several times as fast as what NumPy does to whole arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np
from numba import njit

from minimax_cal.core.arrays import Array
from minimax_cal.robots.kernels.plain import (
    FIRST_ROTATION_DAMPING,
    MAX_ROTATION_DAMPING,
    MAX_ROTATION_STEPS,
    MIN_RELATIVE_ROTATION_GAIN,
    MIN_ROTATION_STEP,
    MIN_SCALED_PIVOT,
)

MAX_POINTS_PER_BLOCK = 384  # points, in all robots: their Jacobian then fits the second-level cache

P = ParamSpec("P")
R = TypeVar("R")


def compile_when_called(function: Callable[P, R]) -> Callable[P, R]:
    """The function compiled when it is first called, and kept on disk; sums in any order."""
    quick: Callable[P, R] = njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})(
        function
    )
    return quick


@compile_when_called
def link_axes_and_origins(
    mdh: Array, q: Array, prismatic: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """See `plain.link_axes_and_origins`."""
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


@compile_when_called
def link_frames_in_flange(
    mdh: Array, q: Array, prismatic: Array, first_pose: int, end_pose: int
) -> Array:
    """See `plain.link_frames_in_flange`."""
    B, n, c = len(mdh), mdh.shape[1], end_pose - first_pose
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
                    slide += q[first_pose + r, j]
                else:
                    turn += q[first_pose + r, j]
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


@compile_when_called
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
    """See `plain.weighted_target_errors`."""
    B, c, k = len(flange_frames), flange_frames.shape[3], len(measured_points)
    some = 1 if len(effect_fields) + len(known_shifts) else 0
    error, swung, root = np.empty((B, k, 3, c)), np.empty((B * some, k, 3, c)), np.empty((k, c))
    for t in range(k):
        for r in range(c):
            root[t, r] = np.sqrt(point_weights[t, first_pose + r])
    seen = np.empty(3)
    for b in range(B):
        for t in range(k):
            for r in range(c):
                u = measured_points[t, 0, first_pose + r] - origin[b, 0]
                v = measured_points[t, 1, first_pose + r] - origin[b, 1]
                w = measured_points[t, 2, first_pose + r] - origin[b, 2]
                for j in range(3):
                    seen[j] = rotation[b, 0, j] * u + rotation[b, 1, j] * v + rotation[b, 2, j] * w
                    if some:
                        shift = known_shifts[t, j, first_pose + r] if len(known_shifts) else 0.0
                        for e in range(len(effect_fields)):
                            shift += effects[b, e] * effect_fields[e, t, j, first_pose + r]
                        seen[j] -= shift
                        for i in range(3):
                            before = swung[b, t, i, r] if j else 0.0
                            swung[b, t, i, r] = before + flange_frames[b, j, i, r] * shift
                for i in range(3):
                    total = flange_frames[b, 3, i, r] - targets[b, t, i]
                    for j in range(3):
                        total += flange_frames[b, j, i, r] * seen[j]
                    error[b, t, i, r] = root[t, r] * total
    return error, swung, root


@compile_when_called
def weighted_shared_jacobian(
    flange_frames: Array,
    axis_rows: Array,
    point_rows: Array,
    targets: Array,
    effect_shifts: Array,
    sqrt_weights: Array,
    effect_fields: Array,
) -> Array:
    """See `plain.weighted_shared_jacobian`."""
    B, c, k, s = len(flange_frames), flange_frames.shape[3], targets.shape[1], len(axis_rows)
    out = np.empty((B, k, s + len(effect_fields), 3, c))
    for b in range(B):
        for t in range(k):
            for row in range(s):
                at, about, along = (
                    point_rows[row],
                    axis_rows[row],
                    len(effect_shifts) > 0 and axis_rows[row] < 3,
                )
                for i in range(3):
                    u, v = (i + 1) % 3, (i + 2) % 3
                    for r in range(c):
                        move = flange_frames[b, about, i, r]
                        if at >= 0:
                            p = targets[b, t, u] - flange_frames[b, at, u, r]
                            q = targets[b, t, v] - flange_frames[b, at, v, r]
                            if along:  # the base takes along what effects have moved
                                p += effect_shifts[b, t, u, r]
                                q += effect_shifts[b, t, v, r]
                            move = (
                                flange_frames[b, about, u, r] * q
                                - flange_frames[b, about, v, r] * p
                            )
                        out[b, t, row, i, r] = sqrt_weights[t, r] * move
            for e in range(len(effect_fields)):
                for i in range(3):
                    for r in range(c):
                        total = 0.0
                        for j in range(3):
                            total += flange_frames[b, j, i, r] * effect_fields[e, t, j, r]
                        out[b, t, s + e, i, r] = sqrt_weights[t, r] * total
    return out


@compile_when_called
def write_lower_gram(rows: Array, out: Array) -> None:
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


@compile_when_called
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
    """See `plain.add_to_normal_equations`."""
    (B, k, h, c3), c = jacobian.shape, sqrt_weights.shape[1]
    both = np.empty((h, h))
    for b in range(B):
        for t in range(k):
            total, square = 0.0, 0.0
            for r in range(c3):
                total += errors[b, t, r] * errors[b, t, r]
            for r in range(c):
                square += sqrt_weights[t, r] * sqrt_weights[t, r]
            cost[b, t] += total
            write_lower_gram(jacobian[b, t], both)
            for i in range(h):
                to, pull = i if i < target_start else i - target_start + target_end, 0.0
                for r in range(c3):
                    pull += jacobian[b, t, i, r] * errors[b, t, r]
                gradient[b, t, to] += pull
                for j in range(h):
                    gram[b, t, to, j if j < target_start else j - target_start + target_end] += (
                        both[max(i, j), min(i, j)]
                    )
            for row in range(target_start, target_end):
                axis = parameter_indices[row] - first_target_parameter - 3 * t
                if 0 <= axis < 3:
                    gram[b, t, row, row] += square
                    pull = 0.0
                    for r in range(c):
                        pull += errors[b, t, axis * c + r] * sqrt_weights[t, r]
                    gradient[b, t, row] += pull
                    for i in range(h):
                        to, side = i if i < target_start else i - target_start + target_end, 0.0
                        for r in range(c):
                            side += jacobian[b, t, i, axis * c + r] * sqrt_weights[t, r]
                        gram[b, t, row, to] += side
                        gram[b, t, to, row] += side


@compile_when_called
def squared_errors_and_gradients(
    errors: Array,
    jacobian: Array,
    sqrt_weights: Array,
    parameter_indices: Array,
    target_start: int,
    target_end: int,
    first_target_parameter: int,
) -> tuple[Array, Array]:
    """See `plain.squared_errors_and_gradients`."""
    k, h, _, c = jacobian.shape
    square, slope = np.empty((k, c)), np.zeros((k, c, len(parameter_indices)))
    for t in range(k):
        for r in range(c):
            u, v, w = errors[t, 0, r], errors[t, 1, r], errors[t, 2, r]
            square[t, r] = u * u + v * v + w * w
            for i in range(h):
                to = i if i < target_start else i - target_start + target_end
                pull = (
                    u * jacobian[t, i, 0, r] + v * jacobian[t, i, 1, r] + w * jacobian[t, i, 2, r]
                )
                slope[t, r, to] = -2.0 * pull
            for row in range(target_start, target_end):
                axis = parameter_indices[row] - first_target_parameter - 3 * t
                if 0 <= axis < 3:
                    slope[t, r, row] = -2.0 * sqrt_weights[t, r] * errors[t, axis, r]
    return square, slope


@compile_when_called
def solve_by_cholesky(matrix: Array, right_side: Array, solution: Array) -> bool:
    """Write x (p,) of matrix x = right; False where the matrix (p, p) is not definite enough."""
    p = len(right_side)
    scale, L = np.empty(p), np.empty((p, p))
    for i in range(p):
        scale[i] = 1.0 / np.sqrt(max(matrix[i, i], 1e-300))
        solution[i] = 0.0
    for i in range(p):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for c in range(j):
                total -= L[i, c] * L[j, c]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > MIN_SCALED_PIVOT:
                L[i, i] = np.sqrt(total)
            else:
                return False
    for i in range(p):
        solution[i] = right_side[i] * scale[i]
        for c in range(i):
            solution[i] -= L[i, c] * solution[c]
        solution[i] /= L[i, i]
    for i in range(p - 1, -1, -1):
        solution[i] /= L[i, i]
        for c in range(i):
            solution[c] -= L[i, c] * solution[i]
    for i in range(p):
        solution[i] *= scale[i]
    return True


@compile_when_called
def solve_gauss_newton_step(
    cost: Array, gradient: Array, gram: Array, prior_offset: Array, prior_weight: Array
) -> tuple[Array, float, float, bool]:
    """See `plain.solve_gauss_newton_step`."""
    p, before, gain = len(prior_offset), 0.0, 0.0
    matrix, slope, dx = np.zeros((p, p)), np.empty(p), np.empty(p)
    for t in range(cost.shape[1]):
        before += cost[0, t]
    for i in range(p):
        slope[i] = prior_weight[i] * prior_offset[i]
        before += slope[i] * prior_offset[i]
        for t in range(cost.shape[1]):
            slope[i] += gradient[0, t, i]
            for j in range(p):
                matrix[i, j] += gram[0, t, i, j]
        matrix[i, i] += prior_weight[i]
    definite = solve_by_cholesky(matrix, slope, dx)
    for i in range(p):
        gain += dx[i] * slope[i]
    return dx, before, gain, definite


@compile_when_called
def write_rotated_by_vector(rotation: Array, rotation_vector: Array, out: Array) -> None:
    """Write a rotation S (3, 3) times that by a vector w (3,), see
    `plain.write_rotated_by_vector`.
    """
    square = (
        rotation_vector[0] * rotation_vector[0]
        + rotation_vector[1] * rotation_vector[1]
        + rotation_vector[2] * rotation_vector[2]
    )
    first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    if square > 1e-8:
        angle = np.sqrt(square)
        first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    for i in range(3):
        along = (
            rotation[i, 0] * rotation_vector[0]
            + rotation[i, 1] * rotation_vector[1]
            + rotation[i, 2] * rotation_vector[2]
        )
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            aside = rotation[i, k] * rotation_vector[m] - rotation[i, m] * rotation_vector[k]
            out[i, j] = (
                (1.0 - second * square) * rotation[i, j]
                + first * aside
                + second * along * rotation_vector[j]
            )


@compile_when_called
def apply_parameter_step(
    mdh: Array,
    rotation: Array,
    origin: Array,
    targets: Array,
    effects: Array,
    parameter_indices: Array,
    step: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """See `plain.apply_parameter_step`."""
    n, k = mdh.shape[1], targets.shape[1]
    mdh, origin, targets, effects = mdh.copy(), origin.copy(), targets.copy(), effects.copy()
    w, after = np.zeros(3), np.empty((1, 3, 3))
    for row in range(len(parameter_indices)):
        at, move = parameter_indices[row], step[row]
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
    write_rotated_by_vector(rotation[0], w, after[0])
    return mdh, after, origin, targets, effects


@compile_when_called
def write_rotation_residuals(
    matrix: Array, right_side: Array, rotation: Array, residuals: Array
) -> float:
    """The cost of `refine_rotations` at a rotation; writes the residuals (r,)."""
    cost = 0.0
    for r in range(len(right_side)):
        total = 0.0
        for a in range(3):
            for b in range(3):
                total += matrix[r, 3 * a + b] * rotation[a, b]
        residuals[r] = total - right_side[r]
        cost += residuals[r] * residuals[r]
    return cost


@compile_when_called
def write_rotation_gram_and_gradient(
    matrix: Array, rotation: Array, residuals: Array, gram: Array, gradient: Array
) -> None:
    """Write gram (3, 3) and slope (3,) of the cost of `refine_rotations` for turns about S's own
    axes.
    """
    row = np.empty(3)
    for i in range(3):
        gradient[i] = 0.0
        for j in range(3):
            gram[i, j] = 0.0
    for r in range(len(residuals)):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            row[i] = 0.0
            for a in range(3):
                row[i] += (
                    matrix[r, 3 * a + j] * rotation[a, k] - matrix[r, 3 * a + k] * rotation[a, j]
                )
        for i in range(3):
            gradient[i] -= row[i] * residuals[r]
            for j in range(3):
                gram[i, j] += row[i] * row[j]


@compile_when_called
def refine_rotations(
    matrix: Array, right_side: Array, start_rotations: Array
) -> tuple[Array, Array]:
    """See `plain.refine_rotations`."""
    turns, costs = start_rotations.copy(), np.empty(len(start_rotations))
    error, gram, pull, step = np.empty(len(right_side)), np.empty((3, 3)), np.empty(3), np.empty(3)
    trial = np.empty((3, 3))
    for s in range(len(start_rotations)):
        at, damping = turns[s], FIRST_ROTATION_DAMPING
        cost = write_rotation_residuals(matrix, right_side, at, error)
        for _ in range(MAX_ROTATION_STEPS):
            write_rotation_gram_and_gradient(matrix, at, error, gram, pull)
            more = damping * (gram[0, 0] + gram[1, 1] + gram[2, 2] + 1e-300)
            for i in range(3):
                gram[i, i] += more
            solve_by_cholesky(gram, pull, step)
            write_rotated_by_vector(at, step, trial)
            new = write_rotation_residuals(matrix, right_side, trial, error)
            gain = pull[0] * step[0] + pull[1] * step[1] + pull[2] * step[2]
            if new < cost or gain <= MIN_RELATIVE_ROTATION_GAIN * cost:
                cost, damping = new, 0.1 * damping
                for i in range(3):
                    for j in range(3):
                        at[i, j] = trial[i, j]
            else:
                damping *= 4.0
                write_rotation_residuals(matrix, right_side, at, error)
            still = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
            if still <= MIN_ROTATION_STEP**2 or damping > MAX_ROTATION_DAMPING:
                break
        costs[s] = cost
    return turns, costs
