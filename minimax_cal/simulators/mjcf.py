"""MJCF out: a new file of a calibrated arm, or a given one with the arm in it; all else stays.

The world of a new file is the robot's base frame, in metres and radians; joint values are the
controller's.  In a given one each body keeps its place relative to its own joint axis, so meshes,
masses and side branches move with the corrected axis.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.correcting.exporters.correct import NOTED, laid, match, seated
from minimax_cal.correcting.exporters.job import Export, Job, origins
from minimax_cal.correcting.exporters.urdf import assumptions, in_link
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError, RobotError
from minimax_cal.ground.files import json_text, write_whole
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.robots.document import Document, Writing
from minimax_cal.robots.gravity import LEAST_MASS, G, inertia_of, masses_of
from minimax_cal.robots.mjcf import Given, body_pose, find_assets, mujoco, read_model, shifted
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints
from minimax_cal.robots.transforms import SAME, difference, head, inverse, tail
from minimax_cal.simulators.arm import Arm, arm_of, assumed, held_terms, sample, stiff
from minimax_cal.simulators.chain import (
    ROBOT,
    TURNS,
    Chain,
    at_zero,
    braked,
    chain_of,
    own_pose,
    pose_at,
)
from minimax_cal.simulators.drive import Written
from minimax_cal.simulators.elements import (
    SAMPLES,
    Drives,
    Layout,
    as_text,
    at_pose,
    equip,
    known,
    parents_of,
    part,
    targets,
)

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
        body = part(parent, "body", name=f"link{i + 1}", **at_pose(at))
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


# ---- a given file --------------------------------------------------------------------------------


IMPLICIT = (2, 3)  # mjINT_IMPLICIT, mjINT_IMPLICITFAST


def content_for(
    document: Document, source: Path, path: Path | None
) -> tuple[bytes, dict[str, bytes]]:
    """The file of a changed document at path: beside the given one its text but for the changes.

    Elsewhere it says where its assets are.  What it includes and what changed is in files of their
    own, by the ending that takes the place of the path's.  source: folder of the given file.
    """
    here = source.resolve()
    away = path is not None and path.resolve().parent != here
    if away and path is not None and any(e.get("file") for e in document.root.iter()):
        find_assets(document.root, Path(os.path.relpath(here, path.resolve().parent)))
    if not document.pieces:
        return text_of(document.root), {}
    how = Writing(away, path.stem if path else "")
    return document.raw(how), how.beside


def write_document(document: Document, source: Path, path: Path) -> None:
    """Write a changed document to a path, and what it includes and changed beside it."""
    content, beside = content_for(document, source, path)
    for ending, text in beside.items():
        write_whole(path.with_suffix(ending), text)
    write_whole(path, content)


def own_masses(chain: Chain, nominal: Robot) -> tuple[Array, Array] | None:
    """Masses of the model, their centres in the link frames of the fit's robot; None if assumed."""
    if assumed(chain.robot):
        return None
    base, _ = match(nominal, chain.seen)
    links, seen = laid(nominal, base)[1:], laid(chain.robot, chain.base)[1:]
    com = [
        inverse(a)[:3, :3] @ (b[:3, :3] @ c + b[:3, 3] - a[:3, 3])
        for a, b, c in zip(links, seen, chain.robot.com, strict=True)
    ]
    return chain.robot.mass, np.array(com)


def corrected(
    given: Given,
    chain: Chain,
    nominal: Robot,
    arm: Arm | None,
    names: Sequence[str] = (),
    *,
    driven: bool = True,
) -> tuple[Document, tuple[str, ...]]:
    """A copy of the model with an arm in it, and notices.

    nominal: the robot that the model is.  arm: None for the nominal one, that nothing bends.
    names: of the targets that become sites.  driven: as in `elements.equip`.
    """
    base, misfit = match(nominal, chain.seen)
    notices = []
    if misfit > NOTED:
        notices.append(
            f"{given.source} and the nominal robot differ by up to {1e3 * misfit:.3g} mm or mrad: "
            "the written model follows the calibrated robot"
        )
    document = given.document.copy()
    tree = document.root
    robot = arm.robot if arm else nominal
    foot = base @ arm.mount if arm else base
    layout = seats(given, tree, chain, (nominal, base), (robot, foot))
    if arm and not chain.gravity and (arm.turn.any() or arm.base or arm.bend):
        raise RobotError(f"{given.source}: has no gravity, so nothing in it can sag; give it some")
    if arm and assumed(chain.robot):  # a file of ours: it has no masses of its own
        ours(layout, arm)
    held = stiff(nominal, masses_of(chain.robot, LEAST_MASS))
    arm = in_gravity(arm, chain.gravity) if arm else held
    equip(layout, arm, driven=driven)
    if names:
        targets(layout, arm, names)
    lengthen_keys(given, tree, chain.model)
    return document, tuple(notices)


def lengthen_keys(given: Given, tree: ET.Element, model: Any) -> None:
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


def ours(layout: Layout, arm: Arm) -> None:
    """Masses and robot in a file of this project, whose bodies are those of the robot's joints."""
    for i, body in enumerate(layout.bodies):
        weigh(body, arm, i)
    for text in layout.root.iter("text"):
        if text.get("name") == ROBOT:
            text.set("data", json.dumps(arm.robot.to_dict()))


def in_gravity(arm: Arm, gravity: float) -> Arm:
    """The same sag under another gravity [m/s^2]."""
    factor = G / gravity if gravity else 1.0
    scaled = {name: getattr(arm, name) * factor for name in ("turn", "base", "sag", "drawn")}
    return replace(arm, bend={i: value * factor for i, value in arm.bend.items()}, **scaled)


def seats(
    given: Given,
    tree: ET.Element,
    chain: Chain,
    nominal: tuple[Robot, Array],
    robot: tuple[Robot, Array],
) -> Layout:
    """Put the bodies of a tree where the calibrated robot has them, and tell where they are.

    nominal, robot: each with its frame 0 in the world (4, 4) [m].
    """
    model, parents = chain.model, parents_of(tree)
    joints = elements_of(tree, chain)
    bodies = [parents[joint] for joint in joints]
    for number, element in zip(chain.joints, joints, strict=True):
        if model.jnt_stiffness[number]:  # its own, or of its class
            element.set("stiffness", "0")
    moving = [joint for joint in chain.seen.chain if joint.moves]
    data = at_zero(model, chain.joints)
    old = [body_pose(data, b) for b in chain.bodies]
    new, out = [], []
    before, placed = laid(*nominal), laid(*robot)
    for i, joint in enumerate(moving):
        anchor = shifted(model.jnt_pos[chain.joints[i]])
        link = seated(inverse(before[i]) @ old[i] @ anchor, joint, nominal[0].sign[i])
        at = placed[i] @ link
        new.append(at @ inverse(anchor))
        out.append(inverse(new[i]) @ placed[i] @ head(robot[0].mdh[i]))
        parent = int(model.body_parentid[chain.bodies[i]])
        here = body_pose(data, parent)
        if i:
            here = new[i - 1] @ inverse(old[i - 1]) @ here
        ref = model.qpos0[[model.jnt_qposadr[chain.joints[i]]]]
        motion = joint.motion(ref)[0]
        place(given, bodies[i], parents, inverse(here) @ at @ motion @ inverse(anchor), chain, i)
    return Layout(
        root=tree,
        names=chain.names,
        bodies=tuple(bodies),
        joints=tuple(joints),
        seats=np.array(out),
        anchors=model.jnt_pos[list(chain.joints)],
        axes=model.jnt_axis[list(chain.joints)],
        drives=drives_of(chain),
        degrees=counts_degrees(given.document.root),
    )


def elements_of(root: ET.Element, chain: Chain) -> list[ET.Element]:
    """The elements of an arm's joints.  Raises RobotError."""
    world = [e for part in root.iter("worldbody") for e in part.iter("joint")]
    named = {e.get("name"): e for e in world if e.get("name")}
    missing = [name or "one without a name" for name in chain.names if name not in named]
    if missing or len(set(chain.bodies)) < len(chain.bodies):
        what = f"joint {missing[0]}" if missing else "two joints on one body"
        source = chain.seen.urdf.source
        raise RobotError(f"{source}: {what}: give each joint a name and a body of its own")
    return [named[name] for name in chain.names]


def servos_of(chain: Chain) -> tuple[Array, Array, Array]:
    """Gains and dampers (n,) of a model's servos at the joints, limits (n, 2) of their torques."""
    model, n = chain.model, len(chain.joints)
    gain, damper, limits = np.zeros(n), np.zeros(n), np.array([[-np.inf, np.inf]] * n)
    for i, (joint, servo) in enumerate(zip(chain.joints, chain.servos, strict=True)):
        if model.jnt_actfrclimited[joint]:
            limits[i] = model.jnt_actfrcrange[joint]
        if servo < 0:
            continue
        gear = model.actuator_gear[servo, 0]
        gain[i], damper[i] = -model.actuator_biasprm[servo, 1:3] * gear**2
        if model.actuator_forcelimited[servo]:
            ends = np.sort(model.actuator_forcerange[servo] * gear)
            limits[i] = max(limits[i, 0], ends[0]), min(limits[i, 1], ends[1])
    return gain, damper, limits


def drives_of(chain: Chain) -> Drives:
    """The servos of a model as MuJoCo sees them."""
    model, own = chain.model, chain.model.dof_damping[chain.dofs]
    gain, damper, limits = servos_of(chain)
    floating = model.body_gravcomp[list(chain.bodies)] > 0.0
    free = bool(floating.any() and not model.jnt_actgravcomp[list(chain.joints)].any())
    return Drives(
        gain, damper + own, own, limits, largest_inertia(chain),
        braked(model)[list(chain.joints)] | (model.opt.integrator not in IMPLICIT),
        chain.step, free,
    )  # fmt: skip


def check_limits(chain: Chain, q: Array, source: str) -> None:
    """Raise RobotError where gravity alone asks for more than a joint's force limit.

    q: (m, n) poses that the arm is to hold [rad, m].
    """
    drives = drives_of(chain)
    if drives.gravity_free:
        return
    mj, model, data, at, dofs = chain.fresh()
    for row in q:
        data.qpos[at] = row
        mj.mj_forward(model, data)
        needed = data.qfrc_bias[dofs]
        short = (needed <= drives.limits[:, 0]) | (needed >= drives.limits[:, 1])
        if short.any():
            i = int(np.argmax(short))
            unit = "N" if chain.robot.prismatic[i] else "N m"
            most = np.abs(drives.limits[i]).min()
            raise RobotError(
                f"{source}: joint {chain.names[i]}: gravity asks for {abs(needed[i]):.4g} {unit} at"
                f" a measured pose, its force limit is {most:.4g} {unit}; raise the limit "
                "(forcerange), or mend the masses"
            )


def largest_inertia(chain: Chain) -> Array:
    """(n,) about each joint, its motor's with it, over poses all over the workspace [kg m^2]."""
    mj, model, data, at, dofs = chain.fresh()
    column, out = np.zeros(model.nv), np.zeros(len(dofs))
    for row in random_joints(chain.robot, (SAMPLES,), np.random.default_rng(0)):
        data.qpos[at] = row
        mj.mj_forward(model, data)
        for i, unit in enumerate(np.eye(model.nv)[dofs]):
            mj.mj_mulM(model, data, column, unit)
            out[i] = max(out[i], column[dofs[i]])
    return out


def compiler_of(root: ET.Element) -> dict[str, str]:
    """Attributes of the <compiler>, the last word of several."""
    out: dict[str, str] = {}
    for element in root:
        if element.tag == "compiler":
            out |= element.attrib
    return out


def counts_degrees(root: ET.Element) -> bool:
    """Whether a file counts angles in degrees."""
    return compiler_of(root).get("angle", "degree") == "degree"


def place(
    given: Given,
    body: ET.Element,
    parents: dict[ET.Element, ET.Element],
    pose: Array,
    chain: Chain,
    i: int,
) -> None:
    """Give a body another pose in its parent body; frames around it stay."""
    model, number = chain.model, chain.bodies[i]
    compiled = pose_at(model.body_pos[number], model.body_quat[number])
    if difference(compiled, pose) <= SAME * 10.0:
        return
    if parents[body].tag not in ("body", "worldbody"):
        own = own_pose(body.attrib, compiler_of(given.document.root))
        pose = own @ inverse(compiled) @ pose
    for name in TURNS:
        body.attrib.pop(name, None)
    body.attrib |= as_text(at_pose(pose))


# ---- the exporter `mjcf` -------------------------------------------------------------------------


def write(job: Job) -> Export:
    """A new MJCF, or the given one corrected; a command map beside it where effects need one."""
    if job.model:
        return correct(job)
    cell, arm, content = new_file(job)
    off = None
    if find_spec("mujoco") and cell.target_names:
        chain = chain_of(mujoco().MjModel.from_xml_string(content.decode()), job.robot.joints,
                         job.source)  # fmt: skip
        off = Written(chain, cell, arm, np.eye(4)).off
    return Export(content, (assumptions(job.robot), *told(arm)), beside(cell, arm), off)


def new_file(job: Job) -> tuple[Cell, Arm, bytes]:
    """The arm of a job in its place, its elements, and the MJCF of these."""
    cell = job.cell or Cell(job.robot, np.eye(4), (), np.zeros((0, 3)))
    arm = arm_of(cell, job.q)
    return cell, arm, text_of(new_tree(arm, cell.target_names))


def carries(cell: Cell) -> tuple[Term, ...]:
    """The effects that a simulator has an element for, or that turn joints alone."""
    return held_terms(cell)


def correct(job: Job) -> Export:
    """The MJCF of a job with the calibrated arm in it: with its own masses, unless assumed."""
    if job.cell is None or not job.fitted or job.model is None:
        raise OptionError(
            f"{job.source}: mjcf= is corrected by a calibration: give one, not a robot"
        )
    given = read_model(job.model)
    chain = chain_of(
        given.compiled(), job.robot.joints, given.source, job.tip, unknown=given.assumed
    )
    arm = arm_of(job.cell, job.q, own_masses(chain, job.nominal))
    check_limits(chain, sample(job.robot) if job.q is None else job.q, given.source)
    document, notices = corrected(given, chain, job.nominal, arm, job.cell.target_names)
    made = chain.in_model(given.compiled(document.root))  # before its files are named from there
    content, parts = content_for(document, given.folder, job.path)
    off = Written(made, job.cell, arm, match(job.nominal, chain.seen)[0]).off
    return Export(content, (*notices, *told(arm)), {**parts, **beside(job.cell, arm)}, off)
