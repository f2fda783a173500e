"""What only a robot's file can tell of a log: its joints' limits, and the size of its torques."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from minimax_cal.dynamics.regressor import Motion, inertial_parameters, regressor
from minimax_cal.dynamics.run import NOTHING, TORQUE, Run
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.gravity import weighed
from minimax_cal.robots.robot import Robot

COMPARED = 400  # rows of a run that are compared with gravity
HEAVY = 5.0  # range of gravity's torque at a joint that shows the size of a torque [N m]
LEAST_SCALE, MOST_SCALE = 0.4, 2.5  # masses of data sheets are not wrong by more
FOLLOWS = 0.9  # correlation of a torque with gravity; 0.93 to 0.96 at the shoulder of real arms
SLACK = 0.01  # of the range of a joint: how far outside its limits it may be


def against_robot(robot: Robot, run: Run) -> Run:
    """A run of the robot's joints, with notices of what does not fit it."""
    return replace(run, notices=(*run.notices, *outside(robot, run), *odd_torque(robot, run)))


def outside(robot: Robot, run: Run) -> Iterator[str]:
    """Notices of joints outside their limits."""
    slack = SLACK * (robot.upper - robot.lower)
    slack = np.where(np.isfinite(slack), slack, 0.0)
    off = (run.q < robot.lower - slack) | (run.q > robot.upper + slack)
    for j in np.flatnonzero(off.any(axis=0)):
        low, high = run.q[:, j].min(), run.q[:, j].max()
        unit, scale = ("mm", 1e3) if robot.prismatic[j] else ("deg", 180.0 / np.pi)
        yield (
            f"{run.source}: joint {j + 1} moves from {scale * low:.4g} to {scale * high:.4g} "
            f"{unit}, outside the limits of {robot.name}; check its unit and zero"
        )


def odd_torque(robot: Robot, run: Run) -> Iterator[str]:
    """A notice where torques are not those that hold the arm's masses: order, sign, size."""
    if run.unit == NOTHING or not weighed(robot).all():
        return
    rows = np.unique(np.linspace(0, len(run.time) - 1, COMPARED).astype(int))
    weight = gravity(robot, run.q[rows])
    span = np.where(robot.prismatic, 0.0, np.ptp(weight, axis=0))
    j = int(np.argmax(span))
    if span[j] < HEAVY:
        return
    alike = np.nan_to_num(np.corrcoef(weight[:, j], run.torque[rows].T)[0, 1:])
    other = int(np.argmax(np.abs(alike)))
    if abs(alike[other]) > FOLLOWS and other != j:
        yield (
            f"{run.source}: the torque of joint {other + 1} follows gravity at joint {j + 1} "
            f"(correlation {alike[other]:.2f}, that of joint {j + 1} {alike[j]:.2f}); check the "
            "order of the joints"
        )
    elif alike[j] < -FOLLOWS:
        yield (
            f"{run.source}: the torque of joint {j + 1} has the sign of gravity, not of what holds "
            "it; check its sign"
        )
    elif run.unit == TORQUE:
        speed = np.gradient(run.q[:, j], run.time)[rows]
        yield from odd_size(robot, run, j, weight[:, j], run.torque[rows, j], speed)


def odd_size(
    robot: Robot, run: Run, j: int, weight: Array, torque: Array, speed: Array
) -> Iterator[str]:
    """A notice where a joint's torque is another multiple of gravity's.  Arrays: (m,)."""
    columns = np.column_stack([weight, np.sign(speed), speed, np.ones(len(speed))])
    scale = float(np.linalg.lstsq(columns, torque, rcond=None)[0][0])
    if not LEAST_SCALE < scale < MOST_SCALE:
        yield (
            f"{run.source}: the torque of joint {j + 1} is {scale:.3g} times what holds the masses "
            f"of {robot.name}; a current? then name the columns i1_A, i2_A, ..."
        )


def gravity(robot: Robot, q: Array) -> Array:
    """(m, n) torques that hold the arm's links at rest [N m, N].  q: (m, n)."""
    rest = np.zeros_like(q)
    columns = regressor(robot, Motion(q, rest, rest))
    return np.asarray(columns @ inertial_parameters(robot).ravel())
