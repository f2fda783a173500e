"""Points of a tracker, in a frame of the instrument's own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import (
    UNREADY,
    Columns,
    Instrument,
    Words,
    checked,
    different,
)
from minimax_cal.instruments.options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangePoses, ResidualRows
from minimax_cal.measuring.measurements import Measurements, measurements_in
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.model import model_of, point_weights
from minimax_cal.modelling.parameters import BASE_NAMES, State
from minimax_cal.modelling.start import fit_base
from minimax_cal.reading.rows import TARGET, Rows
from minimax_cal.robots.kinematics import right_jacobian, rotation
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import transform


@dataclass(frozen=True, eq=False)
class Points(Instrument):
    """Targets that an instrument sees from a place of its own.

    drawn: links, base and targets that fit the arm as drawn.

    Its own: the base's place and turn along and from the axes of that base; then the k targets.
    """

    drawn: State = UNREADY

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
    def numbers(self) -> Array:
        """(m,) three a point."""
        return np.asarray(3 * self.at.seen.sum(axis=1))

    @property
    def points(self) -> int:
        """Number of measured points."""
        return int(self.seen.seen.sum())

    @property
    def independent(self) -> int:
        """Those of different poses, of each target."""
        return 3 * sum(different(self.at, seen) for seen in self.at.seen.T)

    def check(self) -> None:
        """Raise DataError where there are none."""
        if not self.at.seen.any():
            raise DataError(f"{self.at.source}: holds no measured point")

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> Self:
        """With the base that fits the arm as drawn."""
        return replace(self, drawn=fit_base(model_of(robot, self.seen), robot.mdh).state)

    @property
    def names(self) -> tuple[str, ...]:
        """Base and targets."""
        return (*BASE_NAMES, *(f"{t}_{axis}" for t in self.seen.target_names for axis in "xyz"))

    @property
    def parts(self) -> tuple[str, ...]:
        """The targets."""
        return self.seen.target_names

    def base(self, own: Array) -> tuple[Array, Array]:
        """Rotation and origin."""
        axes = self.drawn.rotation
        return axes @ rotation(own[3:6]), axes @ own[:3]

    def placed_at(self, arm: FlangePoses, own: Array) -> tuple[Array, Array]:
        """(m, k, 3) measured minus predicted, and predicted, along the axes of the base [m]."""
        turn, origin = self.base(own)
        place = arm.place(self.targets(own))
        return (self.seen.y - origin) @ turn - place, place

    def read(self, arm: FlangePoses, own: Array) -> ResidualRows:
        """Three rows for each target at each pose, axis by axis, 0 where it was not measured."""
        seen = self.seen
        k, m = len(seen.target_names), seen.poses
        root = np.sqrt(point_weights(seen))
        off, place = self.placed_at(arm, own)
        part, axis, pose = (each.reshape(-1) for each in np.indices((k, 3, m)))
        point = place[pose, part]
        by_point = np.eye(3)[axis] * root[part, pose][:, None]
        by_own = np.zeros((3 * k * m, len(own)))
        by_own[:, :3] = by_point @ rotation(own[3:6]).T
        by_own[:, 3:6] = np.cross(point, by_point) @ right_jacobian(own[3:6])
        spots = np.einsum("ri,rij->rj", by_point, arm.rotation[pose])
        for column in range(3):
            by_own[np.arange(len(part)), 6 + 3 * part + column] = spots[:, column]
        error = np.nan_to_num(np.moveaxis(off * root.T[..., None], 0, -1))  # (k, 3, m) as the rows
        return ResidualRows(
            error.reshape(-1), pose, point, by_point, np.zeros_like(by_point), by_own, part
        )

    def starts(self, arm: FlangePoses, free: Array) -> list[Array]:
        """In closed form."""
        base, targets = self.drawn.rotation.T @ self.drawn.origin, self.drawn.target_positions
        return [np.concatenate([base, np.zeros(3), targets.reshape(-1)])]

    def mean_square(self, arm: FlangePoses, own: Array) -> float:
        """Of the errors of points [m^2]."""
        return float(np.nanmean((self.placed_at(arm, own)[0] ** 2).sum(axis=-1)))

    def errors(self, arm: FlangePoses, own: Array, held: Array) -> Array:
        """Of the points, along the axes of the base."""
        return self.placed_at(arm, own)[0]

    def placed(self, arm: FlangePoses, own: Array, drawn: Array) -> dict[str, Any]:
        """Base in the instrument's frame, targets in the flange."""
        spots = (1e3 * self.targets(own)).tolist()
        return {
            "base": pose_to_dict(transform(*self.base(own))),
            "nominal_base": pose_to_dict(self.drawn.base),
            "targets_mm": dict(zip(self.parts, spots, strict=True)),
        }


def points(at: Measurements) -> Points:
    """Points of a tracker beside other instruments."""
    return checked(Points(at))


def read(file: Rows) -> Points:
    """The reflectors' columns.  Raises DataError."""
    return Points(measurements_in(file))


Points.file = Columns(TARGET, TARGET, "smr1_x_mm ...", read, yields=True)
