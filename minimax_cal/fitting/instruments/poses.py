"""Whole poses of a frame on the flange, as virtual reflectors at the corners of a tetrahedron."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.fitting.checks import check_plausible
from minimax_cal.fitting.found import Parameter
from minimax_cal.fitting.instruments.data import RelativeData, bare, checked, without_blind
from minimax_cal.fitting.instruments.fit import InstrumentFit, allowed_of
from minimax_cal.fitting.instruments.identify import identified
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.fitting.instruments.points import Points
from minimax_cal.fitting.instruments.record import Columns, Instrument, Words
from minimax_cal.fitting.instruments.stack import Stack
from minimax_cal.fitting.reflectors import LEVER, posed, reflectors, spots_of
from minimax_cal.fitting.start import fit_base
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.joint_rows import joint_rows
from minimax_cal.measuring.measurements import FARTHEST, Measurements
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.modelling.parameters import BASE_NAMES, State
from minimax_cal.reading.rows import Rows
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import hat, rotation_vector
from minimax_cal.robots.robot import Robot

PLACE = re.compile(r"flange_([xyz])_(mm|m)")
TURN = re.compile(r"flange_r([xyz])_(rad|deg)")
QUATERNION = re.compile(r"flange_q([wxyz])()")
FLANGE = re.compile(r"flange_(?:[xyz]_(?:mm|m)|r[xyz]_(?:rad|deg)|q[wxyz])")
DOUBTS = re.compile(r"(?:rotation_)?u95_(mm|m|rad|deg)")
NORM = 1e-3  # a quaternion farther from unit length is no rotation
TOOL = ("tool_x", "tool_y", "tool_z", "tool_rx", "tool_ry", "tool_rz")


# ---- what is measured --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FlangePoses(RelativeData):
    """Whole poses.

    pose: (m, 4, 4) of the flange in the measurement frame [m].
    """

    pose: Array

    kind = "poses"
    by_row = ("pose",)

    @property
    def numbers(self) -> Array:
        """(m,) six a pose."""
        return np.full(self.poses, 6)

    def check(self) -> None:
        """Raise DataError for poses that are no rigid motions."""
        if self.pose.shape != (self.poses, 4, 4):
            raise DataError(f"{self.at.source}: pose must be (m, 4, 4); got {self.pose.shape}")
        turn = self.pose[:, :3, :3]
        off = np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3)).max(axis=(1, 2))
        wrong = ~(
            np.isfinite(self.pose).all(axis=(1, 2)) & (off < NORM) & (np.linalg.det(turn) > 0)
        )
        if wrong.any():
            raise DataError(
                f"{self.says(int(np.argmax(wrong)))}: the flange pose is no rigid motion; its "
                "rotation must be orthonormal and right-handed"
            )
        if np.abs(self.pose[:, :3, 3]).max() > FARTHEST:
            row = int(np.argmax(np.abs(self.pose[:, :3, 3]).max(axis=1)))
            raise DataError(f"{self.says(row)}: column flange_x_mm ...: is more than 100 km away")

    def columns(self) -> Mapping[str, Array]:
        """Place and rotation vector."""
        turn = Rotation.from_matrix(self.pose[:, :3, :3]).as_rotvec()
        out = {f"flange_{axis}_mm": 1e3 * self.pose[:, i, 3] for i, axis in enumerate("xyz")}
        return out | {f"flange_r{axis}_rad": turn[:, i] for i, axis in enumerate("xyz")}


def flange_poses(q: Array, pose: Array, **columns: Array) -> FlangePoses:
    """Whole poses from arrays.  q: (m, n) [rad, m].  pose: (m, 4, 4) [m]."""
    pose = np.array(pose, dtype=float)
    return checked(FlangePoses(bare(q, columns, pose=pose), pose))


def poses_as_targets(data: FlangePoses, lever: float = LEVER, count: int = 4) -> Measurements:
    """The poses as virtual reflectors smr1 ..., for `calibrate`.  lever: [m].  count: 3 or 4."""
    return reflectors(data.at, data.pose, lever, count)


def family(file: Rows, pattern: re.Pattern[str], axes: str) -> Array:
    """The columns of a family, (m, axes), or (m, 0) where there is none.  Raises DataError."""
    found = {m[1]: (name, m[2]) for name in file.header if (m := pattern.fullmatch(name))}
    if not found:
        return np.zeros((len(file.rows), 0))
    name, unit = next(iter(found.values()))
    stem, ending = (name.removesuffix(f"_{unit}")[:-1], f"_{unit}") if unit else (name[:-1], "")
    for axis in axes:
        if axis not in found:
            raise DataError(f"{file.path}:1: column {stem}{axis}{ending} is missing")
    columns = [file.number(found[axis][0], unit=found[axis][1], empty=True) for axis in axes]
    return np.stack(columns, axis=1)


def read(file: Rows) -> FlangePoses:
    """Whole poses, orientation as a rotation vector or a quaternion.  Raises DataError."""
    file, at = joint_rows(file, FLANGE, DOUBTS)
    place = family(file, PLACE, "xyz")
    vector, quaternion = family(file, TURN, "xyz"), family(file, QUATERNION, "wxyz")
    if not place.shape[1]:
        raise DataError(f"{file.path}:1: column flange_x_mm is missing")
    if bool(vector.shape[1]) == bool(quaternion.shape[1]):
        raise DataError(
            f"{file.path}:1: give the flange's orientation once: flange_rx_rad, flange_ry_rad, "
            "flange_rz_rad or flange_qw, flange_qx, flange_qy, flange_qz"
        )
    turn = vector if vector.shape[1] else quaternion
    empty = np.isnan(np.concatenate([place, turn], axis=1))
    blind = empty.all(axis=1)
    torn = empty.any(axis=1) & ~blind
    if torn.any():
        raise DataError(
            f"{file.path}:{file.line[int(np.argmax(torn))]}: some of the flange's columns are "
            "empty; give all, or leave all empty where it was not measured"
        )
    seen = np.flatnonzero(~blind)
    pose = np.tile(np.eye(4), (len(place), 1, 1))
    pose[seen, :3, 3] = place[seen]
    pose[seen, :3, :3] = (
        Rotation.from_rotvec(turn[seen]) if vector.shape[1] else unit_rotation(file, turn, seen)
    ).as_matrix()
    return without_blind(FlangePoses(at, pose), blind)


def unit_rotation(file: Rows, quaternion: Array, seen: Array) -> Rotation:
    """Rotations of the rows seen from quaternions (m, 4), scalar first.  Raises DataError."""
    length = np.linalg.norm(quaternion[seen], axis=1)
    off = np.abs(length - 1.0) > NORM
    if off.any():
        row = int(np.argmax(off))
        raise DataError(
            f"{file.path}:{file.line[seen[row]]}: columns flange_qw ...: the quaternion has "
            f"length {length[row]:.4g}, not 1"
        )
    return Rotation.from_quat(quaternion[seen], scalar_first=True)


def lever_of(data: FlangePoses, lever: float | None) -> tuple[float, str]:
    """The lever and where it comes from.  lever: asked for [m], None where not."""
    if lever is not None:
        return lever, "as given"
    columns = data.at.columns
    if {"u95", "rotation_u95"} <= set(columns):
        ratio = np.nanmedian(columns["u95"] / columns["rotation_u95"])
        if np.isfinite(ratio) and ratio > 0.0:
            return float(ratio), "typical u95_mm over rotation_u95_rad"
    return LEVER, "by default; give the lever, the ratio of linear and angular noise"


# ---- the model ---------------------------------------------------------------------------------


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
    def measured(robot: Robot, data: FlangePoses, options: RelativeOptions) -> WholePoses:
        """Poses of a robot."""
        lever, _ = lever_of(data, options.lever)
        model = model_of(robot, poses_as_targets(data, lever))
        return WholePoses(model, robot, fit_base(model, robot.mdh).state, lever)

    @property
    def choices(self) -> Mapping[str, object]:
        """The lever."""
        return {"lever": self.lever}

    @property
    def costless(self) -> int:
        """The reflectors' shape."""
        return 3 * len(self.model.y) - 6

    @property
    def numbers(self) -> int:
        """Six a pose, not the twelve of its reflectors.

        With four reflectors their errors' covariance is 4 s^2 times the projector on rigid motions,
        s^2 being the variance of a coordinate of the pose.  No other motion is in the fit's slopes,
        so that its covariance is that of 4 s^2 I.  The reflectors' shape is known, and its
        parameters take no number.
        """
        return 6 * len(self.model.q) + self.costless

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

    def seen_at(self, data: FlangePoses) -> Measurements:
        """With the virtual reflectors."""
        return poses_as_targets(data, self.lever)

    def predicted(self, model: Model, x: State) -> Array:
        """(m, 4, 4) poses of the measured frame, nearest to where the model has its reflectors."""
        state = self.arm_state(x)
        links = kinematics.chain(state.mdh, model.q, model.prismatic)
        point = kinematics.points(links, state.target_positions)
        in_base = np.moveaxis(model.displaced(state, point, slice(None)), -1, 0)
        return posed(in_base @ state.rotation.T + state.origin, spots_of(self.lever))

    def errors(self, model: Model, x: State, data: FlangePoses, held: Array) -> Array:
        """Of positions, in the measurement frame."""
        return pose_errors(self.predicted(model, x), data)[0][None]

    def turns(self, model: Model, x: State, data: FlangePoses) -> Array:
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


def pose_errors(pose: Array, data: FlangePoses) -> tuple[Array, Array]:
    """Measured minus predicted positions (m, 3) [m], and angles between orientations (m,) [rad].

    pose: (m, 4, 4) predicted.
    """
    turn = np.swapaxes(pose[:, :3, :3], 1, 2) @ data.pose[:, :3, :3]
    return data.pose[:, :3, 3] - pose[:, :3, 3], np.asarray(Rotation.from_matrix(turn).magnitude())


# ---- what is said of it ------------------------------------------------------------------------


def check(robot: Robot, data: FlangePoses, options: RelativeOptions) -> None:
    """Raise DataError for slips, by the reflectors."""
    try:
        check_plausible(robot, poses_as_targets(data, lever_of(data, options.lever)[0]))
    except DataError as wrong:  # the user's columns have other names
        raise DataError(str(wrong).replace("smr1_x_", "flange_x_")) from wrong


def of_lever(robot: Robot, fit: InstrumentFit, i: int, options: RelativeOptions) -> tuple[str, ...]:
    """What a radian counts as."""
    lever, whence = lever_of(fit.trains[i].data, options.lever)
    return (f"a radian counts as {1e3 * lever:.4g} mm ({whence})",)


def beyond_one(robot: Robot, fit: InstrumentFit, options: RelativeOptions) -> tuple[str, ...]:
    """Parameters that whole poses tell, and one reflector at the pose's origin would not."""
    block = fit.stack.blocks[0]
    if not isinstance(block, WholePoses):
        return ()
    train = poses_as_targets(fit.trains[0].data)
    origin = replace(train, y=train.y.mean(axis=1, keepdims=True), target_names=("smr1",))
    lone = Stack.of(robot, [Points.of(robot, origin)], [""])
    tool = block.tool(block.arm_state(fit.state))
    x = lone.state(fit.state.mdh, [np.append(fit.state.effects[:6], tool[:3, 3])])
    allowed, wanted = allowed_of(lone, options)
    alone = identified(
        robot, lone, lone.reference(robot, x), x, allowed, wanted,
        known=np.zeros(lone.names.count, dtype=bool), resolution=options.resolution,
    )  # fmt: skip
    rows = lone.names.geometric + 6
    more = fit.identification.active[:rows] & ~alone.active[:rows]
    place = [name for name, told in zip(TOOL[:3], alone.active[rows:], strict=True) if not told]
    return (*(lone.names.all[i] for i in np.flatnonzero(more)), *place, *TOOL[3:])


INSTRUMENT = Instrument(
    name=FlangePoses.kind,
    words=Words(quantity="position of the flange", of_position=True),
    block=WholePoses.measured,
    columns=Columns(
        re.compile(r"flange.*"),
        FLANGE,
        "flange_x_mm, flange_y_mm, flange_z_mm with flange_rx_rad ... or flange_qw ...",
        read,
    ),
    check_slips=check,
    options=("lever",),
    remarks=of_lever,
    beyond=beyond_one,
)
