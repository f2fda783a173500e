"""The best fit of an instrument's own parameters to the arm as drawn, from several starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.fitting.instruments.rows import Block
from minimax_cal.fitting.instruments.stack import Squares, Stack
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, Limits

SCREENED = Limits(step=1e-6)  # tells one start from another; the best is refined
SPREAD = (0.05, 0.2)  # where the target may be, from the last frame, per metre of reach


def spots_aside(robot: Robot, first: Array) -> Array:
    """(s, 3) places on the flange worth a start: a first one (3,), the last frame, about it [m]."""
    aside = np.concatenate([np.zeros((1, 3)), *(s * np.eye(3) for s in SPREAD), -0.1 * np.eye(3)])
    return np.concatenate([first[None], robot.reach() * aside])


def refined(robot: Robot, block: Block, few: Block, free: Array, starts: Sequence[Array]) -> Array:
    """(e,) own parameters that fit the arm as drawn best.

    few: the block at some of its poses, which screen the starts (e,).  free: (e,) mask.
    """
    own = np.stack(starts)
    active = np.concatenate([np.zeros(5 * robot.joints + 6, dtype=bool), free])
    some = Squares(Stack.of(robot, [few], [""]), active)
    x = some.stack.state(robot.mdh, list(own[:1]))
    x = x.repeat(len(own))
    x.effects[:] = own
    points = float(few.points)
    if len(own) > 1:
        first = least_squares.solve(some, x, len(own), points, limits=SCREENED, trace=False)
        cost = np.where(np.isfinite(first.cost), first.cost, np.inf)
        x = first.x.take(np.array([int(cost.argmin())]))
    problem = Squares(Stack.of(robot, [block], [""]), active)
    limits, points = Limits(damping=1e-6), float(block.points)
    found = least_squares.solve(problem, x, 1, points, METHODS["snllm"], limits)
    return np.asarray(found.x.effects[0])
