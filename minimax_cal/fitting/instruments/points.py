"""Points of a tracker, in a frame of the instrument's own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from minimax_cal.fitting.checks import check_plausible
from minimax_cal.fitting.identify import plenty_of_poses
from minimax_cal.fitting.instruments.data import RelativeData, checked, different
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.fitting.instruments.record import Columns, Instrument, Words
from minimax_cal.fitting.instruments.rows import Plain, of_laws
from minimax_cal.fitting.start import fit_base
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.measurements import Measurements, measurements_in
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.model import Block as Poses
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.modelling.parameters import BASE_NAMES, State
from minimax_cal.reading.rows import TARGET, Rows
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import right_jacobian
from minimax_cal.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class Tracked(RelativeData):
    """Points of a tracker beside other instruments."""

    kind = "points"

    @property
    def numbers(self) -> Array:
        """(m,) three a point."""
        return np.asarray(3 * self.at.seen.sum(axis=1))

    @property
    def independent(self) -> int:
        """Those of different poses, of each target."""
        return 3 * sum(different(self.at, seen) for seen in self.at.seen.T)

    def check(self) -> None:
        """Raise DataError where there are none."""
        if not self.at.seen.any():
            raise DataError(f"{self.at.source}: holds no measured point")


def points(at: Measurements) -> Tracked:
    """Points of a tracker beside other instruments."""
    return checked(Tracked(at))


def read(file: Rows) -> Tracked:
    """The reflectors' columns.  Raises DataError."""
    return Tracked(measurements_in(file))


@dataclass(frozen=True, eq=False)
class Points(Plain):
    """Targets that an instrument sees from a place of its own, as a block, see `rows.Block`.

    Its own: the base's place and turn along and from the axes of the base that fits the arm as
    drawn; then the k targets.  robot: as drawn.  drawn: links, base and targets of that fit.
    """

    model: Model
    robot: Robot
    drawn: State

    kind = "points"
    whole = "all targets moved together"
    has_length = True

    @staticmethod
    def of(robot: Robot, at: Measurements) -> Points:
        """Points of a robot."""
        model = model_of(robot, at)
        return Points(model, robot, fit_base(model, robot.mdh).state)

    @staticmethod
    def seen(robot: Robot, data: Tracked, options: RelativeOptions) -> Points:
        """Points of a tracker."""
        return Points.of(robot, data.at)

    @property
    def spots(self) -> slice:
        """The targets come last."""
        return slice(6, None)

    @property
    def own(self) -> tuple[str, ...]:
        """Base and targets."""
        return (
            *BASE_NAMES,
            *(f"{t}_{axis}" for t in self.model.names.target_names for axis in "xyz"),
        )

    @property
    def parts(self) -> tuple[str, ...]:
        """The targets."""
        return self.model.names.target_names

    @property
    def points(self) -> int:
        """Number of measured points."""
        return int(self.model.counts.sum())

    @property
    def numbers(self) -> int:
        """Three a point."""
        return 3 * self.points

    @property
    def weights(self) -> Array:
        """(rows,) one each."""
        return np.ones(3 * self.model.weight.size)

    @property
    def pose_of_row(self) -> Array:
        """Target by target, axis by axis."""
        k, m = self.model.weight.shape
        return np.tile(np.arange(m), 3 * k)

    def arm_state(self, x: State) -> State:
        """Links, base in the instrument's frame, targets."""
        axes, own = self.drawn.rotation, x.effects[..., : len(self.own)]
        rotation, origin = axes @ kinematics.rotation(own[..., 3:6]), own[..., :3] @ axes.T
        targets = own[..., 6:].reshape(*own.shape[:-1], -1, 3)
        return State(x.mdh, rotation, origin, targets, of_laws(self.model, x))

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """Three rows for each target at each pose, 0 where it was not measured."""
        n, m = self.model.names.joints, len(self.model.q)
        state, first = self.arm_state(x), 5 * n
        links = kinematics.chain(x.mdh, self.model.q, self.model.prismatic)
        every = np.concatenate([active[:first], [True] * 6, active[first + 12 :]])
        error, turned = self.model.weighted_rows(state, Poses(slice(0, m), links), every)
        links_free = int(active[:first].sum())
        base = turned[..., links_free : links_free + 6, :, :]
        move = np.swapaxes(kinematics.rotation(x.effects[..., 3:6]), -1, -2)
        turn = right_jacobian(x.effects[..., 3:6])
        moved = np.einsum("...ij,...kicm->...kjcm", move, base[..., :3, :, :])
        swung = np.einsum("...ij,...kicm->...kjcm", turn, base[..., 3:, :, :])
        own = np.concatenate([moved, swung], axis=-3)[..., active[first + 6 : first + 12], :, :]
        parts = [turned[..., :links_free, :, :], own, turned[..., links_free + 6 :, :, :]]
        jacobian = np.moveaxis(np.concatenate(parts, axis=-3), -3, -4)
        *batch, p, k, _, _ = jacobian.shape
        return error.reshape(*batch, 3 * k * m), jacobian.reshape(*batch, p, 3 * k * m)

    def start(self, robot: Robot, free: Array) -> Array:
        """In closed form."""
        base, targets = self.drawn.rotation.T @ self.drawn.origin, self.drawn.target_positions
        return np.concatenate([base, np.zeros(3), targets.reshape(-1)])

    def reference(self, robot: Robot, x: State) -> Self:
        """At plenty of random poses."""
        return replace(self, model=plenty_of_poses(robot, self.model))

    def closed(self, robot: Robot, x: State) -> Self:
        """The same: points need no arm that fits."""
        return self

    def mean_square(self, x: State) -> float:
        """Of the errors of points [m^2]."""
        error = self.model.error(self.arm_state(x))
        return float(np.nanmean((error**2).sum(axis=-1)))

    def model_at(self, robot: Robot, data: Any) -> Model:
        """With the points there."""
        return model_of(robot, self.seen_at(data))

    def errors(self, model: Model, x: State, data: Any, held: Array) -> Array:
        """Of the points, along the axes of the base."""
        return model.error(self.arm_state(x))

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Base in the instrument's frame, targets in the flange."""
        state = self.arm_state(x)
        spots = (1e3 * state.target_positions).tolist()
        return {
            "base": pose_to_dict(state.base),
            "nominal_base": pose_to_dict(self.drawn.base),
            "targets_mm": dict(zip(self.parts, spots, strict=True)),
        }


def check(robot: Robot, data: Tracked, options: RelativeOptions) -> None:
    """Raise DataError for slips."""
    check_plausible(robot, data.at)


INSTRUMENT = Instrument(
    name=Tracked.kind,
    words=Words(quantity="point of the tracker", part="target", of_position=True),
    block=Points.seen,
    columns=Columns(TARGET, TARGET, "smr1_x_mm ...", read, yields=True),
    check_slips=check,
    alone="it holds reflectors: use minimax-cal calibrate, or give files of other instruments too",
)
