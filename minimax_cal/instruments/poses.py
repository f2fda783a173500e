"""Whole poses of a frame on the flange, as virtual reflectors at the corners of a tetrahedron."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import (
    Columns,
    Told,
    Words,
    bare,
    checked,
    without_blind,
)
from minimax_cal.instruments.options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.instruments.reflectors import LEVER, posed, reflectors, spots_of
from minimax_cal.instruments.tracker import Points
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import FARTHEST, Measurements, joint_rows
from minimax_cal.measuring.slips import MAX_TRIAL_POSES
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.reading.rows import Rows
from minimax_cal.robots.kinematics import hat, rotation_vector
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import transform

PLACE = re.compile(r"flange_([xyz])_(mm|m)")
TURN = re.compile(r"flange_r([xyz])_(rad|deg)")
QUATERNION = re.compile(r"flange_q([wxyz])()")
FLANGE = re.compile(r"flange_(?:[xyz]_(?:mm|m)|r[xyz]_(?:rad|deg)|q[wxyz])")
DOUBTS = re.compile(r"(?:rotation_)?u95_(mm|m|rad|deg)")
INVERSE = np.array([1.0, -1.0, -1.0, -1.0])
QUATERNION_ORDER = "give qw, qx, qy, qz of the flange in the measurement frame"
AS_VECTOR = "write them as a rotation vector, or as a quaternion"
NORM = 1e-3  # a quaternion farther from unit length is no rotation
TOOL = ("tool_x", "tool_y", "tool_z", "tool_rx", "tool_ry", "tool_rz")


@dataclass(frozen=True, eq=False)
class WholePoses(Points):
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
    lever: float = LEVER
    whence: str = ""

    kind = "poses"
    words = Words(quantity="position of the flange", of_position=True, whole="the tool")
    by_row = ("pose", "written")
    chosen = ("drawn", "lever", "whence")
    options = ("lever",)
    row_noise = 2.0  # of the root of its four reflectors
    alone = ""
    parts = ("position",)
    lone_names = TOOL
    first_column = "flange_x_"

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

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> WholePoses:
        """With the lever and the base."""
        lever, whence = lever_of(self.at.columns, options.lever)
        return Points.ready(replace(self, lever=lever, whence=whence), robot, options)

    @cached_property
    def seen(self) -> Measurements:
        """With the virtual reflectors."""
        return poses_as_targets(self, self.lever)

    @property
    def lone(self) -> Points:
        """One reflector at the pose's origin."""
        y = poses_as_targets(self).y.mean(axis=1, keepdims=True)
        return Points(replace(self.at, y=y, target_names=("smr1",)))

    def lone_values(self, own: Array) -> Array:
        """Its unknowns, by those of the whole."""
        return np.append(own[:6], self.tool(own)[:3, 3])

    @property
    def independent(self) -> int:
        """Those of different poses."""
        return 6 * len(np.unique(groups(self.at)))

    @property
    def choices(self) -> Mapping[str, object]:
        """The lever."""
        return {"lever": self.lever}

    @property
    def costless(self) -> int:
        """The reflectors' shape."""
        return 3 * len(self.seen.target_names) - 6

    def shapeless(self, arm: FlangePoses, own: Array) -> Array:
        """What no rigid motion of the reflectors makes."""
        spots = self.targets(own)
        k = len(spots)
        lever = np.einsum("mij,kj->mki", arm.rotation, spots - spots.mean(axis=0))
        shift = np.broadcast_to(np.eye(3), (*lever.shape, 3))
        rigid = np.concatenate([shift, -hat(lever)], axis=-1).reshape(len(lever), 3 * k, 6)
        basis = np.linalg.qr(rigid)[0]
        return np.asarray(np.eye(3 * k) - basis @ np.swapaxes(basis, 1, 2))

    def tool(self, own: Array) -> Array:
        """Pose (4, 4) of the measured frame in the flange [m]."""
        return posed(self.targets(own), spots_of(self.lever))

    def missed(self, arm: FlangePoses, own: Array) -> tuple[Array, Array]:
        """`pose_errors` of the frame nearest to where the model has its reflectors."""
        turn, origin = self.base(own)
        place = arm.place(self.targets(own)) @ turn.T + origin
        return pose_errors(posed(place, spots_of(self.lever)), self)

    def errors(self, arm: FlangePoses, own: Array, held: Array) -> Array:
        """Of positions, in the measurement frame."""
        return self.missed(arm, own)[0][:, None]

    def turns(self, arm: FlangePoses, own: Array) -> Array:
        """(m,) angles between orientations [rad]."""
        return self.missed(arm, own)[1]

    def told(self, own: Array, drawn: Array, covariance: Array) -> tuple[Told, ...]:
        """The tool instead of its reflectors."""
        before, tool = self.tool(drawn), self.tool(own)
        arm = spots_of(self.lever) @ tool[:3, :3].T  # in the flange's axes
        k = len(arm)
        rigid = np.concatenate([np.tile(np.eye(3), (k, 1)), -hat(arm).reshape(3 * k, 3)], axis=1)
        back = np.linalg.pinv(rigid)
        sigma = np.sqrt(np.diag(back @ covariance[6:, 6:] @ back.T))
        turn = rotation_vector(tool[:3, :3] @ before[:3, :3].T)
        was, found = [*before[:3, 3], *np.zeros(3)], [*tool[:3, 3], *turn]
        units = ("m",) * 3 + ("rad",) * 3
        return tuple(zip(TOOL, units, found, was, sigma, strict=True))

    def placed(self, arm: FlangePoses, own: Array, drawn: Array) -> dict[str, Any]:
        """Base in the measurement frame, measured frame in the flange, and the lever."""
        out: dict[str, Any] = {}
        for stem, each in (("", own), ("nominal_", drawn)):
            places = {"base": transform(*self.base(each)), "tool": self.tool(each)}
            out |= {stem + name: pose_to_dict(pose) for name, pose in places.items()}
        return out | {"lever_mm": 1e3 * self.lever}

    # ---- slips and remarks -------------------------------------------------------------------

    def tried(self) -> WholePoses:
        """At some of the poses."""
        rows = np.linspace(0, self.poses - 1, min(self.poses, MAX_TRIAL_POSES)).astype(int)
        return self.take(rows)

    def slips(self) -> Iterator[tuple[str, WholePoses]]:
        """Poses the other way round, rotations of another kind, order or unit than columns say."""
        inverse = "look like poses of the measurement frame in the flange's: invert them"
        yield f"flange_x ... {inverse}", replace(self, pose=np.linalg.inv(self.pose))
        for text, turn in rotations_as(self.written):
            pose = self.pose.copy()
            pose[:, :3, :3] = turn
            yield text, replace(self, pose=pose)

    def remarks(self, parameters: Sequence[Any], noise: float) -> tuple[str, ...]:
        """What a radian counts as."""
        return (f"a radian counts as {1e3 * self.lever:.4g} mm ({self.whence})",)


def flange_poses(q: Array, pose: Array, **columns: Array) -> WholePoses:
    """Whole poses from arrays.  q: (m, n) [rad, m].  pose: (m, 4, 4) [m]."""
    pose = np.array(pose, dtype=float)
    at = bare(q, columns, pose=pose)
    written = np.zeros((len(pose), 3))  # given as matrices
    return checked(WholePoses(at, pose=pose, written=written))


def poses_as_targets(data: WholePoses, lever: float = LEVER, count: int = 4) -> Measurements:
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


def read(file: Rows) -> WholePoses:
    """Whole poses, orientation as a rotation vector or a quaternion.  Raises DataError."""
    at = joint_rows(file, FLANGE, DOUBTS)
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
    return without_blind(WholePoses(at, pose=pose, written=np.nan_to_num(turn)), blind)


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


def rotations_as(written: Array) -> Iterator[tuple[str, Array]]:
    """What columns of a rotation may hold instead: what to say, and the rotations (m, 3, 3).

    written: (m, 3) of a rotation vector, or (m, 4) of a quaternion with the scalar first.
    """
    if not written.any():
        return
    if written.shape[1] == 4:
        for text, quaternion in (
            ("with its scalar last", np.roll(written, 1, axis=1)),
            ("of the measurement frame in the flange's: conjugate it", written * INVERSE),
        ):
            turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
            yield f"flange_qw ... looks like a quaternion {text}; {QUATERNION_ORDER}", turn
        return
    first, *others = ("".join(order) for order in permutations("xyz"))
    tripled = [a + b + a for a, b in permutations("xyz", 2)]
    stem = "flange_rx, flange_ry, flange_rz look like"
    for unit, scale in (("", 1.0), (" in degrees", np.pi / 180.0), (" in radians", 180.0 / np.pi)):
        turn = Rotation.from_rotvec(scale * written).as_matrix()
        if unit:
            yield f"{stem} a rotation vector{unit}: name their unit in the columns", turn
        yield (
            f"{stem} the rotation vector{unit} of the measurement frame in the flange's: give the "
            "flange's in the measurement frame",
            np.swapaxes(turn, 1, 2),
        )
        for order in (first, *others, *tripled):
            for axes, about in ((order, "fixed"), (order.upper(), "moving")):
                turn = Rotation.from_euler(axes, scale * written).as_matrix()
                named = " ".join(f"R{axis}" for axis in order)
                yield f"{stem} Euler angles{unit} about {about} axes, {named}; {AS_VECTOR}", turn


def lever_of(columns: Mapping[str, Array], lever: float | None) -> tuple[float, str]:
    """The lever and where it comes from.  lever: asked for [m], None where not."""
    if lever is not None:
        return lever, "as given"
    if {"u95", "rotation_u95"} <= set(columns):
        ratio = np.nanmedian(columns["u95"] / columns["rotation_u95"])
        if np.isfinite(ratio) and ratio > 0.0:
            return float(ratio), "typical u95_mm over rotation_u95_rad"
    return LEVER, "by default; give the lever, the ratio of linear and angular noise"


def pose_errors(pose: Array, data: WholePoses) -> tuple[Array, Array]:
    """Measured minus predicted positions (m, 3) [m], and angles between orientations (m,) [rad].

    pose: (m, 4, 4) predicted.
    """
    turn = np.swapaxes(pose[:, :3, :3], 1, 2) @ data.pose[:, :3, :3]
    return data.pose[:, :3, 3] - pose[:, :3, 3], np.asarray(Rotation.from_matrix(turn).magnitude())


WholePoses.file = Columns(
    re.compile(r"flange.*"),
    FLANGE,
    "flange_x_mm, flange_y_mm, flange_z_mm with flange_rx_rad ... or flange_qw ...",
    read,
)
