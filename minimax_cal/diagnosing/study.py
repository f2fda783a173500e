"""The geometric fit of some poses, linearised: what a diagnosis starts from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.cell_fit import CellFit
from minimax_cal.fitting.options import Options
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.measuring.session_frames import convert_to_first_frame
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects_in_model import extend_model_with_effects, pose_arm_at_values
from minimax_cal.modelling.error_rows import PointRows, linearise_to_point_rows
from minimax_cal.modelling.point_model import PointModel, build_point_model
from minimax_cal.robots.robot import Robot

LEAST_SQUARES_OPTIONS = Options(objective="sum")


@dataclass(frozen=True, eq=False)
class LinearisedGeometry:
    """The geometric fit of the training poses, linearised.

    model, fit: geometry alone, with the frames of the sessions.  scene: what effects look at. rows:
    rotated, for the two noises.  jump_times: (j,) of the clock at which all targets jumped.
    variance_anisotropy: variance of an instrument's coordinate in the mean over that in its best
    direction.
    """

    robot: Robot
    data: Measurements
    model: PointModel
    fit: CellFit
    scene: PosedArm
    rows: PointRows
    jump_times: Array = field(default_factory=lambda: np.zeros(0))
    variance_anisotropy: float = 1.0

    @property
    def geometric_cell(self) -> Cell:
        """The calibrated robot without effects."""
        return self.fit.cell(self.robot, self.data)

    @property
    def nominal_cell(self) -> Cell:
        """The nominal robot with its best base and targets."""
        return self.fit.nominal_cell(self.robot, self.data)


def linearise_geometry(robot: Robot, data: Measurements, fit: CellFit) -> LinearisedGeometry:
    """A geometric fit linearised."""
    data = convert_to_first_frame(data, fit.frames)
    model, state = build_point_model(robot, data), fit.state
    weight = fit.estimator.model.prior.weight[: model.names.geometric_count]
    model = model.with_prior(replace(model.prior, weight=weight))
    if fit.effects.terms:
        model, _ = extend_model_with_effects(model, robot, data, state, fit.effects.terms)
    scene = pose_arm_at_values(robot, data, model, state)
    rows = linearise_to_point_rows(model, state, scene.jacobian).with_pose_numbers(
        group_repeated_poses(data)
    )
    return LinearisedGeometry(robot, data, model, fit, scene, rows)
