"""The geometric fit of some poses, linearised: what a diagnosis starts from."""

from __future__ import annotations

from dataclasses import dataclass

from minimax_cal.evidence.noise import Rows, linearised
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.solve import Solved
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import NOTHING
from minimax_cal.modelling.joint_fit import scene_of
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.robots.robot import Robot

SUM = Options(objective="sum")


@dataclass(frozen=True, eq=False)
class Study:
    """The geometric fit of the training poses, linearised.

    model, fit: geometry alone.  scene: what effects look at.  rows: rotated, for the two noises.
    """

    robot: Robot
    data: Measurements
    model: Model
    fit: Solved
    scene: Scene
    rows: Rows

    @property
    def geometric(self) -> Cell:
        """The calibrated robot without effects."""
        return Cell.of(self.robot, self.fit.state, self.data.target_names, NOTHING)

    @property
    def nominal(self) -> Cell:
        """The nominal robot with its best base and targets."""
        return Cell.of(self.robot, self.fit.nominal, self.data.target_names, NOTHING)


def studied(robot: Robot, data: Measurements, fit: Solved) -> Study:
    """A geometric fit linearised."""
    model, state = model_of(robot, data), fit.state
    scene = scene_of(robot, data, model, state)
    return Study(robot, data, model, fit, scene, linearised(model, state, scene.jacobian))
