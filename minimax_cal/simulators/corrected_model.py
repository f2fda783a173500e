"""A given MuJoCo model with the calibrated arm in it; all else stays.

Each body keeps its place relative to its own joint axis, so meshes, masses and side branches move
with the corrected axis.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.correcting.exporters.correct import NOTED, laid, match, seated
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.robots.document import Document
from minimax_cal.robots.gravity import LEAST_MASS, G, masses_of
from minimax_cal.robots.mjcf import Given, shifted
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import SAME, difference, head, inverse
from minimax_cal.simulators.arm import Arm
from minimax_cal.simulators.chain import ORIENTATION_ATTRIBUTES, ROBOT, Chain, pose_in_parent
from minimax_cal.simulators.elements import Layout, set_link_mass, write_arm_elements
from minimax_cal.simulators.mjcf_tree import MjcfTree, pose_attributes

PlacedRobot = tuple[Robot, Array]  # a robot, and its frame 0 (4, 4) in the model's world [m]


@dataclass(frozen=True, eq=False)
class CorrectedModel:
    """A corrected copy of a model.

    base: (4, 4) frame 0 of the nominal robot in the model's world [m].
    """

    document: Document
    base: Array
    notices: tuple[str, ...]


def correct_model(
    given: Given,
    chain: Chain,
    nominal: Robot,
    arm: Arm | None,
    target_names: Sequence[str] = (),
    *,
    with_servos: bool = True,
) -> CorrectedModel:
    """A copy of a model that stands where the calibrated arm stands under gravity.

    chain: the arm in the compiled model.  nominal: the robot that the model is.
    arm: what elements hold of the fit; None for the nominal robot with servos that do not sag.
    target_names: of the targets that become sites.
    with_servos: whether servos hold the arm; else its motors are given torques.
    Raises RobotError for a model without gravity, and for joints without a name.
    """
    # Registration: where the nominal robot stands in the model's world; both have to move alike.
    base, misfit = match(nominal, chain.seen)
    notices = list[str]()
    if misfit > NOTED:
        notices.append(
            f"{given.source} and the nominal robot differ by up to {1e3 * misfit:.3g} mm or mrad: "
            "the written model follows the calibrated robot"
        )

    # Geometry: each body moves from the nominal link to the calibrated one.
    document = given.document.copy()
    tree = MjcfTree(document.root)
    calibrated = (arm.robot, base @ arm.mount) if arm else (nominal, base)
    layout = move_bodies(tree, chain, (nominal, base), calibrated)

    # Masses: a model keeps its own, but for a file of ours that assumes them.
    if arm and chain.has_assumed_masses:
        for i, body in enumerate(layout.bodies):
            set_link_mass(body, arm, i)
        for text in tree.root.iter("text"):
            if text.get("name") == ROBOT:
                text.set("data", json.dumps(arm.robot.to_dict()))

    # Compliances: those that give the sag of the fit under the model's own gravity.
    if arm and not chain.gravity and (arm.turn.any() or arm.base or arm.bend):
        raise RobotError(f"{given.source}: has no gravity, so nothing in it can sag; give it some")
    if arm:
        factor = G / chain.gravity if chain.gravity else 1.0
        bend = {link: value * factor for link, value in arm.bend.items()}
        arm = replace(arm, turn=arm.turn * factor, base=arm.base * factor, bend=bend,
                      sag=arm.sag * factor, drawn=arm.drawn * factor)  # fmt: skip

    # Elements: servos, springs, play, a tool that sags, and the targets on it.
    held = arm or Arm.rigid(nominal, masses_of(chain.robot, LEAST_MASS))
    write_arm_elements(layout, held, target_names or None, with_servos=with_servos)
    lengthen_keyframes(given, tree.root, chain.model)
    return CorrectedModel(document, base, tuple(notices))


def move_bodies(
    tree: MjcfTree, chain: Chain, nominal: PlacedRobot, calibrated: PlacedRobot
) -> Layout:
    """Move the bodies of a tree to where the calibrated robot has them; its layout from then on.

    tree: a copy of the given one.  Bodies between two joints of the arm move with the first.
    """
    model, poses, ids = chain.model, chain.find_poses_at_zero(), list(chain.joints)
    joints, parents = tree.find_joints(chain), tree.find_parents()
    bodies = [parents[joint] for joint in joints]
    before, after = laid(*nominal), laid(*calibrated)
    old, new, seats = poses[list(chain.bodies)], list[Array](), []
    moving = [joint for joint in chain.seen.chain if joint.moves]
    for i, (body, joint) in enumerate(zip(bodies, moving, strict=True)):
        if model.jnt_stiffness[ids[i]]:  # its own, or of its class
            joints[i].set("stiffness", "0")

        # The joint's frame in the link before it, its axis along z: the same in both robots.
        anchor = shifted(model.jnt_pos[ids[i]])
        seat = seated(inverse(before[i]) @ old[i] @ anchor, joint, nominal[0].sign[i])
        at = after[i] @ seat
        new.append(at @ inverse(anchor))
        seats.append(inverse(new[i]) @ after[i] @ head(calibrated[0].mdh[i]))

        # The body in its parent, at the joint value (ref) at which the file has it.
        parent = poses[model.body_parentid[chain.bodies[i]]]
        if i:
            parent = new[i - 1] @ inverse(old[i - 1]) @ parent
        motion = joint.motion(model.qpos0[[model.jnt_qposadr[ids[i]]]])[0]
        pose = inverse(parent) @ at @ motion @ inverse(anchor)
        compiled = pose_in_parent(model, chain.bodies[i])
        if difference(compiled, pose) <= SAME * 10.0:
            continue

        # A <frame> around it stays: MuJoCo takes the attributes of the body relative to that.
        if parents[body].tag not in ("body", "worldbody"):
            pose = tree.read_pose(body) @ inverse(compiled) @ pose
        for name in ORIENTATION_ATTRIBUTES:
            body.attrib.pop(name, None)
        body.attrib |= pose_attributes(pose)
    return Layout(tree, chain.names, tuple(bodies), tuple(joints), np.array(seats),
                  model.jnt_pos[ids], model.jnt_axis[ids], chain.read_servos(),
                  chain.find_largest_inertias(), chain.step)  # fmt: skip


def lengthen_keyframes(given: Given, tree: ET.Element, model: Any) -> None:
    """Give the springs that a tree has now their places in its keyframes, at 0.

    model: as it was.
    """
    keys = [key for part in tree.findall("keyframe") for key in part]
    if not keys:
        return
    bare = deepcopy(tree)
    for section in bare.findall("keyframe"):
        bare.remove(section)
    after, old = given.compiled(bare), {model.joint(j).name for j in range(model.njnt)}
    new = [j for j in range(after.njnt) if after.joint(j).name and after.joint(j).name not in old]
    for name, size, starts in (("qpos", model.nq, after.jnt_qposadr),
                               ("qvel", model.nv, after.jnt_dofadr)):  # fmt: skip
        for key in keys if new else ():
            values = key.get(name, "").split()
            if len(values) == size:  # otherwise MuJoCo has refused it, or there are none
                for joint in new:
                    values.insert(int(starts[joint]), "0")
                key.set(name, " ".join(values))
