"""MJCF out: a calibrated arm with its masses, servos, springs and targets, for MuJoCo.

The world is the robot's base frame, in metres and radians; joint values are the controller's.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.correcting.exporters.job import origins
from minimax_cal.correcting.exporters.urdf import in_link
from minimax_cal.ground.files import json_text
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.robots.gravity import G, inertia_of
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import tail
from minimax_cal.simulators.arm import Arm
from minimax_cal.simulators.chain import ROBOT
from minimax_cal.simulators.drive import Drives
from minimax_cal.simulators.elements import Layout, equip, known, part, quaternion, targets

COMMANDS = ".commands.json"
SEEN = 0.02  # radius of the links that are drawn [m]


def told(arm: Arm) -> list[str]:
    """What the file does not hold, for people."""
    out = []
    if arm.mapped.terms:
        named = ", ".join(dict.fromkeys(name_effect(*term.key) for term in arm.mapped.terms))
        out.append(
            f"{named}: no element of a simulator; the file beside (*{COMMANDS}) corrects commands, "
            "and the model counts on it: ctrl = mc.load_commands(PATH)(q)"
        )
    out += [f"not in the file: {text}" for text in arm.left_out]
    if arm.remainder:
        out.append(
            "one set of masses and springs stands for the effects of the fit, to "
            f"{1e3 * arm.remainder:.2g} mm RMS"
        )
    if arm.play.any():
        joints = ", ".join(f"play{i + 1}" for i in np.flatnonzero(arm.play))
        out.append(
            f"backlash: {joints} rest amid their play; set qpos_spring of the joint to half the "
            "play times the sign of the last move"
        )
    return out


def beside(cell: Cell, arm: Arm) -> dict[str, bytes]:
    """The command map, where there is something to map."""
    if not arm.mapped.terms:
        return {}
    content = {"schema": 1, "kind": "commands", "cell": replace(cell, effects=arm.mapped).whole()}
    return {COMMANDS: json_text(content).encode()}


def text_of(tree: ET.Element) -> bytes:
    """The file."""
    ET.indent(tree)
    return bytes(ET.tostring(tree, encoding="utf-8", xml_declaration=True)) + b"\n"


def new_tree(arm: Arm, names: Sequence[str], *, springs: bool = False) -> ET.Element:
    """The whole file.  names: of the targets.  springs: as in `elements.equip`."""
    robot = arm.robot
    root = ET.Element("mujoco", {"model": robot.name})
    root.append(ET.Comment(" written by minimax-cal; world = base of the robot; m, rad "))
    part(root, "compiler", angle="radian", autolimits="true")
    part(root, "option", gravity=-G * robot.up, integrator="implicitfast", timestep=0.002)
    custom = part(root, "custom")
    part(custom, "text", name=ROBOT, data=json.dumps(robot.to_dict()))
    layout = skeleton(root, arm)
    part(root, "actuator")
    equip(layout, arm, springs=springs)
    targets(layout, arm, names)
    return root


def skeleton(root: ET.Element, arm: Arm) -> Layout:
    """Bodies link1 ... linkn with their joints, masses and something to see."""
    robot, parent = arm.robot, part(root, "worldbody")
    bodies, joints = [], []
    for i, pose in enumerate(origins(robot)[:-1]):
        at = arm.mount @ pose if i == 0 else pose
        body = part(parent, "body", name=f"link{i + 1}", pos=at[:3, 3], quat=quaternion(at))
        weigh(body, arm, i)
        joints.append(part(body, "joint", **joint_of(robot, i)))
        drawn(body, robot, i)
        bodies.append(body)
        parent = body
    n = robot.joints
    axes = np.zeros((n, 3))
    axes[:, 2] = robot.sign
    names = tuple(f"joint{i + 1}" for i in range(n))
    seats = np.broadcast_to(np.eye(4), (n, 4, 4))
    zero, new = np.zeros((n, 3)), Drives.none(n)
    return Layout(root, names, tuple(bodies), tuple(joints), seats, zero, axes, new)


def weigh(body: ET.Element, arm: Arm, i: int) -> None:
    """Give a body whose joint axis is z at its origin the mass of a link."""
    centre = in_link(replace(arm.robot, com=arm.com), i)
    known(body, "inertial", pos=centre, mass=arm.mass[i],
          diaginertia=[inertia_of(arm.robot.mdh, i, arm.mass[i])] * 3)  # fmt: skip


def joint_of(robot: Robot, i: int) -> dict[str, object]:
    """Attributes of a joint; limits where both ends are known."""
    out: dict[str, object] = {
        "name": f"joint{i + 1}",
        "type": "slide" if robot.prismatic[i] else "hinge",
        "axis": [0.0, 0.0, float(robot.sign[i])],
    }
    ends = np.array([robot.lower[i], robot.upper[i]])
    return out | ({"range": ends} if np.isfinite(ends).all() else {})


def drawn(body: ET.Element, robot: Robot, i: int) -> None:
    """A rod along the link, and one along its joint axis, that touch nothing."""
    row = robot.mdh[i]
    ends = [np.zeros(3), tail(row)[:3, 3]]
    for start, end in ((np.array([0.0, 0.0, -row[1]]), ends[0]), (ends[0], ends[1])):
        if np.linalg.norm(end - start) > SEEN:
            rod = {"type": "capsule", "fromto": np.concatenate([start, end]), "size": [SEEN]}
            touching = {"contype": "0", "conaffinity": "0"}
            part(body, "geom", **rod, **touching, group="2", mass="0")
