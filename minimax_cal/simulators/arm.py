"""What a simulator can hold of a calibrated arm: masses, springs, play, gains, couplings.

A position servo is a spring: with the gain 1/c it gives way under gravity as a joint of compliance
c does.  What has no element, but turns joints only, goes into a command map; the rest is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.files import format_json
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.bending import (
    BASE_FLEX,
    LINK_BENDING,
    TOOL_FLEX,
    base_tilt_displacement,
    link_bending_displacement,
)
from minimax_cal.modelling.effects.compliance import (
    ALL_LINKS_GROUP,
    GRAVITY_COMPENSATOR,
    JOINT_COMPLIANCE,
    is_stiffening_choice,
)
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.gears import (
    BACKLASH,
    ENCODER_GAIN,
    JOINT_COUPLING,
    joints_at_place,
)
from minimax_cal.modelling.effects.scene import (
    Effect,
    PosedArm,
    bit_mask_to_numbers,
    find_driven_revolute_joints,
    joint_index_from_place,
    numbers_to_bit_mask,
)
from minimax_cal.modelling.effects.table import EFFECTS, NO_EFFECTS, Fitted, Term
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots.gravity_torques import (
    MIN_SIMULATED_LINK_MASS,
    known_link_mass_mask,
    link_masses_and_centres,
)
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import invert_transform

LinkMasses = tuple[Array, Array]  # (n,) [kg] and (n, 3) centres of gravity in the link frames [m]

MASS_PRIOR_WEIGHT_MM = (
    0.01  # what a mass or spring off by e, or a centre by 0.1 m, counts as [mm of all points]
)
CENTRE_PRIOR_M = 0.1  # [m]
MIN_RELATIVE_FIELD = 1e-3  # of the largest: what moves less tells nothing of its spring
MAX_SOFTENING = 30.0  # no spring is softer than the softest by itself, by this factor
MIN_RELATIVE_SINGULAR_VALUE = (
    1e-4  # of the largest singular value: what geometry is asked to take over
)
MIN_COMPLIANCE = 1e-12  # a smaller compliance is none [rad/(N m)]


TRACELESS_BASIS = np.linalg.svd(np.eye(3).reshape(1, 9))[2][1:].T  # (9, 8) matrices without a trace


@dataclass(frozen=True, eq=False)
class FittedSprings:
    """arm_fields: of an arm: `joint_compliances`, `link_flexibility`, `base_compliance`, `mass`,
    `com`, and `remaining_rms`: RMS distance from the laws, or from the measurements [m].

    sag, tool_extension: of the tool: (3, 3) turn per direction of gravity [rad], and along its z
    [m]. geometry_change: of geometry, base and targets, in the order of `Names` [m, rad].
    exact_effect_change: of the parameters of effects that elements hold exactly.
    """

    arm_fields: dict[str, Any]
    sag: Array
    tool_extension: float
    geometry_change: Array
    exact_effect_change: Array


def fit_springs(
    scene: PosedArm,
    compliance_laws: Fitted,
    residual: Array,
    geometry: Array,
    exact_terms: Sequence[Term],
    masses: LinkMasses,
    *,
    with_fixed_masses: bool,
) -> FittedSprings:
    """Springs and masses of one arm that give way as laws say at the poses of a scene.

    A fit without known masses takes the torques of upper arm, forearm and wrist apart, joint by
    joint.  A simulator has one set of masses for all joints, so masses, centres of gravity and
    compliances are chosen together: displacements are bilinear in compliances and in the first
    moments of the links.  What geometry, base and targets can take over does not count; they change
    with the springs.

    residual: (k, 3, m) what the laws leave of measurements, in base axes, NaN where not measured,
    so that the springs explain these; 0 where the laws count alone [m]. geometry: (k, 3, m, p)
    motion of the points per unit of every parameter of the geometry. exact_terms: effects that
    elements hold exactly; their values change with the springs. masses: to begin with, or to keep
    where they are fixed.
    """
    # Displacements of the points [mm] that the laws want, by springs of compliance 1, and by what
    # is fitted with them: geometry, effects that elements hold, the sag of the tool.
    wanted = sum(
        (np.tensordot(v, t.columns(scene).target_displacements(scene), 1)
         for t, v in compliance_laws.terms_with_values),
        np.zeros(scene.points.shape),
    )  # fmt: skip
    seen = np.isfinite(residual).reshape(-1)
    kinds = list_compliant_places(scene, compliance_laws)
    fields = 1e3 * np.array([displacement_per_first_moment(scene, *kind) for kind in kinds])
    fields = fields.reshape(len(kinds), 4 * scene.joints, wanted.size)[..., seen]
    right = 1e3 * (wanted + residual).reshape(-1)[seen]
    beside = [geometry]
    beside += [
        np.moveaxis(term.columns(scene).target_displacements(scene), 0, -1) for term in exact_terms
    ]
    if any(EFFECTS[term.effect].moves == "tool" for term in compliance_laws.terms):
        beside.append(compute_tool_sag_columns(scene))
    parts = [1e3 * part.reshape(wanted.size, -1)[seen] for part in beside]
    count = parts[0].shape[1]
    tool = count + sum(part.shape[1] for part in parts[1 : 1 + len(exact_terms)])

    # What these can take over is projected out; QR leaves as many rows as there are fields.
    u, size, back = np.linalg.svd(np.hstack(parts), full_matrices=False)
    kept = size > MIN_RELATIVE_SINGULAR_VALUE * size[0]
    u, inverse = u[:, kept], (back[kept].T / size[kept]) @ u[:, kept].T
    clear, goal = fields - (fields @ u) @ u.T, right - u @ (u.T @ right)
    rows = np.vstack([clear.reshape(-1, len(goal)), goal]).T
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    clear = triangle[:, :-1].T.reshape(*clear.shape[:2], len(triangle))
    goal = triangle[:, -1]

    # Compliances by non-negative least squares, then with masses and centres; idle springs go.
    mass, com = masses
    points, soft = len(right) / 3.0, np.zeros(0)
    if kinds:
        each = np.einsum("l,elr->re", first_moments(mass, com), clear)
        felt = np.linalg.norm(each, axis=0)
        soft = scipy.optimize.nnls(each * (felt > MIN_RELATIVE_FIELD * felt.max()), goal)[0]
    if kinds and not with_fixed_masses:
        soft, mass, com = fit_compliances_and_masses(
            clear, goal, soft, [kind for kind, _ in kinds], masses, points
        )
        felt = (
            np.linalg.norm(np.einsum("l,elr->er", first_moments(mass, com), clear), axis=1) * soft
        )
        soft = np.where(felt > MIN_RELATIVE_FIELD * felt.max(), soft, 0.0)
    sizes = np.einsum("e,l->el", soft, first_moments(mass, com))
    rest = goal - np.einsum("el,elr->r", sizes, clear)
    change = inverse @ (right - np.einsum("el,elr->r", sizes, fields))
    values = dict(zip(kinds, (float(c) if c > MIN_COMPLIANCE else 0.0 for c in soft), strict=True))
    held = {
        "joint_compliances": np.array(
            [values.get(CompliantPlace("joint", j), 0.0) for j in range(scene.joints)]
        ),
        "link_flexibility": {i: c for (kind, i), c in values.items() if kind == "link" and c > 0.0},
        "base_compliance": values.get(CompliantPlace("base", 0), 0.0),
        "mass": mass,
        "com": com,
        "remaining_rms": 1e-3 * float(np.sqrt((rest**2).sum() / points)),
    }
    *turns, drawn = np.append(change[tool:], np.zeros(9))[:9].tolist()
    sag = (TRACELESS_BASIS @ turns).reshape(3, 3)
    return FittedSprings(held, sag, drawn, change[:count], change[count:tool])


class CompliantPlace(NamedTuple):
    """What gives way: the kind of its spring, and the number of its joint or link."""

    spring_kind: str
    place_index: int


def list_compliant_places(scene: PosedArm, laws: Fitted) -> list[CompliantPlace]:
    """What gives way: joints, links, the base; for a whole arm all joints that turn."""
    out: dict[CompliantPlace, None] = {}
    for term in laws.terms:
        if "parts" in term.choice:
            joints = [part // 4 for part in bit_mask_to_numbers(term.choice["parts"])]
            out |= {
                CompliantPlace("joint", j): None
                for j in (find_driven_revolute_joints(scene) if term.place == "all" else joints)
            }
        elif term.place[0] == "L":
            out[CompliantPlace("link", joint_index_from_place(term.place))] = None
        elif EFFECTS[term.effect].moves == "foot":
            out[CompliantPlace("base", 0)] = None
    return list(out)


def compute_tool_sag_columns(scene: PosedArm) -> Array:
    """(k, 3, m, 9) motion of the points for every way in which weights can make the tool sag.

    Eight turns per direction of gravity, none of them about gravity itself; drawn along z.
    """
    whole = Term(TOOL_FLEX.name, "all", {"lever": 2.0}).columns(scene).target_displacements(scene)
    turns = np.einsum("dkcm,de->kcme", whole[:9], TRACELESS_BASIS)
    return np.concatenate([turns, whole[9][..., None]], axis=-1)


def first_moments(mass: Array, com: Array) -> Array:
    """(4 n,) mass and first moments of each link [kg, kg m]."""
    return np.concatenate([mass[:, None], mass[:, None] * com], axis=1).reshape(-1)


def displacement_per_first_moment(scene: PosedArm, spring_kind: str, place_index: int) -> Array:
    """(4 n, k, 3, m) displacement of a spring of compliance 1, for each mass and first moment."""
    verbs: dict[str, Callable[..., Array]] = {
        "joint": partial(displacement_by_joint_torque, joint=place_index),
        "link": partial(link_bending_displacement, link=place_index),
        "base": base_tilt_displacement,
    }
    verb = verbs[spring_kind]
    out, n = [], scene.joints
    for mass in np.eye(n):
        centres = (np.outer(mass, axis) for axis in np.eye(4)[:, 1:])
        alone, *moved = (verb(scene, link_masses=mass, mass_centres=com) for com in centres)
        out += [alone, *(one - alone for one in moved)]
    return np.array(out)


def displacement_by_joint_torque(
    scene: PosedArm, link_masses: Array, mass_centres: Array, joint: int
) -> Array:
    """(k, 3, m) motion of the targets when a joint turns by the torque about it."""
    return np.asarray(
        scene.drive_gravity_torques(link_masses, mass_centres)[joint] * scene.jacobian[joint]
    )


class SpringFit(NamedTuple):
    """Compliances (e,), masses (n,) and their centres (n, 3) that imitate displacements best."""

    compliances: Array
    masses: Array
    centres: Array


def fit_compliances_and_masses(
    displacement_fields: Array,
    displacement: Array,
    start_compliances: Array,
    spring_kinds: Sequence[str],
    masses: LinkMasses,
    point_count: float,
) -> SpringFit:
    """Compliances, masses and centres that imitate displacements best [mm].

    displacement_fields: (e, 4 n, rows) per unit of compliance and moment.  displacement: (rows,).
    start_compliances: (e,) to begin with, kinds of its springs: those of 0 begin like the others of
    their kind. point_count: how many there are.
    """
    mass, com = masses
    e, n = len(start_compliances), len(mass)
    known, first = start_compliances > MIN_COMPLIANCE, start_compliances.copy()
    for i in np.flatnonzero(~known):
        alike = [j for j in range(e) if known[j] and spring_kinds[j] == spring_kinds[int(i)]]
        first[i] = (
            np.exp(np.log(start_compliances[alike or known]).mean())
            if known.any()
            else MIN_COMPLIANCE
        )
    start = np.concatenate([np.log(first), np.zeros(4 * n)])
    weight = MASS_PRIOR_WEIGHT_MM * np.sqrt(point_count / (e + 4.0 * n))

    def split(x: Array) -> tuple[Array, Array, Array]:
        factors, off = x[e : e + n], x[e + n :].reshape(n, 3)
        return np.exp(x[:e]), mass * np.exp(factors), com + CENTRE_PRIOR_M * off

    def residual(x: Array) -> Array:
        c, m, at = split(x)
        left = (
            np.einsum("el,elr->r", np.outer(c, first_moments(m, at)), displacement_fields)
            - displacement
        )
        return np.concatenate([left, weight * (x - start)])

    def jacobian(x: Array) -> Array:
        c, m, at = split(x)
        by_soft = np.einsum("l,elr->er", first_moments(m, at), displacement_fields) * c[:, None]
        by_moment = (
            np.einsum("e,elr->lr", c, displacement_fields).reshape(n, 4, -1) * m[:, None, None]
        )
        by_mass = by_moment[:, 0] + np.einsum("na,nar->nr", at, by_moment[:, 1:])
        by_com = CENTRE_PRIOR_M * by_moment[:, 1:].reshape(3 * n, -1)
        return np.vstack([np.concatenate([by_soft, by_mass, by_com]).T, weight * np.eye(len(x))])

    ends = np.concatenate([np.full(e, 2.0 * np.log(MAX_SOFTENING)), np.full(4 * n, 3.0)])
    found = scipy.optimize.least_squares(
        residual, start, jacobian, bounds=(start - ends, start + ends), max_nfev=300
    )
    return SpringFit(*split(found.x))


# ---- the arm -------------------------------------------------------------------------------------


COMPARISON_POSES = 120  # poses at which laws and springs are compared
NEGLIGIBLE_TOOL_TWIST = 1e-9  # [rad]
COMMAND_MAP_ENDING = ".commands.json"  # in the place of that of the model
TOOL_LEVER = 0.1  # from the flange to what it carries [m]


@dataclass(frozen=True)
class BalancerSpring:
    """The spring that carries the upper arm; `modelling.effects.compliance` tells what these
    are.
    """

    stiffness_law: float
    zero_angle: float
    eye_distance: float
    rest_length: float


@dataclass(frozen=True, eq=False)
class SimulatedArm:
    """What a simulator holds of an arm, joint values in the controller's sense.

    mass: (n,) of the links [kg].  com: (n, 3) their centres of gravity in the link frames [m].
    joint_compliances: (n,) compliance of each joint, 0 stiff [rad/(N m)].  encoder_gains: (n,) of
    each encoder. couplings: joint, the joint that turns it too, and how much per radian.  backlash:
    (n,) of each gear, from stop to stop, negative where it runs ahead [rad]. link_flexibility: 1/EI
    of links by index [1/(N m^2)].  base_compliance: [rad/(N m)]. tool_sag: (3, 3) turn of the tool
    per direction of gravity in the flange [rad].  tool_extension: (3,) how far its weight draws it
    along each axis [m]. target_positions: (k, 3) the targets in the last frame [m].  mount: (4, 4)
    the arm's foot in the base [m]. mapped_effects: effects that only a command map can hold.
    left_out: what nothing here holds, and why. remaining_rms: RMS distance between these springs
    and the laws of the fit, or what it was fitted to [m].
    """

    robot: Robot
    mass: Array
    com: Array
    joint_compliances: Array
    encoder_gains: Array
    backlashes: Array
    couplings: tuple[tuple[int, int, float], ...] = ()
    link_flexibility: dict[int, float] = field(default_factory=dict)
    base_compliance: float = 0.0
    tool_sag: Array = field(default_factory=lambda: np.zeros((3, 3)))
    tool_extension: Array = field(default_factory=lambda: np.zeros(3))
    target_positions: Array = field(default_factory=lambda: np.zeros((0, 3)))
    mount: Array = field(default_factory=lambda: np.eye(4))
    balance: BalancerSpring | None = None
    mapped_effects: Fitted = NO_EFFECTS
    left_out: tuple[str, ...] = ()
    remaining_rms: float = 0.0

    @staticmethod
    def rigid(robot: Robot, masses: LinkMasses | None = None) -> SimulatedArm:
        """An arm that nothing bends.  masses: as the robot tells, or assumed, unless given."""
        zeros = np.zeros(robot.joints)
        mass, com = masses or link_masses_and_centres(robot, MIN_SIMULATED_LINK_MASS)
        return SimulatedArm(
            robot, mass, com, joint_compliances=zeros, encoder_gains=zeros, backlashes=zeros
        )

    def find_play_positions(self, data: Measurements) -> Array | None:
        """(m, n) where joints rest in their play, by the moves that led to each pose [rad]."""
        if not self.backlashes.any():
            return None
        sides = [data.columns[f"approach{i + 1}"] for i in range(data.q.shape[1])]
        return np.asarray(0.5 * self.backlashes * np.stack(sides, axis=1))

    def format_command_map(self, cell: Cell) -> dict[str, bytes]:
        """The file of the command map by its ending, where there is something to map.

        cell: whose effects the arm does.
        """
        if not self.mapped_effects.terms:
            return {}
        content = {"schema": 1, "kind": "commands",
                   "cell": replace(cell, effects=self.mapped_effects).whole()}  # fmt: skip
        return {COMMAND_MAP_ENDING: format_json(content).encode()}

    def list_limitations(self) -> list[str]:
        """What a file of the arm does not hold, for people."""
        limitations = []
        if self.mapped_effects.terms:
            named = ", ".join(
                dict.fromkeys(format_effect(*term.key) for term in self.mapped_effects.terms)
            )
            limitations.append(
                f"{named}: no element of a simulator; the file beside (*{COMMAND_MAP_ENDING}) "
                "corrects commands, and the model counts on it: ctrl = mc.load_commands(PATH)(q)"
            )
        limitations += [f"not in the file: {text}" for text in self.left_out]
        if self.remaining_rms:
            limitations.append(
                "one set of masses and springs stands for the effects of the fit, to "
                f"{1e3 * self.remaining_rms:.2g} mm RMS"
            )
        if self.backlashes.any():
            joints = ", ".join(f"play{i + 1}" for i in np.flatnonzero(self.backlashes))
            limitations.append(
                f"backlash: {joints} rest amid their play; set qpos_spring of the joint to half "
                "the play times the sign of the last move"
            )
        return limitations

    @cached_property
    def largest_levers(self) -> Array:
        """(n,) largest lever of what is beyond each joint [m]."""
        robot = self.robot
        length = np.abs(robot.mdh[:, :2]).sum(axis=1) + np.linalg.norm(self.com, axis=1)
        slide = np.where(robot.prismatic, np.clip(np.abs(robot.upper), 0.0, 2.0), 0.0)
        return np.cumsum((length + slide)[::-1])[::-1] + TOOL_LEVER

    @cached_property
    def largest_inertias(self) -> Array:
        """(n,) largest of that about each joint [kg m^2]."""
        return np.asarray(np.cumsum(self.mass[::-1])[::-1] * self.largest_levers**2)


def has_assumed_masses(robot: Robot) -> bool:
    """Whether masses have to be assumed: the robot does not tell all of them."""
    return not bool(known_link_mass_mask(robot).all())


def sample_workspace(robot: Robot) -> Array:
    """(m, n) poses all over the workspace [rad, m]."""
    return random_joint_values_above_floor(robot, COMPARISON_POSES, np.random.default_rng(0))


def build_simulated_arm(
    cell: Cell,
    joint_values: Array | None = None,
    masses: tuple[Array, Array] | None = None,
    measured: Measurements | None = None,
) -> SimulatedArm:
    """The elements that do what the effects of a cell do.

    joint_values: (m, n) poses at which they should, all over the workspace unless given [rad, m].
    measured: the poses that the cell was fitted to, instead: where one arm cannot do what the laws
    do, its springs explain these as well as they can.
    masses: of the links, where they are those of a simulator's model and stay; else as the robot
    tells, or assumed: then they are chosen so that one arm explains all joints.
    """
    robot = cell.robot
    joint_values = (
        sample_workspace(robot) if joint_values is None or not len(joint_values) else joint_values
    )
    poses = (
        build_measurements_at_rest(joint_values, cell.target_names, robot)
        if measured is None
        else measured
    )
    scene = cell.pose_arm(poses)
    parts = assign_effects_to_elements(
        cell,
        scene,
        replace(SimulatedArm.rigid(robot, masses), target_positions=cell.target_positions),
    )
    change = np.zeros(sum(len(values) for _, values in parts.exact_effects))
    about = max((abs(float(np.trace(sag))) for sag, _ in parts.tool_sags), default=0.0)
    is_exact = not parts.needs_imitation and about <= NEGLIGIBLE_TOOL_TWIST
    if is_exact and not (parts.compliance_laws and masses):
        for sag, drawn in parts.tool_sags:
            parts.arm = add_tool_sag(parts.arm, sag, drawn)
    else:
        # Springs and masses that imitate the laws; geometry, base and targets change with them.
        plain = replace(cell, effects=NO_EFFECTS)
        state = plain.parameter_values
        model = build_point_model(robot, replace(scene.data, y=plain.predict(scene.data.q)))
        geometry = np.moveaxis(model.point_jacobian(state), 0, 2)
        left = np.zeros(scene.points.shape)
        if measured is not None:
            left = np.moveaxis(cell.error(measured) @ cell.base[:3, :3], 0, 2)
        laws, firm = (
            Fitted.from_pairs((*parts.compliance_laws, *parts.tool_laws)),
            [term for term, _ in parts.exact_effects],
        )
        begun = (parts.arm.mass, parts.arm.com)
        found = fit_springs(
            scene, laws, left, geometry, firm, begun, with_fixed_masses=bool(masses)
        )
        change, after = found.exact_effect_change, state.step(found.geometry_change)
        arm = add_tool_sag(parts.arm, found.sag, found.tool_extension)
        mount = invert_transform(state.base_pose) @ after.base_pose @ arm.mount
        parts.arm = replace(
            arm,
            robot=arm.robot.with_mdh(after.mdh),
            mount=mount,
            target_positions=after.target_positions,
            **found.arm_fields,
        )
    for term, values in parts.exact_effects:
        EXACT_ELEMENT_WRITERS[term.effect](parts, scene, term, values + change[: len(values)])
        change = change[len(values) :]
    return replace(
        parts.arm,
        mapped_effects=Fitted.from_pairs(parts.mapped_effects),
        left_out=tuple(parts.left_out),
    )


def add_tool_sag(arm: SimulatedArm, sag: Array, extension: float) -> SimulatedArm:
    """The arm with a tool that sags.

    sag: (3, 3) without trace, its turn per direction of gravity [rad].  extension: along z [m].
    """
    # -z (z . g) = x (x . g) + y (y . g) - g: against its weight is two slides across, and a shift
    along = (
        np.array([0.0, 0.0, extension])
        if extension > 0.0
        else np.array([-extension, -extension, 0.0])
    )
    mount = arm.mount.copy()
    mount[:3, 3] += max(-extension, 0.0) * arm.robot.up
    return replace(
        arm, tool_sag=arm.tool_sag + sag, tool_extension=arm.tool_extension + along, mount=mount
    )


@dataclass(eq=False)
class ArmBuilder:
    """An arm in the making.  compliance_laws: laws of what gives way under gravity, with their
    values.

    needs_imitation: whether a law takes the torques of several groups of links apart, or no spring
    does what it does.  tool_laws: laws of the tool; tool_sags: each as its turn per direction of
    gravity (3, 3) [rad], and along z [m].  exact_effects: effects that elements hold exactly.
    """

    arm: SimulatedArm
    compliance_laws: list[tuple[Term, Array]] = field(default_factory=list)
    needs_imitation: bool = False
    tool_laws: list[tuple[Term, Array]] = field(default_factory=list)
    tool_sags: list[tuple[Array, float]] = field(default_factory=list)
    exact_effects: list[tuple[Term, Array]] = field(default_factory=list)
    mapped_effects: list[tuple[Term, Array]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def set_arm_fields(self, **changes: Any) -> None:
        """Change fields of the arm."""
        self.arm = replace(self.arm, **changes)


def assign_effects_to_elements(cell: Cell, scene: PosedArm, arm: SimulatedArm) -> ArmBuilder:
    """What is to hold each effect of a cell; those of 0 need nothing.  arm: to begin with."""
    parts = ArmBuilder(arm)
    for term, values in cell.effects.terms_with_values:
        if values.any():
            ELEMENT_WRITERS.get(term.effect, map_or_reject_effect)(parts, scene, term, values)
    return parts


def list_effects_without_element(cell: Cell, data: Measurements) -> tuple[Term, ...]:
    """Those effects of a cell that, with its values, only a command map can hold."""
    mapped = assign_effects_without_masses(cell, data).mapped_effects
    return tuple(term for term, _ in mapped if term in cell.effects.terms)


def assign_effects_without_masses(cell: Cell, data: Measurements) -> ArmBuilder:
    """What is to hold each effect of a cell at some poses, whatever the arm weighs."""
    return assign_effects_to_elements(cell, cell.pose_arm(data), SimulatedArm.rigid(cell.robot))


ElementWriter = Callable[[ArmBuilder, PosedArm, Term, Array], None]


def map_or_reject_effect(parts: ArmBuilder, scene: PosedArm, term: Term, values: Array) -> None:
    """What turns joints goes to the command map, the rest is named."""
    if term.columns(scene).moves_joints_only:
        parts.mapped_effects.append((term, values))
    else:
        parts.left_out.append(
            f"{format_effect(*term.key)}: {explain_missing_element(EFFECTS[term.effect])}"
        )


def explain_missing_element(effect: Effect) -> str:
    """Why a simulator cannot hold an effect."""
    if effect.follows == "time":
        return "changes with time or temperature; the file is the arm at the start"
    if effect.moves == "instrument":
        return "of the instrument and not of the arm"
    return "a simulator has no element for it"


def keep_exact_effect(parts: ArmBuilder, scene: PosedArm, term: Term, values: Array) -> None:
    """What an element holds exactly, whatever else there is."""
    parts.exact_effects.append((term, values))


def add_joint_compliance(parts: ArmBuilder, scene: PosedArm, term: Term, values: Array) -> None:
    """Joints that give way; one torque a joint, or of groups of links that share a spring."""
    if is_stiffening_choice(term.choice):  # no spring of a simulator stiffens
        parts.mapped_effects.append((term, values))
        return
    places = bit_mask_to_numbers(term.choice["parts"])
    grouped = any(part % 4 != ALL_LINKS_GROUP for part in places)
    if grouped:
        parts.compliance_laws.append((term, values))
        parts.needs_imitation = True
        return
    turn = parts.arm.joint_compliances.copy()
    for part, value in zip(places, values, strict=True):
        one = Term(term.effect, f"J{part // 4 + 1}", {"parts": numbers_to_bit_mask([part])})
        if value > 0.0:
            turn[part // 4] += value
            parts.compliance_laws.append((one, np.array([value])))
        elif value < 0.0:
            parts.mapped_effects.append((one, np.array([value])))
    parts.set_arm_fields(joint_compliances=turn)


def add_link_or_base_compliance(
    parts: ArmBuilder, scene: PosedArm, term: Term, values: Array
) -> None:
    """A link that bends, or the base; under a tool of its own weight, which shares the spring."""
    value = float(values[0])
    if len(values) > 1 or value <= 0.0:  # no spring does that; others may take over what it does
        parts.needs_imitation = True
    elif EFFECTS[term.effect].moves == "foot":
        parts.set_arm_fields(base_compliance=parts.arm.base_compliance + value)
    else:
        link = joint_index_from_place(term.place)
        parts.set_arm_fields(
            link_flexibility={
                **parts.arm.link_flexibility,
                link: parts.arm.link_flexibility.get(link, 0.0) + value,
            }
        )
    parts.compliance_laws.append((term, values))


def joint_field_writer(name: str) -> ElementWriter:
    """A field of the arm by joints: the gear of an actuator, or the play of a hinge with stops."""

    def element(parts: ArmBuilder, scene: PosedArm, term: Term, values: Array) -> None:
        held = getattr(parts.arm, name).copy()
        held[joints_at_place(term.place, term.choice)] += values
        parts.set_arm_fields(**{name: held})

    return element


def add_joint_coupling(parts: ArmBuilder, scene: PosedArm, term: Term, values: Array) -> None:
    """A fixed tendon; signs are those of the controller's joints."""
    j, i = joint_index_from_place(term.place), int(term.choice["source"]) - 1
    sign = scene.robot.sign
    one = (j, i, float(values[0] * sign[i] * sign[j]))
    parts.set_arm_fields(couplings=(*parts.arm.couplings, one))


def add_tool_flex(parts: ArmBuilder, scene: PosedArm, term: Term, values: Array) -> None:
    """The turn of the tool per direction of gravity, and how far it is drawn."""
    if term.choice["lever"] == 2.0:
        sag = values[:9].reshape(3, 3)
    else:
        first = term.choice["lever"] == 0.0
        spot = scene.target_positions.mean(axis=0) if first else np.array([0.0, 0.0, 1.0])
        spot = spot / max(float(np.linalg.norm(spot)), 1e-3)
        sag = values[0] * np.cross(spot, np.eye(3)).T
    parts.tool_laws.append((term, values))
    parts.tool_sags.append((sag, float(values[-1])))


def add_balancer_spring(parts: ArmBuilder, scene: PosedArm, term: Term, values: Array) -> None:
    """A tendon with a spring, where it pulls."""
    upright = term.place == "J2" and abs(term.choice["zero"]) < 0.5 * np.pi
    if parts.arm.balance or values[0] >= 0.0 or not upright:
        parts.mapped_effects.append((term, values))  # a spring that pushes the arm down is none
        return
    zero, eye, rest = (float(term.choice[key]) for key in ("zero", "eye", "rest"))
    parts.set_arm_fields(balance=BalancerSpring(float(values[0]), zero, eye, rest))


EXACT_ELEMENT_WRITERS: dict[str, ElementWriter] = {
    ENCODER_GAIN.name: joint_field_writer("encoder_gains"),
    BACKLASH.name: joint_field_writer("backlashes"),
    JOINT_COUPLING.name: add_joint_coupling,
}
ELEMENT_WRITERS: dict[str, ElementWriter] = {
    JOINT_COMPLIANCE.name: add_joint_compliance,
    LINK_BENDING.name: add_link_or_base_compliance,
    BASE_FLEX.name: add_link_or_base_compliance,
    TOOL_FLEX.name: add_tool_flex,
    GRAVITY_COMPENSATOR.name: add_balancer_spring,
    **dict.fromkeys(EXACT_ELEMENT_WRITERS, keep_exact_effect),
}
