"""A given MJCF with the bodies, gains and springs of the calibrated arm; all else stays.

Includes are written out, because a change may lie in any of them.  Each body keeps its place
relative to its own joint axis, so meshes, masses and side branches move with the corrected axis.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.correcting.exporters.correct import NOTED, laid, match, seated
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.ground.files import read_raw
from minimax_cal.robots.gravity import LEAST_MASS, G, masses_of
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import SAME, difference, head, inverse
from minimax_cal.robots.urdf_file import ASSUMED, parse_xml, walk
from minimax_cal.simulators.arm import Arm, assumed, stiff
from minimax_cal.simulators.chain import (
    ROBOT,
    Chain,
    at_zero,
    body_pose,
    mujoco,
    own_pose,
    shifted,
)
from minimax_cal.simulators.elements import Layout, equip, numbers, quaternion, targets
from minimax_cal.simulators.mjcf import weigh

ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
IMPLICIT = (2, 3)  # mjINT_IMPLICIT, mjINT_IMPLICITFAST
DEEPEST = 20  # includes within includes
NESTED = 100  # elements within elements
MOST = {  # what a model of an arm and its cell may hold, and what it is called
    "elements": (10_000.0, "elements, replicated ones too"),
    "body": (1_000.0, "bodies"),
    "freejoint": (50.0, "bodies that float freely"),
    "hfield": (4e6, "<hfield>: cells"),
    "texture": (2e7, "<texture>: pixels"),
    "size": (1e5, "<size>: numbers set aside"),
}


@dataclass(frozen=True, eq=False)
class Given:
    """A model's file.  tree: with its includes written out.  folder: where its assets are.

    assumed: whether it says itself that its masses are.
    """

    source: str
    tree: ET.Element
    folder: Path
    assumed: bool = False

    def compiled(self, tree: ET.Element | None = None) -> Any:
        """The model as MuJoCo sees it.  Raises RobotError."""
        text = ET.tostring(assets_from(self.tree if tree is None else tree, self.folder.resolve()))
        try:
            return mujoco().MjModel.from_xml_string(text.decode())
        except (ValueError, RuntimeError) as error:
            raise RobotError(f"{self.source}: MuJoCo refuses it: {one(error)}") from error


def one(error: Exception) -> str:
    """A message in one line."""
    return " ".join(str(error).split())


def read_model(path: Path | str) -> Given:
    """An MJCF, or a URDF as MuJoCo takes it.  Raises RobotError."""
    path = Path(path)
    raw = read_raw(path, kind=RobotError)
    top = parse_xml(raw, str(path))
    if top.tag == "robot":
        marked = any(ASSUMED in element.attributes for element in walk(top))
        return Given(str(path), from_urdf(path), path.parent, marked)
    if top.tag != "mujoco":
        raise RobotError(f"{path}: is neither MJCF nor URDF: its root is <{top.tag}>")
    tree = written_out(path, path.parent, 0)
    check_size(tree, str(path))
    return Given(str(path), tree, path.parent)


def check_size(tree: ET.Element, source: str) -> None:
    """Raise RobotError for what fills any memory, or never ends, once MuJoCo makes it.

    Elements count as often as what they stand in is replicated.
    """
    kinds, stack = dict.fromkeys(MOST, 0.0), [(tree, 1.0, 0)]
    while stack:
        element, times, depth = stack.pop()
        tag = str(element.tag)
        if depth > NESTED:
            raise RobotError(f"{source}: elements within elements, {NESTED} deep: no arm is so")
        times *= product(element.get("count"))
        told = {"elements": times, tag: times}
        if tag == "joint" and element.get("type") == "free":
            told["freejoint"] = times
        if tag == "hfield":
            told[tag] = product(element.get("nrow")) * product(element.get("ncol"))
        if tag == "texture":
            told[tag] = product(element.get("width")) * product(element.get("height"))
        if tag == "size":
            told[tag] = max([1.0, *(product(v) for k, v in element.items() if k != "memory")])
        for kind, amount in told.items():
            if kind in kinds:
                kinds[kind] += amount
        stack += [(child, times, depth + 1) for child in element]
    for kind, amount in kinds.items():
        if not amount <= MOST[kind][0]:
            what, most = MOST[kind][1], MOST[kind][0]
            raise RobotError(f"{source}: {what}: {amount:.3g}, at most {most:g} are taken")


def product(text: str | None) -> float:
    """Of the numbers of an attribute; 1 without it, or where MuJoCo will refuse it."""
    try:
        return float(np.prod([abs(float(word)) for word in (text or "1").split()]))
    except ValueError:
        return 1.0


def parsed(path: Path) -> ET.Element:
    """An XML file with its comments; document types are refused."""
    raw = read_raw(path, kind=RobotError)
    parse_xml(raw, str(path))
    try:
        return ET.fromstring(raw, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    except ET.ParseError as error:  # an encoding that is not the declared one
        raise RobotError(f"{path}: is not XML ({error})") from error


def written_out(path: Path, folder: Path, depth: int) -> ET.Element:
    """A file with what it includes in the place of each <include>."""
    if depth > DEEPEST:
        raise RobotError(f"{path}: includes itself")
    root = parsed(path)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag != "include":
                continue
            name = child.get("file", "")
            found = next((p / name for p in (folder, path.parent) if (p / name).is_file()), None)
            if found is None:
                raise RobotError(f"{path}: includes {name!r}, which is not there")
            at = list(parent).index(child)
            parent.remove(child)
            for i, part in enumerate(written_out(found, folder, depth + 1)):
                parent.insert(at + i, part)
    return root


def from_urdf(path: Path) -> ET.Element:
    """A URDF as MJCF, its bodies with all the digits that MuJoCo's own writer leaves out."""
    try:
        spec = mujoco().MjSpec.from_file(str(path))
        model = spec.compile()
        root = ET.fromstring(spec.to_xml())
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"{path}: MuJoCo refuses it: {one(error)}") from error
    for element in root.iter("body"):
        body = model.body(element.get("name"))
        element.set("pos", numbers(model.body_pos[body.id]))
        element.set("quat", numbers(model.body_quat[body.id]))
    for element in root.iter("joint"):
        if element.get("name"):
            joint = model.joint(element.get("name")).id
            element.set("axis", numbers(model.jnt_axis[joint]))
    return root


def assets_from(tree: ET.Element, folder: Path) -> ET.Element:
    """A copy whose assets are looked for where the given file had them."""
    tree = deepcopy(tree)
    compilers = [c for c in tree if c.tag == "compiler"]
    if not compilers:
        compilers = [ET.Element("compiler")]
        tree.insert(0, compilers[0])
    shared = next((c.get("assetdir") for c in compilers if c.get("assetdir")), "")
    for name in ("meshdir", "texturedir"):
        told = [c.get(name) for c in compilers if c.get(name)]
        place = os.path.join(folder, (told[-1] if told else shared) or "")
        for compiler in compilers:
            compiler.set(name, place)
    return tree


def moved_to(tree: ET.Element, source: Path, path: Path | None) -> ET.Element:
    """The tree for a file at path: as it is beside the given one, else with its asset folders."""
    here = source.resolve()
    if path is None or path.resolve().parent == here or not any(e.get("file") for e in tree.iter()):
        return tree
    return assets_from(tree, Path(os.path.relpath(here, path.resolve().parent)))


def told_masses(chain: Chain, nominal: Robot) -> tuple[Array, Array]:
    """Masses of the model, their centres in the link frames of the fit's robot."""
    base, _ = match(nominal, chain.seen)
    links, seen = laid(nominal, base)[1:], laid(chain.robot, chain.base)[1:]
    com = [
        inverse(a)[:3, :3] @ (b[:3, :3] @ c + b[:3, 3] - a[:3, 3])
        for a, b, c in zip(links, seen, chain.robot.com, strict=True)
    ]
    return chain.robot.mass, np.array(com)


def corrected(
    given: Given, chain: Chain, nominal: Robot, arm: Arm | None, names: Sequence[str] = ()
) -> tuple[ET.Element, tuple[str, ...]]:
    """A copy of the tree with an arm in it, and notices.

    nominal: the robot that the model is.  arm: None for the nominal one, that nothing bends.
    names: of the targets that become sites.
    """
    base, misfit = match(nominal, chain.seen)
    notices = []
    if misfit > NOTED:
        notices.append(
            f"{given.source} and the nominal robot differ by up to {1e3 * misfit:.3g} mm or mrad: "
            "the written model follows the calibrated robot"
        )
    tree = deepcopy(given.tree)
    robot = arm.robot if arm else nominal
    foot = base @ arm.mount if arm else base
    layout = seats(given, tree, chain, (nominal, base), (robot, foot))
    if arm and not chain.gravity and (arm.turn.any() or arm.base or arm.bend):
        raise RobotError(f"{given.source}: has no gravity, so nothing in it can sag; give it some")
    if arm and any("gravcomp" in body.attrib for body in tree.iter("body")):
        notices.append(f"{given.source}: gravcomp of its bodies is set to 0, or nothing would sag")
        for body in tree.iter("body"):
            body.attrib.pop("gravcomp", None)
    if arm and assumed(chain.robot):  # a file of ours: it has no masses of its own
        ours(layout, arm)
    held = stiff(nominal, masses_of(chain.robot, LEAST_MASS))
    arm = in_gravity(arm, chain.gravity) if arm else held
    equip(layout, arm)
    for parent in list(tree.iter("body")):
        for site in [e for e in parent if e.tag == "site" and e.get("name") in ("flange", *names)]:
            parent.remove(site)
    if names:
        targets(layout, arm, names)
    return tree, tuple(notices)


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
    return replace(
        arm,
        turn=arm.turn * factor,
        base=arm.base * factor,
        bend={link: value * factor for link, value in arm.bend.items()},
        sag=arm.sag * factor,
        drawn=arm.drawn * factor,
    )


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
    model, parents = chain.model, {c: p for p in tree.iter() for c in p}
    world = [e for part in tree.iter("worldbody") for e in part.iter("joint")]
    named = {e.get("name"): e for e in world if e.get("name")}
    missing = [name or "one without a name" for name in chain.names if name not in named]
    if missing or len(set(chain.bodies)) < len(chain.bodies):
        what = f"joint {missing[0]}" if missing else "two joints on one body"
        raise RobotError(f"{given.source}: {what}: give each joint a name and a body of its own")
    joints = [named[name] for name in chain.names]
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
        ref = float(model.qpos0[model.jnt_qposadr[chain.joints[i]]])
        motion = joint.motion(np.array([ref]))[0]
        place(given, bodies[i], parents, inverse(here) @ at @ motion @ inverse(anchor), chain, i)
    return Layout(
        root=tree,
        names=chain.names,
        bodies=tuple(bodies),
        joints=tuple(joints),
        seats=np.array(out),
        anchors=np.array([model.jnt_pos[j] for j in chain.joints]),
        axes=np.array([model.jnt_axis[j] for j in chain.joints]),
        implicit=int(model.opt.integrator) in IMPLICIT,
        degrees=compiler_of(given).get("angle", "degree") == "degree",
    )


def compiler_of(given: Given) -> dict[str, str]:
    """Attributes of the <compiler>, the last word of several."""
    out: dict[str, str] = {}
    for element in given.tree:
        if element.tag == "compiler":
            out |= element.attrib
    return out


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
    compiled = own_pose(
        {"pos": numbers(model.body_pos[number]), "quat": numbers(model.body_quat[number])}, {}
    )
    if difference(compiled, pose) <= SAME * 10.0:
        return
    if parents[body].tag not in ("body", "worldbody"):
        own = own_pose(body.attrib, compiler_of(given))
        pose = own @ inverse(compiled) @ pose
    for name in ORIENTATIONS:
        body.attrib.pop(name, None)
    body.set("pos", numbers(pose[:3, 3]))
    body.set("quat", numbers(quaternion(pose)))
