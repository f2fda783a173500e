"""Forward kinematics of a serial arm and its derivatives, batched over poses and over robots.

A link is ``Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` (distal Denavit-Hartenberg with Hayati's
beta; paper S, eq. 6-8).  Everything is expressed in the robot's base frame; leading axes ``...``
stand for a batch of robots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots.kernels import plain
from minimax_cal.robots.kernels.kernel_choice import active_kernels, prepare_kernel_arrays
from minimax_cal.robots.kernels.plain import ALPHA as ALPHA
from minimax_cal.robots.kernels.plain import BETA as BETA
from minimax_cal.robots.kernels.plain import THETA as THETA
from minimax_cal.robots.kernels.plain import A as A
from minimax_cal.robots.kernels.plain import D as D
from minimax_cal.robots.kernels.plain import cross as cross

MDH_NAMES = ("a", "d", "theta", "alpha", "beta")


@dataclass(frozen=True, eq=False)
class LinkFrames:
    """Where every joint and link of the arm lies, at every pose, in the base frame.

    The pose is the last axis, so that sums over poses run through memory in order.
    x: (..., n, 3, m) direction of a_i, the axis alpha_i turns about.
    y: (..., n, 3, m) axis that beta_i turns about.
    z: (..., n, 3, m) joint axis: direction of d_i, the axis theta_i turns about.
    before: (..., n, 3, m) a point on the joint axis, origin of frame i-1 [m].
    after: (..., n, 3, m) origin of frame i [m].
    axes: (..., 3, 3, m) the three axes of the last frame, one a row.
    """

    x: Array
    y: Array
    z: Array
    before: Array
    after: Array
    axes: Array

    @property
    def origin(self) -> Array:
        """(..., 3, m) origin of the last frame [m]."""
        return np.asarray(self.after[..., -1, :, :])


def compute_link_frames(mdh: Array, q: Array, prismatic: Array) -> LinkFrames:
    """Axes and origins of all links [paper S, eq. 6-11].

    mdh: (..., n, 5) as a, d, theta, alpha, beta [m, rad].
    q: (..., m, n) joint values with their signs applied [rad, or m where prismatic].
    prismatic: (n,) True where q moves along the joint axis.
    """
    if q.ndim == 2 and mdh.dtype == q.dtype == np.float64:
        every = active_kernels().link_axes_and_origins(
            *prepare_kernel_arrays(mdh.reshape(-1, *mdh.shape[-2:]), q, prismatic)
        )
        x, y, z, after, axes = (part.reshape(*mdh.shape[:-2], *part.shape[1:]) for part in every)
    else:
        x, y, z, after, axes = plain.link_axes_and_origins(mdh, q, prismatic)
    before = np.zeros_like(after)
    before[..., 1:, :, :] = after[..., :-1, :, :]
    return LinkFrames(x, y, z, before, after, axes)


def forward_kinematics(mdh: Array, q: Array, prismatic: Array) -> Array:
    """Pose of the last frame in the base: (..., m, 4, 4) [m].  Arguments as `chain`."""
    links = compute_link_frames(mdh, q, prismatic)
    *batch, _, _, m = links.axes.shape
    pose = np.zeros((*batch, m, 4, 4), dtype=links.axes.dtype)
    pose[..., :3, :3] = np.moveaxis(links.axes, -1, -3).swapaxes(-1, -2)
    pose[..., :3, 3] = np.swapaxes(links.origin, -1, -2)
    pose[..., 3, 3] = 1.0
    return pose


def targets_in_base(links: LinkFrames, targets: Array) -> Array:
    """Targets in the base frame: (..., k, 3, m) [m].

    targets: (..., k, 3) in the last frame [m].
    """
    return plain.targets_in_base(links.axes, links.origin, targets)


class ScrewAxes(NamedTuple):
    """Axes and moments (..., 3n, 3, m) of turns by theta, then alpha, then beta."""

    axes: Array
    moments: Array


def screw_axes_and_moments(links: LinkFrames) -> ScrewAxes:
    """Axis w and moment o x w of all theta, then alpha, then beta: (..., 3n, 3, m) each.

    A point p moves by ``(o x w) - (p x w) = w x (p - o)`` per radian about the axis w through o.
    """
    axis = np.concatenate([links.z, links.x, links.y], axis=-3)
    through = np.concatenate([links.before, links.after, links.after], axis=-3)
    return ScrewAxes(axis, cross(through, axis))


def skew_matrix(vector: Array) -> Array:
    """Skew matrix of vector: hat(w) @ v = w x v.  vector: (..., 3).  Returns (..., 3, 3)."""
    out = np.zeros((*vector.shape, 3), dtype=vector.dtype)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., k, j], out[..., j, k] = vector[..., i], -vector[..., i]
    return out


def rotation_from_vector(rotation_vectors: Array) -> Array:
    """Rotation by the rotation vector w [rad] (Rodrigues).  rotation_vectors: (..., 3).  Returns
    (..., 3, 3).
    """
    squared = (rotation_vectors * rotation_vectors).sum(-1)[..., None, None]
    small = np.real(squared) < 1e-8
    angle = np.sqrt(np.where(small, 1.0, squared))
    first = np.where(small, 1.0 - squared / 6.0, np.sin(angle) / angle)
    second = np.where(small, 0.5 - squared / 24.0, (1.0 - np.cos(angle)) / angle**2)
    k = skew_matrix(rotation_vectors)
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def so3_right_jacobian(rotation_vectors: Array) -> Array:
    """J with exp(w + dw) = exp(w) exp(J dw): (..., 3, 3).  rotation_vectors: (..., 3) rotation
    vectors [rad].
    """
    size = np.linalg.norm(rotation_vectors, axis=-1)[..., None, None]
    small = size < 1e-4  # where the quotients are their limits to rounding
    safe = np.where(small, 1.0, size)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    skew = skew_matrix(rotation_vectors)
    return np.asarray(np.eye(3) - first * skew + second * skew @ skew)


def rotation_to_vector(rotation: Array) -> Array:
    """The rotation vector (3,) of a rotation (3, 3) [rad]: the inverse of
    `rotation_from_vector`.
    """
    v, w = rotation_to_unnormalised_quaternion(rotation)
    sine = float(np.linalg.norm(v))
    return np.asarray(v * (2.0 * np.arctan2(sine, w) / sine if sine > 0.0 else 0.0))


def rotation_to_quaternion(rotation: Array) -> Array:
    """The unit quaternion (4,) of a rotation (3, 3): w, x, y, z with w not negative."""
    v, w = rotation_to_unnormalised_quaternion(rotation)
    every = np.array([w, *v])
    return np.asarray(every / np.linalg.norm(every))


class UnnormalisedQuaternion(NamedTuple):
    """Vector (3,) and scalar of a quaternion of any length."""

    vector: Array
    scalar: float


def rotation_to_unnormalised_quaternion(rotation: Array) -> UnnormalisedQuaternion:
    """Vector (3,) and scalar of the quaternion of a rotation (3, 3), of any length.

    From its largest entry [Shepperd 1978].
    """
    square = np.append(
        np.diag(rotation), np.trace(rotation)
    )  # 4 x^2 ... 4 w^2, alike up to a constant
    largest = int(np.argmax(square))
    if largest == 3:
        w = 1.0 + np.trace(rotation)
        v = np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        v = np.empty(3)
        v[i] = 1.0 + rotation[i, i] - rotation[j, j] - rotation[k, k]
        v[j], v[k] = rotation[j, i] + rotation[i, j], rotation[k, i] + rotation[i, k]
        w = rotation[k, j] - rotation[j, k]
    sign = -1.0 if w < 0.0 else 1.0
    return UnnormalisedQuaternion(sign * v, sign * float(w))
