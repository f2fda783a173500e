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

from minimax_cal.compensation.exporters.urdf_correction import (
    MIN_NOTED_URDF_MISFIT,
    align_frame_with_joint_axis,
    link_frames_at_zero,
    match_robot_to_urdf,
)
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.robots.gravity_torques import (
    MIN_SIMULATED_LINK_MASS,
    STANDARD_GRAVITY,
    link_masses_and_centres,
)
from minimax_cal.robots.mjcf_import import MjcfModel, translation_to_point
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import (
    MAX_EQUAL_TRANSFORM_DIFFERENCE,
    invert_transform,
    max_entry_difference,
    theta_d_transform,
)
from minimax_cal.robots.xml_document import XmlDocument
from minimax_cal.simulators.arm import SimulatedArm
from minimax_cal.simulators.chain import (
    ORIENTATION_ATTRIBUTES,
    ROBOT_TEXT_NAME,
    ModelArm,
    pose_in_parent,
)
from minimax_cal.simulators.elements import ArmLayout, set_link_mass, write_arm_elements
from minimax_cal.simulators.mjcf_tree import MjcfTree, pose_attributes

PlacedRobot = tuple[Robot, Array]  # a robot, and its frame 0 (4, 4) in the model's world [m]


@dataclass(frozen=True, eq=False)
class CorrectedModel:
    """A corrected copy of a model.

    base: (4, 4) frame 0 of the nominal robot in the model's world [m].
    """

    document: XmlDocument
    base: Array
    notices: tuple[str, ...]


def correct_model(
    given: MjcfModel,
    chain: ModelArm,
    nominal: Robot,
    arm: SimulatedArm | None,
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
    base, misfit = match_robot_to_urdf(nominal, chain.urdf_robot)
    notices = list[str]()
    if misfit > MIN_NOTED_URDF_MISFIT:
        notices.append(
            f"{given.source} and the nominal robot differ by up to {1e3 * misfit:.3g} mm or mrad: "
            "the written model follows the calibrated robot"
        )

    # Geometry: each body moves from the nominal link to the calibrated one.
    document = given.document.copy()
    tree = MjcfTree(document.root)
    calibrated = (arm.robot, base @ arm.mount) if arm else (nominal, base)
    layout = move_bodies_and_build_layout(tree, chain, (nominal, base), calibrated)

    # Masses: a model keeps its own, but for a file of ours that assumes them.
    if arm and chain.has_assumed_masses:
        for i, body in enumerate(layout.bodies):
            set_link_mass(body, arm, i)
        for text in tree.root.iter("text"):
            if text.get("name") == ROBOT_TEXT_NAME:
                text.set("data", json.dumps(arm.robot.to_dict()))

    # Compliances: those that give the sag of the fit under the model's own gravity.
    if (
        arm
        and not chain.gravity
        and (arm.joint_compliances.any() or arm.base_compliance or arm.link_flexibility)
    ):
        raise RobotError(f"{given.source}: has no gravity, so nothing in it can sag; give it some")
    if arm:
        factor = STANDARD_GRAVITY / chain.gravity if chain.gravity else 1.0
        bend = {link: value * factor for link, value in arm.link_flexibility.items()}
        arm = replace(
            arm,
            joint_compliances=arm.joint_compliances * factor,
            base_compliance=arm.base_compliance * factor,
            link_flexibility=bend,
            tool_sag=arm.tool_sag * factor,
            tool_extension=arm.tool_extension * factor,
        )

    # Elements: servos, springs, play, a tool that sags, and the targets on it.
    held = arm or SimulatedArm.rigid(
        nominal, link_masses_and_centres(chain.robot, MIN_SIMULATED_LINK_MASS)
    )
    write_arm_elements(layout, held, target_names or None, with_servos=with_servos)
    add_springs_to_keyframes(given, tree.root, chain.model)
    return CorrectedModel(document, base, tuple(notices))


def move_bodies_and_build_layout(
    tree: MjcfTree, chain: ModelArm, nominal: PlacedRobot, calibrated: PlacedRobot
) -> ArmLayout:
    """Move the bodies of a tree to where the calibrated robot has them; its layout from then on.

    tree: a copy of the given one.  Bodies between two joints of the arm move with the first.
    """
    model, poses, ids = chain.model, chain.find_poses_at_zero(), list(chain.joint_ids)
    joints, parents = tree.find_joints(chain), tree.find_parents()
    bodies = [parents[joint] for joint in joints]
    before, after = link_frames_at_zero(*nominal), link_frames_at_zero(*calibrated)
    old, new, seats = poses[list(chain.body_ids)], list[Array](), []
    moving = [joint for joint in chain.urdf_robot.chain if joint.is_moving]
    for i, (body, joint) in enumerate(zip(bodies, moving, strict=True)):
        if model.jnt_stiffness[ids[i]]:  # its own, or of its class
            joints[i].set("stiffness", "0")

        # The joint's frame in the link before it, its axis along z: the same in both robots.
        anchor = translation_to_point(model.jnt_pos[ids[i]])
        seat = align_frame_with_joint_axis(
            invert_transform(before[i]) @ old[i] @ anchor, joint, nominal[0].sign[i]
        )
        at = after[i] @ seat
        new.append(at @ invert_transform(anchor))
        seats.append(invert_transform(new[i]) @ after[i] @ theta_d_transform(calibrated[0].mdh[i]))

        # The body in its parent, at the joint value (ref) at which the file has it.
        parent = poses[model.body_parentid[chain.body_ids[i]]]
        if i:
            parent = new[i - 1] @ invert_transform(old[i - 1]) @ parent
        motion = joint.motion_transforms(model.qpos0[[model.jnt_qposadr[ids[i]]]])[0]
        pose = invert_transform(parent) @ at @ motion @ invert_transform(anchor)
        compiled = pose_in_parent(model, chain.body_ids[i])
        if max_entry_difference(compiled, pose) <= MAX_EQUAL_TRANSFORM_DIFFERENCE * 10.0:
            continue

        # A <frame> around it stays: MuJoCo takes the attributes of the body relative to that.
        if parents[body].tag not in ("body", "worldbody"):
            pose = tree.read_pose(body) @ invert_transform(compiled) @ pose
        for name in ORIENTATION_ATTRIBUTES:
            body.attrib.pop(name, None)
        body.attrib |= pose_attributes(pose)
    return ArmLayout(tree, chain.joint_names, tuple(bodies), tuple(joints), np.array(seats),
                  model.jnt_pos[ids], model.jnt_axis[ids], chain.read_servos(),
                  chain.largest_inertias_over_workspace(), chain.timestep)  # fmt: skip


def add_springs_to_keyframes(given: MjcfModel, tree: ET.Element, model: Any) -> None:
    """Give the springs that a tree has now their places in its keyframes, at 0.

    model: as it was.
    """
    keys = [key for part in tree.findall("keyframe") for key in part]
    if not keys:
        return
    bare = deepcopy(tree)
    for section in bare.findall("keyframe"):
        bare.remove(section)
    after, old = given.compile_model(bare), {model.joint(j).name for j in range(model.njnt)}
    new = [j for j in range(after.njnt) if after.joint(j).name and after.joint(j).name not in old]
    for name, size, starts in (("qpos", model.nq, after.jnt_qposadr),
                               ("qvel", model.nv, after.jnt_dofadr)):  # fmt: skip
        for key in keys if new else ():
            values = key.get(name, "").split()
            if len(values) == size:  # otherwise MuJoCo has refused it, or there are none
                for joint in new:
                    values.insert(int(starts[joint]), "0")
                key.set(name, " ".join(values))
