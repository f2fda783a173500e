"""Whole poses of a frame on the flange, as virtual reflectors at the corners of a tetrahedron."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.instruments.instrument import (
    InstrumentColumns,
    ReportedParameter,
    Words,
    bare,
    check_instrument_data,
    drop_unmeasured_rows,
)
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.instruments.tracker_points import TrackerPoints
from minimax_cal.instruments.virtual_reflectors import (
    DEFAULT_ROTATION_LEVER,
    build_virtual_reflectors,
    fit_poses_to_points,
    virtual_reflector_positions,
)
from minimax_cal.measuring.file_mistakes import MAX_TRIAL_POSES
from minimax_cal.measuring.measurements import (
    MAX_POINT_DISTANCE,
    Measurements,
    build_joint_measurements,
)
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.reading.measurement_table import MeasurementTable
from minimax_cal.robots.kinematics import rotation_to_vector, skew_matrix
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform

FLANGE_POSITION_PATTERN = re.compile(r"flange_([xyz])_(mm|m)")
FLANGE_ROTATION_PATTERN = re.compile(r"flange_r([xyz])_(rad|deg)")
FLANGE_QUATERNION_PATTERN = re.compile(r"flange_q([wxyz])()")
FLANGE_COLUMN_PATTERN = re.compile(r"flange_(?:[xyz]_(?:mm|m)|r[xyz]_(?:rad|deg)|q[wxyz])")
POSE_U95_PATTERN = re.compile(r"(?:rotation_)?u95_(mm|m|rad|deg)")
QUATERNION_CONJUGATION = np.array([1.0, -1.0, -1.0, -1.0])
QUATERNION_ORDER_ADVICE = "give qw, qx, qy, qz of the flange in the measurement frame"
ROTATION_VECTOR_ADVICE = "write them as a rotation vector, or as a quaternion"
MAX_ORTHONORMAL_DEVIATION = 1e-3  # a quaternion farther from unit length is no rotation
TOOL_PARAMETER_NAMES = ("tool_x", "tool_y", "tool_z", "tool_rx", "tool_ry", "tool_rz")


class PoseErrors(NamedTuple):
    """Measured minus predicted positions (m, 3) [m], and angles between orientations (m,) [rad]."""

    positions: Array
    angles: Array


@dataclass(frozen=True, eq=False)
class WholePoses(TrackerPoints):
    """Whole poses, as virtual reflectors.

    pose: (m, 4, 4) of the flange in the measurement frame [m].  written: (m, 3) or (m, 4) numbers
    of the columns that hold its rotation.  lever: that a radian counts as [m].

    With four reflectors their errors' covariance is 4 s^2 times the projector on rigid motions, s^2
    being the variance of a coordinate of the pose.  No other motion is in the fit's slopes, so that
    its covariance is that of 4 s^2 I.  The reflectors' shape is known, and its parameters take no
    number.
    """

    pose: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    written: Array = field(default_factory=lambda: np.zeros((0, 3)))
    lever: float = DEFAULT_ROTATION_LEVER
    whence: str = ""

    kind = "poses"
    words = Words(quantity="position of the flange", of_position=True, whole="the tool")
    by_row = ("pose", "written")
    chosen = ("drawn", "lever", "whence")
    options = ("lever",)
    row_noise = 2.0  # of the root of its four reflectors
    alone = ""
    part_names = ("position",)
    lone_names = TOOL_PARAMETER_NAMES
    first_column = "flange_x_"

    @property
    def numbers_per_pose(self) -> Array:
        """(m,) six a pose."""
        return np.full(self.poses, 6)

    def check_data(self) -> None:
        """Raise DataError for poses that are no rigid motions."""
        if self.pose.shape != (self.poses, 4, 4):
            raise DataError(f"{self.at.source}: pose must be (m, 4, 4); got {self.pose.shape}")
        turn = self.pose[:, :3, :3]
        off = np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3)).max(axis=(1, 2))
        wrong = ~(
            np.isfinite(self.pose).all(axis=(1, 2))
            & (off < MAX_ORTHONORMAL_DEVIATION)
            & (np.linalg.det(turn) > 0)
        )
        if wrong.any():
            raise DataError(
                f"{self.row_location(int(np.argmax(wrong)))}: the "
                f"flange pose is no rigid motion; its "
                "rotation must be orthonormal and right-handed"
            )
        if np.abs(self.pose[:, :3, 3]).max() > MAX_POINT_DISTANCE:
            row = int(np.argmax(np.abs(self.pose[:, :3, 3]).max(axis=1)))
            raise DataError(
                f"{self.row_location(row)}: column flange_x_mm ...: is more than 100 km away"
            )

    def file_columns(self) -> Mapping[str, Array]:
        """Place and rotation vector."""
        turn = Rotation.from_matrix(self.pose[:, :3, :3]).as_rotvec()
        out = {f"flange_{axis}_mm": 1e3 * self.pose[:, i, 3] for i, axis in enumerate("xyz")}
        return out | {f"flange_r{axis}_rad": turn[:, i] for i, axis in enumerate("xyz")}

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> WholePoses:
        """With the lever and the base."""
        lever, whence = choose_rotation_lever(self.at.columns, options.lever)
        return TrackerPoints.ready(replace(self, lever=lever, whence=whence), robot, options)

    @cached_property
    def measurements_with_points(self) -> Measurements:
        """With the virtual reflectors."""
        return poses_as_targets(self, self.lever)

    @property
    def single_point_instrument(self) -> TrackerPoints:
        """One reflector at the pose's origin."""
        y = poses_as_targets(self).y.mean(axis=1, keepdims=True)
        return TrackerPoints(replace(self.at, y=y, target_names=("smr1",)))

    def single_point_unknowns(self, unknowns: Array) -> Array:
        """Its unknowns, by those of the whole."""
        return np.append(unknowns[:6], self.tool_pose(unknowns)[:3, 3])

    @property
    def independent_number_count(self) -> int:
        """Those of different poses."""
        return 6 * len(np.unique(group_repeated_poses(self.at)))

    @property
    def choices_for_record(self) -> Mapping[str, object]:
        """The lever."""
        return {"lever": self.lever}

    @property
    def costless_parameter_count(self) -> int:
        """The reflectors' shape."""
        return 3 * len(self.measurements_with_points.target_names) - 6

    def projectors_on_empty_rows(self, arm: FlangePoses, unknowns: Array) -> Array:
        """What no rigid motion of the reflectors makes."""
        spots = self.flange_points(unknowns)
        k = len(spots)
        lever = np.einsum("mij,kj->mki", arm.rotation, spots - spots.mean(axis=0))
        shift = np.broadcast_to(np.eye(3), (*lever.shape, 3))
        rigid = np.concatenate([shift, -skew_matrix(lever)], axis=-1).reshape(len(lever), 3 * k, 6)
        basis = np.linalg.qr(rigid)[0]
        return np.asarray(np.eye(3 * k) - basis @ np.swapaxes(basis, 1, 2))

    def tool_pose(self, unknowns: Array) -> Array:
        """Pose (4, 4) of the measured frame in the flange [m]."""
        return fit_poses_to_points(
            self.flange_points(unknowns), virtual_reflector_positions(self.lever)
        )

    def position_and_angle_errors(self, arm: FlangePoses, unknowns: Array) -> PoseErrors:
        """`position_and_angle_errors` of the frame nearest to where the model has its
        reflectors.
        """
        turn, origin = self.base_rotation_and_origin(unknowns)
        place = arm.place(self.flange_points(unknowns)) @ turn.T + origin
        return position_and_angle_errors(
            fit_poses_to_points(place, virtual_reflector_positions(self.lever)), self
        )

    def part_errors(self, arm: FlangePoses, unknowns: Array, holdout_mask: Array) -> Array:
        """Of positions, in the measurement frame."""
        return self.position_and_angle_errors(arm, unknowns)[0][:, None]

    def orientation_errors(self, arm: FlangePoses, unknowns: Array) -> Array:
        """(m,) angles between orientations [rad]."""
        return self.position_and_angle_errors(arm, unknowns)[1]

    def parameters_for_report(
        self, unknowns: Array, nominal_unknowns: Array, covariance: Array
    ) -> tuple[ReportedParameter, ...]:
        """The tool instead of its reflectors."""
        before, tool = self.tool_pose(nominal_unknowns), self.tool_pose(unknowns)
        arm = virtual_reflector_positions(self.lever) @ tool[:3, :3].T  # in the flange's axes
        k = len(arm)
        rigid = np.concatenate(
            [np.tile(np.eye(3), (k, 1)), -skew_matrix(arm).reshape(3 * k, 3)], axis=1
        )
        back = np.linalg.pinv(rigid)
        sigma = np.sqrt(np.diag(back @ covariance[6:, 6:] @ back.T))
        turn = rotation_to_vector(tool[:3, :3] @ before[:3, :3].T)
        was, found = [*before[:3, 3], *np.zeros(3)], [*tool[:3, 3], *turn]
        units = ("m",) * 3 + ("rad",) * 3
        return tuple(zip(TOOL_PARAMETER_NAMES, units, found, was, sigma, strict=True))

    def fitted_values_to_dict(
        self, arm: FlangePoses, unknowns: Array, nominal_unknowns: Array
    ) -> dict[str, Any]:
        """Base in the measurement frame, measured frame in the flange, and the lever."""
        out: dict[str, Any] = {}
        for stem, each in (("", unknowns), ("nominal_", nominal_unknowns)):
            places = {
                "base": build_transform(*self.base_rotation_and_origin(each)),
                "tool": self.tool_pose(each),
            }
            out |= {stem + name: pose_to_dict(pose) for name, pose in places.items()}
        return out | {"lever_mm": 1e3 * self.lever}

    # ---- slips and remarks -------------------------------------------------------------------

    def thin_for_trials(self) -> WholePoses:
        """At some of the poses."""
        rows = np.linspace(0, self.poses - 1, min(self.poses, MAX_TRIAL_POSES)).astype(int)
        return self.take_rows(rows)

    def propose_data_corrections(self) -> Iterator[tuple[str, WholePoses]]:
        """Poses the other way round, rotations of another kind, order or unit than columns say."""
        inverse = "look like poses of the measurement frame in the flange's: invert them"
        yield f"flange_x ... {inverse}", replace(self, pose=np.linalg.inv(self.pose))
        for text, turn in propose_other_rotation_conventions(self.written):
            pose = self.pose.copy()
            pose[:, :3, :3] = turn
            yield text, replace(self, pose=pose)

    def list_remarks(self, parameters: Sequence[Any], noise: float) -> tuple[str, ...]:
        """What a radian counts as."""
        return (f"a radian counts as {1e3 * self.lever:.4g} mm ({self.whence})",)


def flange_poses(q: Array, pose: Array, **columns: Array) -> WholePoses:
    """Whole poses from arrays.  q: (m, n) [rad, m].  pose: (m, 4, 4) [m]."""
    pose = np.array(pose, dtype=float)
    at = bare(q, columns, pose=pose)
    written = np.zeros((len(pose), 3))  # given as matrices
    return check_instrument_data(WholePoses(at, pose=pose, written=written))


def poses_as_targets(
    data: WholePoses, lever: float = DEFAULT_ROTATION_LEVER, count: int = 4
) -> Measurements:
    """The poses as virtual reflectors smr1 ..., for `calibrate`.  lever: [m].  count: 3 or 4."""
    return build_virtual_reflectors(data.at, data.pose, lever, count)


def axis_columns_of_table(table: MeasurementTable, pattern: re.Pattern[str], axes: str) -> Array:
    """The columns of a family, (m, axes), or (m, 0) where there is none.  Raises DataError."""
    found = {m[1]: (name, m[2]) for name in table.header if (m := pattern.fullmatch(name))}
    if not found:
        return np.zeros((len(table.rows), 0))
    name, unit = next(iter(found.values()))
    stem, ending = (name.removesuffix(f"_{unit}")[:-1], f"_{unit}") if unit else (name[:-1], "")
    for axis in axes:
        if axis not in found:
            raise DataError(f"{table.path}:1: column {stem}{axis}{ending} is missing")
    columns = [
        table.number_column(found[axis][0], unit=found[axis][1], allow_empty=True) for axis in axes
    ]
    return np.stack(columns, axis=1)


def parse_whole_poses(table: MeasurementTable) -> WholePoses:
    """Whole poses, orientation as a rotation vector or a quaternion.  Raises DataError."""
    at = build_joint_measurements(table, FLANGE_COLUMN_PATTERN, POSE_U95_PATTERN)
    place = axis_columns_of_table(table, FLANGE_POSITION_PATTERN, "xyz")
    vector, quaternion = (
        axis_columns_of_table(table, FLANGE_ROTATION_PATTERN, "xyz"),
        axis_columns_of_table(table, FLANGE_QUATERNION_PATTERN, "wxyz"),
    )
    if not place.shape[1]:
        raise DataError(f"{table.path}:1: column flange_x_mm is missing")
    if bool(vector.shape[1]) == bool(quaternion.shape[1]):
        raise DataError(
            f"{table.path}:1: give the flange's orientation once: flange_rx_rad, flange_ry_rad, "
            "flange_rz_rad or flange_qw, flange_qx, flange_qy, flange_qz"
        )
    turn = vector if vector.shape[1] else quaternion
    empty = np.isnan(np.concatenate([place, turn], axis=1))
    blind = empty.all(axis=1)
    torn = empty.any(axis=1) & ~blind
    if torn.any():
        raise DataError(
            f"{table.path}:{table.line[int(np.argmax(torn))]}: some of the flange's columns are "
            "empty; give all, or leave all empty where it was not measured"
        )
    seen = np.flatnonzero(~blind)
    pose = np.tile(np.eye(4), (len(place), 1, 1))
    pose[seen, :3, 3] = place[seen]
    pose[seen, :3, :3] = (
        Rotation.from_rotvec(turn[seen])
        if vector.shape[1]
        else quaternions_to_rotations(table, turn, seen)
    ).as_matrix()
    return drop_unmeasured_rows(WholePoses(at, pose=pose, written=np.nan_to_num(turn)), blind)


def quaternions_to_rotations(
    table: MeasurementTable, quaternions: Array, measured_rows: Array
) -> Rotation:
    """Rotations of the rows seen from quaternions (m, 4), scalar first.  Raises DataError."""
    length = np.linalg.norm(quaternions[measured_rows], axis=1)
    off = np.abs(length - 1.0) > MAX_ORTHONORMAL_DEVIATION
    if off.any():
        row = int(np.argmax(off))
        raise DataError(
            f"{table.path}:{table.line[measured_rows[row]]}: "
            f"columns flange_qw ...: the quaternion has "
            f"length {length[row]:.4g}, not 1"
        )
    return Rotation.from_quat(quaternions[measured_rows], scalar_first=True)


class RotationReading(NamedTuple):
    """What columns of a rotation may hold instead, and the rotations (m, 3, 3) then."""

    message: str
    rotations: Array


def propose_other_rotation_conventions(written: Array) -> Iterator[RotationReading]:
    """What columns of a rotation may hold instead: what to say, and the rotations (m, 3, 3).

    written: (m, 3) of a rotation vector, or (m, 4) of a quaternion with the scalar first.
    """
    if not written.any():
        return
    if written.shape[1] == 4:
        for text, quaternion in (
            ("with its scalar last", np.roll(written, 1, axis=1)),
            (
                "of the measurement frame in the flange's: conjugate it",
                written * QUATERNION_CONJUGATION,
            ),
        ):
            turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
            yield RotationReading(
                f"flange_qw ... looks like a quaternion {text}; {QUATERNION_ORDER_ADVICE}", turn
            )
        return
    first, *others = ("".join(order) for order in permutations("xyz"))
    tripled = [a + b + a for a, b in permutations("xyz", 2)]
    stem = "flange_rx, flange_ry, flange_rz look like"
    for unit, scale in (("", 1.0), (" in degrees", np.pi / 180.0), (" in radians", 180.0 / np.pi)):
        turn = Rotation.from_rotvec(scale * written).as_matrix()
        if unit:
            yield RotationReading(
                f"{stem} a rotation vector{unit}: name their unit in the columns", turn
            )
        yield RotationReading(
            f"{stem} the rotation vector{unit} of the measurement frame in the flange's: give the "
            "flange's in the measurement frame",
            np.swapaxes(turn, 1, 2),
        )
        for order in (first, *others, *tripled):
            for axes, about in ((order, "fixed"), (order.upper(), "moving")):
                turn = Rotation.from_euler(axes, scale * written).as_matrix()
                named = " ".join(f"R{axis}" for axis in order)
                yield RotationReading(
                    (
                        f"{stem} Euler angles{unit} about {about} axes, "
                        f"{named}; {ROTATION_VECTOR_ADVICE}"
                    ),
                    turn,
                )


class RotationLever(NamedTuple):
    """Length that converts rotation errors to metres [m], and where it comes from."""

    length: float
    source: str


def choose_rotation_lever(columns: Mapping[str, Array], given_lever: float | None) -> RotationLever:
    """The lever and where it comes from.  given_lever: asked for [m], None where not."""
    if given_lever is not None:
        return RotationLever(given_lever, "as given")
    if {"u95", "rotation_u95"} <= set(columns):
        ratio = np.nanmedian(columns["u95"] / columns["rotation_u95"])
        if np.isfinite(ratio) and ratio > 0.0:
            return RotationLever(float(ratio), "typical u95_mm over rotation_u95_rad")
    return RotationLever(
        DEFAULT_ROTATION_LEVER, "by default; give the lever, the ratio of linear and angular noise"
    )


def position_and_angle_errors(predicted_poses: Array, data: WholePoses) -> PoseErrors:
    """Measured minus predicted positions (m, 3) [m], and angles between orientations (m,) [rad].

    predicted_poses: (m, 4, 4) predicted.
    """
    turn = np.swapaxes(predicted_poses[:, :3, :3], 1, 2) @ data.pose[:, :3, :3]
    return PoseErrors(
        data.pose[:, :3, 3] - predicted_poses[:, :3, 3],
        np.asarray(Rotation.from_matrix(turn).magnitude()),
    )


WholePoses.file = InstrumentColumns(
    re.compile(r"flange.*"),
    FLANGE_COLUMN_PATTERN,
    "flange_x_mm, flange_y_mm, flange_z_mm with flange_rx_rad ... or flange_qw ...",
    parse_whole_poses,
)
