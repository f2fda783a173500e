"""Joint values at random, where a robot can be."""

from __future__ import annotations

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots.joint_ranges import DEFAULT_SLIDE_RANGE, JointBounds, clip_range_near_zero
from minimax_cal.robots.robot import Robot


def sampling_range(robot: Robot, max_joint_angle: float = np.pi) -> JointBounds:
    """(n,) lowest and highest joint values: the limits, at most one turn [rad, m].

    max_joint_angle: most that a joint turns from 0 [rad], where it comes there.
    """
    return clip_range_near_zero(
        robot.lower, robot.upper, np.where(robot.prismatic, DEFAULT_SLIDE_RANGE, max_joint_angle)
    )


def random_joint_values(robot: Robot, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Joint values (*size, n) all over their range [rad, m]."""
    return rng.uniform(*sampling_range(robot), (*shape, robot.joints))


def random_joint_values_above_floor(
    robot: Robot, count: int, rng: np.random.Generator, max_joint_angle: float = np.pi
) -> Array:
    """Joint values (count, n) within the limits and one turn, the flange above the floor."""
    lower, upper = sampling_range(robot, max_joint_angle)
    chosen = np.empty((0, robot.joints))
    for _ in range(100):
        q = rng.uniform(lower, upper, (4 * count, robot.joints))
        high = robot.pose(q)[:, :3, 3] @ robot.up > 0.1 * robot.reach()
        chosen = np.concatenate([chosen, q[high]])[:count]
        if len(chosen) == count:
            return chosen
    # an arm that hangs below its base: every pose is as good as another
    return rng.uniform(lower, upper, (count, robot.joints))
