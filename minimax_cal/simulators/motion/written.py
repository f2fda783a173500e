"""Numbers of an arm in motion, written into a model: its text stays but for what changes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.dynamics.regressor import inertial_parameters
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.robots.document import Document
from minimax_cal.robots.gravity import LEAST_MASS, G, masses_of, weighed
from minimax_cal.robots.mjcf import Given, mujoco, numbers, read_model
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.transforms import tail
from minimax_cal.robots.urdf import MODELS, is_urdf
from minimax_cal.simulators.arm import arm_of, stiff
from minimax_cal.simulators.chain import TURNS, Chain, braked, chain_along, chain_of
from minimax_cal.simulators.elements import STEPS, carried, forget, known, parents_of, section, tune
from minimax_cal.simulators.mjcf import (
    content_for,
    corrected,
    counts_degrees,
    elements_of,
    new_tree,
    own_masses,
)
from minimax_cal.simulators.motion.numbers import (
    Bodies,
    Numbers,
    bristle,
    inertial,
    parameters_of,
    pseudo_inertia,
)

SAME = 1e-12  # relative change of a number that is none
STOPS = 4e-6  # friction moves the tool of a new file, at each joint, by no more [m]
OPEN = {"motorconst": "1", "resistance": "1e9", "input": "none"}  # a motor that drives nothing
HISTORY = 2  # samples of a delayed signal beyond those of the delay
SHORTEST = 0.5  # of a timestep: a shorter delay is none


def write_numbers(document: Document, chain: Chain, given: Numbers, found: Numbers) -> None:
    """Change a model's elements to what was found, where that differs from what it has.

    Raises RobotError.
    """
    parents = parents_of(document.root)
    for i, joint in enumerate(elements_of(document.root, chain)):
        if differs(found.bodies[i], given.bodies[i]):
            weigh(parents[joint], found.bodies[i])
        put(joint, "armature", found.armature[i], given.armature[i])
        put(joint, "frictionloss", found.loss[i], given.loss[i])
        put(joint, "damping", powers(found.damping[i]), powers(given.damping[i]))
        put(joint, "stiffness", powers(found.stiffness[i]), powers(given.stiffness[i]))
        if differs(found.stiffness[i], given.stiffness[i]):
            rest = found.rest[i]
            turns = chain.model.jnt_type[chain.joints[i]] != 2 and counts_degrees(document.root)
            joint.set("springref", numbers([np.degrees(rest) if turns else rest]))
    write_gains(document.root, chain, found)
    write_delay(document.root, chain, found)
    write_bristles(document.root, chain, found)


def differs(found: Array, given: Array) -> bool:
    """Whether a number changes."""
    return not np.allclose(found, given, rtol=SAME, atol=0.0)


def powers(values: Array) -> Array:
    """Numbers without zeros at their end, one at least."""
    last = int(np.flatnonzero(values)[-1]) + 1 if values.any() else 1
    return values[:last]


def put(joint: ET.Element, name: str, found: Array | float, given: Array | float) -> None:
    """Set an attribute, where its number changes."""
    new, old = np.atleast_1d(found), np.atleast_1d(given)
    if new.shape != old.shape or differs(new, old):
        joint.set(name, numbers(new))


def weigh(body: ET.Element, pseudo: Array) -> None:
    """Give a body its mass and inertia."""
    values = inertial(pseudo)
    element = known(body, "inertial")
    for name in (*TURNS, "fullinertia"):
        element.attrib.pop(name, None)
    for name, value in values.items():
        element.set(name, numbers(value))
    if list(body).index(element) and body.find("joint") is not None:
        body.remove(element)
        body.insert(0, element)


def write_gains(root: ET.Element, chain: Chain, found: Numbers) -> None:
    """Let motors of a joint put out what its drive does, of what is commanded."""
    for name, gain in zip(chain.names, found.gain, strict=True):
        if gain == 1.0:
            continue
        for actuator in actuators_of(root, name):
            old = [float(v) for v in str(actuator.get("gear", "1")).split()]
            actuator.set("gear", numbers([old[0] / gain, *old[1:]]))


def actuators_of(root: ET.Element, joint: str) -> list[ET.Element]:
    """The actuators that drive a joint."""
    every = [e for part in root.iter("actuator") for e in part]
    return [e for e in every if e.get("joint") == joint and e.get("input") != OPEN["input"]]


def write_bristles(root: ET.Element, chain: Chain, found: Numbers) -> None:
    """Give joints their bristles, and take away those that they have no more."""
    for j, name in enumerate(chain.names):
        for k, friction in enumerate(found.bristles[j]):
            if friction > 0.0:
                stiffness = friction / found.yields[j, k]
                level = [stiffness, stiffness * found.damped[j], friction, friction, 1.0]
                known(section(root, "actuator"), "dcmotor", bristle(name, k), joint=name,
                      lugre=level, **OPEN)  # fmt: skip
            else:
                forget(root, "actuator", "dcmotor", bristle(name, k))


def write_delay(root: ET.Element, chain: Chain, found: Numbers) -> None:
    """A command that acts late, or a torque that is read late."""
    late = delayed(abs(found.late), float(chain.model.opt.timestep))
    for name in chain.names if late else ():
        if found.late > 0.0:
            sensors = section(root, "sensor")
            known(sensors, "jointactuatorfrc", f"{name}_torque", joint=name, **late)
            continue
        for actuator in actuators_of(root, name):
            actuator.attrib |= late


def delayed(late: float, step: float) -> dict[str, str]:
    """Attributes of what is so late [s]; none where that is no delay.  step: of time [s]."""
    if late < SHORTEST * step:
        return {}
    count = math.ceil(late / step) + HISTORY
    return {"delay": numbers([late]), "nsample": str(count), "interp": "linear"}


def stiffen(root: ET.Element, chain: Chain, found: Numbers) -> None:
    """Let position servos of a new file hold the arm where it is commanded, for all its friction.

    A servo of gain k stops within friction / k of its command.
    """
    mass, com = masses_of(chain.robot, LEAST_MASS)
    reach, _ = carried(stiff(chain.robot, (mass, com)))
    needed = found.friction * np.where(chain.robot.prismatic, 1.0, reach) / STOPS
    for i, name in enumerate(chain.names):
        for servo in actuators_of(root, name):
            if servo.tag != "position" or needed[i] <= float(servo.get("kp", "0")):
                continue
            inertia = float(servo.get("kv", "0")) ** 2 / (4.0 * float(servo.get("kp", "1")))
            damper = 2.0 * np.sqrt(needed[i] * inertia)
            step = float(chain.model.opt.timestep)
            tune(servo, needed[i], max(damper, STEPS * step * needed[i]))


def free_joints(root: ET.Element, chain: Chain) -> None:
    """Give servos the dampers that joints of a new file hold for them.

    Along logs the damping of a joint is friction, and a servo's damper is part of its torque.
    """
    for number, joint in zip(chain.joints, elements_of(root, chain), strict=True):
        if braked(chain.model)[number]:
            servo = chain.model.actuator(chain.servo(number))
            damper = float(joint.attrib.pop("damping")) / float(servo.gear[0]) ** 2
            known(section(root, "actuator"), "position", str(servo.name), kv=damper)


def new_model(robot: Robot) -> Document:
    """A new file of a robot: its masses as drawn, position servos that hold it."""
    root = new_tree(stiff(robot, masses_of(robot, LEAST_MASS)), ())
    weigh_drawn(root, robot)
    return Document(root)


def weigh_drawn(root: ET.Element, robot: Robot) -> None:
    """Give the links of a new file the inertias of a robot, where it tells them."""
    bodies = {str(body.get("name")): body for body in root.iter("body")}
    drawn = inertial_parameters(robot)
    for i in np.flatnonzero(weighed(robot)):
        place = tail(robot.mdh[i])  # of the link's frame in that of its joint, the body's
        moved = place @ pseudo_inertia(drawn[i]) @ place.T
        if drawn[i, 0] > LEAST_MASS and np.linalg.eigvalsh(moved)[0] > 0.0:
            weigh(bodies[f"link{i + 1}"], moved)


def unwritten(chain: Chain, wanted: Array, names: Sequence[str]) -> list[str]:
    """Links whose masses MuJoCo did not take from the file.  wanted: (n, 4, 4)."""
    got = Bodies.of(chain).drawn
    off = np.abs(parameters_of(got) - parameters_of(wanted)).max(axis=1)
    size = np.abs(parameters_of(wanted)).max(axis=1)
    return [names[int(i)] for i in np.flatnonzero(off > 1e-6 * size)]


# ---- a model to be corrected ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Opened:
    """A model and its arm.  given: its file.  new: whether it is made of a robot file or URDF."""

    given: Given
    chain: Chain
    new: bool

    def again(self, document: Document) -> Opened:
        """The same arm in a changed tree."""
        given = replace(self.given, document=document)
        return replace(self, given=given, chain=self.chain.in_model(given.compiled()))

    def rebuilt(self, given: Given) -> Opened:
        """The arm of the same joints, whose bodies may stand elsewhere."""
        model = given.compiled()
        joints = self.chain.ids_in(model)
        chain = chain_along(model, joints, given.source, unknown=given.assumed)
        return replace(self, given=given, chain=chain)

    def with_free_joints(self) -> Opened:
        """The same with the dampers of servos in the servos."""
        free_joints(self.given.document.root, self.chain)
        return self.again(self.given.document)

    def content(self, path: Path | None) -> bytes:
        """The file, to be written at a path."""
        return content_for(self.given.document, self.given.folder, path)


def is_mjcf(model: Path | str) -> bool:
    """Whether a model is a simulator's own."""
    path = Path(model)
    return path.suffix.lower() in MODELS and not is_urdf(path)


def open_model(model: Path | str, joints: int, tip: str = "", *, freed: bool = True) -> Opened:
    """The arm of so many joints in a model's file; of a robot file or URDF a new model.

    freed: whether servos get the dampers that joints hold for them.  Raises CalibrationError.
    """
    mujoco()
    if is_mjcf(model):
        given = read_model(model)
        chain = chain_of(given.compiled(), joints, given.source, tip, unknown=given.assumed)
        opened = Opened(given, chain, new=False)
        return opened.with_free_joints() if freed else opened
    robot = load_robot(model)
    if robot.joints != joints:
        raise OptionError(f"{model}: has {robot.joints} joints, the logs have {joints}")
    given = Given(str(model), new_model(robot), Path())
    chain = chain_of(given.compiled(), joints, given.source)
    opened = Opened(given, chain, new=True)
    return opened.with_free_joints() if freed else opened


def calibrated(opened: Opened, fit: Fit) -> tuple[Opened, tuple[str, ...]]:
    """The model with the arm of a static calibration in it, and notices."""
    names = fit.cell.target_names
    if opened.new:
        arm = arm_of(fit.cell, fit.train.q, masses_of(fit.cell.robot, LEAST_MASS))
        document = Document(new_tree(arm, names, springs=True))
        weigh_drawn(document.root, fit.cell.robot)
        given = replace(opened.given, document=document)
        return opened.rebuilt(given).with_free_joints(), ()
    nominal = fit.nominal.robot
    arm = arm_of(fit.cell, fit.train.q, own_masses(opened.chain, nominal))
    driven = bool((opened.chain.servos >= 0).any())
    document, notices = corrected(opened.given, opened.chain, nominal, arm, names, driven=driven)
    if not driven and (arm.gain.any() or arm.coupled):
        notices += (
            "not in the model: encoder gains and couplings, which only position servos hold",
        )
    return opened.rebuilt(replace(opened.given, document=document)), notices


def in_its_gravity(chain: Chain) -> Robot:
    """The robot of a model, its vertical as long as the model's gravity over that of the earth."""
    if chain.gravity == 0.0:
        raise OptionError("the model has no gravity; give it <option gravity=...>, as the arm has")
    return replace(chain.robot, up=chain.robot.up * chain.gravity / G)
