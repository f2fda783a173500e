"""The rigid body: torques of an arm in motion, linear in ten inertial parameters a link.

A link's parameters are its mass m, its first moment m c and its inertia xx, xy, xz, yy, yz, zz,
both about the origin of its own frame, in that frame's axes [Atkeson, An, Hollerbach 1986].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots.gravity_torques import (
    STANDARD_GRAVITY,
    assumed_link_inertia,
    known_link_mass_mask,
)
from minimax_cal.robots.kinematics import LinkFrames, compute_link_frames, cross
from minimax_cal.robots.robot import Robot

INERTIAL_PARAMETERS_PER_LINK = 10  # inertial parameters of a link
INERTIA_ENTRY_INDICES = (
    (0, 0),
    (0, 1),
    (0, 2),
    (1, 1),
    (1, 2),
    (2, 2),
)  # order of the entries of an inertia
INERTIA_MATRIX_LAYOUT = np.array(
    [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
)  # which of these a matrix has where
MIN_BASE_PARAMETER_SINGULAR_VALUE = (
    1e-7  # of the largest singular value: combinations that turn no joint by more have no say
)


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Joint values and their derivatives, in the controller's sense: (m, n) [rad, m, s]."""

    q: Array
    qd: Array
    qdd: Array

    def select_samples(self, sample_indices: Array | slice) -> JointMotion:
        """Some samples."""
        return JointMotion(
            self.q[sample_indices], self.qd[sample_indices], self.qdd[sample_indices]
        )


def compute_link_axes(link_frames: LinkFrames) -> Array:
    """(n, 3, 3, m) axes x, y, z of each link's own frame in the base, one a row."""
    z = np.concatenate([link_frames.z[1:], link_frames.axes[2:]])
    return np.stack([cross(link_frames.y, z), link_frames.y, z], axis=1)


class ChainMotion(NamedTuple):
    """Link frames, and (3, n, 3, m) turning rate, its derivative and acceleration of each
    origin.
    """

    link_frames: LinkFrames
    rates: Array


def compute_chain_motion(robot: Robot, motion: JointMotion) -> ChainMotion:
    """The chain that the drives move by the robot's couplings, and how: (3, n, 3, m) in the base.

    Turning rate, its derivative and acceleration of the origin of each link.  The base accelerates
    upwards with g, which stands for gravity.
    """
    q, qd, qdd = (robot.chain_joint_values(part) for part in (motion.q, motion.qd, motion.qdd))
    links = compute_link_frames(robot.mdh, np.ascontiguousarray(q), robot.prismatic)
    n, _, m = links.z.shape
    rate, change = np.zeros((3, m)), np.zeros((3, m))
    speeding = np.broadcast_to(STANDARD_GRAVITY * robot.up[:, None], (3, m))
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
    return ChainMotion(links, out)


def convert_chain_to_drive_torques(robot: Robot, chain_torques: Array) -> Array:
    """(m, n, ...) torque of each drive, in the controller's sense, of the chain's (n, ..., m)."""
    return np.moveaxis(
        np.einsum("ij,i...->j...", robot.joint_to_chain_matrix, chain_torques), -1, 0
    )


class WrenchColumns(NamedTuple):
    """Force and moment per inertial parameter, (3, 10, m) each."""

    force: Array
    moment: Array


def compute_wrench_per_inertial_parameter(
    angular_velocity: Array, angular_acceleration: Array, origin_acceleration: Array
) -> WrenchColumns:
    """Force and moment about a link's origin per inertial parameter: (3, 10, m) each.

    Arguments (3, m): turning rate, its derivative, acceleration of the origin, in the link's axes.
    """
    m = angular_velocity.shape[1]
    force, moment = np.zeros((2, 3, INERTIAL_PARAMETERS_PER_LINK, m))
    eye = np.eye(3)[:, :, None]
    force[:, 0] = origin_acceleration
    for i in range(3):
        unit = np.broadcast_to(eye[i], (3, m))
        force[:, 1 + i] = cross(angular_acceleration, unit) + cross(
            angular_velocity, cross(angular_velocity, unit)
        )
        moment[:, 1 + i] = cross(unit, origin_acceleration)
    for number, (i, j) in enumerate(INERTIA_ENTRY_INDICES):
        spin, turn = np.zeros((2, 3, m))
        spin[i], turn[i] = angular_velocity[j], angular_acceleration[j]
        spin[j], turn[j] = angular_velocity[i], angular_acceleration[i]
        moment[:, 4 + number] = turn + cross(angular_velocity, spin)
    return WrenchColumns(force, moment)


def regressor(robot: Robot, motion: JointMotion) -> Array:
    """(m, n, 10 n) torque of each drive [N m, N] per inertial parameter, in the controller's sense.

    Newton and Euler, each link's wrench projected on the joints before it.
    """
    links, moving = compute_chain_motion(robot, motion)
    axes, n, m = compute_link_axes(links), robot.joints, len(motion.q)
    out = np.zeros((n, n * INERTIAL_PARAMETERS_PER_LINK, m))
    for k in range(n):
        own = (np.einsum("abm,bm->am", axes[k], part[k]) for part in moving)
        force, moment = compute_wrench_per_inertial_parameter(*own)
        for j in range(k + 1):
            z = np.einsum("abm,bm->am", axes[k], links.z[j])
            part = out[j, INERTIAL_PARAMETERS_PER_LINK * k : INERTIAL_PARAMETERS_PER_LINK * (k + 1)]
            if robot.prismatic[j]:
                part[:] = np.einsum("am,apm->pm", z, force)
                continue
            lever = cross(links.z[j], links.after[k] - links.before[j])
            lever = np.einsum("abm,bm->am", axes[k], lever)
            part[:] = np.einsum("am,apm->pm", z, moment) + np.einsum("am,apm->pm", lever, force)
    return convert_chain_to_drive_torques(robot, out)


def inverse_dynamics(robot: Robot, motion: JointMotion, link_inertial_parameters: Array) -> Array:
    """(m, n) torque of each drive [N m, N] of known inertial parameters (n, 10).

    Newton and Euler in the base frame: as the regressor's, without its columns.
    """
    links, (rate, change, speeding) = compute_chain_motion(robot, motion)
    axes = compute_link_axes(links)
    mass = link_inertial_parameters[:, 0, None, None]
    first = np.einsum("nabm,na->nbm", axes, link_inertial_parameters[:, 1:4])
    own = link_inertial_parameters[:, 4 + INERTIA_MATRIX_LAYOUT]

    def about(w: Array) -> Array:
        inner = own @ np.einsum("nabm,nbm->nam", axes, w)
        return np.asarray(np.einsum("nabm,nam->nbm", axes, inner))

    force = mass * speeding + cross(change, first) + cross(rate, cross(rate, first))
    moment = cross(first, speeding) + about(change) + cross(rate, about(rate))
    moment = moment + cross(links.after, force)  # about the origin of the base
    force, moment = (np.cumsum(part[::-1], axis=0)[::-1] for part in (force, moment))
    turning = links.z * (moment - cross(links.before, force))
    along = np.where(robot.prismatic[:, None, None], links.z * force, turning)
    return convert_chain_to_drive_torques(robot, along.sum(axis=1))


def compute_link_inertial_parameters(mass: float, centre_of_mass: Array, inertia: Array) -> Array:
    """(10,) of a body.  centre_of_mass: (3,) [m].  inertia: (6,) about the centre of gravity [kg
    m^2].
    """
    about = inertia[INERTIA_MATRIX_LAYOUT] + mass * (
        centre_of_mass @ centre_of_mass * np.eye(3) - np.outer(centre_of_mass, centre_of_mass)
    )
    return np.array([mass, *(mass * centre_of_mass), *about[np.triu_indices(3)]])


def build_nominal_inertial_parameters(robot: Robot) -> Array:
    """(n, 10) of the links as the robot file gives them; 0 of a link without a mass.

    Without an inertia a link is a solid body as long as it is.
    """
    out, known = np.zeros((robot.joints, INERTIAL_PARAMETERS_PER_LINK)), known_link_mass_mask(robot)
    for i in np.flatnonzero(known):
        inertia = robot.inertia[i] if len(robot.inertia) else np.full(6, np.nan)
        if not np.isfinite(inertia).all():
            about = assumed_link_inertia(robot.mdh, int(i), float(robot.mass[i]))
            inertia = np.array([about, 0.0, 0.0, about, 0.0, about])
        out[i] = compute_link_inertial_parameters(float(robot.mass[i]), robot.com[i], inertia)
    return out


def compute_base_parameter_combinations(
    regressor_rows: Array, min_singular_value: float = MIN_BASE_PARAMETER_SINGULAR_VALUE
) -> Array:
    """(p, r) orthonormal combinations of inertial parameters that torques can tell [Gautier 1991].

    regressor_rows: (N, p) rows of a regressor, of random or of real motion.
    """
    scale = np.linalg.norm(regressor_rows, axis=0)
    used = scale > min_singular_value * scale.max(initial=0.0)
    _, size, right = np.linalg.svd(regressor_rows[:, used] / scale[used], full_matrices=False)
    kept = size > min_singular_value * size.max(initial=0.0)
    out = np.zeros((regressor_rows.shape[1], int(kept.sum())))
    out[used] = right[kept].T * scale[used][:, None]
    return np.linalg.qr(out)[0]
