"""How well pixels determine a position of the arm, against how well the drawing is known.

An error of the arm is what no base and no tool takes away: both are fitted wherever it works.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.fitting.instruments.rows import arm_at, state_of
from minimax_cal.fitting.start import fit_base
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import measurements
from minimax_cal.modelling.model import model_of
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints

POSES = 300  # over the joints' whole range
TOOL = np.array([0.0, 0.0, 0.1])  # a point beside the last axes, in the flange [m]
CLEAR = 2.0  # times its sigma: a change of the arm that pixels cannot have made up (1 of 100)


def arms_apart(one: Robot, other: Robot, poses: int = POSES, tool: Array = TOOL) -> float:
    """RMS distance of a tool's point on two arms, base and tool of the other fitted [m]."""
    q = random_joints(one, (poses,), np.random.default_rng(0))
    pose = one.pose(q)
    point = pose[:, :3, :3] @ tool + pose[:, :3, 3]
    data = measurements(q, point)
    return float(np.sqrt(fit_base(model_of(other, data), other.mdh).mean_square))


def position_rows(robot: Robot, tool: Array = TOOL) -> Array:
    """(5n, 3m) motion of a tool's point by each link parameter, without what base and tool take."""
    q = random_joints(robot, (POSES,), np.random.default_rng(0))
    arm = arm_at(robot, q)
    every = arm.jacobian(state_of(robot.mdh, tool, np.zeros(0)))[0].reshape(3 * len(q), -1)
    links = 5 * robot.joints
    u, size, _ = np.linalg.svd(every[:, links:], full_matrices=False)
    taken = u[:, size > 1e-9 * size[0]]
    rows = every[:, :links]
    return np.asarray((rows - taken @ (taken.T @ rows)).T)


def position_sigma(robot: Robot, covariance: Array) -> float:
    """RMS over the joints' range of a position's standard deviation [m].

    covariance: (5n, 5n) of the links.
    """
    rows = position_rows(robot)
    return float(np.sqrt(max(np.trace(rows @ rows.T @ covariance) / POSES, 0.0)))


def drawn_sigma(robot: Robot) -> float:
    """RMS position error that a drawing as good as `drawn_within` leaves [m]."""
    length, angle = robot.drawn_within
    sigma = np.repeat([length, angle], [2 * robot.joints, 3 * robot.joints])
    return position_sigma(robot, np.diag(sigma**2))


@dataclass(frozen=True)
class Claim:
    """What is known of positions of the arm, RMS over the joints' range, base and tool fitted [m].

    sigma: of the calibrated arm.  drawn: of the drawing, by `drawn_within`.  change: between the
    two.
    """

    sigma: float
    drawn: float
    change: float

    @property
    def is_better(self) -> bool:
        """Whether the calibrated arm is known better than the drawn one, which it contradicts."""
        return self.sigma < self.drawn and self.change > CLEAR * self.sigma

    def sentence(self) -> str:
        """For people."""
        mm = {name: f"{1e3 * value:#.3g} mm" for name, value in vars(self).items()}
        said = (
            f"These pixels determine a position of the arm to {mm['sigma']} RMS (sigma over the "
            "joints' whole range, lack of fit and the lenses' doubt included); the drawing knows "
            f"it to {mm['drawn']} (drawn_within), and the calibrated arm differs from it by "
            f"{mm['change']}"
        )
        if self.is_better:
            return f"{said}: the calibrated arm is better."
        if self.sigma >= self.drawn:
            return f"{said}: keep the drawn arm; take more images, nearer, with more tilt."
        return f"{said}, no more than the pixels make up: keep the drawn arm."
