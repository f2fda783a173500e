"""SDF out, for Gazebo: what an MJCF holds of an arm, by the elements of SDFormat 1.9.

The frame of a link is that of its body; a joint stands at its anchor, its axis in the link's frame.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.correcting.exporters.job import Export, Job
from minimax_cal.correcting.exporters.urdf import assumptions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.robots.mjcf import body_pose, mujoco, numbers, read_model
from minimax_cal.robots.transforms import inverse, to_rpy
from minimax_cal.simulators.chain import at_zero, braked, pose_at
from minimax_cal.simulators.mjcf import new_file

VERSION = "1.9"
KINDS = {2: "prismatic", 3: "revolute"}  # of mjtJoint: a slide, a hinge
SHAPES = {2: "sphere", 3: "capsule", 5: "cylinder", 6: "box"}  # of mjtGeom
CENTRAL = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
UNLIMITED = 1e16  # what SDFormat takes for no limit


def write(job: Job) -> Export:
    """A new SDF of an arm: geometry, masses, limits and targets."""
    made = new_file(job)[2]
    found = as_sdf(mujoco().MjModel.from_xml_string(made.decode()), job.robot.name, job.source)
    return replace(found, notices=(assumptions(job.robot), *found.notices))


def convert(path: Path) -> Export:
    """The SDF of an MJCF, its friction, damping and springs included.  Raises RobotError."""
    model = read_model(path).compiled()
    return as_sdf(model, path.stem, str(path))


def relative(model: Any, data: Any, body: int) -> Array:
    """(4, 4) pose of a body in that of its parent."""
    parent = int(model.body_parentid[body])
    return inverse(body_pose(data, parent)) @ body_pose(data, body)


def as_sdf(model: Any, name: str, source: str) -> Export:
    """The file, and what of the model it does not hold.  Raises RobotError."""
    check_joints(model, source)
    data = at_zero(model, range(model.njnt))
    root = ET.Element("sdf", {"version": VERSION})
    arm = ET.SubElement(root, "model", {"name": name})
    root.insert(0, ET.Comment(" written by minimax-cal; world = base of the robot; m, rad, kg "))
    for body in range(1, model.nbody):
        write_link(arm, model, data, body)
        write_joint(arm, model, data, body)
    for site in range(model.nsite):
        frame = ET.SubElement(arm, "frame", {
            "name": f"{model.site(site).name or f'site{site}'}",
            "attached_to": name_of(model, int(model.site_bodyid[site])),
        })  # fmt: skip
        frame_pose(frame, pose_at(model.site_pos[site], model.site_quat[site]))
    ET.indent(root)
    content = ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"
    return Export(content, tuple(lost_of(model)))


def check_joints(model: Any, source: str) -> None:
    """Raise RobotError for what has no joint of SDF."""
    for body in range(1, model.nbody):
        if model.body_jntnum[body] > 1:
            raise RobotError(
                f"{source}: body {name_of(model, body)} has several joints (play or compliance); "
                "SDF holds one; export without these effects"
            )
    if not set(model.jnt_type.tolist()) <= set(KINDS):
        raise RobotError(f"{source}: has a free or ball joint; SDF is written of hinges and slides")


def name_of(model: Any, body: int) -> str:
    """Of a link; the world's own."""
    return str(model.body(body).name) or f"body{body}"


def element(parent: ET.Element, tag: str, value: object) -> ET.Element:
    """A child with a number or text."""
    made = ET.SubElement(parent, tag)
    made.text = numbers([value]) if isinstance(value, int | float) else str(value)
    return made


def frame_pose(parent: ET.Element, at: Array, relative_to: str = "") -> None:
    """The pose (4, 4) of an element: position, roll, pitch and yaw."""
    pose = element(parent, "pose", f"{numbers(at[:3, 3])} {numbers(to_rpy(at))}")
    if relative_to:
        pose.set("relative_to", relative_to)


def write_link(arm: ET.Element, model: Any, data: Any, body: int) -> None:
    """A body with its mass and what is to be seen of it."""
    parent = int(model.body_parentid[body])
    link = ET.SubElement(arm, "link", {"name": name_of(model, body)})
    frame_pose(link, relative(model, data, body), name_of(model, parent) if parent else "")
    inertial = ET.SubElement(link, "inertial")
    element(inertial, "mass", model.body_mass[body])
    frame_pose(inertial, pose_at(model.body_ipos[body]))
    turn = pose_at(model.body_ipos[body], model.body_iquat[body])[:3, :3]
    tensor = turn @ np.diag(model.body_inertia[body]) @ turn.T
    moments = ET.SubElement(inertial, "inertia")
    for tag, value in zip(CENTRAL, tensor[np.triu_indices(3)].tolist(), strict=True):
        element(moments, tag, value)
    for geom in np.flatnonzero(model.geom_bodyid == body):
        write_visual(link, model, int(geom))


def write_visual(link: ET.Element, model: Any, geom: int) -> None:
    """A simple shape; nothing of a mesh."""
    shape = SHAPES.get(model.geom_type[geom])
    if shape is None:
        return
    visual = ET.SubElement(link, "visual", {"name": f"geom{geom}"})
    frame_pose(visual, pose_at(model.geom_pos[geom], model.geom_quat[geom]))
    made = ET.SubElement(ET.SubElement(visual, "geometry"), shape)
    size = model.geom_size[geom]
    if shape == "box":
        element(made, "size", numbers(2.0 * size))
        return
    element(made, "radius", size[0])
    if shape != "sphere":
        element(made, "length", 2.0 * float(size[1]))


def write_joint(arm: ET.Element, model: Any, data: Any, body: int) -> None:
    """What holds a body to its parent: a joint with limits and dynamics, or a fixed one."""
    parent, moves = int(model.body_parentid[body]), bool(model.body_jntnum[body])
    j = int(model.body_jntadr[body])
    name = str(model.joint(j).name) or f"joint{j}" if moves else f"{name_of(model, body)}_fixed"
    kind = KINDS[model.jnt_type[j]] if moves else "fixed"
    joint = ET.SubElement(arm, "joint", {"name": name, "type": kind})
    element(joint, "parent", name_of(model, parent) if parent else "world")
    element(joint, "child", name_of(model, body))
    if not moves:
        return
    inward = inverse(body_pose(data, body))
    anchor = inward @ [*data.xanchor[j], 1.0]
    frame_pose(joint, pose_at(anchor[:3]))
    axis = ET.SubElement(joint, "axis")
    element(axis, "xyz", numbers(inward[:3, :3] @ data.xaxis[j]))
    limit = ET.SubElement(axis, "limit")
    ends = model.jnt_range[j] if model.jnt_limited[j] else (-UNLIMITED, UNLIMITED)
    element(limit, "lower", ends[0])
    element(limit, "upper", ends[1])
    if model.jnt_actfrclimited[j]:
        element(limit, "effort", np.abs(model.jnt_actfrcrange[j]).max())
    dynamics = ET.SubElement(axis, "dynamics")
    dof = int(model.jnt_dofadr[j])
    element(dynamics, "damping", 0.0 if braked(model)[j] else model.dof_damping[dof])
    element(dynamics, "friction", model.dof_frictionloss[dof])
    element(dynamics, "spring_reference", model.qpos_spring[model.jnt_qposadr[j]])
    element(dynamics, "spring_stiffness", model.jnt_stiffness[j])


def lost_of(model: Any) -> list[str]:
    """What SDF has no element for, with the joints or links that lose it."""

    def joints(which: Any) -> str:
        held = model.dof_jntid[np.flatnonzero(which)]
        return ", ".join(dict.fromkeys(str(model.joint(int(j)).name) for j in held))

    out = []
    if which := joints(model.dof_armature > 0.0):
        out.append(f"not in the file: rotor inertia (armature) of {which}")
    if which := joints(np.any(np.asarray(model.dof_dampingpoly).reshape(model.nv, -1), axis=1)):
        out.append(f"not in the file: damping that is not proportional to the speed, of {which}")
    if model.nu:
        out.append(f"not in the file: {model.nu} actuators; give Gazebo its own controllers")
    if np.any(model.body_gravcomp > 0.0):
        out.append("not in the file: what the controller does against gravity (gravcomp)")
    if np.any(~np.isin(model.geom_type, list(SHAPES)) & (model.geom_bodyid > 0)):
        out.append("not in the file: meshes; only simple shapes are drawn")
    return out
