"""Rigid transforms: roll, pitch, yaw; and the link that leads from one joint axis to the next.

A link ``Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` puts the z axis of its last frame on any given
line.  Between axes that are not parallel it takes the common normal (beta = 0); between nearly
parallel ones, whose common normal is nowhere, it keeps d = 0 and uses beta [Hayati 1983].

A turns about z, B about the y axis that results, C about the x axis that results then, as KUKA
does: the rotation is Rz(A) Ry(B) Rx(C).  And the links of an arm as its file writes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.core.units import display_unit_of_change, display_unit_of_value
from minimax_cal.robots.kinematics import (
    MDH_NAMES,
    rotation_to_quaternion,
    rotation_to_vector,
    skew_matrix,
)

if TYPE_CHECKING:
    from minimax_cal.robots.robot import Robot

MAX_PARALLEL_AXES_SINE = np.sin(
    np.radians(5.0)
)  # neighbouring axes closer than this count as parallel
MAX_TIP_DISTANCE_ON_AXIS = 1e-5  # a tip this near to the last axis is meant to lie on it [m]
MAX_EQUAL_TRANSFORM_DIFFERENCE = (
    1e-12  # transforms that differ by less are equal to rounding [m, rad]
)


def build_transform(rotation: Array, origin: Array) -> Array:
    """A pose (..., 4, 4) of a rotation (..., 3, 3) and an origin (..., 3) [m]."""
    shape = np.broadcast_shapes(rotation.shape[:-2], origin.shape[:-1])
    pose = np.zeros((*shape, 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, origin, 1.0
    return pose


def invert_transform(transforms: Array) -> Array:
    """The inverse of rigid transforms (..., 4, 4)."""
    turned = np.swapaxes(transforms[..., :3, :3], -1, -2)
    return build_transform(turned, -(turned @ transforms[..., :3, 3, None])[..., 0])


def axis_rotation(axis_index: int, angle: float) -> Array:
    """Rotation about x, y or z by an angle: (4, 4)."""
    out, (i, j) = np.eye(4), ((axis_index + 1) % 3, (axis_index + 2) % 3)
    out[i, i] = out[j, j] = np.cos(angle)
    out[j, i], out[i, j] = np.sin(angle), -np.sin(angle)
    return out


def translation(x: float, y: float, z: float) -> Array:
    """Translation: (4, 4) [m]."""
    return build_transform(np.eye(3), np.array([x, y, z]))


def theta_d_transform(link_row: Array) -> Array:
    """The part of a link that lies along its joint axis: Rz(theta) Tz(d).  link_row: (5,)."""
    return axis_rotation(2, link_row[2]) @ translation(0.0, 0.0, link_row[1])


def a_alpha_beta_transform(link_row: Array) -> Array:
    """The rest of the link: Tx(a) Rx(alpha) Ry(beta).  link_row: (5,) a, d, theta, alpha, beta."""
    return (
        translation(link_row[0], 0.0, 0.0)
        @ axis_rotation(0, link_row[3])
        @ axis_rotation(1, link_row[4])
    )


def link_transform(link_row: Array) -> Array:
    """A link at joint value 0.  link_row: (5,) a, d, theta, alpha, beta [m, rad]."""
    return theta_d_transform(link_row) @ a_alpha_beta_transform(link_row)


def transform_from_xyz_rpy(xyz: Array, rpy: Array) -> Array:
    """A URDF origin: Txyz Rz(yaw) Ry(pitch) Rx(roll).  xyz [m], rpy [rad]."""
    roll, pitch, yaw = rpy
    return (
        translation(*xyz) @ axis_rotation(2, yaw) @ axis_rotation(1, pitch) @ axis_rotation(0, roll)
    )


def pose_to_rpy(pose: Array, near_rpy: Array | None = None) -> Array:
    """Roll, pitch, yaw of a pose [rad]; of the two ways to write them, the one nearer to near."""
    near_rpy = np.zeros(3) if near_rpy is None else near_rpy
    one = pose_to_rpy_within_quarter_pitch(pose, near_rpy[2])
    other = np.array([one[0] + np.pi, np.pi - one[1], one[2] + np.pi])
    both = [
        near_rpy + np.remainder(way - near_rpy + np.pi, 2 * np.pi) - np.pi for way in (one, other)
    ]
    best = both[int(np.abs(both[1] - near_rpy).sum() < np.abs(both[0] - near_rpy).sum() - 1e-9)]
    return np.asarray(np.where(np.abs(best) < 1e-17, 0.0, best))


def pose_to_rpy_within_quarter_pitch(pose: Array, yaw_if_vertical: float = 0.0) -> Array:
    """Roll, pitch, yaw of a pose [rad], the pitch within a quarter turn.

    yaw_if_vertical: taken where the pitch is one, and only roll - yaw or roll + yaw counts.
    """
    r = pose[:3, :3]
    steep = np.hypot(r[0, 0], r[1, 0]) < 1e-14
    yaw_if_vertical = yaw_if_vertical if steep else float(np.arctan2(r[1, 0], r[0, 0]))
    rest = (
        axis_rotation(2, -yaw_if_vertical)[:3, :3] @ r
    )  # = Ry(pitch) Rx(roll): well conditioned everywhere
    roll, pitch = np.arctan2(-rest[1, 2], rest[1, 1]), np.arctan2(-rest[2, 0], rest[0, 0])
    return np.array([roll, pitch, yaw_if_vertical])


def max_entry_difference(first: Array, second: Array) -> float:
    """The largest difference between the entries of two transforms [m, rad]."""
    return float(np.abs(first - second).max(initial=0.0))


def nearest_rotations(matrices: Array) -> Array:
    """The rotations nearest to matrices (..., 3, 3), by SVD [Kabsch 1976]."""
    u, _, vt = np.linalg.svd(matrices)
    flip = np.ones((*matrices.shape[:-2], 3))
    flip[..., 2] = np.linalg.det(u @ vt)
    return np.asarray((u * flip[..., None, :]) @ vt)


def perpendicular_unit_vectors(direction: Array) -> Array:
    """(2, 3) unit vectors across a direction (3,) and each other."""
    return np.asarray(np.linalg.svd(direction[None])[2][1:])


def rotation_from_z_to_direction(direction: Array) -> Array:
    """The smallest rotation that takes z to a direction: (3, 3)."""
    c = float(direction[2])
    if c < -1.0 + 1e-12:
        return axis_rotation(0, np.pi)[:3, :3]
    v = skew_matrix(np.cross([0.0, 0.0, 1.0], direction))
    return np.asarray(np.eye(3) + v + v @ v / (1.0 + c))


def link_row_to_axis(axis_point: Array, axis_direction: Array) -> Array:
    """The link (5,) whose last z axis is the line through point along direction.

    Both in the frame before the link, whose z is the joint axis [m].
    """
    w = axis_direction / np.linalg.norm(axis_direction)
    if np.hypot(w[0], w[1]) < MAX_PARALLEL_AXES_SINE:
        spot = axis_point - w * axis_point[2] / w[2]
        a = float(np.hypot(spot[0], spot[1]))
        a, theta = (
            equivalent_a_theta_within_quarter_turn(a, float(np.arctan2(spot[1], spot[0])))
            if a > MAX_EQUAL_TRANSFORM_DIFFERENCE
            else (0.0, 0.0)
        )
        v = axis_rotation(2, -theta)[:3, :3] @ w
        return np.array([a, 0.0, theta, *alpha_beta_for_z_axis(v)])
    theta = float(np.arctan2(w[0], -w[1]))  # x along the common normal z x w
    a, theta = equivalent_a_theta_within_quarter_turn(
        float(axis_point @ [np.cos(theta), np.sin(theta), 0.0]), theta
    )
    y = np.array([-np.sin(theta), np.cos(theta), 0.0])
    d = axis_point[2] - w[2] * (axis_point @ y) / (w @ y)
    return np.array([a, d, theta, np.arctan2(-(w @ y), w[2]), 0.0])


class OffsetAndTurn(NamedTuple):
    """An offset a [m] and an angle theta [rad] of a link."""

    a: float
    theta: float


def equivalent_a_theta_within_quarter_turn(a: float, theta: float) -> OffsetAndTurn:
    """The same offset with theta within a quarter turn, a negative if need be."""
    quarter = np.pi / 2
    if abs(theta) > quarter + 1e-6 or (abs(theta) > quarter - 1e-6 and a < -1e-9):
        return OffsetAndTurn(-a, float(theta - np.copysign(np.pi, theta)))
    return OffsetAndTurn(a, theta)


class AlphaBeta(NamedTuple):
    """The angles of Rx(alpha) Ry(beta) [rad]."""

    alpha: float
    beta: float


def alpha_beta_for_z_axis(z_axis: Array) -> AlphaBeta:
    """alpha and beta with Rx(alpha) Ry(beta) z = v."""
    return AlphaBeta(
        float(np.arctan2(-z_axis[1], z_axis[2])),
        float(np.arctan2(z_axis[0], np.hypot(z_axis[1], z_axis[2]))),
    )


def link_row_to_tip(tip_pose: Array) -> Array:
    """The last link (5,), to a tip (4, 4) in the frame before it.

    A tip on the axis is reached whole.  Elsewhere the link reaches its origin and z axis; a turn
    about that z remains, for a link has five numbers and a pose six.
    """
    point, r = tip_pose[:3, 3], tip_pose[:3, :3]
    a = float(np.hypot(point[0], point[1]))
    if a > MAX_TIP_DISTANCE_ON_AXIS:
        theta = float(np.arctan2(point[1], point[0]))
        ways = [(a, theta), (-a, theta - float(np.copysign(np.pi, theta)))]
        rows = [
            np.array(
                [
                    size,
                    point[2],
                    way,
                    *alpha_beta_for_z_axis(axis_rotation(2, -way)[:3, :3] @ r[:, 2]),
                ]
            )
            for size, way in ways
        ]
        return max(rows, key=lambda row: float(np.trace(link_transform(row)[:3, :3].T @ r)))
    level = np.hypot(r[2, 0], r[2, 2])
    beta = float(np.arctan2(-r[2, 0], r[2, 2])) if level > 1e-14 else 0.0
    rest = r @ axis_rotation(1, -beta)[:3, :3]  # = Rz(theta) Rx(alpha)
    theta, alpha = np.arctan2(rest[1, 0], rest[0, 0]), np.arctan2(rest[2, 1], rest[2, 2])
    return np.array([0.0, point[2], theta, alpha, beta])


def fit_shared_base(first_moves: Array, second_moves: Array) -> Array:
    """The transform B (4, 4) for which one = B other B^-1 as nearly as possible.

    first_moves, second_moves: (m, 4, 4) what the same moves of two arms do to space.  Linear least
    squares [AX = XB of hand-eye calibration]; what no move tells (along axes that are all parallel)
    is 0.
    """
    eye, rows, right = np.eye(3), [], []
    for a, b in zip(first_moves, second_moves, strict=True):
        # vec by rows: vec(A R - R B) = (A x I - I x B') vec(R)
        turning = np.kron(a[:3, :3], eye) - np.kron(eye, b[:3, :3].T)
        moving = np.kron(eye, b[:3, 3][None])
        rows += [np.hstack([turning, np.zeros((9, 3))]), np.hstack([moving, eye - a[:3, :3]])]
        right += [np.zeros(9), a[:3, 3]]
    found = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=1e-9)[0]
    rotation = nearest_rotations(found[:9].reshape(3, 3))
    stacked = np.vstack([eye - a[:3, :3] for a in first_moves])
    rest = np.concatenate(
        [a[:3, 3] - rotation @ b[:3, 3] for a, b in zip(first_moves, second_moves, strict=True)]
    )
    return build_transform(rotation, np.linalg.lstsq(stacked, rest, rcond=1e-9)[0])


# ---- frames --------------------------------------------------------------------------------------


ABC_ANGLES_CONVENTION = (
    "A about z, then B about y, then C about x, each axis as turned: Rz(A) Ry(B) Rx(C)"
)
MDH_LENGTH_NAMES = ("a", "d")
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Frame:
    """A rigid motion: where a frame stands in another.  Angles A, B, C; B within 90 degrees."""

    xyz_mm: Triple
    abc_deg: Triple
    quaternion_wxyz: tuple[float, float, float, float]
    rotation_vector_rad: Triple

    @staticmethod
    def from_pose(pose: Array) -> Frame:
        """From a pose (4, 4) [m]."""
        (length, _), (angle, _) = display_unit_of_change("m"), display_unit_of_value("rad")
        x, y, z = (length * pose[:3, 3]).tolist()
        c, b, a = (angle * pose_to_rpy_within_quarter_pitch(pose)).tolist()
        w, *v = rotation_to_quaternion(pose[:3, :3]).tolist()
        turn = rotation_to_vector(pose[:3, :3]).tolist()
        return Frame((x, y, z), (a, b, c), (w, *v), tuple(turn))

    @property
    def pose(self) -> Array:
        """(4, 4) [m]."""
        a, b, c = self.abc_deg
        scale, _ = display_unit_of_value("rad")
        xyz = np.array(self.xyz_mm) / display_unit_of_change("m")[0]
        return transform_from_xyz_rpy(xyz, np.array([c, b, a]) / scale)

    @property
    def origin_distance_mm(self) -> float:
        """Of its origin."""
        return float(np.linalg.norm(self.xyz_mm))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {name: list(value) for name, value in vars(self).items()}


class FrameTables(NamedTuple):
    """Tables of frames, by X, Y, Z and A, B, C, and by quaternions and rotation vectors."""

    angles: Table
    quaternions: Table


def build_frame_tables(frames: Mapping[str, Frame], title: str) -> FrameTables:
    """Frames by their names as X, Y, Z and A, B, C, and as quaternions and rotation vectors."""
    return FrameTables(
        Table.from_rows(
            f"{title}; {ABC_ANGLES_CONVENTION}",
            [(name, *frame.xyz_mm, *frame.abc_deg) for name, frame in frames.items()],
            "frame | X mm .3f | Y mm .3f | Z mm .3f | A deg .4f | B deg .4f | C deg .4f",
        ),
        Table.from_rows(
            "the same rotations as unit quaternions (w, x, y, z) and as rotation vectors",
            [(n, *f.quaternion_wxyz, *f.rotation_vector_rad) for n, f in frames.items()],
            "frame | w .6f | x .6f | y .6f | z .6f | rx rad .6f | ry rad .6f | rz rad .6f",
        ),
    )


def build_links_table(robot: Robot) -> Table:
    """Links and limits in millimetres and degrees, in the convention of the robot's file."""
    units = [
        display_unit_of_value("m" if name in MDH_LENGTH_NAMES else "rad") for name in MDH_NAMES
    ]
    own, _ = robot.notation.rows_in_file_convention(robot.mdh, robot.prismatic)
    rows = (
        (f"J{i + 1}", *(size * part for (size, _), part in zip(units, link, strict=True)),
         scale * robot.lower[i], scale * robot.upper[i], unit)
        for i, link in enumerate(own)
        for scale, unit in [display_unit_of_value("m" if robot.prismatic[i] else "rad")]
    )  # fmt: skip
    heads = (f"{name} {unit} .3f" for name, (_, unit) in zip(MDH_NAMES, units, strict=True))
    craig = " (modified DH)" if robot.notation.modified else ""
    title = f"{robot.name}: links and limits{craig}"
    return Table.from_rows(title, rows, "joint", *heads, "from .1f", "to .1f", "in")
