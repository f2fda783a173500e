"""Joint values at random, where a robot can be."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.ranges import SLIDE, near_zero
from minimax_cal.robots.robot import Robot


def joint_range(robot: Robot, span: float = np.pi) -> tuple[Array, Array]:
    """(n,) lowest and highest joint values: the limits, at most one turn [rad, m].

    span: most that a joint turns from 0 [rad], where it comes there.
    """
    return near_zero(robot.lower, robot.upper, np.where(robot.prismatic, SLIDE, span))


def random_joints(robot: Robot, size: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Joint values (*size, n) all over their range [rad, m]."""
    return rng.uniform(*joint_range(robot), (*size, robot.joints))


def random_poses(robot: Robot, count: int, rng: np.random.Generator, span: float = np.pi) -> Array:
    """Joint values (count, n) within the limits and one turn, the flange above the floor."""
    lower, upper = joint_range(robot, span)
    chosen = np.empty((0, robot.joints))
    for _ in range(100):
        q = rng.uniform(lower, upper, (4 * count, robot.joints))
        high = robot.pose(q)[:, :3, 3] @ robot.up > 0.1 * robot.reach()
        chosen = np.concatenate([chosen, q[high]])[:count]
        if len(chosen) == count:
            return chosen
    # an arm that hangs below its base: every pose is as good as another
    return rng.uniform(lower, upper, (count, robot.joints))
