"""Torques that gravity puts on the joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.kinematics import Chain, cross

if TYPE_CHECKING:
    from minimax_cal.robots.robot import Robot

G = 9.80665  # [m/s^2]
MASS_PER_METRE = 60.0  # of links whose mass the robot file does not tell [kg/m]: an assumption
LEAST_MASS = 1e-3  # of a link for simulators, which refuse one without any [kg]
STOCKY = 0.1  # no link is taken to be shorter, for its inertia [m]


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


def inertia_of(mdh: Array, link: int, mass: float) -> float:
    """A moment of inertia that a link may have about any axis: a solid body as long as it is.

    mdh: (n, 5) [m, rad].  mass: [kg].  [kg m^2]
    """
    length = max(float(np.hypot(mdh[link, 0], mdh[link, 1])), STOCKY)
    return mass * length**2 / 6.0


def tubes(mdh: Array) -> tuple[Array, Array]:
    """(n,) masses [kg] and (n, 3) centres of gravity in the link frames [m]: uniform tubes.

    For links whose masses nobody tells.  mdh: (n, 5) [m, rad].
    """
    # back from frame i towards frame i-1: half of a along x, half of d along the old z
    ca, sa = np.cos(mdh[:, 3]), np.sin(mdh[:, 3])
    halfway = -0.5 * np.stack([mdh[:, 0], mdh[:, 1] * sa, mdh[:, 1] * ca], axis=1)
    return MASS_PER_METRE * np.hypot(mdh[:, 0], mdh[:, 1]), halfway


def weighed(robot: Robot) -> Array:
    """(n,) True for links whose mass and centre of gravity the robot file tells."""
    return np.isfinite(robot.mass) & np.isfinite(robot.com).all(axis=1)


def masses_of(robot: Robot, least: float = 0.0) -> tuple[Array, Array]:
    """(n,) masses [kg] and (n, 3) centres in the link frames [m]: as told, else those of tubes.

    least: of any link [kg].
    """
    known, (tube, halfway) = weighed(robot), tubes(robot.mdh)
    mass = np.maximum(np.where(known, robot.mass, tube), least)
    return mass, np.where(known[:, None], robot.com, halfway)
