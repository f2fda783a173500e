"""The geometric fit of some poses, linearised: what a diagnosis starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.evidence.noise import Rows, linearised
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.solve import Solved
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import NOTHING, Term
from minimax_cal.modelling.joint_fit import refitted, scene_of
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.robots.robot import Robot

SUM = Options(objective="sum")
ANY: Array = np.zeros(0)


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

    def cell(self, data: Measurements, terms: Sequence[Term] = (), usual: Array = ANY) -> Cell:
        """Geometry and effects fitted to some poses, from the fit of the training poses.

        usual: (e,) size of the effects' parameters, where the poses may not tell them.
        """
        active = self.fit.identification.active
        state, effects = refitted(self.robot, data, self.fit.state, active, terms, usual)
        return Cell.of(self.robot, state, self.data.target_names, effects)

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
