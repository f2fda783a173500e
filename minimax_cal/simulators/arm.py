"""What a simulator can hold of a calibrated arm: masses, springs, play, gains, couplings.

A position servo is a spring: with the gain 1/c it gives way under gravity as a joint of compliance
c does.  What has no element, but turns joints only, goes into a command map; the rest is named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.bending import BASE_FLEX, LINK_BENDING, TOOL_FLEX
from minimax_cal.modelling.effects.compliance import (
    GRAVITY_COMPENSATOR,
    JOINT_COMPLIANCE,
    WHOLE,
    stiffens,
)
from minimax_cal.modelling.effects.gears import BACKLASH, ENCODER_GAIN, JOINT_COUPLING, joints_at
from minimax_cal.modelling.effects.scene import Effect, Scene, joint_of, mask_of, unmasked
from minimax_cal.modelling.effects.table import EFFECTS, NOTHING, Fitted, Term
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.gravity import LEAST_MASS, masses_of, weighed
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_poses
from minimax_cal.robots.transforms import inverse
from minimax_cal.simulators.springs import Springs, springs_of

SAMPLES = 120  # poses at which laws and springs are compared
NEGLIGIBLE = 1e-9  # [rad]


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


def assumed(robot: Robot) -> bool:
    """Whether masses have to be assumed: the robot does not tell all of them."""
    return not bool(weighed(robot).all())


def stiff(robot: Robot, masses: tuple[Array, Array]) -> Arm:
    """An arm that nothing bends.  masses: (n,) [kg] and (n, 3) centres in the link frames [m]."""
    n = robot.joints
    return Arm(robot, *masses, turn=np.zeros(n), gain=np.zeros(n), play=np.zeros(n))


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
    begun = stiff(robot, masses or masses_of(robot, LEAST_MASS))
    parts = parts_of(cell, scene, replace(begun, spots=cell.target_positions))
    change = np.zeros(sum(len(values) for _, values in parts.firm))
    if parts.exact and not (parts.soft and masses):
        for sag, drawn in parts.tools:
            parts.arm = with_tool(parts.arm, sag, drawn)
    else:
        found, plain = imitated(cell, scene, parts, measured, fixed=bool(masses))
        parts.arm = with_springs(parts.arm, found, plain)
        change = found.firm
    for term, values in parts.firm:
        FIRM[term.effect](parts, scene, term, values + change[: len(values)])
        change = change[len(values) :]
    return parts.whole()


def imitated(
    cell: Cell, scene: Scene, parts: Parts, measured: Measurements | None, *, fixed: bool
) -> tuple[Springs, State]:
    """Springs that do what laws do, and the geometry that they begin from."""
    laws = Fitted.of((*parts.soft, *parts.sagging))
    plain = replace(cell, effects=NOTHING)
    model = model_of(cell.robot, replace(scene.data, y=plain.predict(scene.data.q)))
    geometry = np.moveaxis(model.jacobian(plain.state), 1, 2)
    left = np.zeros(scene.points.shape)
    if measured is not None:
        left = np.moveaxis(cell.error(measured) @ cell.base[:3, :3], 1, 2)
    firm = [term for term, _ in parts.firm]
    masses = (parts.arm.mass, parts.arm.com)
    return springs_of(scene, laws, left, geometry, firm, masses, fixed=fixed), plain.state


def with_springs(arm: Arm, found: Springs, state: State) -> Arm:
    """The arm with springs and masses that imitate laws, and what geometry took over.

    state: geometry, base and targets of the fit.
    """
    after = state.step(found.change)
    mount = inverse(state.base) @ after.base
    arm = with_tool(arm, found.sag, found.drawn)
    robot, spots = arm.robot.with_mdh(after.mdh), after.target_positions
    return replace(arm, robot=robot, spots=spots, mount=mount @ arm.mount, **found.held)


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

    @property
    def exact(self) -> bool:
        """Whether elements do exactly what the laws do."""
        about = [abs(float(np.trace(sag))) for sag, _ in self.tools]
        return not self.grouped and max(about, default=0.0) <= NEGLIGIBLE

    def whole(self) -> Arm:
        """The arm with what no element holds."""
        return replace(self.arm, mapped=Fitted.of(self.mapped), left_out=tuple(self.left_out))


def parts_of(cell: Cell, scene: Scene, arm: Arm) -> Parts:
    """What is to hold each effect of a cell; those of 0 need nothing.  arm: to begin with."""
    parts = Parts(arm)
    for term, values in cell.effects.pairs:
        if values.any():
            ELEMENTS.get(term.effect, without_element)(parts, scene, term, values)
    return parts


def held_terms(cell: Cell) -> tuple[Term, ...]:
    """The effects of a cell that elements hold, or a command map; those of 0 need nothing."""
    data = still(np.zeros((1, cell.robot.joints)), cell.target_names, cell.robot)
    alone = ((term, replace(cell, effects=Fitted.of([(term, values)])))
             for term, values in cell.effects.pairs)  # fmt: skip
    return tuple(term for term, one in alone if not bare_parts(one, data).left_out)


def unheld(cell: Cell, data: Measurements) -> tuple[Term, ...]:
    """Those effects of a cell that, with its values, only a command map can hold."""
    mapped = bare_parts(cell, data).mapped
    return tuple(term for term, _ in mapped if term in cell.effects.terms)


def bare_parts(cell: Cell, data: Measurements) -> Parts:
    """What is to hold each effect of a cell at some poses, whatever the arm weighs."""
    return parts_of(cell, cell.scene(data), stiff(cell.robot, masses_of(cell.robot, LEAST_MASS)))


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
