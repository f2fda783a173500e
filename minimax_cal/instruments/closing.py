"""Joint values that bring the ball on the flange into a given socket."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots.inverse import missing, nearest
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints
from minimax_cal.robots.transforms import transform

LONGEST = 0.5  # step of a joint [rad, m]
CLOSED = 1e-9  # a gap below this counts as none [m]


def reach(
    robot: Robot, ball: Array, goal: Array, q: Array, iterations: int = 100
) -> tuple[Array, Array]:
    """Joint values (m, n) near q at which the ball lies at its goal, and the gaps left (m,) [m].

    ball: (3,) in the last frame [m].  goal: (m, 3) in the base [m].  q: (m, n) where to start
    [rad, m].  Damped Newton with steps of least norm; what cannot be reached ends nearby.
    """
    place = transform(np.eye(3), goal)

    def look(rows: Array, here: Array) -> tuple[Array, Array]:
        turned, turning = robot.turned(here), robot.turning
        return missing(robot.mdh, turned, robot.prismatic, turning, place[rows], 0.0, ball)

    anywhere = np.full(q.shape, np.inf)
    found = nearest(look, q, -anywhere, anywhere, longest=LONGEST, steps=iterations)
    gap, _ = look(np.arange(len(q)), found)
    return found, np.asarray(np.linalg.norm(gap, axis=1))


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
