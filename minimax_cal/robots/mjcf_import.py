"""MJCF in: a file with what it includes, and the links and joints that MuJoCo makes of it."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from os import path as paths
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.core.files import read_bytes
from minimax_cal.core.optional_packages import import_optional
from minimax_cal.robots.transforms import build_transform, invert_transform
from minimax_cal.robots.urdf_file import (
    ASSUMED_MASS_ATTRIBUTE,
    DEFAULT_UP_VECTOR,
    MOVING_JOINT_KINDS,
    Mimic,
    Urdf,
    UrdfJoint,
    list_elements_below,
    parse_xml_without_entities,
)
from minimax_cal.robots.xml_document import (
    MAX_ELEMENT_DEPTH,
    TOO_DEEP_MESSAGE,
    XmlDocument,
    read_xml_with_includes,
)

MUJOCO_JOINT_KINDS = (
    "floating",
    "ball",
    "prismatic",
    "revolute",
)  # of MuJoCo's joints, by mjtJoint
MUJOCO_JOINT_EQUALITY = 2  # mjEQ_JOINT
MUJOCO_TENDON_TRANSMISSION = 3  # mjTRN_TENDON
LOG = logging.getLogger("minimax_cal")
MAX_MODEL_COUNTS = {  # what a model of an arm and its cell may hold, and what it is called
    "elements": (10_000.0, "elements, replicated ones too"),
    "body": (1_000.0, "bodies"),
    "freejoint": (50.0, "bodies that float freely"),
    "hfield": (4e6, "<hfield>: cells"),
    "texture": (2e7, "<texture>: pixels"),
    "size": (1e5, "<size>: numbers set aside"),
}


def import_mujoco() -> Any:
    """The package, whose warnings would go to a file.  Raises OptionError without it."""
    found = import_optional("mujoco", "a simulator's model", "minimax-cal[mujoco]")
    if found.get_mju_user_warning() is None:
        found.set_mju_user_warning(LOG.info)
    return found


@dataclass(frozen=True, eq=False)
class MjcfModel:
    """A model's file.  document: with all that it includes.  folder: where its assets are.

    assumed: whether it says itself that its masses are.
    """

    source: str
    document: XmlDocument
    folder: Path
    assumed: bool = False

    def compile_model(self, tree: ET.Element | None = None) -> Any:
        """The model as MuJoCo sees it.  Raises RobotError."""
        whole = copy_with_asset_directories(
            self.document.root if tree is None else tree, self.folder.resolve()
        )
        try:
            return compile_without_lost_meshes(whole)
        except (ValueError, RuntimeError) as error:
            raise RobotError(
                f"{self.source}: MuJoCo refuses it: {error_in_one_line(error)}"
            ) from error


def compile_without_lost_meshes(tree: ET.Element) -> Any:
    """The model of a tree; where MuJoCo refuses it, without meshes whose files are missing.

    Masses and motions are those of <inertial>: a mesh is needed only by a body that has none.
    Raises ValueError or RuntimeError.
    """
    mj = import_mujoco()
    try:
        return mj.MjModel.from_xml_string(ET.tostring(tree).decode())
    except (ValueError, RuntimeError):
        if not drop_lost_meshes(tree):
            raise
        return mj.MjModel.from_xml_string(ET.tostring(tree).decode())


def drop_lost_meshes(tree: ET.Element) -> bool:
    """Take meshes and textures without a file from a tree, with what shows them; whether any is."""
    compilers = list(tree.iter("compiler"))
    if any(one.get("inertiafromgeom") == "true" for one in compilers):
        return False
    folders = {kind: next((one.get(f"{kind}dir", "") for one in compilers), "")
               for kind in ("mesh", "texture")}  # fmt: skip
    lost = [
        (asset, element) for asset in tree.iter("asset") for element in asset
        if element.tag in folders and (file := element.get("file"))
        and not Path(folders[element.tag], file).exists()
    ]  # fmt: skip
    names = {"mesh": set[str](), "texture": set[str]()}
    for _, element in lost:
        names[element.tag].add(element.get("name", Path(element.get("file", "")).stem))
    for body in tree.iter("body"):
        for geom in body.findall("geom") if body.find("inertial") is not None else ():
            if geom.get("mesh") in names["mesh"]:
                body.remove(geom)
    for material in tree.iter("material"):
        if material.get("texture") in names["texture"]:
            del material.attrib["texture"]
    needed = {geom.get("mesh") for geom in tree.iter("geom")}
    for asset, element in lost:
        if element.get("name", Path(element.get("file", "")).stem) not in needed:
            asset.remove(element)
    return bool(lost)


def error_in_one_line(error: Exception) -> str:
    """A message in one line."""
    return " ".join(str(error).split())


def read_mujoco_model(path: Path | str) -> MjcfModel:
    """An MJCF, or a URDF as MuJoCo takes it.  Raises RobotError."""
    path = Path(path)
    raw = read_bytes(path, error_type=RobotError)
    top = parse_xml_without_entities(raw, str(path))
    if top.tag == "robot":
        marked = any(
            ASSUMED_MASS_ATTRIBUTE in element.attributes for element in list_elements_below(top)
        )
        tree = convert_urdf_to_mjcf(path, with_effort_limits=not marked)
        return MjcfModel(str(path), XmlDocument(tree), path.parent, marked)
    if top.tag != "mujoco":
        raise RobotError(f"{path}: is neither MJCF nor URDF: its root is <{top.tag}>")
    document = read_xml_with_includes(path)
    check_model_size(document.root, str(path))
    return MjcfModel(str(path), document, path.parent)


def check_model_size(tree: ET.Element, source: str) -> None:
    """Raise RobotError for what fills any memory, or never ends, once MuJoCo makes it.

    Elements count as often as what they stand in is replicated.
    """
    kinds, stack = dict.fromkeys(MAX_MODEL_COUNTS, 0.0), [(tree, 1.0, 0)]
    while stack:
        element, times, depth = stack.pop()
        tag = str(element.tag)
        if depth > MAX_ELEMENT_DEPTH:
            raise RobotError(f"{source}: {TOO_DEEP_MESSAGE}")
        times *= product_of_attribute(element.get("count"))
        told = {"elements": times, tag: times}
        if tag == "joint" and element.get("type") == "free":
            told["freejoint"] = times
        if tag == "hfield":
            told[tag] = product_of_attribute(element.get("nrow")) * product_of_attribute(
                element.get("ncol")
            )
        if tag == "texture":
            told[tag] = product_of_attribute(element.get("width")) * product_of_attribute(
                element.get("height")
            )
        if tag == "size":
            told[tag] = max(
                [1.0, *(product_of_attribute(v) for k, v in element.items() if k != "memory")]
            )
        for kind, amount in told.items():
            if kind in kinds:
                kinds[kind] += amount
        stack += [(child, times, depth + 1) for child in element]
    for kind, amount in kinds.items():
        if not amount <= MAX_MODEL_COUNTS[kind][0]:
            what, most = MAX_MODEL_COUNTS[kind][1], MAX_MODEL_COUNTS[kind][0]
            raise RobotError(f"{source}: {what}: {amount:.3g}, at most {most:g} are taken")


def product_of_attribute(text: str | None) -> float:
    """Of the numbers of an attribute; 1 without it, or where MuJoCo will refuse it."""
    try:
        return float(np.prod([abs(float(word)) for word in (text or "1").split()]))
    except ValueError:
        return 1.0


def convert_urdf_to_mjcf(path: Path, *, with_effort_limits: bool) -> ET.Element:
    """A URDF as MJCF, its bodies with all the digits that MuJoCo's own writer leaves out.

    with_effort_limits: whether its limits of effort are any; beside assumed masses they are not.
    """
    mj = import_mujoco()
    try:
        try:
            spec = mj.MjSpec.from_file(str(path))
            model = spec.compile()
        except (ValueError, RuntimeError):
            spec = mj.MjSpec.from_string(read_urdf_without_meshes(path))  # a mesh may be missing
            model = spec.compile()
        root = ET.fromstring(spec.to_xml())
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"{path}: MuJoCo refuses it: {error_in_one_line(error)}") from error
    for element in root.iter("body"):
        body = model.body(element.get("name"))
        element.set("pos", format_exact_numbers(model.body_pos[body.id]))
        element.set("quat", format_exact_numbers(model.body_quat[body.id]))
    for element in root.iter("joint"):
        if element.get("name"):
            joint = model.joint(element.get("name")).id
            element.set("axis", format_exact_numbers(model.jnt_axis[joint]))
        if not with_effort_limits:
            element.attrib.pop("actuatorfrcrange", None)
    return root


def read_urdf_without_meshes(path: Path) -> str:
    """The text of a URDF without the meshes of links whose masses it gives.  Raises RobotError."""
    root = ET.fromstring(read_bytes(path, error_type=RobotError))
    for link in root.iter("link"):
        if link.find("inertial") is not None:
            for shape in (*link.findall("visual"), *link.findall("collision")):
                if shape.find("geometry/mesh") is not None:
                    link.remove(shape)
    return ET.tostring(root, encoding="unicode")


def copy_with_asset_directories(tree: ET.Element, asset_folder: Path) -> ET.Element:
    """A copy whose assets are looked for where the given file had them."""
    tree = deepcopy(tree)
    set_asset_directories(tree, asset_folder)
    return tree


def set_asset_directories(tree: ET.Element, asset_folder: Path) -> None:
    """Tell a tree where its assets are."""
    compilers = [c for c in tree if c.tag == "compiler"]
    if not compilers:
        compilers = [ET.Element("compiler")]
        tree.insert(0, compilers[0])
    shared = next((c.get("assetdir") for c in compilers if c.get("assetdir")), "")
    for name in ("meshdir", "texturedir"):
        told = [c.get(name) for c in compilers if c.get(name)]
        place = paths.join(asset_folder, (told[-1] if told else shared) or "")
        for compiler in compilers:
            compiler.set(name, place)


def read_mjcf(path: Path | str) -> Urdf:
    """The links and joints of an MJCF.  Raises RobotError.

    Where actuators drive joints, the others are not the controller's: they follow a driven one,
    where an equality says so, or stay where the file has them.
    """
    model = read_mujoco_model(path).compile_model()
    arms = [
        j for j in range(model.njnt) if MUJOCO_JOINT_KINDS[model.jnt_type[j]] in MOVING_JOINT_KINDS
    ]
    driven = {joint for joint in arms if has_actuator(model, joint)}
    held = set(arms) - driven if driven else set()
    moving = set(range(model.njnt)) - held
    mimics = {
        j: mimic
        for j, other, mimic in find_linear_joint_couplings(model)
        if j in held and other in moving
    }
    left = ", ".join(joint_name(model, joint) for joint in sorted(held - mimics.keys())[:8])
    said = f"{path}: no actuator drives these joints; they stay where the file has them: {left}"
    tree = convert_model_to_urdf(model, str(path), moving | mimics.keys(), mimics)
    return replace(tree, notices=(said,) if left else ())


def convert_model_to_urdf(
    model: Any,
    source: str,
    moving_joint_ids: Collection[int],
    mimics: Mapping[int, Mimic] | None = None,
) -> Urdf:
    """The bodies and sites of a compiled model as links, the world first.

    moving_joint_ids: ids of its joints that count; the others stay where the file has them.  The
    link of a joint lies at the joint's anchor, in the axes of its body.
    """
    data = import_mujoco().MjData(model)
    import_mujoco().mj_kinematics(model, data)
    names = [body_name(model, body) for body in range(model.nbody)]
    poses, joints = [body_pose(data, body) for body in range(model.nbody)], list[UrdfJoint]()
    masses, inertias = {}, {}
    for body in range(1, model.nbody):
        above, first = int(model.body_parentid[body]), int(model.body_jntadr[body])
        parent, frame = names[above], invert_transform(poses[above]) @ poses[body]
        for number in range(first, first + int(model.body_jntnum[body])):
            if number in moving_joint_ids:
                joint = build_urdf_joint(model, number, parent, frame)
                joints.append(replace(joint, mimic=(mimics or {}).get(number)))
                parent, frame = joint.child, translation_to_point(-model.jnt_pos[number])
        if parent != names[body]:
            joints.append(build_fixed_joint(parent, names[body], frame))
        if model.body_mass[body] > 0.0:
            inward = invert_transform(poses[body])
            turn = inward[:3, :3] @ data.ximat[body].reshape(3, 3)
            centre = inward[:3, :3] @ data.xipos[body] + inward[:3, 3]
            masses[names[body]] = float(model.body_mass[body]), centre
            if model.body_inertia[body].any():
                inertias[names[body]] = turn @ np.diag(model.body_inertia[body]) @ turn.T
    for site in range(model.nsite):
        name, body = model.site(site).name, int(model.site_bodyid[site])
        if name and name not in names:
            pose = build_transform(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])
            joints.append(
                build_fixed_joint(names[body], name, invert_transform(poses[body]) @ pose)
            )
    size = float(np.linalg.norm(model.opt.gravity))
    up = -model.opt.gravity / size if size else DEFAULT_UP_VECTOR
    return Urdf(source, b"", Path(source).stem, "world", tuple(joints), masses, inertias, up)


def build_urdf_joint(model: Any, joint_id: int, parent_link: str, body_frame: Array) -> UrdfJoint:
    """A joint on a link, at its value 0.  body_frame: (4, 4) its body in that, at its reference
    [m].
    """
    kind, name = MUJOCO_JOINT_KINDS[int(model.jnt_type[joint_id])], joint_name(model, joint_id)
    body = int(model.jnt_bodyid[joint_id])
    last = joint_id + 1 == model.body_jntadr[body] + model.body_jntnum[body]
    whole = last and not model.jnt_pos[joint_id].any()
    limited = kind in MOVING_JOINT_KINDS and bool(model.jnt_limited[joint_id])
    joint = UrdfJoint(
        name=name,
        kind="continuous" if kind == "revolute" and not limited else kind,
        parent=parent_link,
        child=body_name(model, body) if whole else f"{name} (axis)",
        origin=body_frame @ translation_to_point(model.jnt_pos[joint_id]),
        axis=np.array(model.jnt_axis[joint_id]),
        lower=float(model.jnt_range[joint_id, 0]) if limited else -np.inf,
        upper=float(model.jnt_range[joint_id, 1]) if limited else np.inf,
        mimic=None,
    )
    if not joint.is_moving:
        return joint
    return replace(
        joint,
        origin=joint.origin @ joint.motion_transforms(-joint_reference_value(model, joint_id))[0],
    )


def build_fixed_joint(parent: str, child: str, origin: Array) -> UrdfJoint:
    """A link that stays where it is in another: origin (4, 4) [m]."""
    return UrdfJoint(
        f"to {child}", "fixed", parent, child, origin, np.zeros(3), -np.inf, np.inf, None
    )


def body_name(model: Any, body_id: int) -> str:
    """Of a body, also of one without a name; the world is body 0."""
    return str(model.body(body_id).name or f"body {body_id}")


def joint_name(model: Any, joint_id: int) -> str:
    """Of a joint, also of one without a name."""
    return str(model.joint(joint_id).name or f"joint {joint_id + 1}")


def joint_reference_value(model: Any, joint_id: int) -> Array:
    """(1,) the value at which a joint stands as its file has it [rad, m]."""
    return np.array(model.qpos0[[model.jnt_qposadr[joint_id]]])


def find_linear_joint_couplings(model: Any) -> list[tuple[int, int, Mimic]]:
    """Of the equalities that couple two joints linearly: the one, the other, and how it follows."""
    out = []
    for i in range(model.neq):
        one, other = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        start, slope, *bent = model.eq_data[i, :5].tolist()
        if model.eq_type[i] == MUJOCO_JOINT_EQUALITY and other >= 0 and not any(bent):
            at, from_ = (float(joint_reference_value(model, j)[0]) for j in (one, other))
            follows = Mimic(joint_name(model, other), slope, at + start - slope * from_)
            out.append((one, other, follows))
    return out


def find_joint_path_to_body(model: Any, body_id: int) -> tuple[int, ...]:
    """Ids of the hinges and slides from the world to a body."""
    out: list[int] = []
    while body_id > 0:
        first, number = int(model.body_jntadr[body_id]), int(model.body_jntnum[body_id])
        own = [
            j
            for j in range(first, first + number)
            if MUJOCO_JOINT_KINDS[model.jnt_type[j]] in MOVING_JOINT_KINDS
        ]
        out = [*own, *out]
        body_id = int(model.body_parentid[body_id])
    return tuple(out)


def has_actuator(model: Any, joint_id: int) -> bool:
    """Whether an actuator drives a joint."""
    return any(is_driven_by_actuator(model, i, joint_id) for i in range(model.nu))


def is_driven_by_actuator(model: Any, actuator_id: int, joint_id: int) -> bool:
    """Whether an actuator drives a joint, itself or by a tendon of ours."""
    kind, number = (
        int(model.actuator_trntype[actuator_id]),
        int(model.actuator_trnid[actuator_id, 0]),
    )
    if kind == MUJOCO_TENDON_TRANSMISSION:
        name = model.joint(joint_id).name
        return bool(name) and bool(model.tendon(number).name == f"{name}_drive")
    return kind == 0 and number == joint_id


def body_pose(data: Any, body_id: int) -> Array:
    """(4, 4) of a body in the world [m]."""
    return build_transform(np.array(data.xmat[body_id]).reshape(3, 3), np.array(data.xpos[body_id]))


def translation_to_point(point: Array) -> Array:
    """A translation (4, 4)."""
    return build_transform(np.eye(3), np.asarray(point, dtype=float))


def format_exact_numbers(values: ArrayLike) -> str:
    """Numbers as they are read back."""
    return " ".join(repr(float(v) + 0.0) for v in np.ravel(values))
