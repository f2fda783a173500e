"""A URDF file: its links and joints, and the bytes where their origins stand.

XML is read by expat with document types refused, so no entity is ever defined or fetched.  Every
element remembers its bytes, so that an exporter can change an origin and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.core.files import read_bytes, read_text
from minimax_cal.robots import kinematics
from minimax_cal.robots.transforms import build_transform, transform_from_xyz_rpy

ASSUMED_MASS_ATTRIBUTE = "assumed"  # attribute of an <inertial> of ours whose mass nobody told
MOVING_JOINT_KINDS = ("revolute", "continuous", "prismatic")
DEFAULT_UP_VECTOR: Array = np.array([0.0, 0.0, 1.0])
XML_ATTRIBUTE_PATTERN = re.compile(rb"""([^\s=<>"']+)\s*=\s*("[^"]*"|'[^']*')""")


ByteEdit = tuple[int, int, bytes]  # replace raw[start:end]


@dataclass(frozen=True, eq=False)
class XmlElement:
    """An XML element: start is the byte of its ``<``, end the one after its start tag's ``>``."""

    tag: str
    attributes: Mapping[str, str]
    line: int
    start: int
    end: int
    children: list[XmlElement] = field(default_factory=list)

    def first_child(self, tag: str) -> XmlElement | None:
        """Its first child with a tag."""
        return next((c for c in self.children if c.tag == tag), None)


@dataclass(frozen=True)
class Mimic:
    """A joint that goes multiplier times as far as another one, and an offset [rad, m]."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """origin: (4, 4) of the child link in its parent at joint value 0.  axis: (3,) in the child."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    axis: Array
    lower: float
    upper: float
    mimic: Mimic | None
    element: XmlElement = XmlElement("joint", {}, 0, 0, 0)

    @property
    def is_moving(self) -> bool:
        """Whether it turns or slides."""
        return self.kind in MOVING_JOINT_KINDS

    def motion_transforms(self, q: Array) -> Array:
        """What joint values q (m,) do in the child's frame: (m, 4, 4)."""
        if self.kind == "prismatic":
            return build_transform(np.eye(3), q[:, None] * self.axis)
        return build_transform(kinematics.rotation_from_vector(q[:, None] * self.axis), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Urdf:
    """A file.  masses: kg and centre of gravity in the link's frame [m], of links that have any.

    inertias: (3, 3) about the centre of gravity in the link's axes, of links that have any
    [kg m^2].  up: (3,) vertical in the root.  notices: what of the file is not in it.
    """

    source: str
    raw: bytes
    name: str
    root: str
    joints: tuple[UrdfJoint, ...]
    masses: Mapping[str, tuple[float, Array]]
    inertias: Mapping[str, Array] = field(default_factory=dict)
    up: Array = field(default_factory=DEFAULT_UP_VECTOR.copy)
    notices: tuple[str, ...] = ()

    def joints_on_link(self, link_name: str) -> list[UrdfJoint]:
        """The joints that hang on a link."""
        return [joint for joint in self.joints if joint.parent == link_name]

    def joints_from_root_to_link(self, link_name: str) -> tuple[UrdfJoint, ...]:
        """The joints from the root to a link."""
        by_child, out = {joint.child: joint for joint in self.joints}, []
        while link_name in by_child:
            out.append(by_child[link_name])
            link_name = by_child[link_name].parent
        return tuple(reversed(out))


def parse_xml_without_entities(raw: bytes, source: str) -> XmlElement:
    """The root element.  Raises RobotError for broken XML, a document type or an entity."""
    parser, stack, roots = expat.ParserCreate("utf-8"), list[XmlElement](), list[XmlElement]()

    def refuse(*_: object) -> int:
        raise RobotError(
            f"{source}:{parser.CurrentLineNumber}: has a DOCTYPE or entities, which can reach other"
            " files and are not read; remove them"
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        first = parser.CurrentByteIndex
        last, quote = first, b""
        while quote or raw[last : last + 1] != b">":
            mark = raw[last : last + 1]
            if mark in (b'"', b"'") and quote in (b"", mark):
                quote = b"" if quote else mark
            last += 1
        new = XmlElement(tag, attributes, parser.CurrentLineNumber, first, last + 1)
        (stack[-1].children if stack else roots).append(new)
        stack.append(new)

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.ExternalEntityRefHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    try:
        parser.Parse(raw, True)
    except expat.ExpatError as error:
        what = expat.errors.messages[error.code]
        raise RobotError(f"{source}:{error.lineno}: is not XML ({what})") from error
    return roots[0]


def read_urdf(path: Path | str) -> Urdf:
    """The links and joints of a URDF file.  Raises RobotError."""
    read_text(path, error_type=RobotError)  # says what is wrong with the file or its encoding
    return parse_urdf(read_bytes(path, error_type=RobotError), str(path))


def parse_urdf(raw: bytes, source: str = "URDF") -> Urdf:
    """The links and joints of a URDF.  Raises RobotError."""
    top = parse_xml_without_entities(raw, source)
    if top.tag != "robot":
        raise RobotError(f"{source}: is not a URDF: its root is <{top.tag}>, expected <robot>")
    for child in list_elements_below(top):
        if child.tag.startswith("xacro:"):
            raise RobotError(
                f"{source}:{child.line}: <{child.tag}>: this is xacro, not URDF; "
                "expand it first: xacro FILE > robot.urdf"
            )
    links: dict[str, XmlElement] = {}
    joints: dict[str, UrdfJoint] = {}
    for child in top.children:
        if child.tag not in ("link", "joint"):
            continue
        name = required_attribute(child, "name", source)
        if name in (links if child.tag == "link" else joints):
            raise RobotError(f"{source}:{child.line}: a second {child.tag} {name!r}")
        if child.tag == "link":
            links[name] = child
        else:
            joints[name] = parse_joint(child, name, source)
    root = find_root_link(links, tuple(joints.values()), source)
    masses = {name: parse_link_mass(element, name, source) for name, element in links.items()}
    known = {name: mass for name, mass in masses.items() if mass[0] > 0.0}
    name = top.attributes.get("name", "robot")
    inertias = {link: parse_link_inertia(links[link], link, source) for link in known}
    given = {link: inertia for link, inertia in inertias.items() if inertia.any()}
    return Urdf(source, raw, name, root, tuple(joints.values()), known, given)


def list_elements_below(top: XmlElement) -> list[XmlElement]:
    """An element and all below it."""
    out = [top]
    for element in out:  # grows while it is walked
        out.extend(element.children)
    return out


def required_attribute(element: XmlElement, name: str, source: str) -> str:
    """An attribute that must be there."""
    if not element.attributes.get(name):
        raise RobotError(f"{source}:{element.line}: <{element.tag}> has no {name}")
    return element.attributes[name]


def attribute_numbers(
    element: XmlElement | None, name: str, default: Sequence[float], description: str, source: str
) -> Array:
    """The numbers of an attribute, or the default."""
    if element is None or name not in element.attributes:
        return np.array(default, dtype=float)
    text = element.attributes[name]
    place = f"{source}:{element.line}: {description}: {name}={text[:60]!r}"
    if "${" in text or "$(" in text:
        raise RobotError(f"{place}: is xacro; expand it first: xacro FILE > robot.urdf")
    try:
        found = np.array([float(part) for part in text.split()])
    except ValueError:
        found = np.zeros(0)
    if len(found) != len(default) or not np.all(np.isfinite(found)):
        count = "a number" if len(default) == 1 else f"{len(default)} numbers"
        raise RobotError(f"{place}: expected {count}")
    return found


def parse_joint(element: XmlElement, name: str, source: str) -> UrdfJoint:
    """A <joint>; one whose limits are the same number is fixed there."""
    where, ends = f"joint {name!r}", []
    for tag in ("parent", "child"):
        end = element.first_child(tag)
        if end is None:
            raise RobotError(f"{source}:{element.line}: {where} has no <{tag}>")
        ends.append(required_attribute(end, "link", source))
    kind = required_attribute(element, "type", source)
    if kind not in (*MOVING_JOINT_KINDS, "fixed", "floating", "planar"):
        raise RobotError(f"{source}:{element.line}: {where}: no joint type {kind!r}")
    place, limit = element.first_child("origin"), element.first_child("limit")
    zero = (0.0, 0.0, 0.0)
    origin = transform_from_xyz_rpy(
        attribute_numbers(place, "xyz", zero, where, source),
        attribute_numbers(place, "rpy", zero, where, source),
    )
    axis = attribute_numbers(element.first_child("axis"), "xyz", (1.0, 0.0, 0.0), where, source)
    length = float(np.linalg.norm(axis))
    if length < 1e-9 and kind in MOVING_JOINT_KINDS:
        raise RobotError(f"{source}:{element.line}: {where}: its axis is a zero vector")
    given = limit is not None and {"lower", "upper"} & limit.attributes.keys()
    lower, upper = (-np.inf, np.inf)
    if given and kind in ("revolute", "prismatic"):
        lower, upper = (float(attribute_numbers(limit, n, (0.0,), where, source)[0])
                        for n in ("lower", "upper"))  # fmt: skip
        if lower > upper:
            raise RobotError(f"{source}:{element.line}: {where}: limit lower is above upper")
    joint = UrdfJoint(
        name=name,
        kind=kind,
        parent=ends[0],
        child=ends[1],
        origin=origin,
        axis=axis / max(length, 1e-9),
        lower=lower,
        upper=upper,
        mimic=parse_mimic(element.first_child("mimic"), where, source),
        element=element,
    )
    if lower < upper:
        return joint
    held = joint.motion_transforms(np.array([lower]))[0]
    return replace(joint, kind="fixed", origin=origin @ held, mimic=None)


def parse_mimic(element: XmlElement | None, description: str, source: str) -> Mimic | None:
    """A <mimic>, if there is one."""
    if element is None:
        return None
    multiplier, offset = (
        float(attribute_numbers(element, name, (default,), description, source)[0])
        for name, default in (("multiplier", 1.0), ("offset", 0.0))
    )
    return Mimic(required_attribute(element, "joint", source), multiplier, offset)


class LinkMass(NamedTuple):
    """Mass of a link [kg], and its centre of gravity (3,) in the link's frame [m]."""

    mass: float
    centre: Array


def parse_link_mass(element: XmlElement, name: str, source: str) -> LinkMass:
    """Mass [kg] and centre of gravity in the link's frame [m]; mass 0 where none is given."""
    inertial, where = element.first_child("inertial"), f"link {name!r}"
    if inertial is None or ASSUMED_MASS_ATTRIBUTE in inertial.attributes:
        return LinkMass(0.0, np.zeros(3))
    mass = float(attribute_numbers(inertial.first_child("mass"), "value", (0.0,), where, source)[0])
    if mass < 0.0:
        raise RobotError(f"{source}:{inertial.line}: {where}: a mass below zero")
    return LinkMass(
        mass,
        attribute_numbers(inertial.first_child("origin"), "xyz", (0.0, 0.0, 0.0), where, source),
    )


def parse_link_inertia(element: XmlElement, name: str, source: str) -> Array:
    """Inertia (3, 3) about the centre of gravity in the link's axes [kg m^2]; 0 if not given."""
    inertial, where = element.first_child("inertial"), f"link {name!r}"
    found = None if inertial is None else inertial.first_child("inertia")
    if inertial is None or found is None:
        return np.zeros((3, 3))
    xx, xy, xz, yy, yz, zz = (
        float(attribute_numbers(found, key, (0.0,), where, source)[0])
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    rpy = attribute_numbers(inertial.first_child("origin"), "rpy", (0.0, 0.0, 0.0), where, source)
    turned = transform_from_xyz_rpy(np.zeros(3), rpy)[:3, :3]
    return np.asarray(turned @ [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]] @ turned.T)


def find_root_link(
    links: Mapping[str, XmlElement], joints: tuple[UrdfJoint, ...], source: str
) -> str:
    """The one link that hangs on none.  Raises RobotError unless links and joints form a tree."""
    parents: dict[str, str] = {}
    for joint in joints:
        for name in (joint.parent, joint.child):
            if name not in links:
                raise RobotError(
                    f"{source}:{joint.element.line}: joint {joint.name!r}: no link {name!r}"
                )
        if joint.child in parents:
            raise RobotError(
                f"{source}:{joint.element.line}: link {joint.child!r} has two parents; "
                "closed chains are not supported"
            )
        parents[joint.child] = joint.parent
    if not links:
        raise RobotError(f"{source}: holds no <link>, so no robot")
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        said = ", ".join(roots[:6]) or "none: the joints form a ring"
        raise RobotError(f"{source}: expected one root link, found {said}")
    seen = {roots[0]}
    for _ in parents:
        seen |= {child for child, parent in parents.items() if parent in seen}
        if len(seen) == len(links):
            break
    if missing := [name for name in links if name not in seen]:
        raise RobotError(f"{source}: link {missing[0]!r} does not hang on {roots[0]!r}")
    return roots[0]


def build_origin_edit(
    raw: bytes, joint: UrdfJoint, write_origin: Callable[[Array], tuple[str, str]]
) -> ByteEdit:
    """The change of bytes that gives a joint another origin.

    write_origin: from the roll, pitch, yaw that stand there to the new xyz and rpy.
    """
    place = joint.element.first_child("origin")
    if place is None:
        xyz, rpy = write_origin(np.zeros(3))
        before = raw[: joint.element.start]
        line = before[before.rfind(b"\n") + 1 :]
        newline = b"\r\n" if before.endswith(b"\r\n" + line) else b"\n"
        indent = newline + line + b"  " if b"\n" in before and not line.strip() else b""
        new = f'<origin xyz="{xyz}" rpy="{rpy}"/>'.encode()
        return joint.element.end, joint.element.end, indent + new
    old = raw[place.start : place.end]
    rpy_now = np.array([float(v) for v in place.attributes.get("rpy", "0 0 0").split()])
    values = dict(zip((b"xyz", b"rpy"), write_origin(rpy_now), strict=True))

    def replaced(found: re.Match[bytes]) -> bytes:
        if found[1] not in values:
            return found[0]
        quote = found[2][:1]
        return found[0][: -len(found[2])] + quote + values.pop(found[1]).encode() + quote

    new = XML_ATTRIBUTE_PATTERN.sub(replaced, old)
    missing = b"".join(b" " + n + b'="' + text.encode() + b'"' for n, text in values.items())
    return place.start, place.end, new.replace(b"<origin", b"<origin" + missing, 1)


def apply_byte_edits(raw: bytes, edits: Sequence[ByteEdit]) -> bytes:
    """Bytes with all edits made."""
    for start, end, new in sorted(edits, reverse=True):
        raw = raw[:start] + new + raw[end:]
    return raw
