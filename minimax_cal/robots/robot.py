"""A robot: nominal or calibrated geometry, limits, masses; a table, URDF or MJCF in, JSON out."""

from __future__ import annotations

import difflib
import json
import math
import tomllib
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationWarning, RobotError
from minimax_cal.core.files import (
    build_object_with_unique_keys,
    format_json,
    read_text,
    write_file_atomically,
)
from minimax_cal.core.units import metres_to_file_mm
from minimax_cal.reading.workbook import WORKBOOK_SUFFIXES
from minimax_cal.robots import dh_notation, joint_couplings, kinematics
from minimax_cal.robots.angle_units import check_joint_limit_unit, check_link_angle_unit
from minimax_cal.robots.dh_notation import DH_FORMULAS, STANDARD_NOTATION, DhNotation
from minimax_cal.robots.inverse_kinematics import (
    MAX_REACHED_RESIDUAL,
    pose_residual_and_jacobian,
    solve_joints_with_restarts,
    solve_nearest_joints,
)
from minimax_cal.robots.joint_ranges import JointBounds
from minimax_cal.robots.kinematics import MDH_NAMES
from minimax_cal.robots.parallel_axes import move_frames_along_parallel_axes
from minimax_cal.robots.transforms import a_alpha_beta_transform, axis_rotation

STANDARD_DH_FORMULA = DH_FORMULAS["standard"]
METRES_PER_UNIT = {"mm": 1e-3, "m": 1.0}
RADIANS_PER_UNIT = {"rad": 1.0, "deg": np.pi / 180.0}

DEFAULT_NOMINAL_SIGMAS = (
    0.3e-3,
    0.5e-3,
)  # sigmas of a length and of an angle of most drawings [m, rad]

Finite = Annotated[float, Field(allow_inf_nan=False)]
INVERSE_LEVER_PER_REACH = 0.1  # of the reach: what a radian counts as
MAX_ROTATION_ERROR = 1e-6  # how far a rotation may be from one
MAX_LINK_LENGTH, MAX_LINK_ANGLE = 1e3, 1e3  # no link is longer, no angle larger than this [m, rad]
Vector = tuple[Finite, Finite, Finite]
Inertia = tuple[Finite, Finite, Finite, Finite, Finite, Finite]


def check_gear_ratio(ratio: float) -> float:
    """A gear ratio; zero is none.  Raises ValueError."""
    if ratio == 0.0:
        raise ValueError("a gear ratio of zero turns nothing; leave the key out")
    return ratio


NOTE_KEY_PREFIXES = ("x_", "source", "note")  # how keys begin that a robot file may hold for people


def check_known_keys(
    known_keys: Collection[str], content: object, note_prefixes: tuple[str, ...] = ()
) -> object:
    """Keys of a part of a file, if all are known or free.  Raises ValueError with the nearest."""
    for key in map(str, content if isinstance(content, Mapping) else ()):
        if key not in known_keys and not (note_prefixes and key.startswith(note_prefixes)):
            (near,) = difflib.get_close_matches(key, known_keys, 1, cutoff=0.0)
            more = "; begin a note of your own with x_, source or note" if note_prefixes else ""
            raise ValueError(f"unknown key {key[:60]!r}; did you mean {near!r}?{more}")
    return content


class StrictSchema(BaseModel):
    """A part of a robot file: what is not known would be ignored in silence, and is refused."""

    model_config = ConfigDict(extra="forbid")
    notes: ClassVar[tuple[str, ...]] = ()  # how keys begin that are nobody's

    @model_validator(mode="before")
    @classmethod
    def check_no_unknown_keys(cls, content: object) -> object:
        """The keys, if all are known.  Raises ValueError with the nearest."""
        return check_known_keys(cls.model_fields, content, cls.notes)


class UnitsSchema(StrictSchema):
    """Units of a robot file."""

    length: Literal["mm", "m"]
    angle: Literal["rad", "deg"]


class JointSchema(StrictSchema):
    """One joint of a robot file, in the file's units."""

    a: Finite
    d: Finite
    theta: Finite
    alpha: Finite
    beta: Finite = 0.0
    offset: Finite = 0.0
    sign: Literal[1, -1] = 1
    type: Literal["revolute", "prismatic"] = "revolute"
    lower: Finite | None = None
    upper: Finite | None = None
    ratio: Annotated[Finite, AfterValidator(check_gear_ratio)] | None = None
    mass_kg: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None
    com_mm: Vector | None = None
    inertia: Inertia | None = None
    drive_gain: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    name: str = ""


class EndSchema(StrictSchema):
    """What follows the last joint of modified DH, as the a, alpha and beta of a next row."""

    a: Finite = 0.0
    alpha: Finite = 0.0
    beta: Finite = 0.0


class WithinSchema(StrictSchema):
    """How well the drawing is known: standard deviations of its lengths and of its angles."""

    mm: Annotated[float, Field(gt=0.0, lt=100.0)] = 0.3
    mrad: Annotated[float, Field(gt=0.0, lt=100.0)] = 0.5


class RobotSchema(StrictSchema):
    """A robot file.  Keys that begin as `NOTE_KEY_PREFIXES` says are notes; others are refused."""

    model_config = ConfigDict(
        extra="ignore",
        json_schema_extra={
            "patternProperties": {f"^({'|'.join(NOTE_KEY_PREFIXES)})": {}},
            "additionalProperties": False,
        },
    )
    notes = NOTE_KEY_PREFIXES

    name: str
    convention: str = STANDARD_DH_FORMULA
    units: UnitsSchema
    joints: Annotated[list[JointSchema], Field(min_length=1)]
    coupling: dict[str, dict[str, Finite]] | list[list[Finite]] | None = None
    flange: EndSchema | None = None
    up: Vector = (0.0, 0.0, 1.0)
    repeatability_mm: Annotated[float, Field(gt=0.0, lt=100.0)] | None = None
    nominal: Literal["drawn", "rough"] = "drawn"
    drawn_within: WithinSchema = WithinSchema()


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial arm.

    mdh: (n, 5) a, d, theta, alpha, beta [m, rad].
    sign: (n,) +1 or -1, the controller's sense of each joint.
    prismatic: (n,) True where the joint slides.
    lower, upper: (n,) joint limits, infinite where unknown [rad, m].
    ratio: (n,) gear ratio, NaN where unknown.
    mass: (n,) mass of the link that joint i moves, NaN where unknown [kg].
    com: (n, 3) its centre of gravity in frame i, NaN where unknown [m].
    up: (3,) vertical in the base frame.
    repeatability: of its data sheet, by ISO 9283; NaN where unknown [m].
    rough: whether its geometry is no drawing but a first guess, from which it may be far.
    inertia: (n, 6) xx, xy, xz, yy, yz, zz of each link about its centre of gravity, in the axes of
    frame i, NaN where unknown; empty where no link's is known [kg m^2].
    drive_gain: (n,) torque for one ampere, NaN where unknown; may be empty [N m/A, N/A].
    drawn_within: how well its lengths and its angles are known as drawn, as sigmas [m, rad].
    coupling: (n, n) how far each joint goes per unit of each joint value; (0, 0) for each its own.
    notation: how the robot's file writes its links.  notices: how its frames are not those of the
    links of a URDF or MJCF, which no file of it tells.
    """

    name: str
    mdh: Array
    sign: Array
    prismatic: Array
    lower: Array
    upper: Array
    ratio: Array
    mass: Array
    com: Array
    up: Array
    repeatability: float = math.nan
    rough: bool = False
    inertia: Array = field(default_factory=lambda: np.zeros((0, 6)))
    drive_gain: Array = field(default_factory=lambda: np.zeros(0))
    drawn_within: tuple[float, float] = DEFAULT_NOMINAL_SIGMAS
    coupling: Array = field(default_factory=lambda: np.zeros((0, 0)))
    notation: DhNotation = STANDARD_NOTATION
    notices: tuple[str, ...] = ()

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.mdh)

    @property
    def passive(self) -> Array:
        """(n,) True for joints without a drive, which others take along: their value is 0."""
        if not len(self.coupling):
            return np.zeros(self.joints, dtype=bool)
        return np.asarray(~self.coupling.any(axis=0))

    @property
    def joint_to_chain_matrix(self) -> Array:
        """(n, n) how the joints turn or slide in the chain per unit of each joint value."""
        own = self.coupling if len(self.coupling) else np.eye(self.joints)
        return np.asarray(self.sign[:, None] * own)

    def chain_joint_values(self, q: Array) -> Array:
        """Joint values (..., n) as the chain takes them: couplings and signs applied."""
        return np.asarray((q @ self.coupling.T if len(self.coupling) else q) * self.sign)

    def controller_joint_values(self, chain_values: Array) -> Array:
        """The joint values (..., n) of those in the chain: the inverse of `chain_values`."""
        own = chain_values * self.sign
        return np.asarray(own @ np.linalg.pinv(self.coupling).T if len(self.coupling) else own)

    def pose(self, q: Array) -> Array:
        """Pose of the last frame in the base: (..., 4, 4) [m].  q: (..., n) [rad, m].

        Raises RobotError for joint values of another arm.
        """
        q = self.check_joint_values(q)
        flat = q.reshape(-1, self.joints)
        pose = kinematics.forward_kinematics(
            self.mdh, self.chain_joint_values(flat), self.prismatic
        )
        return pose.reshape(*q.shape[:-1], 4, 4)

    def check_joint_values(self, q: Array) -> Array:
        """Joint values (..., n), if they are of so many joints, or of those with a drive.

        Raises RobotError.
        """
        q = joint_couplings.insert_passive_joint_zeros(np.asarray(q), self.passive)
        if not q.ndim or q.shape[-1] != self.joints:
            raise RobotError(
                f"{self.name} has {self.joints} joints: joint values must be (..., {self.joints}), "
                f"not {q.shape}"
            )
        return q

    def inverse(self, pose: Array, near: Array | None = None) -> Array:
        """Joints (..., n) that bring the last frame to poses in the base, within the limits.

        pose: (..., 4, 4) [m].  near: joints to start from, (n,) or (..., n), which choose among the
        ways of the arm [rad, m]; without it any way will do.  What cannot be reached ends nearby,
        with a CalibrationWarning.  Raises RobotError for what is no pose.
        """
        lever = INVERSE_LEVER_PER_REACH * self.reach()

        def find(goal: Array, begin: Array) -> tuple[Array, Array]:
            def look(rows: Array, q: Array) -> tuple[Array, Array]:
                turned, turning = self.chain_joint_values(q), self.joint_to_chain_matrix
                return pose_residual_and_jacobian(
                    self.mdh, turned, self.prismatic, turning, goal[rows], lever
                )

            box = (np.broadcast_to(end, begin.shape) for end in (self.lower, self.upper))
            q = solve_nearest_joints(look, begin, *box)
            return q, np.linalg.norm(look(np.arange(len(q)), q)[0], axis=1)

        given = check_poses_and_start(pose, near, self.joints)
        return warn_of_unreached_poses(
            *solve_joints_with_restarts(find, *given, self.lower, self.upper)
        )

    def reach(self) -> float:
        """Length of the stretched arm without its slides, at least 0.1: a scale for errors [m]."""
        return max(0.1, float(np.hypot(self.mdh[:, 0], self.mdh[:, 1]).sum()))

    @staticmethod
    def from_dict(content: Mapping[str, Any], source: str) -> Robot:
        """As `robot_from_dict`."""
        return robot_from_dict(content, source)

    def to_dict(self) -> dict[str, Any]:
        """The robot in the file schema and the convention of its file, in mm and radians."""
        rows, end = self.notation.rows_in_file_convention(self.mdh, self.prismatic)
        sign = self.sign.copy()
        sign[0] *= -1.0 if self.notation.half_turn else 1.0

        def joint(i: int) -> dict[str, Any]:
            a, d, theta, alpha, beta = map(float, rows[i])
            scale = 1e3 if self.prismatic[i] else 1.0
            offset = self.notation.offset[i] if len(self.notation.offset) else 0.0
            limits = {"lower": self.lower[i] * scale, "upper": self.upper[i] * scale}
            optional = {
                "offset": offset * scale if offset else math.nan,
                **({} if self.passive[i] else limits),
                "ratio": self.ratio[i],
                "mass_kg": self.mass[i],
            }
            out: dict[str, Any] = dict(
                a=metres_to_file_mm(a), d=metres_to_file_mm(d), theta=theta, alpha=alpha, beta=beta
            )
            out["sign"] = int(sign[i])
            if self.prismatic[i]:
                out["type"] = "prismatic"
            out |= {key: float(value) for key, value in optional.items() if np.isfinite(value)}
            if np.all(np.isfinite(self.com[i])):
                com = self.com[i]
                if self.notation.modified:  # of the frame of joint i, which lies before the link
                    rest = a_alpha_beta_transform(
                        self.notation.values_in_file_convention(self.mdh, self.prismatic)[i]
                    )
                    com = rest[:3, :3] @ com + rest[:3, 3]
                out["com_mm"] = [metres_to_file_mm(c) for c in com]
            if len(self.inertia) and np.all(np.isfinite(self.inertia[i])):
                out["inertia"] = [float(c) for c in self.inertia_in_file_axes(i)]
            if len(self.drive_gain) and np.isfinite(self.drive_gain[i]):
                out["drive_gain"] = float(self.drive_gain[i])
            return out

        known = np.isfinite(self.repeatability)
        coupling = joint_couplings.coupling_to_dict(self.coupling)
        within = dict(zip(("mm", "mrad"), (1e3 * each for each in self.drawn_within), strict=True))
        after = dict(a=metres_to_file_mm(end[0]), alpha=end[3], beta=end[4])
        return {
            "name": self.name,
            "convention": "modified" if self.notation.modified else STANDARD_DH_FORMULA,
            "units": {"length": "mm", "angle": "rad"},
            "up": [float(u) for u in self.up],
            **({"repeatability_mm": 1e3 * self.repeatability} if known else {}),
            **({"nominal": "rough"} if self.rough else {}),
            **({"drawn_within": within} if self.drawn_within != DEFAULT_NOMINAL_SIGMAS else {}),
            **({"coupling": coupling} if coupling else {}),
            **({"flange": {k: float(v) for k, v in after.items()}} if end.any() else {}),
            "joints": [joint(i) for i in range(self.joints)],
        }

    def inertia_in_file_axes(self, link_index: int) -> Array:
        """(6,) of link i, in the axes of the file's own frame i."""
        if not self.notation.modified:
            return np.asarray(self.inertia[link_index])
        rest = a_alpha_beta_transform(
            self.notation.values_in_file_convention(self.mdh, self.prismatic)[link_index]
        )
        return rotate_inertia(self.inertia[link_index], rest[:3, :3])

    def save(self, path: Path | str) -> None:
        """Write the robot as JSON."""
        write_file_atomically(path, format_json(self.to_dict()))

    def with_mdh(self, mdh: Array) -> Robot:
        """The same robot with another geometry (n, 5).  Raises RobotError for another shape."""
        new = np.array(mdh)
        if new.shape != self.mdh.shape:
            raise RobotError(f"{self.name}: mdh must be {self.mdh.shape}, not {new.shape}")
        return replace(self, mdh=new)


class PosesAndStart(NamedTuple):
    """Goal poses (..., 4, 4), and joint values to start from."""

    poses: Array
    near_joints: Array | None


def check_poses_and_start(
    poses: Array, near_joints: Array | None, joint_count: int
) -> PosesAndStart:
    """Poses (..., 4, 4) and joints to start from, if they are some.  Raises RobotError."""
    try:
        poses = np.asarray(poses, dtype=float)
        near_joints = None if near_joints is None else np.asarray(near_joints, dtype=float)
    except (TypeError, ValueError) as error:
        raise RobotError("inverse: pose and near must be numbers") from error
    if poses.shape[-2:] != (4, 4) or not np.isfinite(poses).all():
        raise RobotError(f"inverse: pose must be finite, of shape (..., 4, 4); it is {poses.shape}")
    turn = poses[..., :3, :3]
    apart = np.abs(turn @ np.swapaxes(turn, -1, -2) - np.eye(3)).max(initial=0.0)
    if apart > MAX_ROTATION_ERROR or np.any(np.linalg.det(turn) < 0.0):
        raise RobotError("inverse: the upper left 3 x 3 of a pose must be a rotation")
    if near_joints is not None:
        fits = near_joints.shape[-1:] == (joint_count,) and near_joints.shape[:-1] in (
            (),
            poses.shape[:-2],
        )
        if not (fits and np.isfinite(near_joints).all()):
            raise RobotError(
                f"inverse: near must be finite, of shape ({joint_count}"
                f",) or a row for each pose; it is "
                f"{near_joints.shape}"
            )
    return PosesAndStart(poses, near_joints)


def warn_of_unreached_poses(q: Array, residuals: Array) -> Array:
    """The joints found; a CalibrationWarning where they do not reach their poses."""
    if count := int(np.count_nonzero(residuals > MAX_REACHED_RESIDUAL)):
        warnings.warn(
            f"{count} of {residuals.size} poses are not reached, "
            f"by {1e3 * residuals.max():.3g} mm at worst: "
            "out of reach, beyond a limit, or another way of the arm (near)",
            CalibrationWarning,
            stacklevel=3,
        )
    return q


def robot_from_dict(content: Mapping[str, Any], source: str = "robot") -> Robot:
    """A robot from the file schema.  source: what messages call it.  Raises RobotError."""
    try:
        schema = RobotSchema.model_validate(content)
    except ValidationError as error:
        raise RobotError(f"{source}: {format_validation_error(error)}") from error
    modified = is_modified_dh(schema, source)
    metre, radian = METRES_PER_UNIT[schema.units.length], RADIANS_PER_UNIT[schema.units.angle]
    joints = schema.joints
    prismatic = np.array([joint.type == "prismatic" for joint in joints])
    unit, scale = np.where(prismatic, metre, radian), np.array([metre, metre, *[radian] * 3])
    mdh = build_link_rows(schema, scale, source)
    lower, upper = build_joint_limits(schema, prismatic, unit, source)
    coupling = joint_couplings.build_coupling_matrix(
        schema.coupling, [j.name for j in joints], source
    )
    passive = ~coupling.any(axis=0) if len(coupling) else np.zeros(len(joints), dtype=bool)
    sign = np.array([float(j.sign) for j in joints])
    offset = np.array([j.offset for j in joints]) * unit
    offset = offset if offset.any() else np.zeros(0)
    com = np.array([[np.nan] * 3 if j.com_mm is None else j.com_mm for j in joints]) * 1e-3
    inertia = build_array_unless_missing([j.inertia for j in joints], [np.nan] * 6)
    if modified:
        end = schema.flange or EndSchema()
        after = np.array([end.a, 0.0, 0.0, end.alpha, end.beta]) * scale
        com = convert_centres_to_engine_frames(com, np.vstack([mdh[1:], after]))
        turns = [a_alpha_beta_transform(row)[:3, :3].T for row in np.vstack([mdh[1:], after])]
        inertia = np.array([rotate_inertia(*two) for two in zip(inertia, turns, strict=False)])
        inertia = inertia.reshape(-1, 6)
        mdh, sign, said = dh_notation.convert_modified_rows(
            mdh, sign, prismatic, offset, after, source
        )
    else:
        mdh, sign = dh_notation.apply_offsets_and_half_turn(mdh, sign, prismatic, offset, False)
        said = DhNotation(offset=offset) if len(offset) else STANDARD_NOTATION
    moved = move_frames_along_parallel_axes(mdh)
    if moved.shifts.any():
        mdh = moved.mdh
        turns = [axis_rotation(2, turn)[:3, :3] for turn in moved.turns]
        com = np.stack(
            [
                turn @ (centre - [0.0, 0.0, shift])
                for turn, centre, shift in zip(turns, com, moved.shifts, strict=True)
            ]
        )
        if len(inertia):
            inertia = np.stack([rotate_inertia(*two) for two in zip(inertia, turns, strict=True)])
    return Robot(
        name=schema.name,
        mdh=mdh,
        sign=sign,
        prismatic=prismatic,
        lower=np.where(passive, 0.0, lower),
        upper=np.where(passive, 0.0, upper),
        ratio=fill_missing_numbers([j.ratio for j in joints], np.nan),
        mass=fill_missing_numbers([j.mass_kg for j in joints], np.nan),
        com=com,
        up=build_up_vector(schema, source),
        repeatability=1e-3 * (schema.repeatability_mm or math.nan),
        rough=schema.nominal == "rough",
        drawn_within=(1e-3 * schema.drawn_within.mm, 1e-3 * schema.drawn_within.mrad),
        inertia=inertia,
        drive_gain=build_array_unless_missing([j.drive_gain for j in joints], np.nan),
        coupling=coupling,
        notation=said,
    )


def fill_missing_numbers(values: list[float | None], default: float) -> Array:
    """Numbers (n,), a default where there is none."""
    return np.array([default if value is None else value for value in values], dtype=float)


def build_array_unless_missing(values: list[Any], fill_value: Any) -> Array:
    """Numbers or rows (n, ...), `fill_value` where there is none; (0, ...) where there are none."""
    if all(value is None for value in values):
        return np.zeros((0, *np.shape(fill_value)))
    return np.array([fill_value if value is None else value for value in values], dtype=float)


def build_link_rows(schema: RobotSchema, unit_scales: Array, source: str) -> Array:
    """The links (n, 5) as a file has them.  unit_scales: (5,) its units [m, rad].  Raises
    RobotError.
    """
    mdh = np.array([[j.a, j.d, j.theta, j.alpha, j.beta] for j in schema.joints])
    check_link_angle_unit(mdh[:, 2:], schema.units.angle, source)
    mdh = mdh * unit_scales
    huge = np.abs(mdh) > [
        MAX_LINK_LENGTH,
        MAX_LINK_LENGTH,
        MAX_LINK_ANGLE,
        MAX_LINK_ANGLE,
        MAX_LINK_ANGLE,
    ]
    if huge.any():
        joint, column = np.argwhere(huge)[0]
        raise RobotError(
            f"{source}: joints[{joint}].{MDH_NAMES[column]}: is over 1 km or 1000 rad; check units"
        )
    return np.asarray(mdh)


def build_joint_limits(
    schema: RobotSchema, prismatic: Array, joint_units: Array, source: str
) -> JointBounds:
    """Lower and upper limits (n,), infinite where unknown [rad, m].  Raises RobotError."""
    lower = fill_missing_numbers([j.lower for j in schema.joints], -np.inf)
    upper = fill_missing_numbers([j.upper for j in schema.joints], np.inf)
    check_joint_limit_unit(lower, upper, prismatic, schema.units.angle, source)
    if np.any(lower >= upper):
        number = int(np.argmax(lower >= upper)) + 1
        raise RobotError(f"{source}: joint {number}: lower must be less than upper")
    return JointBounds(lower * joint_units, upper * joint_units)


def build_up_vector(schema: RobotSchema, source: str) -> Array:
    """(3,) the unit vector upwards in the base frame.  Raises RobotError."""
    up = np.array(schema.up)
    up = up / max(1.0, float(np.abs(up).max()))  # the squares of huge numbers are none
    if np.linalg.norm(up) < 1e-9:
        raise RobotError(f"{source}: up: is a zero vector; give the vertical, e.g. [0, 0, 1]")
    return np.asarray(up / np.linalg.norm(up))


def is_modified_dh(schema: RobotSchema, source: str) -> bool:
    """Whether a file's rows are Craig's.  Raises RobotError for a convention that is not known."""
    given = "".join(schema.convention.split()).lower()
    for name, formula in DH_FORMULAS.items():
        if given in (name, "".join(formula.split()).lower()):
            if schema.flange and name == "standard":
                raise RobotError(
                    f"{source}: flange: of modified DH alone; a standard row holds its own a, "
                    "alpha and beta: put them into the last joint"
                )
            return name == "modified"
    raise RobotError(
        f"{source}: convention {schema.convention!r} is not known; use 'standard' "
        f"({DH_FORMULAS['standard']}) or 'modified' (Craig's: {DH_FORMULAS['modified']})"
    )


def rotate_inertia(inertia: Array, rotation: Array) -> Array:
    """An inertia (6,) xx, xy, xz, yy, yz, zz in axes that a rotation (3, 3) leads into."""
    at = np.triu_indices(3)
    whole = np.zeros((3, 3))
    whole[at] = whole.T[at] = inertia
    return np.asarray((rotation @ whole @ rotation.T)[at])


def convert_centres_to_engine_frames(centres: Array, next_rows: Array) -> Array:
    """Centres of gravity (n, 3), given in the frames of Craig's joints, in the engine's frames.

    next_rows: (n, 5) the row after each joint [m, rad].
    """
    parts = [a_alpha_beta_transform(row) for row in next_rows]
    return np.array([t[:3, :3].T @ (c - t[:3, 3]) for t, c in zip(parts, centres, strict=True)])


def format_validation_error(error: ValidationError) -> str:
    """The first complaint of the schema, in one line: where and what."""
    first = error.errors(include_url=False)[0]
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
    text = first["msg"].removeprefix("Value error, ")
    message = f"{place.lstrip('.') or 'file'}: {text[0].lower()}{text[1:]}"
    more = error.error_count() - 1
    return message + (f" (and {more} more)" if more else "")


@cache
def builtin_robots() -> tuple[str, ...]:
    """Names of the robots that come with the package.

    >>> "irb2600" in mc.builtin_robots()
    True
    """
    folder = resources.files("minimax_cal.robots") / "builtin"
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".json")))


@cache
def load_builtin_robot(name: str) -> Robot:
    """A built-in robot, read once: its arrays cannot be changed."""
    builtin = resources.files("minimax_cal.robots") / "builtin" / f"{name}.json"
    robot = robot_from_dict(json.loads(builtin.read_text("utf-8")), name)
    for part in (*vars(robot).values(), robot.notation.offset):
        if isinstance(part, np.ndarray):
            part.flags.writeable = False
    return robot


def parse_yaml_text(text: str) -> Any:
    """A YAML document without aliases.  Raises ValueError."""
    from minimax_cal.robots.strict_yaml import parse_strict_yaml  # few robots come as one

    return parse_strict_yaml(text)


PARSER_BY_SUFFIX: dict[str, tuple[Callable[[str], Any], type[Exception]]] = {
    ".json": (
        partial(json.loads, object_pairs_hook=build_object_with_unique_keys),
        json.JSONDecodeError,
    ),
    ".toml": (tomllib.loads, tomllib.TOMLDecodeError),
    ".yaml": (parse_yaml_text, ValueError),
    ".yml": (parse_yaml_text, ValueError),
}


RobotSource = Robot | str | Path  # loaded, or what `load_robot` takes


def load_robot(source: Robot | Path | str) -> Robot:
    """A built-in robot by name, or a file (.json, .toml, .yaml, .csv, .xlsx, .urdf, MJCF .xml).

    Parameters
    ----------
    source
        Name or path; ``robot.urdf#tip`` or ``robot.xml#root:tip`` name the ends of a chain.  A
        robot stays as it is.

    Returns
    -------
    Robot
        The file says its units; the robot has metres and radians.

    Raises
    ------
    RobotError
        For wrong input.

    Examples
    --------
    >>> robot = mc.load_robot("irb2600")
    """
    if isinstance(source, Robot) or str(source) in builtin_robots():
        return source if isinstance(source, Robot) else load_builtin_robot(str(source))
    path = Path(source)
    from minimax_cal.robots.urdf_robot import (
        is_urdf_or_mjcf_source,
        load_urdf,
        split_file_and_link_names,
    )  # not for a built-in robot

    file, ur_name = split_file_and_link_names(source)
    if file.lower().endswith(".conf"):
        from minimax_cal.robots.ur_files import read_ur_calibration  # few robots come as one

        return read_ur_calibration(Path(file), ur_name)
    if is_urdf_or_mjcf_source(source):
        found = load_urdf(source)
        return replace(
            robot_from_dict(found.content, str(source)), notices=found.base_and_tool_notices
        )
    if path.suffix.lower() in (".csv", *WORKBOOK_SUFFIXES):
        from minimax_cal.robots.dh_data_sheet import read_dh_data_sheet  # few robots come as one

        return robot_from_dict(read_dh_data_sheet(path), str(path))
    if path.suffix.lower() not in PARSER_BY_SUFFIX:
        if len(str(source)) < 200 and path.exists():
            use = ", ".join((*PARSER_BY_SUFFIX, ".csv, .xlsx, .urdf, .xml"))
            raise RobotError(f"{path}: not a robot file; use {use}")
        near = difflib.get_close_matches(str(source), builtin_robots(), 1)
        hint = f"did you mean {near[0]!r}?" if near else f"built in: {', '.join(builtin_robots())}"
        raise RobotError(f"no robot called {str(source)[:60]!r}; {hint}, or give a robot file")
    parse, failure = PARSER_BY_SUFFIX[path.suffix.lower()]
    text = read_text(path, error_type=RobotError)
    try:
        content = parse(text)
    except (failure, RecursionError, ValueError) as error:
        raise RobotError(f"{path}: cannot be parsed: {' '.join(str(error).split())}") from error
    if not isinstance(content, Mapping):
        raise RobotError(f"{path}: holds no robot; expected keys name, units, joints")
    if isinstance(content.get("robot"), Mapping):  # a saved calibration holds its robot whole
        content = content["robot"]
    if "kinematics" in content:
        from minimax_cal.robots.ur_files import convert_ur_kinematics, is_ur_kinematics

        if is_ur_kinematics(content):
            return convert_ur_kinematics(content, str(path))
    return robot_from_dict(content, str(path))
