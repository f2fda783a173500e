"""Numbers of an arm in motion, written into a model: its text stays but for what changes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.dynamics.regressor import inertial_parameters
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.document import Document
from minimax_cal.robots.gravity import LEAST_MASS, masses_of, weighed
from minimax_cal.robots.mjcf import numbers
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import tail
from minimax_cal.simulators.arm import stiff
from minimax_cal.simulators.chain import Chain, braked
from minimax_cal.simulators.drive import STEPS, carried
from minimax_cal.simulators.elements import known, parents_of, section, tune
from minimax_cal.simulators.given import counts_degrees, elements_of
from minimax_cal.simulators.mjcf import new_tree
from minimax_cal.simulators.motion.bodies import Bodies, inertial, parameters_of, pseudo_inertia
from minimax_cal.simulators.motion.numbers import Numbers, bristle

SAME = 1e-12  # relative change of a number that is none
TURNS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
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
                continue
            for part in root.iter("actuator"):
                for old in part.findall("dcmotor"):
                    if old.get("name") == bristle(name, k):
                        part.remove(old)


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
    _, reach, _ = carried(stiff(chain.robot, (mass, com)))
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
