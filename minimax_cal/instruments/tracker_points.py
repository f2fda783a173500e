"""Points of a tracker, in a frame of the instrument's own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.instruments.instrument import (
    NOT_READY,
    FramePose,
    Instrument,
    InstrumentColumns,
    Words,
    check_instrument_data,
    count_distinct_poses,
)
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangePoses, ResidualRows
from minimax_cal.measuring.measurements import Measurements, build_measurements
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.parameters import BASE_PARAMETER_NAMES, ParameterValues
from minimax_cal.modelling.point_model import build_point_model, point_weights_from_u95
from minimax_cal.reading.measurement_table import TARGET_COLUMN_PATTERN, MeasurementTable
from minimax_cal.robots.kinematics import rotation_from_vector, so3_right_jacobian
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform


class PointErrors(NamedTuple):
    """Measured minus predicted, and predicted points, (m, k, 3) along the base's axes [m]."""

    errors: Array
    predictions: Array


@dataclass(frozen=True, eq=False)
class TrackerPoints(Instrument):
    """Targets that an instrument sees from a place of its own.

    drawn: links, base and targets that fit the arm as drawn.

    Its own: the base's place and turn along and from the axes of that base; then the k targets.
    """

    drawn: ParameterValues = NOT_READY

    kind = "points"
    words = Words(
        quantity="point of the tracker",
        part="target",
        of_position=True,
        whole="all targets moved together",
    )
    chosen: ClassVar[tuple[str, ...]] = ("drawn",)
    targets_at = slice(6, None)
    refines = False
    alone = "it holds reflectors: use minimax-cal calibrate, or give files of other instruments too"

    @property
    def numbers_per_pose(self) -> Array:
        """(m,) three a point."""
        return np.asarray(3 * self.at.seen.sum(axis=1))

    @property
    def point_count(self) -> int:
        """Number of measured points."""
        return int(self.measurements_with_points.seen.sum())

    @property
    def independent_number_count(self) -> int:
        """Those of different poses, of each target."""
        return 3 * sum(count_distinct_poses(self.at, seen) for seen in self.at.seen.T)

    def check_data(self) -> None:
        """Raise DataError where there are none."""
        if not self.at.seen.any():
            raise DataError(f"{self.at.source}: holds no measured point")

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> Self:
        """With the base that fits the arm as drawn."""
        return replace(
            self,
            drawn=fit_base_and_targets(
                build_point_model(robot, self.measurements_with_points), robot.mdh
            ).state,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Base and targets."""
        return (
            *BASE_PARAMETER_NAMES,
            *(f"{t}_{axis}" for t in self.measurements_with_points.target_names for axis in "xyz"),
        )

    @property
    def part_names(self) -> tuple[str, ...]:
        """The targets."""
        return self.measurements_with_points.target_names

    def base_rotation_and_origin(self, unknowns: Array) -> FramePose:
        """Rotation and origin."""
        axes = self.drawn.rotation
        return FramePose(axes @ rotation_from_vector(unknowns[3:6]), axes @ unknowns[:3])

    def point_errors_and_predictions(self, arm: FlangePoses, unknowns: Array) -> PointErrors:
        """(m, k, 3) measured minus predicted, and predicted, along the axes of the base [m]."""
        turn, origin = self.base_rotation_and_origin(unknowns)
        place = arm.place(self.flange_points(unknowns))
        return PointErrors((self.measurements_with_points.y - origin) @ turn - place, place)

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        """Three rows for each target at each pose, axis by axis, 0 where it was not measured."""
        seen = self.measurements_with_points
        k, m = len(seen.target_names), seen.poses
        root = np.sqrt(point_weights_from_u95(seen))
        off, place = self.point_errors_and_predictions(arm, unknowns)
        part, axis, pose = (each.reshape(-1) for each in np.indices((k, 3, m)))
        point = place[pose, part]
        by_point = np.eye(3)[axis] * root[part, pose][:, None]
        by_own = np.zeros((3 * k * m, len(unknowns)))
        by_own[:, :3] = by_point @ rotation_from_vector(unknowns[3:6]).T
        by_own[:, 3:6] = np.cross(point, by_point) @ so3_right_jacobian(unknowns[3:6])
        spots = np.einsum("ri,rij->rj", by_point, arm.rotation[pose])
        for column in range(3):
            by_own[np.arange(len(part)), 6 + 3 * part + column] = spots[:, column]
        error = np.nan_to_num(np.moveaxis(off * root.T[..., None], 0, -1))  # (k, 3, m) as the rows
        return ResidualRows(
            error.reshape(-1), pose, point, by_point, np.zeros_like(by_point), by_own, part
        )

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> list[Array]:
        """In closed form."""
        base, targets = self.drawn.rotation.T @ self.drawn.origin, self.drawn.target_positions
        return [np.concatenate([base, np.zeros(3), targets.reshape(-1)])]

    def mean_square_error(self, arm: FlangePoses, unknowns: Array) -> float:
        """Of the errors of points [m^2]."""
        return float(
            np.nanmean((self.point_errors_and_predictions(arm, unknowns)[0] ** 2).sum(axis=-1))
        )

    def part_errors(self, arm: FlangePoses, unknowns: Array, holdout_mask: Array) -> Array:
        """Of the points, along the axes of the base."""
        return self.point_errors_and_predictions(arm, unknowns)[0]

    def fitted_values_to_dict(
        self, arm: FlangePoses, unknowns: Array, nominal_unknowns: Array
    ) -> dict[str, Any]:
        """Base in the instrument's frame, targets in the flange."""
        spots = (1e3 * self.flange_points(unknowns)).tolist()
        return {
            "base": pose_to_dict(build_transform(*self.base_rotation_and_origin(unknowns))),
            "nominal_base": pose_to_dict(self.drawn.base_pose),
            "targets_mm": dict(zip(self.part_names, spots, strict=True)),
        }


def build_tracker_points(measurements: Measurements) -> TrackerPoints:
    """Points of a tracker beside other instruments."""
    return check_instrument_data(TrackerPoints(measurements))


def parse_tracker_points(table: MeasurementTable) -> TrackerPoints:
    """The reflectors' columns.  Raises DataError."""
    return TrackerPoints(build_measurements(table))


TrackerPoints.file = InstrumentColumns(
    TARGET_COLUMN_PATTERN, TARGET_COLUMN_PATTERN, "smr1_x_mm ...", parse_tracker_points, yields=True
)
