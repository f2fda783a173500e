"""Forward kinematics of a serial arm and its derivatives, batched over poses and over robots.

A link is ``Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` (distal Denavit-Hartenberg with Hayati's
beta; paper S, eq. 6-8).  Everything is expressed in the robot's base frame; leading axes ``...``
stand for a batch of robots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.arrays import Array

A, D, THETA, ALPHA, BETA = range(5)  # columns of an MDH table
MDH_NAMES = ("a", "d", "theta", "alpha", "beta")


@dataclass(frozen=True, eq=False)
class Chain:
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


def chain(mdh: Array, q: Array, prismatic: Array) -> Chain:
    """Axes and origins of all links [paper S, eq. 6-11].

    mdh: (..., n, 5) as a, d, theta, alpha, beta [m, rad].
    q: (..., m, n) joint values with their signs applied [rad, or m where prismatic].
    prismatic: (n,) True where q moves along the joint axis.
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
    return stretch(Chain(x, y, z, z, z, axes), mdh, q, prismatic)


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


def stretch(links: Chain, mdh: Array, q: Array, prismatic: Array) -> Chain:
    """The same directions with the lengths a, d of another MDH table: only origins move."""
    a, d = mdh[..., A, None, None], mdh[..., D, None, None]
    if prismatic.any():
        slide = np.where(prismatic[:, None], np.swapaxes(q, -1, -2), 0.0)
        step = a * links.x + (d + slide[..., :, None, :]) * links.z
    else:
        step = a * links.x + d * links.z
    after = np.cumsum(step, axis=-3)
    before = np.zeros_like(after)
    before[..., 1:, :, :] = after[..., :-1, :, :]
    return replace(links, before=before, after=after)


def forward(mdh: Array, q: Array, prismatic: Array) -> Array:
    """Pose of the last frame in the base: (..., m, 4, 4) [m].  Arguments as `chain`."""
    links = chain(mdh, q, prismatic)
    *batch, _, _, m = links.axes.shape
    pose = np.zeros((*batch, m, 4, 4), dtype=links.axes.dtype)
    pose[..., :3, :3] = np.moveaxis(links.axes, -1, -3).swapaxes(-1, -2)
    pose[..., :3, 3] = np.swapaxes(links.origin, -1, -2)
    pose[..., 3, 3] = 1.0
    return pose


def points(links: Chain, targets: Array) -> Array:
    """Targets in the base frame: (..., k, 3, m) [m].

    targets: (..., k, 3) in the last frame [m].
    """
    *batch, _, _, m = links.axes.shape
    turned = targets @ links.axes.reshape(*batch, 3, 3 * m)
    return turned.reshape(*turned.shape[:-1], 3, m) + links.origin[..., None, :, :]


def screws(links: Chain) -> tuple[Array, Array]:
    """Axis w and moment o x w of all theta, then alpha, then beta: (..., 3n, 3, m) each.

    A point p moves by ``(o x w) - (p x w) = w x (p - o)`` per radian about the axis w through o.
    """
    axis = np.concatenate([links.z, links.x, links.y], axis=-3)
    through = np.concatenate([links.before, links.after, links.after], axis=-3)
    return axis, cross(through, axis)


def cross(u: Array, v: Array) -> Array:
    """u x v along the last axis but one: (..., 3, m).  (Faster than np.cross on short arrays.)"""
    out = np.empty(np.broadcast_shapes(u.shape, v.shape), dtype=np.result_type(u, v))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(u[..., j, :], v[..., k, :], out=out[..., i, :])
        out[..., i, :] -= u[..., k, :] * v[..., j, :]
    return out


def hat(w: Array) -> Array:
    """Skew matrix of w: hat(w) @ v = w x v.  w: (..., 3).  Returns (..., 3, 3)."""
    out = np.zeros((*w.shape, 3), dtype=w.dtype)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., k, j], out[..., j, k] = w[..., i], -w[..., i]
    return out


def rotation(w: Array) -> Array:
    """Rotation by the rotation vector w [rad] (Rodrigues).  w: (..., 3).  Returns (..., 3, 3)."""
    squared = (w * w).sum(-1)[..., None, None]
    small = np.real(squared) < 1e-8
    angle = np.sqrt(np.where(small, 1.0, squared))
    first = np.where(small, 1.0 - squared / 6.0, np.sin(angle) / angle)
    second = np.where(small, 0.5 - squared / 24.0, (1.0 - np.cos(angle)) / angle**2)
    k = hat(w)
    return np.asarray(np.eye(3) + first * k + second * (k @ k))
