"""The XML tree of a MuJoCo model: its sections, joints, actuators, and attributes as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.robots.mjcf_import import format_exact_numbers, import_mujoco
from minimax_cal.simulators.chain import ORIENTATION_ATTRIBUTES, ModelArm, pose_in_parent


def format_attributes(attributes: Mapping[str, object]) -> dict[str, str]:
    """Attributes as text; arrays become numbers that read back as the same ones."""
    return {
        key: value
        if isinstance(value, str)
        else format_exact_numbers(np.asarray(value, dtype=float))
        for key, value in attributes.items()
    }


def add_element(parent: ET.Element, tag: str, **attributes: object) -> ET.Element:
    """A new element, the last one of its parent."""
    return ET.SubElement(parent, tag, format_attributes(attributes))


def set_element(parent: ET.Element, tag: str, name: str = "", **attributes: object) -> ET.Element:
    """The element of a name in its parent, with these attributes; added where there is none."""
    for element in parent.findall(tag):
        if element.get("name", "") == name:
            element.attrib |= format_attributes(attributes)
            return element
    return add_element(parent, tag, **({"name": name} if name else {}), **attributes)


def pose_attributes(pose: Array) -> dict[str, str]:
    """Attributes of an element at a pose (4, 4), w of the quaternion first."""
    turn = Rotation.from_matrix(pose[:3, :3])
    return format_attributes({"pos": pose[:3, 3], "quat": turn.as_quat(scalar_first=True)})


@dataclass(frozen=True, eq=False)
class MjcfTree:
    """The elements of an MJCF.  root: <mujoco>."""

    root: ET.Element

    def to_bytes(self) -> bytes:
        """The text of a file, indented."""
        ET.indent(self.root)
        return bytes(ET.tostring(self.root, encoding="utf-8", xml_declaration=True)) + b"\n"

    def section_or_new(self, tag: str) -> ET.Element:
        """The first section of a tag, added where there is none."""
        found = self.root.find(tag)
        return ET.SubElement(self.root, tag) if found is None else found

    def find_parents(self) -> dict[ET.Element, ET.Element]:
        """The parent of every element below the root."""
        return {child: parent for parent in self.root.iter() for child in parent}

    def find_joints(self, chain: ModelArm) -> list[ET.Element]:
        """The elements of an arm's joints, from the foot.

        Raises RobotError for joints without a name, and for two on one body.
        """
        world = [e for part in self.root.iter("worldbody") for e in part.iter("joint")]
        named = {e.get("name"): e for e in world if e.get("name")}
        missing = [name or "one without a name" for name in chain.joint_names if name not in named]
        if missing or len(set(chain.body_ids)) < len(chain.body_ids):
            what = f"joint {missing[0]}" if missing else "two joints on one body"
            source = chain.urdf_robot.urdf.source
            raise RobotError(f"{source}: {what}: give each joint a name and a body of its own")
        return [named[name] for name in chain.joint_names]

    def find_actuators(self, joint: str) -> list[ET.Element]:
        """The actuators that drive a joint of a name."""
        every = [e for part in self.root.iter("actuator") for e in part]
        return [e for e in every if e.get("joint") == joint]

    def servo_or_new(self, joint: str) -> ET.Element:
        """The position actuator of a joint; a new one of a free name where there is none."""
        actuators, name = self.section_or_new("actuator"), joint
        for element in actuators:
            if element.get("joint") == joint and element.tag in ("position", "general"):
                return element
        while any(element.get("name") == name for element in self.root.findall("actuator/*")):
            name += "_servo"
        return ET.SubElement(actuators, "position", {"name": name, "joint": joint})

    def remove_elements(self, section: str, tag: str, name: str) -> None:
        """Remove the elements of a name from all sections of a tag."""
        for holder in self.root.iter(section):
            for old in [e for e in holder.findall(tag) if e.get("name") == name]:
                holder.remove(old)

    @property
    def compiler(self) -> dict[str, str]:
        """Attributes of <compiler>, the last value of several."""
        attributes: dict[str, str] = {}
        for element in self.root.findall("compiler"):
            attributes |= element.attrib
        return attributes

    def read_pose(self, element: ET.Element) -> Array:
        """(4, 4) that the attributes of an element say, in whatever form, in its parent [m]."""
        said, compiler = element.attrib, self.compiler
        pose = " ".join(f'{k}="{said[k]}"' for k in ("pos", *ORIENTATION_ATTRIBUTES) if k in said)
        units = " ".join(f'{k}="{compiler[k]}"' for k in ("angle", "eulerseq") if k in compiler)
        text = f"<mujoco><compiler {units}/><worldbody><body {pose}/></worldbody></mujoco>"
        return pose_in_parent(import_mujoco().MjModel.from_xml_string(text), 1)

    @property
    def uses_degrees(self) -> bool:
        """Whether the file gives angles in degrees."""
        return self.compiler.get("angle", "degree") == "degree"
