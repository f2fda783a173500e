"""Joint values that bring the ball on the flange into a given socket."""

from __future__ import annotations

import numpy as np

from minimax_cal.fitting.identify import random_joints
from minimax_cal.ground.arrays import Array
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

LONGEST = 0.5  # step of a joint [rad, m]
CLOSED = 1e-9  # a gap below this counts as none [m]


def reach(
    robot: Robot, ball: Array, goal: Array, q: Array, iterations: int = 100
) -> tuple[Array, Array]:
    """Joint values (m, n) near q at which the ball lies at its goal, and the gaps left (m,) [m].

    ball: (3,) in the last frame [m].  goal: (m, 3) in the base [m].  q: (m, n) where to start
    [rad, m].  Damped Newton with steps of least norm; what cannot be reached ends nearby.
    """
    best = q * robot.sign
    damping = np.full(len(q), 1e-6)
    gap, jacobian = examine(robot, ball, goal, best)
    for _ in range(iterations):
        square = jacobian @ np.swapaxes(jacobian, 1, 2)
        size = np.trace(square, axis1=1, axis2=2)[:, None, None] + 1e-12
        damped = square + damping[:, None, None] * size * np.eye(3)
        step = np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(damped, gap[..., None])
        step = step[..., 0] * np.minimum(1.0, LONGEST / np.maximum(np.abs(step).max(axis=1), 1e-12))
        trial = best + step
        after, after_slope = examine(robot, ball, goal, trial)
        better = np.linalg.norm(after, axis=1) < np.linalg.norm(gap, axis=1)
        best, gap = np.where(better[:, None], trial, best), np.where(better[:, None], after, gap)
        jacobian = np.where(better[:, None, None], after_slope, jacobian)
        damping = np.clip(np.where(better, damping / 10.0, damping * 10.0), 1e-12, 1e6)
        if not better.any() and (damping >= 1e2).all():
            break
    return best * robot.sign, np.asarray(np.linalg.norm(gap, axis=1))


def examine(robot: Robot, ball: Array, goal: Array, q: Array) -> tuple[Array, Array]:
    """Gap from the ball to its goal (m, 3), and the ball's motion (m, 3, n); q: signs applied."""
    links = kinematics.chain(robot.mdh, q, robot.prismatic)
    point = kinematics.points(links, ball[None])[0]
    swing = kinematics.cross(links.z, point - links.before)
    jacobian = np.where(robot.prismatic[:, None, None], links.z, swing)
    return goal - point.T, np.moveaxis(jacobian, -1, 0).swapaxes(1, 2)


def closing_poses(
    robot: Robot, ball: Array, sockets: int, visits: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Random joint values (m, n) that hold the ball in the same socket by turns, and labels (m,).

    Each socket is reached from `visits` random starts over the joints' whole range.  Where fewer
    than two ways to it are found, it is left out.
    """
    q = random_joints(robot, (sockets, visits), rng)
    pose = robot.pose(q[:, 0])
    place = pose[:, :3, :3] @ ball + pose[:, :3, 3]
    goal = np.repeat(place, visits, axis=0)
    found, gap = reach(robot, ball, goal, q.reshape(-1, robot.joints))
    label = np.repeat(np.arange(sockets), visits)
    closed = gap < CLOSED
    often = np.bincount(label[closed], minlength=sockets) > 1
    kept = closed & often[label]
    return found[kept], label[kept]
