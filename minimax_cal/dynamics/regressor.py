"""The rigid body: torques of an arm in motion, linear in ten inertial parameters a link.

A link's parameters are its mass m, its first moment m c and its inertia xx, xy, xz, yy, yz, zz,
both about the origin of its own frame, in that frame's axes [Atkeson, An, Hollerbach 1986].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.gravity import G, inertia_of, weighed
from minimax_cal.robots.kinematics import Chain, chain, cross
from minimax_cal.robots.robot import Robot

PER_LINK = 10  # inertial parameters of a link
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # order of the entries of an inertia
SQUARE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # which of these a matrix has where
RANK = 1e-7  # of the largest singular value: combinations that turn no joint by more have no say


@dataclass(frozen=True, eq=False)
class Motion:
    """Joint values and their derivatives, in the controller's sense: (m, n) [rad, m, s]."""

    q: Array
    qd: Array
    qdd: Array

    def at(self, rows: Array | slice) -> Motion:
        """Some samples."""
        return Motion(self.q[rows], self.qd[rows], self.qdd[rows])


def link_axes(links: Chain) -> Array:
    """(n, 3, 3, m) axes x, y, z of each link's own frame in the base, one a row."""
    z = np.concatenate([links.z[1:], links.axes[2:]])
    return np.stack([cross(links.y, z), links.y, z], axis=1)


def moving_chain(robot: Robot, motion: Motion) -> tuple[Chain, Array]:
    """The chain that the drives move by the robot's couplings, and how: (3, n, 3, m) in the base.

    Turning rate, its derivative and acceleration of the origin of each link.  The base accelerates
    upwards with g, which stands for gravity.
    """
    q, qd, qdd = (robot.turned(part) for part in (motion.q, motion.qd, motion.qdd))
    links = chain(robot.mdh, np.ascontiguousarray(q), robot.prismatic)
    n, _, m = links.z.shape
    rate, change = np.zeros((3, m)), np.zeros((3, m))
    speeding = np.broadcast_to(G * robot.up[:, None], (3, m))
    out = np.empty((3, n, 3, m))
    for j in range(n):
        z, arm = links.z[j], links.after[j] - links.before[j]
        if robot.prismatic[j]:
            slide = z * qdd[:, j] + 2.0 * cross(rate, z * qd[:, j])
        else:
            change = change + z * qdd[:, j] + cross(rate, z * qd[:, j])
            rate = rate + z * qd[:, j]
            slide = np.zeros((3, m))
        inward = cross(rate, cross(rate, arm))
        speeding = speeding + cross(change, arm) + inward + slide
        out[:, j] = rate, change, speeding
    return links, out


def at_drives(robot: Robot, torque: Array) -> Array:
    """(m, n, ...) torque of each drive, in the controller's sense, of the chain's (n, ..., m)."""
    return np.moveaxis(np.einsum("ij,i...->j...", robot.turning, torque), -1, 0)


def wrench(rate: Array, change: Array, speeding: Array) -> tuple[Array, Array]:
    """Force and moment about a link's origin per inertial parameter: (3, 10, m) each.

    Arguments (3, m): turning rate, its derivative, acceleration of the origin, in the link's axes.
    """
    m = rate.shape[1]
    force, moment = np.zeros((2, 3, PER_LINK, m))
    eye = np.eye(3)[:, :, None]
    force[:, 0] = speeding
    for i in range(3):
        unit = np.broadcast_to(eye[i], (3, m))
        force[:, 1 + i] = cross(change, unit) + cross(rate, cross(rate, unit))
        moment[:, 1 + i] = cross(unit, speeding)
    for number, (i, j) in enumerate(UPPER):
        spin, turn = np.zeros((2, 3, m))
        spin[i], turn[i] = rate[j], change[j]
        spin[j], turn[j] = rate[i], change[i]
        moment[:, 4 + number] = turn + cross(rate, spin)
    return force, moment


def regressor(robot: Robot, motion: Motion) -> Array:
    """(m, n, 10 n) torque of each drive [N m, N] per inertial parameter, in the controller's sense.

    Newton and Euler, each link's wrench projected on the joints before it.
    """
    links, moving = moving_chain(robot, motion)
    axes, n, m = link_axes(links), robot.joints, len(motion.q)
    out = np.zeros((n, n * PER_LINK, m))
    for k in range(n):
        own = (np.einsum("abm,bm->am", axes[k], part[k]) for part in moving)
        force, moment = wrench(*own)
        for j in range(k + 1):
            z = np.einsum("abm,bm->am", axes[k], links.z[j])
            part = out[j, PER_LINK * k : PER_LINK * (k + 1)]
            if robot.prismatic[j]:
                part[:] = np.einsum("am,apm->pm", z, force)
                continue
            lever = cross(links.z[j], links.after[k] - links.before[j])
            lever = np.einsum("abm,bm->am", axes[k], lever)
            part[:] = np.einsum("am,apm->pm", z, moment) + np.einsum("am,apm->pm", lever, force)
    return at_drives(robot, out)


def inverse_dynamics(robot: Robot, motion: Motion, parameters: Array) -> Array:
    """(m, n) torque of each drive [N m, N] of known inertial parameters (n, 10).

    Newton and Euler in the base frame: as the regressor's, without its columns.
    """
    links, (rate, change, speeding) = moving_chain(robot, motion)
    axes = link_axes(links)
    mass = parameters[:, 0, None, None]
    first = np.einsum("nabm,na->nbm", axes, parameters[:, 1:4])
    own = parameters[:, 4 + SQUARE]

    def about(w: Array) -> Array:
        inner = own @ np.einsum("nabm,nbm->nam", axes, w)
        return np.asarray(np.einsum("nabm,nam->nbm", axes, inner))

    force = mass * speeding + cross(change, first) + cross(rate, cross(rate, first))
    moment = cross(first, speeding) + about(change) + cross(rate, about(rate))
    moment = moment + cross(links.after, force)  # about the origin of the base
    force, moment = (np.cumsum(part[::-1], axis=0)[::-1] for part in (force, moment))
    turning = links.z * (moment - cross(links.before, force))
    along = np.where(robot.prismatic[:, None, None], links.z * force, turning)
    return at_drives(robot, along.sum(axis=1))


def link_parameters(mass: float, com: Array, inertia: Array) -> Array:
    """(10,) of a body.  com: (3,) [m].  inertia: (6,) about the centre of gravity [kg m^2]."""
    about = inertia[SQUARE] + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.array([mass, *(mass * com), *about[np.triu_indices(3)]])


def inertial_parameters(robot: Robot) -> Array:
    """(n, 10) of the links as the robot file gives them; 0 of a link without a mass.

    Without an inertia a link is a solid body as long as it is.
    """
    out, known = np.zeros((robot.joints, PER_LINK)), weighed(robot)
    for i in np.flatnonzero(known):
        inertia = robot.inertia[i] if len(robot.inertia) else np.full(6, np.nan)
        if not np.isfinite(inertia).all():
            about = inertia_of(robot.mdh, int(i), float(robot.mass[i]))
            inertia = np.array([about, 0.0, 0.0, about, 0.0, about])
        out[i] = link_parameters(float(robot.mass[i]), robot.com[i], inertia)
    return out


def base_parameters(columns: Array, rank: float = RANK) -> Array:
    """(p, r) orthonormal combinations of inertial parameters that torques can tell [Gautier 1991].

    columns: (N, p) rows of a regressor, of random or of real motion.
    """
    scale = np.linalg.norm(columns, axis=0)
    used = scale > rank * scale.max(initial=0.0)
    _, size, right = np.linalg.svd(columns[:, used] / scale[used], full_matrices=False)
    kept = size > rank * size.max(initial=0.0)
    out = np.zeros((columns.shape[1], int(kept.sum())))
    out[used] = right[kept].T * scale[used][:, None]
    return np.linalg.qr(out)[0]
