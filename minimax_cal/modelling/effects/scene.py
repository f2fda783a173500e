"""What the law of an effect may look at, and what it answers with.

Gears, motors and encoders act at the drives: a law of theirs sees the value of a drive and the
torque that it carries, and turns all joints that it moves (`one_joint`).  Bearings and links act at
the joints of the chain, at their `angles`.  Without couplings both are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.session_frames import instrument_positions
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity_torques import (
    STANDARD_GRAVITY,
    joint_gravity_torques,
    known_link_mass_mask,
    link_mass_centres_in_base,
    link_masses_and_centres,
)
from minimax_cal.robots.kinematics import LinkFrames
from minimax_cal.robots.robot import Robot

RELATIVE_MASS_SIGMA = 0.2  # relative sigma of the masses and centres of gravity in a robot file
PRIOR_REFERENCE_ERROR = 5e-5  # error of a coordinate beside which priors of effects are weighed [m]
MIN_LOAD_SHARE = 0.05  # of the largest load, below which a joint carries no weight
MIN_MASS_CENTRE_SIGMA = 0.02  # sigma of a centre of gravity, where 20 % of it is less [m]


@dataclass(frozen=True, eq=False)
class PosedArm:
    """An arm at its measured poses, in its base frame.

    robot: with the geometry at hand.  data: m poses with the columns of `add_history_columns`.
    links: the chain there.  target_positions: (k, 3) in the last frame [m].
    points: (k, 3, m) the targets in the base frame [m].
    rotation, origin: (3, 3), (3,) pose of the base in the measurement frame [m].
    """

    robot: Robot
    data: Measurements
    links: LinkFrames
    target_positions: Array
    points: Array
    rotation: Array
    origin: Array

    @staticmethod
    def at_measured_poses(
        robot: Robot,
        data: Measurements,
        base_rotation_and_origin: tuple[Array, Array],
        spots: Array,
        signed_joint_values: Array,
    ) -> PosedArm:
        """The scene of a cell.  base_rotation_and_origin: its rotation and origin.
        signed_joint_values: (m, n) signs applied.
        """
        links = kinematics.compute_link_frames(robot.mdh, signed_joint_values, robot.prismatic)
        points = kinematics.targets_in_base(links, spots)
        return PosedArm(
            robot, add_history_columns(data), links, spots, points, *base_rotation_and_origin
        )

    @cached_property
    def column_cache(self) -> dict[str, EffectColumns]:
        """Columns of effects that were asked for here, by the text of their terms."""
        return {}

    @property
    def joints(self) -> int:
        """n."""
        return self.robot.joints

    @property
    def poses(self) -> int:
        """m."""
        return int(self.points.shape[-1])

    @property
    def targets(self) -> int:
        """k."""
        return len(self.points)

    @cached_property
    def q(self) -> Array:
        """(n, m) values of the drives, signs applied [rad, m]."""
        return np.ascontiguousarray((self.data.q * self.robot.sign).T)

    @cached_property
    def angles(self) -> Array:
        """(n, m) values of the joints, as the drives move them [rad, m]."""
        return np.ascontiguousarray(self.robot.chain_joint_values(self.data.q).T)

    @property
    def joint_motion_per_drive(self) -> Array:
        """(n, n) how far each joint goes per unit of each drive, signs applied."""
        return self.robot.joint_to_chain_matrix * self.robot.sign

    @cached_property
    def jacobian(self) -> Array:
        """(n, k, 3, m) motion of every target per unit of every drive [m per rad or m]."""
        return np.asarray(np.tensordot(self.joint_motion_per_drive, self.jacobian_by_joint, (0, 0)))

    @cached_property
    def jacobian_by_joint(self) -> Array:
        """(n, k, 3, m) motion of every target per unit of every joint [m per rad or m]."""
        z, o = self.links.z[:, None], self.links.before[:, None]
        turned = kinematics.cross(np.broadcast_to(z, (self.joints, *self.points.shape)),
                                  self.points[None] - o)  # fmt: skip
        return np.where(self.robot.prismatic[:, None, None, None], z + 0.0 * turned, turned)

    @property
    def instrument(self) -> Array:
        """(3,) where the instrument stands [m]: the origin of the (first) measurement frame."""
        return np.asarray(-self.origin @ self.rotation)

    @property
    def instruments(self) -> Array:
        """(3, m) where it stood at each pose [m]."""
        return np.asarray(((instrument_positions(self.data) - self.origin) @ self.rotation).T)

    def column(self, stem: str) -> Array:
        """(m,) an optional column; zeros where it is empty or absent."""
        values = self.data.columns.get(stem)
        return np.zeros(self.poses) if values is None else np.nan_to_num(values.astype(float))

    def column_varies(self, stem: str) -> bool:
        """Whether an optional column is there and varies."""
        values = self.column(stem)
        return bool(np.ptp(values) > 0.0) if len(values) else False

    @property
    def missing_order_clause(self) -> str:
        """A clause where the file tells no order of its poses, which takes two, else nothing."""
        followed = self.data.columns.get("followed")
        timed = (
            self.column_varies("clock")
            or followed is None
            or bool(followed.any())
            or self.poses < 2
        )
        return "" if timed else "; the file tells no order"

    @cached_property
    def has_measured_torques(self) -> bool:
        """Whether the data hold a torque, at all poses, of every joint that gravity loads.

        Columns of some joints or poses, and those that never vary, tell less than assumed masses.
        """
        told = np.array(
            [self.column_is_complete_and_varies(f"tau{j + 1}") for j in range(self.joints)]
        )
        if not told.any():  # as nearly always: no torque is computed
            return False
        load = np.abs(
            self.drive_gravity_torques(*self.link_masses_and_centres) + self.payload_torques
        ).max(axis=1, initial=0.0)
        heavy = load > MIN_LOAD_SHARE * load.max(initial=0.0)
        return bool(heavy.any() and told[heavy].all())

    @property
    def unused_torques_notice(self) -> str:
        """What to say of torques that are not used; empty where there are none."""
        known = [j + 1 for j in range(self.joints) if f"tau{j + 1}" in self.data.columns]
        if self.has_measured_torques or not known:
            return ""
        names = ", ".join(f"tau{j}_Nm" for j in known)
        return (
            f"{names}: gravity's torques are computed, not read here: measured ones count where "
            "every joint that carries weight has them, at every pose and not always the same"
        )

    def column_is_complete_and_varies(self, stem: str) -> bool:
        """Whether an optional column has a number at every pose, and not one alone for all."""
        values = self.data.columns.get(stem)
        if values is None or not np.isfinite(values.astype(float)).all():
            return False
        return self.poses < 2 or self.column_varies(stem)

    def each(self, stem: str) -> Array:
        """(n, m) the optional columns stem1 ... stemn, in the sense of `signed_joint_values`."""
        values = [self.column(f"{stem}{j + 1}") for j in range(self.joints)]
        return np.array(values) * self.robot.sign[:, None]

    @cached_property
    def has_known_masses(self) -> bool:
        """Whether the robot file tells the masses and centres of gravity of the moving links."""
        return bool(known_link_mass_mask(self.robot)[1:].all())

    @cached_property
    def link_masses_and_centres(self) -> tuple[Array, Array]:
        """(n,) masses [kg] and (n, 3) centres of gravity in the link frames [m]:
        `link_masses_and_centres`.
        """
        return link_masses_and_centres(self.robot)

    def drive_gravity_torques(self, link_masses: Array, mass_centres: Array) -> Array:
        """(n, m) gravity's torque that each drive carries, 0 at slides [N m]."""
        found = joint_gravity_torques(self.links, link_masses, mass_centres, self.robot.up)
        return np.asarray(
            self.joint_motion_per_drive.T @ np.where(self.robot.prismatic[:, None], 0.0, found)
        )

    @cached_property
    def payload_torques(self) -> Array:
        """(n, m) torque of the payload [N m].

        Its centre is that of the columns payload_x ..., else amid the targets.
        """
        if not self.column("payload").any():
            return np.zeros((self.joints, self.poses))
        return self.torques_per_flange_kilogram(self.payload_centre_in_flange) * self.column(
            "payload"
        )

    @property
    def payload_centre_in_flange(self) -> Array:
        """(3, m) centre of gravity of the payload in the last frame [m]."""
        amid = self.target_positions.mean(axis=0)
        given = [self.data.columns.get(f"payload_{axis}") for axis in "xyz"]
        if any(column is None for column in given):
            return np.repeat(amid[:, None], self.poses, axis=1)
        centre = np.array(given, dtype=float)
        return np.where(np.isfinite(centre).all(axis=0), centre, amid[:, None])

    @property
    def payload_centre_in_base(self) -> Array:
        """(3, m) centre of gravity of the payload in the base [m]."""
        along = np.einsum("am,axm->xm", self.payload_centre_in_flange, self.links.axes)
        return np.asarray(self.links.origin + along)

    def torques_per_flange_kilogram(self, centre: Array) -> Array:
        """(n, m) torque of one kilogram on the last link.  centre: (3, m) in its frame [m].

        Affine in the centre: of one in the origin, and of a metre along each axis.
        """
        one = np.zeros(self.joints)
        one[-1] = 1.0
        ends = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        torque = []
        for end in ends:
            com = np.zeros((self.joints, 3))
            com[-1] = end
            torque.append(self.drive_gravity_torques(one, com))
        slopes = np.array(torque[1:]) - torque[0]
        return np.asarray(torque[0] + np.einsum("anm,am->nm", slopes, centre))

    @cached_property
    def gravity(self) -> Array:
        """(n, m) the drives' static torques: measured where they are, else computed [N m]."""
        if self.has_measured_torques:
            return self.each("tau")
        return self.drive_gravity_torques(*self.link_masses_and_centres) + self.payload_torques

    @cached_property
    def gravity_changes_per_sigma(self) -> Array:
        """(l, n, m) change of `gravity` for one sigma of each mass and centre of gravity [N m]."""
        if self.has_measured_torques:
            return np.zeros((0, self.joints, self.poses))
        whole = self.drive_gravity_torques(*self.link_masses_and_centres)
        parts = [
            self.drive_gravity_torques(*other) - whole
            for other in self.link_masses_and_centres_off_by_one_sigma
        ]
        return np.array(parts)

    @cached_property
    def link_masses_and_centres_off_by_one_sigma(self) -> list[tuple[Array, Array]]:
        """Masses and centres of gravity, one of them off by its sigma each."""
        out = []
        mass, com = self.link_masses_and_centres
        for link in range(1, self.joints):
            heavier = mass.copy()
            heavier[link] *= 1.0 + RELATIVE_MASS_SIGMA
            out.append((heavier, com))
            for axis in range(3):
                moved = com.copy()
                moved[link, axis] += max(
                    RELATIVE_MASS_SIGMA * abs(com[link, axis]), MIN_MASS_CENTRE_SIGMA
                )
                out.append((mass, moved))
        return out

    def moment_and_mass_beyond_link(
        self, link: int, link_masses: Array, mass_centres: Array
    ) -> tuple[Array, Array]:
        """Weight that hangs beyond the end of a link: its moment (3, m) about that end, and mass.

        [N m, kg]
        """
        centre = link_mass_centres_in_base(self.links, mass_centres)[link + 1 :]
        beyond = link_masses[link + 1 :]
        lever = (beyond[:, None, None] * (centre - self.links.after[link])).sum(axis=0)
        total = float(beyond.sum())
        moment = kinematics.cross(
            lever, np.broadcast_to(-STANDARD_GRAVITY * self.robot.up[:, None], lever.shape)
        )
        tip = self.points.mean(axis=0) - self.links.after[link]
        weight = -STANDARD_GRAVITY * self.robot.up[:, None] * self.column("payload")
        moment = moment + kinematics.cross(tip, weight)
        return moment, np.full(self.poses, total) + self.column("payload")


class DisplacementUncertainty(NamedTuple):
    """Of a parameter, (r, k, 3, m) displacements that its field may differ by, one sigma each."""

    parameter_index: int
    displacements: Array


@dataclass(frozen=True, eq=False)
class EffectColumns:
    """An effect at a place: how points move per unit of each of its d parameters.

    names, units: d of each; units are SI.
    turn: (d, n, m) by how much each joint turns or slides [rad or m per unit]; empty for none.
    shift: (d, k, 3, m) by how much each target moves besides [m per unit]; empty for none.
    doubt: of a parameter (r, k, 3, m) of a scene, once called, how its field may differ, one sigma
    each.
    fixed: what was chosen and not fitted (turns per revolution, time constants), for the report.
    ridge: (d,) weight of a prior of mean zero, (BESIDE / sigma)^2 [m^2 per unit^2]; empty for none.
    either: (d,) True for parameters of a positive effect that may have either sign; empty for none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    turn: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    shift: Array = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))
    doubt: Mapping[int, Callable[[PosedArm], Array]] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    ridge: Array = field(default_factory=lambda: np.zeros(0))
    either: Array = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def moves_joints_only(self) -> bool:
        """Whether joints turn, and targets do not move besides."""
        return not self.shift.size

    def target_displacements(self, posed_arm: PosedArm) -> Array:
        """(d, k, 3, m) motion of every target per unit, to first order [m per unit]."""
        out = np.zeros((len(self.names), *posed_arm.points.shape))
        if self.turn.size:
            out = out + np.einsum(
                "dnm,nkcm->dkcm", self.turn, posed_arm.jacobian_by_joint, optimize=True
            )
        if self.shift.size:
            out = out + self.shift
        return out

    def displacement_uncertainties(self, posed_arm: PosedArm) -> list[DisplacementUncertainty]:
        """Displacements by which the fields may differ, of each parameter with an uncertain one."""
        found = [(owner, doubt(posed_arm)) for owner, doubt in self.doubt.items()]
        return [DisplacementUncertainty(owner, part) for owner, part in found if len(part)]


MAX_LAW_VARIATIONS = 3  # independent ways in which a law may differ from the one computed


def principal_variations(variations: Array) -> Array:
    """The few independent directions that many one-sigma doubts (l, ...) add up to: (r, ...)."""
    if not variations.size:
        return variations
    flat = variations.reshape(len(variations), -1)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    kept = [i for i in range(len(values))[::-1] if values[i] > 1e-6 * values[-1]][
        :MAX_LAW_VARIATIONS
    ]
    return np.asarray((vectors[:, kept].T @ flat).reshape(len(kept), *variations.shape[1:]))


Choice = Mapping[str, float]  # what picks one variant of a law, as {"turns": 2}
DEFAULT_CHOICES: tuple[Choice, ...] = ({},)


MOVED_PARTS = ("arm", "foot", "frame", "tool", "target", "instrument")
EFFECT_DRIVERS = (  # "" stands for a joint's own value, whatever else there is
    "", "angle", "wave", "source", "load", "approach", "move", "time", "session", "attitude",
    "sight",
)  # fmt: skip


@dataclass(frozen=True)
class Effect:
    """A physical cause.

    name: as in the contract.  cause: one line for people.  law: the formula. places: where it may
    sit in a scene; empty if the data cannot test it. columns: its `EffectColumns` at a place, for a
    choice.  needs: what the data lack, '' if nothing. choices: the variants of the law at a place
    that are worth trying. finer: variants near one that was chosen, to try afterwards. entire: of
    the variants found at a place, beside others of `all` places that hold it too, those that are
    estimated instead, where what shows may be but a part of it. positive: whether its parameters
    are compliances, which cannot be negative, but for those that its columns say may have either
    sign. lines: whether several of its variants at one place are one cause: waves of one gear.
    typical: usual size of a parameter; far larger ones are believed less [SI]. is_map: whether its
    parameters are those of a free curve, told by the curve; sought when causes with a formula are
    known. moves: what it moves, one of MOVED: the arm itself, its foot with it, the arm's frame as
    the instrument sees it, the tool or reflectors beyond the flange, or only what is read. follows:
    what drives it, one of DRIVERS, by which its curve is drawn; `angle` and `wave` mean the joint's
    own angle and nothing else. of_past: whether it says what was before the last rows alone, so
    that any file of the geometry holds it. linear: whether a constant turn belongs to what drives
    it, and is geometry. against: label and (m,) values of the curve's axis, for a joint and a
    choice, where DRIVERS has none that fits.
    """

    name: str
    cause: str
    law: str
    places: Callable[[PosedArm], Sequence[str]]
    columns: Callable[[PosedArm, str, Choice], EffectColumns]
    needs: Callable[[PosedArm], str] = lambda scene: ""
    choices: Callable[[PosedArm, str], Sequence[Choice]] = lambda scene, place: DEFAULT_CHOICES
    finer: Callable[[PosedArm, Choice], Sequence[Choice]] = lambda scene, choice: ()
    entire: Callable[[Sequence[Choice], Sequence[Choice]], Sequence[Choice]] = (
        lambda found, beside: found
    )
    positive: bool = False
    lines: bool = False
    typical: float = np.inf
    is_map: bool = False
    moves: str = "arm"
    follows: str = ""
    of_past: bool = False
    linear: bool = False
    against: Callable[[PosedArm, int, Choice], tuple[str, Array]] | None = None

    def nonnegative_mask(self, columns: EffectColumns) -> Array:
        """(d,) True for parameters of its columns that no body has below 0."""
        either = columns.either if len(columns.either) else np.zeros(len(columns.names), dtype=bool)
        return np.asarray(self.positive & ~either)

    @property
    def moves_flange(self) -> bool:
        """Whether the flange moves in the arm's own base, and not only what is seen of it."""
        return self.moves in ("arm", "foot")

    @property
    def moves_base(self) -> bool:
        """Whether it moves the robot's foot."""
        return self.moves in ("foot", "frame")

    @property
    def follows_own_angle(self) -> bool:
        """Whether it is a function of its joint's own angle."""
        return self.follows in ("angle", "wave")

    @property
    def follows_last_move(self) -> bool:
        """Whether it comes from the way to a pose."""
        return self.follows in ("approach", "move")

    @property
    def ends_with_session(self) -> bool:
        """Whether it ends with the session in which it was measured."""
        return self.follows == "time" and not self.moves_flange


def joint_index_from_place(place: str) -> int:
    """Index of the joint or link that a place names, J3 or L3."""
    return int(place[1:]) - 1


def numbers_to_bit_mask(numbers: Sequence[int]) -> float:
    """Small whole numbers as one number: bits.  So that a choice can hold a list of joints."""
    return float(sum(1 << i for i in numbers))


def bit_mask_to_numbers(mask: float) -> list[int]:
    """The numbers of `numbers_to_bit_mask`."""
    return [i for i in range(52) if int(mask) >> i & 1]


def find_driven_revolute_joints(posed_arm: PosedArm) -> list[int]:
    """The joints that turn by a drive of their own."""
    return [
        j
        for j in range(posed_arm.joints)
        if not (posed_arm.robot.prismatic | posed_arm.robot.passive)[j]
    ]


def one_joint(posed_arm: PosedArm, joint: int, values: Array) -> Array:
    """(d, n, m) turns of all joints that a joint's drive moves, turning by values (d, m)."""
    return np.asarray(posed_arm.joint_motion_per_drive[:, joint, None] * values[:, None])
