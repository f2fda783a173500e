"""What geometry lacks, as random functions: turns of each joint that are smooth in all angles.

A law that no parameter holds (compliance, gears, cables) turns a joint by a function of the pose;
what drifts, by one of time.  Nobody knows the functions, but poses tell how large they are: waves
of the joint's own angle, waves of each other one alone and together with it, and the gravity on it,
each with a random factor [Rasmussen and Williams 2006].
"""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity import masses_of, torques
from minimax_cal.robots.robot import Robot

UNIT = 1e-4  # turn by a factor of 1, so that variances are numbers of ordinary size [rad]
OF_ITSELF, OF_OTHERS, OF_GRAVITY = DRIVERS = range(3)  # what drives a function
OWN = 2  # waves in a turn of the joint itself: gears err once and twice a turn
WAVES = 2  # of the place in the session: a drift and a bow
GONE_ON = float(np.sqrt(12.0))  # from one session's mean to the next, over the RMS of a drift


def joint_units(robot: Robot) -> Array:
    """(n,) what counts as a radian of each joint: of a slide the arm's reach [m]."""
    return np.where(robot.prismatic, robot.reach(), 1.0)


def by_pose(robot: Robot, q: Array, arm: Array) -> tuple[Array, Array]:
    """(m, r, c) motion of the points by each function's factor, and (c, 2) its kind.

    The kind is the joint that it turns, and what drives it.  q: (m, n) joint values with signs
    applied.  arm: (m, r, n) motion per unit of each joint.
    """
    unit = joint_units(robot)
    angle, n = q / unit, robot.joints
    links = kinematics.chain(robot.mdh, q, robot.prismatic)
    load = torques(links, *masses_of(robot), robot.up).T
    size = float(np.sqrt(np.mean(load**2)))
    columns, kind = [], []
    for j in range(n):
        others = np.delete(angle, j, axis=1)
        own = angle[:, j, None]
        waves = [own * np.arange(1, OWN + 1), others, others + own, others - own]
        phase = np.concatenate(waves, axis=1)
        pull = load[:, j, None] / (size or 1.0)
        functions = np.concatenate([np.sin(phase), np.cos(phase), pull], axis=1)
        columns.append(UNIT * unit[j] * arm[:, :, j, None] * functions[:, None, :])
        driven = np.repeat([OF_ITSELF, *[OF_OTHERS] * 3], [part.shape[1] for part in waves])
        driver = np.concatenate([driven, driven, np.full(pull.shape[1], OF_GRAVITY)])
        kind.append(np.stack([np.full(len(driver), j), driver], axis=1))
    return np.concatenate(columns, axis=2), np.concatenate(kind)


def by_time(robot: Robot, when: Array, arm: Array, growth: Array) -> tuple[Array, Array]:
    """(1 + WAVES, m, r, n + 1) motion by what drifts: for the whole session, then by each wave.

    And (n + 1,) the kind: 0 a joint's zero, 1 the length of all links.  when: (m,) place in the
    session, 0 to 1.  arm: as in `by_pose`.  growth: (m, r) motion per share of all lengths.
    """
    turned = UNIT * np.concatenate([joint_units(robot) * arm, growth[..., None]], axis=2)
    phase = np.pi * np.arange(WAVES + 1)[:, None] * when
    size = np.where(np.arange(WAVES + 1) > 0, np.sqrt(2.0), GONE_ON)[:, None]
    functions = size * np.cos(phase)
    kind = np.append(np.zeros(robot.joints, dtype=int), 1)
    return functions[:, :, None, None] * turned, kind
