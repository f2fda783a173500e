"""Servos of ordinary gains that hold an arm where its fit says, and bring it there smoothly.

Actuators carry gravity but for a share s (`gravcomp` of the bodies, `actuatorgravcomp` of the
joints), so that a joint of the gain s/c stands off by s tau / (s/c) = c tau, whatever s is.  Where
no share suits all joints, because one is stiff and another is not, actuators carry all of gravity
and a compliant joint has a spring of its own on its axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.gravity import G, centres, inertia_of, torques
from minimax_cal.robots.kinematics import chain, cross
from minimax_cal.robots.sampling import random_poses
from minimax_cal.simulators.arm import Arm

SETTLES = 15.0  # a servo's frequency at the largest inertia: 1.5 s of rest leave 4e-9 [rad/s]
LEAST_RATIO, SLOWEST = 0.7, 7.5  # a given damper stays from this damping ratio to this pole [1/s]
SMALLEST = 0.1  # of the largest gain, for joints that carry little: as published models have them
WIDEST = 10.0  # gains are at most so much larger than the largest that a smooth move needs
SAG = 2e-6  # gravity moves the tool of a joint that is stiff by no more [m]
STEPS = 2.0  # a damper's own time is at least so many timesteps: then no stiffness shakes
NOTHING = 1e-12
LEVER = 0.1  # from the flange to what it carries [m]
SAMPLES = 200  # poses at which loads are looked for


@dataclass(frozen=True, eq=False)
class Drives:
    """The servos of a model as they are, all at the joints; of a new one there are none.

    gain, damper: (n,) [N m/rad, N m s/rad]; own: (n,) the part of damper that the joint itself has.
    limits: (n, 2) of the torque of each joint's actuators [N m].
    inertia: (n,) largest about each joint [kg m^2].  timestep: [s].
    gravity_free: whether actuators carry no gravity because the model's bodies float already.
    braked: (n,) True where the joint is to hold its servo's damper, which is implicit there.
    """

    gain: Array
    damper: Array
    own: Array
    limits: Array
    inertia: Array
    braked: Array
    timestep: float = 0.002
    gravity_free: bool = False

    @staticmethod
    def none(joints: int) -> Drives:
        """Of a new file."""
        nothing = np.zeros(joints)
        ends = np.array([[-np.inf, np.inf]] * joints)
        return Drives(nothing, nothing, nothing, ends, nothing, np.ones(joints, dtype=bool))


@dataclass(frozen=True, eq=False)
class Servos:
    """share: of gravity that bends the joints, s.  gain, damper: (n,) [N m/rad, N m s/rad].

    sprung: (n,) True where a spring of its own holds the joint's compliance.
    kept: (n,) True where gain and damper are those that the model has.
    """

    share: float
    gain: Array
    damper: Array
    sprung: Array
    kept: Array


def choose_servos(arm: Arm, drives: Drives, *, springs: bool = False) -> Servos:
    """Gains that settle within a rest of 1.5 s, and the share of gravity that makes them exact.

    springs: whether springs of their own hold what joints give way, and no gain.
    """
    inertia, torque = loads(arm)
    inertia = np.maximum(inertia, drives.inertia)
    needed = SETTLES**2 * inertia
    ordinary = np.maximum(drives.gain, np.maximum(needed, SMALLEST * needed.max()))
    _, reach, _ = carried(arm)
    lever = np.where(arm.robot.prismatic, 1.0, reach)
    soft = arm.turn > NOTHING
    compliance = np.where(soft, arm.turn, np.inf)
    share = min(1.0, float((arm.turn * ordinary).max()))
    stiff = np.maximum(ordinary, share * torque * lever / SAG)
    gain = np.where(soft, share / compliance, stiff)
    sprung = np.zeros(len(gain), dtype=bool)
    if springs or gain.max() > WIDEST * ordinary.max():
        share, gain, sprung = 0.0, ordinary, soft
    critical = 2.0 * np.sqrt(gain * inertia)
    kept = np.isclose(gain, drives.gain, rtol=1e-9)
    kept &= (drives.damper >= LEAST_RATIO * critical) & (drives.damper <= gain / SLOWEST)
    new = np.maximum(critical, STEPS * drives.timestep * gain)
    return Servos(share, gain, np.where(kept, drives.damper, new), sprung, kept)


def loads(arm: Arm, q: Array | None = None) -> tuple[Array, Array]:
    """(n,) largest inertia [kg m^2] and gravity torque [N m] of each joint, of slides kg and N.

    q: (m, n) poses, all over the workspace unless given [rad, m].
    """
    robot = arm.robot
    if q is None:
        q = random_poses(robot, SAMPLES, np.random.default_rng(0))
    links = chain(robot.mdh, robot.turned(q), robot.prismatic)
    at = centres(links, arm.com)
    beyond = np.cumsum(arm.mass[::-1])[::-1]
    own = [inertia_of(robot.mdh, i, m) for i, m in enumerate(arm.mass)]
    turning = np.cumsum(np.array(own)[::-1])[::-1]
    inertia = np.zeros((robot.joints, len(q)))
    for i in range(robot.joints):
        lever = cross(links.z[i][None], at[i:] - links.before[i][None])
        inertia[i] = np.einsum("k,kam,kam->m", arm.mass[i:], lever, lever) + turning[i]
    torque = torques(links, arm.mass, arm.com, robot.up)
    force = G * beyond[:, None] * np.einsum("nam,a->nm", links.z, robot.up)
    slides = robot.prismatic[:, None]
    return (
        np.asarray(np.where(slides, beyond[:, None], inertia).max(axis=1)),
        np.asarray(np.abs(np.where(slides, force, torque)).max(axis=1)),
    )


def carried(arm: Arm) -> tuple[Array, Array, Array]:
    """For each joint: weight beyond it [N], largest lever of that [m], largest inertia [kg m^2]."""
    robot = arm.robot
    length = np.abs(robot.mdh[:, :2]).sum(axis=1) + np.linalg.norm(arm.com, axis=1)
    slide = np.where(robot.prismatic, np.clip(np.abs(robot.upper), 0.0, 2.0), 0.0)
    reach = np.cumsum((length + slide)[::-1])[::-1] + LEVER
    mass = np.cumsum(arm.mass[::-1])[::-1]
    return mass * G, reach, mass * reach**2
