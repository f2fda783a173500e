"""The geometric fit of some poses, linearised: what a diagnosis starts from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from minimax_cal.fitting.options import Options
from minimax_cal.fitting.solve import Solved
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import seen_from
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.joint_fit import extended, scene_of
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.modelling.rows import Rows, linearised
from minimax_cal.robots.robot import Robot

SUM = Options(objective="sum")


@dataclass(frozen=True, eq=False)
class Study:
    """The geometric fit of the training poses, linearised.

    model, fit: geometry alone, with the frames of the sessions.  scene: what effects look at.
    rows: rotated, for the two noises.  moments: (j,) of the clock at which all targets jumped.
    uneven: variance of an instrument's coordinate in the mean over that in its best direction.
    """

    robot: Robot
    data: Measurements
    model: Model
    fit: Solved
    scene: Scene
    rows: Rows
    moments: Array = field(default_factory=lambda: np.zeros(0))
    uneven: float = 1.0

    @property
    def geometric(self) -> Cell:
        """The calibrated robot without effects."""
        return self.fit.cell(self.robot, self.data)

    @property
    def nominal(self) -> Cell:
        """The nominal robot with its best base and targets."""
        return self.fit.nominal_cell(self.robot, self.data)


def studied(robot: Robot, data: Measurements, fit: Solved) -> Study:
    """A geometric fit linearised."""
    data = seen_from(data, fit.frames)
    model, state = model_of(robot, data), fit.state
    weight = fit.estimator.model.prior.weight[: model.names.geometric]
    model = model.with_prior(replace(model.prior, weight=weight))
    if fit.effects.terms:
        model, _ = extended(model, robot, data, state, fit.effects.terms)
    scene = scene_of(robot, data, model, state)
    rows = linearised(model, state, scene.jacobian).with_poses(groups(data))
    return Study(robot, data, model, fit, scene, rows)
