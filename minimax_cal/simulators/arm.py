"""What a simulator can hold of a calibrated arm: masses, springs, play, gains, couplings.

A position servo is a spring: with the gain 1/c it gives way under gravity as a joint of compliance
c does.  What has no element, but turns joints only, goes into a command map; the rest is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import json_text
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.bending import BASE_FLEX, LINK_BENDING, TOOL_FLEX, bent, tilted
from minimax_cal.modelling.effects.compliance import (
    GRAVITY_COMPENSATOR,
    JOINT_COMPLIANCE,
    WHOLE,
    stiffens,
)
from minimax_cal.modelling.effects.gears import BACKLASH, ENCODER_GAIN, JOINT_COUPLING, joints_at
from minimax_cal.modelling.effects.scene import Effect, Scene, joint_of, mask_of, turning, unmasked
from minimax_cal.modelling.effects.table import EFFECTS, NOTHING, Fitted, Term
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.modelling.model import model_of
from minimax_cal.robots.gravity import LEAST_MASS, masses_of, weighed
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_poses
from minimax_cal.robots.transforms import inverse

Masses = tuple[Array, Array]  # (n,) [kg] and (n, 3) centres of gravity in the link frames [m]

BELIEF = 0.01  # what a mass or spring off by e, or a centre by 0.1 m, counts as [mm of all points]
NEAR = 0.1  # [m]
FELT = 1e-3  # of the largest: what moves less tells nothing of its spring
MOST = 30.0  # no spring is softer than the softest by itself, by this factor
RESOLVED = 1e-4  # of the largest singular value: what geometry is asked to take over
LEAST = 1e-12  # a smaller compliance is none [rad/(N m)]


TRACELESS = np.linalg.svd(np.eye(3).reshape(1, 9))[2][1:].T  # (9, 8) matrices without a trace


@dataclass(frozen=True, eq=False)
class Springs:
    """held: of an arm: `turn`, `bend`, `base`, `mass`, `com`, and `remainder`: RMS distance from
    the laws, or from the measurements [m].

    sag, drawn: of the tool: (3, 3) turn per direction of gravity [rad], and along its z [m].
    change: of geometry, base and targets, in the order of `Names` [m, rad].  firm: of the
    parameters of effects that elements hold exactly.
    """

    held: dict[str, Any]
    sag: Array
    drawn: float
    change: Array
    firm: Array


def springs_of(
    scene: Scene,
    laws: Fitted,
    left: Array,
    geometry: Array,
    firm: Sequence[Term],
    masses: Masses,
    *,
    fixed: bool,
) -> Springs:
    """Springs and masses of one arm that give way as laws say at the poses of a scene.

    A fit without known masses takes the torques of upper arm, forearm and wrist apart, joint by
    joint.  A simulator has one set of masses for all joints, so masses, centres of gravity and
    compliances are chosen together: displacements are bilinear in compliances and in the first
    moments of the links.  What geometry, base and targets can take over does not count; they change
    with the springs.

    left: (k, 3, m) what the laws leave of measurements, in base axes, NaN where not measured, so
    that the springs explain these; 0 where the laws count alone [m].
    geometry: (k, 3, m, p) motion of the points per unit of every parameter of the geometry.
    firm: effects that elements hold exactly; their values change with the springs.
    masses: to begin with, or to keep where they are fixed.
    """
    # Displacements of the points [mm] that the laws want, by springs of compliance 1, and by what
    # is fitted with them: geometry, effects that elements hold, the sag of the tool.
    wanted = sum(
        (np.tensordot(v, t.columns(scene).displacement(scene), 1)
         for t, v in laws.pairs),
        np.zeros(scene.points.shape),
    )  # fmt: skip
    seen = np.isfinite(left).reshape(-1)
    kinds = places_of(scene, laws)
    fields = 1e3 * np.array([per_moment(scene, *kind) for kind in kinds])
    fields = fields.reshape(len(kinds), 4 * scene.joints, wanted.size)[..., seen]
    right = 1e3 * (wanted + left).reshape(-1)[seen]
    beside = [geometry]
    beside += [np.moveaxis(term.columns(scene).displacement(scene), 0, -1) for term in firm]
    if any(EFFECTS[term.effect].moves == "tool" for term in laws.terms):
        beside.append(tool_columns(scene))
    parts = [1e3 * part.reshape(wanted.size, -1)[seen] for part in beside]
    count = parts[0].shape[1]
    tool = count + sum(part.shape[1] for part in parts[1 : 1 + len(firm)])

    # What these can take over is projected out; QR leaves as many rows as there are fields.
    u, size, back = np.linalg.svd(np.hstack(parts), full_matrices=False)
    kept = size > RESOLVED * size[0]
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
        each = np.einsum("l,elr->re", moments(mass, com), clear)
        felt = np.linalg.norm(each, axis=0)
        soft = scipy.optimize.nnls(each * (felt > FELT * felt.max()), goal)[0]
    if kinds and not fixed:
        soft, mass, com = together(clear, goal, soft, [kind for kind, _ in kinds], masses, points)
        felt = np.linalg.norm(np.einsum("l,elr->er", moments(mass, com), clear), axis=1) * soft
        soft = np.where(felt > FELT * felt.max(), soft, 0.0)
    sizes = np.einsum("e,l->el", soft, moments(mass, com))
    rest = goal - np.einsum("el,elr->r", sizes, clear)
    change = inverse @ (right - np.einsum("el,elr->r", sizes, fields))
    values = dict(zip(kinds, (float(c) if c > LEAST else 0.0 for c in soft), strict=True))
    held = {
        "turn": np.array([values.get(("joint", j), 0.0) for j in range(scene.joints)]),
        "bend": {i: c for (kind, i), c in values.items() if kind == "link" and c > 0.0},
        "base": values.get(("base", 0), 0.0), "mass": mass, "com": com,
        "remainder": 1e-3 * float(np.sqrt((rest**2).sum() / points)),
    }  # fmt: skip
    *turns, drawn = np.append(change[tool:], np.zeros(9))[:9].tolist()
    sag = (TRACELESS @ turns).reshape(3, 3)
    return Springs(held, sag, drawn, change[:count], change[count:tool])


def places_of(scene: Scene, laws: Fitted) -> list[tuple[str, int]]:
    """What gives way: joints, links, the base; for a whole arm all joints that turn."""
    out: dict[tuple[str, int], None] = {}
    for term in laws.terms:
        if "parts" in term.choice:
            joints = [part // 4 for part in unmasked(term.choice["parts"])]
            out |= {("joint", j): None for j in (turning(scene) if term.place == "all" else joints)}
        elif term.place[0] == "L":
            out[("link", joint_of(term.place))] = None
        elif EFFECTS[term.effect].moves == "foot":
            out[("base", 0)] = None
    return list(out)


def tool_columns(scene: Scene) -> Array:
    """(k, 3, m, 9) motion of the points for every way in which weights can make the tool sag.

    Eight turns per direction of gravity, none of them about gravity itself; drawn along z.
    """
    whole = Term(TOOL_FLEX.name, "all", {"lever": 2.0}).columns(scene).displacement(scene)
    turns = np.einsum("dkcm,de->kcme", whole[:9], TRACELESS)
    return np.concatenate([turns, whole[9][..., None]], axis=-1)


def moments(mass: Array, com: Array) -> Array:
    """(4 n,) mass and first moments of each link [kg, kg m]."""
    return np.concatenate([mass[:, None], mass[:, None] * com], axis=1).reshape(-1)


def per_moment(scene: Scene, kind: str, place: int) -> Array:
    """(4 n, k, 3, m) displacement of a spring of compliance 1, for each mass and first moment."""
    verbs: dict[str, Callable[..., Array]] = {
        "joint": partial(turned, joint=place),
        "link": partial(bent, link=place),
        "base": tilted,
    }
    verb = verbs[kind]
    out, n = [], scene.joints
    for mass in np.eye(n):
        centres = (np.outer(mass, axis) for axis in np.eye(4)[:, 1:])
        alone, *moved = (verb(scene, mass=mass, com=com) for com in centres)
        out += [alone, *(one - alone for one in moved)]
    return np.array(out)


def turned(scene: Scene, mass: Array, com: Array, joint: int) -> Array:
    """(k, 3, m) motion of the targets when a joint turns by the torque about it."""
    return np.asarray(scene.torque(mass, com)[joint] * scene.jacobian[joint])


def together(
    fields: Array, right: Array, soft: Array, kinds: Sequence[str], masses: Masses, points: float
) -> tuple[Array, Array, Array]:
    """Compliances, masses and centres that imitate displacements best [mm].

    fields: (e, 4 n, rows) per unit of compliance and moment.  right: (rows,).  soft: (e,) to begin
    with, kinds of its springs: those of 0 begin like the others of their kind.
    points: how many there are.
    """
    mass, com = masses
    e, n = len(soft), len(mass)
    known, first = soft > LEAST, soft.copy()
    for i in np.flatnonzero(~known):
        alike = [j for j in range(e) if known[j] and kinds[j] == kinds[int(i)]]
        first[i] = np.exp(np.log(soft[alike or known]).mean()) if known.any() else LEAST
    start = np.concatenate([np.log(first), np.zeros(4 * n)])
    weight = BELIEF * np.sqrt(points / (e + 4.0 * n))

    def split(x: Array) -> tuple[Array, Array, Array]:
        factors, off = x[e : e + n], x[e + n :].reshape(n, 3)
        return np.exp(x[:e]), mass * np.exp(factors), com + NEAR * off

    def residual(x: Array) -> Array:
        c, m, at = split(x)
        left = np.einsum("el,elr->r", np.outer(c, moments(m, at)), fields) - right
        return np.concatenate([left, weight * (x - start)])

    def jacobian(x: Array) -> Array:
        c, m, at = split(x)
        by_soft = np.einsum("l,elr->er", moments(m, at), fields) * c[:, None]
        by_moment = np.einsum("e,elr->lr", c, fields).reshape(n, 4, -1) * m[:, None, None]
        by_mass = by_moment[:, 0] + np.einsum("na,nar->nr", at, by_moment[:, 1:])
        by_com = NEAR * by_moment[:, 1:].reshape(3 * n, -1)
        return np.vstack([np.concatenate([by_soft, by_mass, by_com]).T, weight * np.eye(len(x))])

    ends = np.concatenate([np.full(e, 2.0 * np.log(MOST)), np.full(4 * n, 3.0)])
    found = scipy.optimize.least_squares(
        residual, start, jacobian, bounds=(start - ends, start + ends), max_nfev=300
    )
    return split(found.x)


# ---- the arm -------------------------------------------------------------------------------------


SAMPLES = 120  # poses at which laws and springs are compared
NEGLIGIBLE = 1e-9  # [rad]
COMMAND_MAP_ENDING = ".commands.json"  # in the place of that of the model
LEVER = 0.1  # from the flange to what it carries [m]


@dataclass(frozen=True)
class Balance:
    """The spring that carries the upper arm; `effects.compliance.spring` tells what these are."""

    k: float
    zero: float
    eye: float
    rest: float


@dataclass(frozen=True, eq=False)
class Arm:
    """What a simulator holds of an arm, joint values in the controller's sense.

    mass: (n,) of the links [kg].  com: (n, 3) their centres of gravity in the link frames [m].
    turn: (n,) compliance of each joint, 0 stiff [rad/(N m)].  gain: (n,) of each encoder.
    coupled: joint, the joint that turns it too, and how much per radian.  play: (n,) of each gear,
    from stop to stop, negative where it runs ahead [rad].
    bend: 1/EI of links by index [1/(N m^2)].  base: [rad/(N m)].
    sag: (3, 3) turn of the tool per direction of gravity in the flange [rad].  drawn: (3,) how far
    its weight draws it along each axis [m].
    spots: (k, 3) the targets in the last frame [m].  mount: (4, 4) the arm's foot in the base [m].
    mapped: effects that only a command map can hold.  left_out: what nothing here holds, and why.
    remainder: RMS distance between these springs and the laws of the fit, or what it was fitted to
    [m].
    """

    robot: Robot
    mass: Array
    com: Array
    turn: Array
    gain: Array
    play: Array
    coupled: tuple[tuple[int, int, float], ...] = ()
    bend: dict[int, float] = field(default_factory=dict)
    base: float = 0.0
    sag: Array = field(default_factory=lambda: np.zeros((3, 3)))
    drawn: Array = field(default_factory=lambda: np.zeros(3))
    spots: Array = field(default_factory=lambda: np.zeros((0, 3)))
    mount: Array = field(default_factory=lambda: np.eye(4))
    balance: Balance | None = None
    mapped: Fitted = NOTHING
    left_out: tuple[str, ...] = ()
    remainder: float = 0.0

    @staticmethod
    def rigid(robot: Robot, masses: Masses | None = None) -> Arm:
        """An arm that nothing bends.  masses: as the robot tells, or assumed, unless given."""
        zeros = np.zeros(robot.joints)
        mass, com = masses or masses_of(robot, LEAST_MASS)
        return Arm(robot, mass, com, turn=zeros, gain=zeros, play=zeros)

    def rest_in_play(self, data: Measurements) -> Array | None:
        """(m, n) where joints rest in their play, by the moves that led to each pose [rad]."""
        if not self.play.any():
            return None
        sides = [data.columns[f"approach{i + 1}"] for i in range(data.q.shape[1])]
        return np.asarray(0.5 * self.play * np.stack(sides, axis=1))

    def format_command_map(self, cell: Cell) -> dict[str, bytes]:
        """The file of the command map by its ending, where there is something to map.

        cell: whose effects the arm does.
        """
        if not self.mapped.terms:
            return {}
        content = {"schema": 1, "kind": "commands",
                   "cell": replace(cell, effects=self.mapped).whole()}  # fmt: skip
        return {COMMAND_MAP_ENDING: json_text(content).encode()}

    def list_limitations(self) -> list[str]:
        """What a file of the arm does not hold, for people."""
        limitations = []
        if self.mapped.terms:
            named = ", ".join(dict.fromkeys(name_effect(*term.key) for term in self.mapped.terms))
            limitations.append(
                f"{named}: no element of a simulator; the file beside (*{COMMAND_MAP_ENDING}) "
                "corrects commands, and the model counts on it: ctrl = mc.load_commands(PATH)(q)"
            )
        limitations += [f"not in the file: {text}" for text in self.left_out]
        if self.remainder:
            limitations.append(
                "one set of masses and springs stands for the effects of the fit, to "
                f"{1e3 * self.remainder:.2g} mm RMS"
            )
        if self.play.any():
            joints = ", ".join(f"play{i + 1}" for i in np.flatnonzero(self.play))
            limitations.append(
                f"backlash: {joints} rest amid their play; set qpos_spring of the joint to half "
                "the play times the sign of the last move"
            )
        return limitations

    @cached_property
    def reach(self) -> Array:
        """(n,) largest lever of what is beyond each joint [m]."""
        robot = self.robot
        length = np.abs(robot.mdh[:, :2]).sum(axis=1) + np.linalg.norm(self.com, axis=1)
        slide = np.where(robot.prismatic, np.clip(np.abs(robot.upper), 0.0, 2.0), 0.0)
        return np.cumsum((length + slide)[::-1])[::-1] + LEVER

    @cached_property
    def inertia(self) -> Array:
        """(n,) largest of that about each joint [kg m^2]."""
        return np.asarray(np.cumsum(self.mass[::-1])[::-1] * self.reach**2)


def assumed(robot: Robot) -> bool:
    """Whether masses have to be assumed: the robot does not tell all of them."""
    return not bool(weighed(robot).all())


def sample(robot: Robot) -> Array:
    """(m, n) poses all over the workspace [rad, m]."""
    return random_poses(robot, SAMPLES, np.random.default_rng(0))


def arm_of(
    cell: Cell,
    q: Array | None = None,
    masses: tuple[Array, Array] | None = None,
    measured: Measurements | None = None,
) -> Arm:
    """The elements that do what the effects of a cell do.

    q: (m, n) poses at which they should, all over the workspace unless given [rad, m].
    measured: the poses that the cell was fitted to, instead: where one arm cannot do what the laws
    do, its springs explain these as well as they can.
    masses: of the links, where they are those of a simulator's model and stay; else as the robot
    tells, or assumed: then they are chosen so that one arm explains all joints.
    """
    robot = cell.robot
    q = sample(robot) if q is None or not len(q) else q
    poses = still(q, cell.target_names, robot) if measured is None else measured
    scene = cell.scene(poses)
    parts = parts_of(cell, scene, replace(Arm.rigid(robot, masses), spots=cell.target_positions))
    change = np.zeros(sum(len(values) for _, values in parts.firm))
    about = max((abs(float(np.trace(sag))) for sag, _ in parts.tools), default=0.0)
    is_exact = not parts.grouped and about <= NEGLIGIBLE
    if is_exact and not (parts.soft and masses):
        for sag, drawn in parts.tools:
            parts.arm = with_tool(parts.arm, sag, drawn)
    else:
        # Springs and masses that imitate the laws; geometry, base and targets change with them.
        plain = replace(cell, effects=NOTHING)
        state = plain.state
        model = model_of(robot, replace(scene.data, y=plain.predict(scene.data.q)))
        geometry = np.moveaxis(model.jacobian(state), 0, 2)
        left = np.zeros(scene.points.shape)
        if measured is not None:
            left = np.moveaxis(cell.error(measured) @ cell.base[:3, :3], 0, 2)
        laws, firm = Fitted.of((*parts.soft, *parts.sagging)), [term for term, _ in parts.firm]
        begun = (parts.arm.mass, parts.arm.com)
        found = springs_of(scene, laws, left, geometry, firm, begun, fixed=bool(masses))
        change, after = found.firm, state.step(found.change)
        arm = with_tool(parts.arm, found.sag, found.drawn)
        mount = inverse(state.base) @ after.base @ arm.mount
        parts.arm = replace(arm, robot=arm.robot.with_mdh(after.mdh), mount=mount,
                            spots=after.target_positions, **found.held)  # fmt: skip
    for term, values in parts.firm:
        FIRM[term.effect](parts, scene, term, values + change[: len(values)])
        change = change[len(values) :]
    return replace(parts.arm, mapped=Fitted.of(parts.mapped), left_out=tuple(parts.left_out))


def with_tool(arm: Arm, sag: Array, drawn: float) -> Arm:
    """The arm with a tool that sags.

    sag: (3, 3) without trace, its turn per direction of gravity [rad].  drawn: along z [m].
    """
    # -z (z . g) = x (x . g) + y (y . g) - g: against its weight is two slides across, and a shift
    along = np.array([0.0, 0.0, drawn]) if drawn > 0.0 else np.array([-drawn, -drawn, 0.0])
    mount = arm.mount.copy()
    mount[:3, 3] += max(-drawn, 0.0) * arm.robot.up
    return replace(arm, sag=arm.sag + sag, drawn=arm.drawn + along, mount=mount)


@dataclass(eq=False)
class Parts:
    """An arm in the making.  soft: laws of what gives way under gravity, with their values.

    grouped: whether a law takes the torques of several groups of links apart, or no spring does
    what it does.  sagging: laws of the
    tool; tools: each as its turn per direction of gravity (3, 3) [rad], and along z [m].  firm:
    effects that elements hold exactly.
    """

    arm: Arm
    soft: list[tuple[Term, Array]] = field(default_factory=list)
    grouped: bool = False
    sagging: list[tuple[Term, Array]] = field(default_factory=list)
    tools: list[tuple[Array, float]] = field(default_factory=list)
    firm: list[tuple[Term, Array]] = field(default_factory=list)
    mapped: list[tuple[Term, Array]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def put(self, **changes: Any) -> None:
        """Change fields of the arm."""
        self.arm = replace(self.arm, **changes)


def parts_of(cell: Cell, scene: Scene, arm: Arm) -> Parts:
    """What is to hold each effect of a cell; those of 0 need nothing.  arm: to begin with."""
    parts = Parts(arm)
    for term, values in cell.effects.pairs:
        if values.any():
            ELEMENTS.get(term.effect, without_element)(parts, scene, term, values)
    return parts


def unheld(cell: Cell, data: Measurements) -> tuple[Term, ...]:
    """Those effects of a cell that, with its values, only a command map can hold."""
    mapped = bare_parts(cell, data).mapped
    return tuple(term for term, _ in mapped if term in cell.effects.terms)


def bare_parts(cell: Cell, data: Measurements) -> Parts:
    """What is to hold each effect of a cell at some poses, whatever the arm weighs."""
    return parts_of(cell, cell.scene(data), Arm.rigid(cell.robot))


Element = Callable[[Parts, Scene, Term, Array], None]


def without_element(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
    """What turns joints goes to the command map, the rest is named."""
    if term.columns(scene).only_turns:
        parts.mapped.append((term, values))
    else:
        parts.left_out.append(f"{name_effect(*term.key)}: {why_not(EFFECTS[term.effect])}")


def why_not(effect: Effect) -> str:
    """Why a simulator cannot hold an effect."""
    if effect.follows == "time":
        return "changes with time or temperature; the file is the arm at the start"
    if effect.moves == "instrument":
        return "of the instrument and not of the arm"
    return "a simulator has no element for it"


def kept(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
    """What an element holds exactly, whatever else there is."""
    parts.firm.append((term, values))


def compliance(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
    """Joints that give way; one torque a joint, or of groups of links that share a spring."""
    if stiffens(term.choice):  # no spring of a simulator stiffens
        parts.mapped.append((term, values))
        return
    places = unmasked(term.choice["parts"])
    grouped = any(part % 4 != WHOLE for part in places)
    if grouped:
        parts.soft.append((term, values))
        parts.grouped = True
        return
    turn = parts.arm.turn.copy()
    for part, value in zip(places, values, strict=True):
        one = Term(term.effect, f"J{part // 4 + 1}", {"parts": mask_of([part])})
        if value > 0.0:
            turn[part // 4] += value
            parts.soft.append((one, np.array([value])))
        elif value < 0.0:
            parts.mapped.append((one, np.array([value])))
    parts.put(turn=turn)


def softness(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
    """A link that bends, or the base; under a tool of its own weight, which shares the spring."""
    value = float(values[0])
    if len(values) > 1 or value <= 0.0:  # no spring does that; others may take over what it does
        parts.grouped = True
    elif EFFECTS[term.effect].moves == "foot":
        parts.put(base=parts.arm.base + value)
    else:
        link = joint_of(term.place)
        parts.put(bend={**parts.arm.bend, link: parts.arm.bend.get(link, 0.0) + value})
    parts.soft.append((term, values))


def on_joints(name: str) -> Element:
    """A field of the arm by joints: the gear of an actuator, or the play of a hinge with stops."""

    def element(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
        held = getattr(parts.arm, name).copy()
        held[joints_at(term.place, term.choice)] += values
        parts.put(**{name: held})

    return element


def coupling(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
    """A fixed tendon; signs are those of the controller's joints."""
    j, i = joint_of(term.place), int(term.choice["source"]) - 1
    sign = scene.robot.sign
    one = (j, i, float(values[0] * sign[i] * sign[j]))
    parts.put(coupled=(*parts.arm.coupled, one))


def tool(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
    """The turn of the tool per direction of gravity, and how far it is drawn."""
    if term.choice["lever"] == 2.0:
        sag = values[:9].reshape(3, 3)
    else:
        first = term.choice["lever"] == 0.0
        spot = scene.target_positions.mean(axis=0) if first else np.array([0.0, 0.0, 1.0])
        spot = spot / max(float(np.linalg.norm(spot)), 1e-3)
        sag = values[0] * np.cross(spot, np.eye(3)).T
    parts.sagging.append((term, values))
    parts.tools.append((sag, float(values[-1])))


def balancer(parts: Parts, scene: Scene, term: Term, values: Array) -> None:
    """A tendon with a spring, where it pulls."""
    upright = term.place == "J2" and abs(term.choice["zero"]) < 0.5 * np.pi
    if parts.arm.balance or values[0] >= 0.0 or not upright:
        parts.mapped.append((term, values))  # a spring that pushes the arm down is none
        return
    choice = {key: float(term.choice[key]) for key in ("zero", "eye", "rest")}
    parts.put(balance=Balance(float(values[0]), **choice))


FIRM: dict[str, Element] = {
    ENCODER_GAIN.name: on_joints("gain"),
    BACKLASH.name: on_joints("play"),
    JOINT_COUPLING.name: coupling,
}
ELEMENTS: dict[str, Element] = {
    JOINT_COMPLIANCE.name: compliance,
    LINK_BENDING.name: softness,
    BASE_FLEX.name: softness,
    TOOL_FLEX.name: tool,
    GRAVITY_COMPENSATOR.name: balancer,
    **dict.fromkeys(FIRM, kept),
}
