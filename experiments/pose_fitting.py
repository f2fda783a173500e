"""Poses measured by three reflectors, their errors, and Gauss-Newton fits to them [paper M].

A pose is a (4, 4) matrix.  A twist is (v, w): a point p moves by v + w x p, in the axes of the
frame that the pose is given in (a spatial twist) [m, rad].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.identification import DEFAULT_RESOLUTION
from minimax_cal.robots.kinematics import rotation_from_vector, skew_matrix
from minimax_cal.robots.transforms import build_transform
from minimax_cal.solvers.status import Status
from minimax_cal.validation.iso9283 import formulas
from minimax_cal.validation.iso9283.formulas import fit_rotations

X = TypeVar("X")


def triangle_from_distances(measured_points: Array) -> Array:
    """Three reflectors in a frame of their own, from their mean distances: (3, 3) [m].

    measured_points: (m, 3, 3) pose, reflector, coordinate [m].  Origin in the centroid, x from the
    first to the second, z normal to the plane, so that the third lies at y > 0.
    """
    pairs = ((0, 1), (1, 2), (2, 0))
    ab, bc, ca = (
        np.linalg.norm(measured_points[:, i] - measured_points[:, j], axis=-1).mean()
        for i, j in pairs
    )
    along = (ab**2 + ca**2 - bc**2) / (2.0 * ab)
    corners = np.array([[0, 0, 0], [ab, 0, 0], [along, np.sqrt(max(ca**2 - along**2, 0.0)), 0]])
    return np.asarray(corners - corners.mean(axis=0))


def fit_poses_to_points(body_points: Array, measured_points: Array) -> Array:
    """Poses (m, 4, 4) that bring a shape nearest to measured points [Kabsch 1976].

    body_points: (k, 3) centred, its points not on a line.  measured_points: (m, k, 3) [m].
    """
    return build_transform(
        fit_rotations(body_points, measured_points), measured_points.mean(axis=1)
    )


def transform_points(poses: Array, body_points: Array) -> Array:
    """Points fixed in moving frames: (m, k, 3) [m].  poses: (m, 4, 4).  body_points: (k, 3)."""
    return np.asarray(
        np.einsum("mij,kj->mki", poses[:, :3, :3], body_points) + poses[:, None, :3, 3]
    )


def rotation_vectors(rotations: Array) -> Array:
    """Rotation vectors (..., 3) of rotations (..., 3, 3) [rad]."""
    return (
        Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(rotations.shape[:-1])
    )


def orientation_error(measured: Array, computed: Array) -> Array:
    """Angle between measured and computed orientations, |log(R_m' R_c)|: (m,) [rad; M eq. 5]."""
    return formulas.orientation_error(measured[..., :3, :3], computed[..., :3, :3])


def euler_deviation(measured: Array, computed: Array) -> Array:
    """Sizes of the deviations of the angles a, b, c: (m, 3) [rad; M eq. 4; ISO 9283]."""
    return np.abs(formulas.euler_deviation(measured[..., :3, :3], computed[..., :3, :3]))


def rotation_lever_arm(body_points: Array) -> float:
    """Length that makes an angle comparable to a position: sqrt(2/3) of the RMS radius [m].

    With it |e_p|^2 + lever^2 |e_R|^2 is a third of the sum of squares over the three points, the
    directions of the turn averaged: a small turn w moves them by sum |w x s_k|^2.
    """
    return float(np.sqrt(2.0 / 3.0 * (body_points**2).sum(axis=1).mean()))


def pose_residuals(measured: Array, computed: Array, lever_arm: float) -> Array:
    """Position p_c - p_m and length times log(R_m' R_c): (m, 6) [m]."""
    turn = rotation_vectors(np.swapaxes(measured[:, :3, :3], -1, -2) @ computed[:, :3, :3])
    return np.concatenate([computed[:, :3, 3] - measured[:, :3, 3], lever_arm * turn], axis=1)


def pose_residual_jacobian(
    measured: Array, computed: Array, twists: Array, lever_arm: float
) -> Array:
    """Derivative of `pose_residuals`: (m, 6, p).  twists: (m, 6, p) of the computed poses.

    log(R_m' exp(w) R_c) = log(exp(R_m' w) R_m' R_c) changes by Jl^-1(log(R_m' R_c)) R_m' w.
    """
    back = np.swapaxes(measured[:, :3, :3], -1, -2)
    turn = (
        so3_inverse_left_jacobian(rotation_vectors(back @ computed[:, :3, :3]))
        @ back
        @ twists[:, 3:]
    )
    return np.concatenate([point_jacobian(computed[:, :3, 3], twists), lever_arm * turn], axis=1)


def point_jacobian(points: Array, twists: Array) -> Array:
    """Motion v + w x p of points (m, 3) under twists (m, 6, p): (m, 3, p)."""
    return np.asarray(twists[:, :3] - skew_matrix(points) @ twists[:, 3:])


def so3_left_jacobian(rotation_vectors: Array) -> Array:
    """V with exp(v, w) = [exp(w), V v] and d exp(w) exp(-w) = hat(V dw).  rotation_vectors: (...,
    3) [rad].

    Returns (..., 3, 3).
    """
    squared = (rotation_vectors * rotation_vectors).sum(-1)[..., None, None]
    small = np.real(squared) < 1e-8
    angle = np.sqrt(np.where(small, 1.0, squared))
    first = np.where(small, 0.5 - squared / 24.0, 2.0 * (np.sin(0.5 * angle) / angle) ** 2)
    second = np.where(small, 1.0 / 6.0 - squared / 120.0, (angle - np.sin(angle)) / angle**3)
    k = skew_matrix(rotation_vectors)
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def so3_inverse_left_jacobian(rotation_vectors: Array) -> Array:
    """Inverse of `so3_left_jacobian`, for angles below 2 pi: (..., 3, 3)."""
    squared = (rotation_vectors * rotation_vectors).sum(-1)[..., None, None]
    small = squared < 1e-4
    half = 0.5 * np.sqrt(np.where(small, 1.0, squared))
    series = 1.0 / 12.0 + squared / 720.0
    k = skew_matrix(rotation_vectors)
    factor = np.where(small, series, (1.0 - half / np.tan(half)) / np.where(small, 1.0, squared))
    return np.asarray(np.eye(3) - 0.5 * k + factor * (k @ k))


def twist_exponential(twist: Array) -> Array:
    """Motion (..., 4, 4) of a unit time with twist (..., 6).  Any dtype."""
    v, w = twist[..., :3], twist[..., 3:]
    return build_transform(rotation_from_vector(w), (so3_left_jacobian(w) @ v[..., None])[..., 0])


def adjoint_matrix(T: Array) -> Array:
    """Matrix that takes twists of the inner frame of T to its outer frame: (..., 6, 6)."""
    turn, zero = T[..., :3, :3], np.zeros_like(T[..., :3, :3])
    shift = skew_matrix(T[..., :3, 3]) @ turn
    top, bottom = np.concatenate([turn, shift], -1), np.concatenate([zero, turn], -1)
    return np.concatenate([top, bottom], axis=-2)


@dataclass(frozen=True, eq=False)
class GaussNewtonSolution(Generic[X]):
    """x: where Gauss-Newton ended.  cost: sum of squares there [m^2].

    identified: rank of the last Jacobian.
    """

    x: X
    cost: float
    identified: int
    status: Status


def minimise_by_gauss_newton(
    linearise: Callable[[X], tuple[Array, Array]],
    step: Callable[[X, Array], X],
    x: X,
    relative_rank_tolerance: float = DEFAULT_RESOLUTION,
    max_iterations: int = 100,
) -> GaussNewtonSolution[X]:
    """Gauss-Newton for redundant parameters: the least step of all that fit equally well.

    linearise: residuals (r,) [m] and Jacobian (r, p).  Columns are scaled to unit norm; singular
    values below resolution times the largest are cut off (truncated SVD), so that combinations
    the data do not show keep their start.  A step that raises the cost is halved.  Ends where the
    step moves the residuals by less than 1e-11 m (root mean square).
    """
    residual, slope = linearise(x)
    cost, status, rank = float(residual @ residual), Status.ITERATION_LIMIT, 0
    for _ in range(max_iterations):
        scale = np.linalg.norm(slope, axis=0)
        largest = scale.max()  # a column that is nothing but rounding must not be blown up
        scale = np.where(scale > 1e-9 * largest, scale, largest)
        u, s, vt = np.linalg.svd(slope / scale, full_matrices=False)
        rank = int(np.count_nonzero(s > relative_rank_tolerance * s[0]))
        pull = -(u[:, :rank].T @ residual)
        move = vt[:rank].T @ (pull / s[:rank]) / scale
        share = 1.0
        for _ in range(30):
            trial = step(x, share * move)
            after, after_slope = linearise(trial)
            if float(after @ after) <= cost * (1.0 + 1e-12) + 1e-24:
                break
            share *= 0.5
        else:
            status = Status.STALLED
            break
        x, residual, slope, cost = trial, after, after_slope, float(after @ after)
        if np.linalg.norm(pull) <= 1e-11 * np.sqrt(len(residual)):
            status = Status.CONVERGED
            break
    return GaussNewtonSolution(x, cost, rank, status)


@dataclass(frozen=True, eq=False)
class PointFit:
    """A calibrated arm: predict (m, n) joints -> (m, 3, 3) points [m], and how the fit ended."""

    predict: Callable[[Array], Array]
    status: str
