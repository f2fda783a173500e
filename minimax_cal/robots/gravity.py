"""Torques that gravity puts on the joints."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.kinematics import Chain, cross

G = 9.80665  # [m/s^2]


def link_axes(links: Chain) -> Array:
    """The three axes of every frame i in the base: (..., n, axis, 3, m)."""
    z = np.concatenate([links.z[..., 1:, :, :], links.axes[..., 2:, :, :]], axis=-3)
    return np.stack([cross(links.y, z), links.y, z], axis=-3)


def torques(links: Chain, mass: Array, com: Array, up: Array) -> Array:
    """Gravity's torque about each joint axis: (..., n, m) [N m].

    mass: (n,) of each link [kg].  com: (n, 3) its centre of gravity in its own frame [m].
    up: (3,) vertical in the base frame.
    """
    centre = links.after + np.einsum("...naim,na->...nim", link_axes(links), com)
    # weight and first moment of all that hangs beyond a joint, from the flange inwards
    load = np.cumsum(mass[::-1])[::-1, None, None]
    weighted = mass[:, None, None] * centre
    moment = np.cumsum(weighted[..., ::-1, :, :], axis=-3)[..., ::-1, :, :]
    lever = moment - load * links.before
    pull = np.broadcast_to(-G * up[:, None], lever.shape)
    return np.asarray((links.z * cross(lever, pull)).sum(axis=-2))
