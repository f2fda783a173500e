"""Torques that gravity puts on the joints."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.kinematics import Chain, cross

G = 9.80665  # [m/s^2]
MASS_PER_METRE = 60.0  # of links whose mass the robot file does not tell [kg/m]: an assumption


def centres(links: Chain, com: Array) -> Array:
    """Centres of gravity in the base: (..., n, 3, m) [m].  com: (n, 3) in the link frames."""
    z = np.concatenate([links.z[..., 1:, :, :], links.axes[..., 2:, :, :]], axis=-3)
    axes = np.stack([cross(links.y, z), links.y, z], axis=-3)
    return np.asarray(links.after + np.einsum("...naim,na->...nim", axes, com))


def torques(links: Chain, mass: Array, com: Array, up: Array) -> Array:
    """Gravity's torque about each joint axis: (..., n, m) [N m].

    mass: (n,) of each link [kg].  com: (n, 3) its centre of gravity in its own frame [m].
    up: (3,) vertical in the base frame.
    """
    # weight and first moment of all that hangs beyond a joint, from the flange inwards
    load = np.cumsum(mass[::-1])[::-1, None, None]
    weighted = mass[:, None, None] * centres(links, com)
    moment = np.cumsum(weighted[..., ::-1, :, :], axis=-3)[..., ::-1, :, :]
    lever = moment - load * links.before
    pull = np.broadcast_to(-G * up[:, None], lever.shape)
    return np.asarray((links.z * cross(lever, pull)).sum(axis=-2))
