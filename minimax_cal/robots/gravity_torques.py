"""Torques that gravity puts on the joints."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots.kinematics import LinkFrames, cross

if TYPE_CHECKING:
    from minimax_cal.robots.robot import Robot

STANDARD_GRAVITY = 9.80665  # [m/s^2]
ASSUMED_LINK_MASS_PER_METRE = (
    60.0  # of links whose mass the robot file does not tell [kg/m]: an assumption
)
MIN_SIMULATED_LINK_MASS = 1e-3  # of a link for simulators, which refuse one without any [kg]
MIN_INERTIA_LINK_LENGTH = 0.1  # no link is taken to be shorter, for its inertia [m]


def link_mass_centres_in_base(links: LinkFrames, centres_in_links: Array) -> Array:
    """Centres of gravity in the base: (..., n, 3, m) [m].  centres_in_links: (n, 3) in the link
    frames.
    """
    z = np.concatenate([links.z[..., 1:, :, :], links.axes[..., 2:, :, :]], axis=-3)
    axes = np.stack([cross(links.y, z), links.y, z], axis=-3)
    return np.asarray(links.after + np.einsum("...naim,na->...nim", axes, centres_in_links))


def joint_gravity_torques(
    links: LinkFrames, link_masses: Array, centres_in_links: Array, up: Array
) -> Array:
    """Gravity's torque about each joint axis: (..., n, m) [N m].

    link_masses: (n,) of each link [kg].  centres_in_links: (n, 3) its centre of gravity in its own
    frame [m]. up: (3,) vertical in the base frame.
    """
    # weight and first moment of all that hangs beyond a joint, from the flange inwards
    load = np.cumsum(link_masses[::-1])[::-1, None, None]
    weighted = link_masses[:, None, None] * link_mass_centres_in_base(links, centres_in_links)
    moment = np.cumsum(weighted[..., ::-1, :, :], axis=-3)[..., ::-1, :, :]
    lever = moment - load * links.before
    pull = np.broadcast_to(-STANDARD_GRAVITY * up[:, None], lever.shape)
    return np.asarray((links.z * cross(lever, pull)).sum(axis=-2))


def assumed_link_inertia(mdh: Array, link_index: int, mass: float) -> float:
    """A moment of inertia that a link may have about any axis: a solid body as long as it is.

    mdh: (n, 5) [m, rad].  mass: [kg].  [kg m^2]
    """
    length = max(float(np.hypot(mdh[link_index, 0], mdh[link_index, 1])), MIN_INERTIA_LINK_LENGTH)
    return mass * length**2 / 6.0


class LinkMasses(NamedTuple):
    """Masses (n,) [kg] and centres of gravity (n, 3) in the link frames [m]."""

    masses: Array
    centres: Array


def assumed_link_masses_and_centres(mdh: Array) -> LinkMasses:
    """(n,) masses [kg] and (n, 3) centres of gravity in the link frames [m]: uniform tubes.

    For links whose masses nobody tells.  mdh: (n, 5) [m, rad].
    """
    # back from frame i towards frame i-1: half of a along x, half of d along the old z
    ca, sa = np.cos(mdh[:, 3]), np.sin(mdh[:, 3])
    halfway = -0.5 * np.stack([mdh[:, 0], mdh[:, 1] * sa, mdh[:, 1] * ca], axis=1)
    return LinkMasses(ASSUMED_LINK_MASS_PER_METRE * np.hypot(mdh[:, 0], mdh[:, 1]), halfway)


def known_link_mass_mask(robot: Robot) -> Array:
    """(n,) True for links whose mass and centre of gravity the robot file tells."""
    return np.isfinite(robot.mass) & np.isfinite(robot.com).all(axis=1)


def link_masses_and_centres(robot: Robot, min_mass: float = 0.0) -> LinkMasses:
    """(n,) masses [kg] and (n, 3) centres in the link frames [m]: as told, else those of tubes.

    min_mass: of any link [kg].
    """
    known, (tube, halfway) = known_link_mass_mask(robot), assumed_link_masses_and_centres(robot.mdh)
    mass = np.maximum(np.where(known, robot.mass, tube), min_mass)
    return LinkMasses(mass, np.where(known[:, None], robot.com, halfway))
