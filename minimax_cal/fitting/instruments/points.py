"""Points of a tracker, and whole poses as virtual ones, in a frame of the instrument's own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from minimax_cal.fitting.fit import Parameter
from minimax_cal.fitting.identify import plenty_of_poses
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.poses import (
    TOOL,
    pose_errors,
    posed,
    poses_as_targets,
    spots_of,
)
from minimax_cal.fitting.instruments.rows import Plain, of_laws
from minimax_cal.fitting.start import fit_base
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.model import Block as Poses
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.modelling.parameters import BASE_NAMES, State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import hat, right_jacobian, rotation_vector
from minimax_cal.robots.robot import Robot


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
    row_noise = 1.0
    given_up: ClassVar[tuple[str, ...]] = ()
    held: ClassVar[tuple[str, ...]] = ()
    whole = "all targets moved together"
    has_length = True

    @staticmethod
    def of(robot: Robot, at: Measurements) -> Points:
        """Points of a robot."""
        model = model_of(robot, at)
        return Points(model, robot, fit_base(model, robot.mdh).state)

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

    def model_at(self, robot: Robot, data: RelativeData) -> Model:
        """With the points there."""
        return model_of(robot, self.seen_at(data))

    def errors(self, model: Model, x: State, data: RelativeData, held: Array) -> Array:
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


@dataclass(frozen=True, eq=False)
class WholePoses(Points):
    """Whole poses of a frame on the flange, as virtual reflectors at the corners of a tetrahedron.

    lever: that a radian counts as [m].
    """

    lever: float = 0.0

    kind = "poses"
    parts = ("position",)
    row_noise = 2.0  # of the root of its four reflectors
    whole = "the tool"

    @staticmethod
    def seen(robot: Robot, data: RelativeData, lever: float) -> WholePoses:
        """Poses of a robot."""
        model = model_of(robot, poses_as_targets(data, lever))
        return WholePoses(model, robot, fit_base(model, robot.mdh).state, lever)

    @property
    def numbers(self) -> int:
        """Six a pose, not the twelve of its reflectors.

        With four reflectors their errors' covariance is 4 s^2 times the projector on rigid motions,
        s^2 being the variance of a coordinate of the pose.  No other motion is in the fit's slopes,
        so that its covariance is that of 4 s^2 I.  The reflectors' shape is known, and its
        parameters take no number.
        """
        return 6 * len(self.model.q) + 3 * len(self.model.y) - 6

    def shapeless(self, x: State) -> Array:
        """What no rigid motion of the reflectors makes."""
        state, k = self.arm_state(x), len(self.model.y)
        links = kinematics.chain(state.mdh, self.model.q, self.model.prismatic)
        arm = np.moveaxis(kinematics.points(links, state.target_positions), -1, 0)
        arm = arm - arm.mean(axis=1, keepdims=True)
        shift = np.broadcast_to(np.eye(3), (*arm.shape, 3))
        rigid = np.concatenate([shift, -hat(arm)], axis=-1).reshape(len(arm), 3 * k, 6)
        basis = np.linalg.qr(rigid)[0]
        return np.asarray(np.eye(3 * k) - basis @ np.swapaxes(basis, 1, 2))

    def tool(self, state: State) -> Array:
        """Pose (4, 4) of the measured frame in the flange [m]."""
        return posed(state.target_positions, spots_of(self.lever))

    def seen_at(self, data: RelativeData) -> Measurements:
        """With the virtual reflectors."""
        return poses_as_targets(data, self.lever)

    def predicted(self, model: Model, x: State) -> Array:
        """(m, 4, 4) poses of the measured frame, nearest to where the model has its reflectors."""
        state = self.arm_state(x)
        links = kinematics.chain(state.mdh, model.q, model.prismatic)
        point = kinematics.points(links, state.target_positions)
        in_base = np.moveaxis(model.displaced(state, point, slice(None)), -1, 0)
        return posed(in_base @ state.rotation.T + state.origin, spots_of(self.lever))

    def errors(self, model: Model, x: State, data: RelativeData, held: Array) -> Array:
        """Of positions, in the measurement frame."""
        return pose_errors(self.predicted(model, x), data)[0][None]

    def turns(self, model: Model, x: State, data: RelativeData) -> Array:
        """(m,) angles between orientations [rad]."""
        return pose_errors(self.predicted(model, x), data)[1]

    def listed(
        self, fitted: tuple[Parameter, ...], nominal: State, x: State, covariance: Array
    ) -> tuple[Parameter, ...]:
        """The base, and the tool instead of its reflectors."""
        before, tool = (self.tool(self.arm_state(each)) for each in (nominal, x))
        arm = spots_of(self.lever) @ tool[:3, :3].T  # in the flange's axes
        k = len(arm)
        rigid = np.concatenate([np.tile(np.eye(3), (k, 1)), -hat(arm).reshape(3 * k, 3)], axis=1)
        back = np.linalg.pinv(rigid)
        spread = back @ covariance[6:, 6:] @ back.T
        turn = rotation_vector(tool[:3, :3] @ before[:3, :3].T)
        was, found = [*before[:3, 3], *np.zeros(3)], [*tool[:3, 3], *turn]
        told = all(each.identifiable for each in fitted[6:])
        stem = fitted[0].name.removesuffix(BASE_NAMES[0])
        return fitted[:6] + tuple(
            Parameter(
                name=stem + name,
                value=float(found[i]),
                nominal=float(was[i]),
                sigma=float(np.sqrt(spread[i, i])) if told else np.nan,
                unit="m" if i < 3 else "rad",
                identifiable=told,
                reason="" if told else "same motion as links and base",
            )
            for i, name in enumerate(TOOL)
        )

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Base in the measurement frame, measured frame in the flange, and the lever."""
        out: dict[str, Array] = {}
        for stem, each in (("", x), ("nominal_", nominal)):
            state = self.arm_state(each)
            out |= {f"{stem}base": state.base, f"{stem}tool": self.tool(state)}
        return {name: pose_to_dict(pose) for name, pose in out.items()} | {
            "lever_mm": 1e3 * self.lever
        }
