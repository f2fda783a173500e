"""A URDF file: its links and joints, and the bytes where their origins stand.

XML is read by expat with document types refused, so no entity is ever defined or fetched.  Every
element remembers its bytes, so that an exporter can change an origin and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.parsers import expat

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.ground.files import read_raw, read_text
from minimax_cal.robots import kinematics
from minimax_cal.robots.transforms import from_rpy, transform

ASSUMED = "assumed"  # attribute of an <inertial> of ours whose mass nobody told
MOVING = ("revolute", "continuous", "prismatic")
UPRIGHT: Array = np.array([0.0, 0.0, 1.0])
ATTRIBUTE = re.compile(rb"""([^\s=<>"']+)\s*=\s*("[^"]*"|'[^']*')""")


Edit = tuple[int, int, bytes]  # replace raw[start:end]


@dataclass(frozen=True, eq=False)
class Element:
    """An XML element: start is the byte of its ``<``, end the one after its start tag's ``>``."""

    tag: str
    attributes: Mapping[str, str]
    line: int
    start: int
    end: int
    children: list[Element] = field(default_factory=list)

    def child(self, tag: str) -> Element | None:
        """Its first child with a tag."""
        return next((c for c in self.children if c.tag == tag), None)


@dataclass(frozen=True)
class Mimic:
    """A joint that goes multiplier times as far as another one, and an offset [rad, m]."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class Joint:
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
    element: Element = Element("joint", {}, 0, 0, 0)

    @property
    def moves(self) -> bool:
        """Whether it turns or slides."""
        return self.kind in MOVING

    def motion(self, q: Array) -> Array:
        """What joint values q (m,) do in the child's frame: (m, 4, 4)."""
        if self.kind == "prismatic":
            return transform(np.eye(3), q[:, None] * self.axis)
        return transform(kinematics.rotation(q[:, None] * self.axis), np.zeros(3))


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
    joints: tuple[Joint, ...]
    masses: Mapping[str, tuple[float, Array]]
    inertias: Mapping[str, Array] = field(default_factory=dict)
    up: Array = field(default_factory=UPRIGHT.copy)
    notices: tuple[str, ...] = ()

    def from_link(self, name: str) -> list[Joint]:
        """The joints that hang on a link."""
        return [joint for joint in self.joints if joint.parent == name]

    def to_link(self, name: str) -> tuple[Joint, ...]:
        """The joints from the root to a link."""
        by_child, out = {joint.child: joint for joint in self.joints}, []
        while name in by_child:
            out.append(by_child[name])
            name = by_child[name].parent
        return tuple(reversed(out))


def parse_xml(raw: bytes, source: str) -> Element:
    """The root element.  Raises RobotError for broken XML, a document type or an entity."""
    parser, stack, roots = expat.ParserCreate("utf-8"), list[Element](), list[Element]()

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
        new = Element(tag, attributes, parser.CurrentLineNumber, first, last + 1)
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
    read_text(path, kind=RobotError)  # says what is wrong with the file or its encoding
    return parse_urdf(read_raw(path, kind=RobotError), str(path))


def parse_urdf(raw: bytes, source: str = "URDF") -> Urdf:
    """The links and joints of a URDF.  Raises RobotError."""
    top = parse_xml(raw, source)
    if top.tag != "robot":
        raise RobotError(f"{source}: is not a URDF: its root is <{top.tag}>, expected <robot>")
    for child in walk(top):
        if child.tag.startswith("xacro:"):
            raise RobotError(
                f"{source}:{child.line}: <{child.tag}>: this is xacro, not URDF; "
                "expand it first: xacro FILE > robot.urdf"
            )
    links: dict[str, Element] = {}
    joints: dict[str, Joint] = {}
    for child in top.children:
        if child.tag not in ("link", "joint"):
            continue
        name = attribute(child, "name", source)
        if name in (links if child.tag == "link" else joints):
            raise RobotError(f"{source}:{child.line}: a second {child.tag} {name!r}")
        if child.tag == "link":
            links[name] = child
        else:
            joints[name] = joint_of(child, name, source)
    root = root_of(links, tuple(joints.values()), source)
    masses = {name: mass_of(element, name, source) for name, element in links.items()}
    known = {name: mass for name, mass in masses.items() if mass[0] > 0.0}
    name = top.attributes.get("name", "robot")
    inertias = {link: inertia_of(links[link], link, source) for link in known}
    given = {link: inertia for link, inertia in inertias.items() if inertia.any()}
    return Urdf(source, raw, name, root, tuple(joints.values()), known, given)


def walk(top: Element) -> list[Element]:
    """An element and all below it."""
    out = [top]
    for element in out:  # grows while it is walked
        out.extend(element.children)
    return out


def attribute(element: Element, name: str, source: str) -> str:
    """An attribute that must be there."""
    if not element.attributes.get(name):
        raise RobotError(f"{source}:{element.line}: <{element.tag}> has no {name}")
    return element.attributes[name]


def numbers(
    element: Element | None, name: str, default: Sequence[float], where: str, source: str
) -> Array:
    """The numbers of an attribute, or the default."""
    if element is None or name not in element.attributes:
        return np.array(default, dtype=float)
    text = element.attributes[name]
    place = f"{source}:{element.line}: {where}: {name}={text[:60]!r}"
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


def joint_of(element: Element, name: str, source: str) -> Joint:
    """A <joint>; one whose limits are the same number is fixed there."""
    where, ends = f"joint {name!r}", []
    for tag in ("parent", "child"):
        end = element.child(tag)
        if end is None:
            raise RobotError(f"{source}:{element.line}: {where} has no <{tag}>")
        ends.append(attribute(end, "link", source))
    kind = attribute(element, "type", source)
    if kind not in (*MOVING, "fixed", "floating", "planar"):
        raise RobotError(f"{source}:{element.line}: {where}: no joint type {kind!r}")
    place, limit = element.child("origin"), element.child("limit")
    zero = (0.0, 0.0, 0.0)
    origin = from_rpy(
        numbers(place, "xyz", zero, where, source), numbers(place, "rpy", zero, where, source)
    )
    axis = numbers(element.child("axis"), "xyz", (1.0, 0.0, 0.0), where, source)
    length = float(np.linalg.norm(axis))
    if length < 1e-9 and kind in MOVING:
        raise RobotError(f"{source}:{element.line}: {where}: its axis is a zero vector")
    given = limit is not None and {"lower", "upper"} & limit.attributes.keys()
    lower, upper = (-np.inf, np.inf)
    if given and kind in ("revolute", "prismatic"):
        lower, upper = (float(numbers(limit, n, (0.0,), where, source)[0])
                        for n in ("lower", "upper"))  # fmt: skip
        if lower > upper:
            raise RobotError(f"{source}:{element.line}: {where}: limit lower is above upper")
    joint = Joint(
        name=name,
        kind=kind,
        parent=ends[0],
        child=ends[1],
        origin=origin,
        axis=axis / max(length, 1e-9),
        lower=lower,
        upper=upper,
        mimic=mimic_of(element.child("mimic"), where, source),
        element=element,
    )
    if lower < upper:
        return joint
    held = joint.motion(np.array([lower]))[0]
    return replace(joint, kind="fixed", origin=origin @ held, mimic=None)


def mimic_of(element: Element | None, where: str, source: str) -> Mimic | None:
    """A <mimic>, if there is one."""
    if element is None:
        return None
    multiplier, offset = (
        float(numbers(element, name, (default,), where, source)[0])
        for name, default in (("multiplier", 1.0), ("offset", 0.0))
    )
    return Mimic(attribute(element, "joint", source), multiplier, offset)


def mass_of(element: Element, name: str, source: str) -> tuple[float, Array]:
    """Mass [kg] and centre of gravity in the link's frame [m]; mass 0 where none is given."""
    inertial, where = element.child("inertial"), f"link {name!r}"
    if inertial is None or ASSUMED in inertial.attributes:
        return 0.0, np.zeros(3)
    mass = float(numbers(inertial.child("mass"), "value", (0.0,), where, source)[0])
    if mass < 0.0:
        raise RobotError(f"{source}:{inertial.line}: {where}: a mass below zero")
    return mass, numbers(inertial.child("origin"), "xyz", (0.0, 0.0, 0.0), where, source)


def inertia_of(element: Element, name: str, source: str) -> Array:
    """Inertia (3, 3) about the centre of gravity in the link's axes [kg m^2]; 0 if not given."""
    inertial, where = element.child("inertial"), f"link {name!r}"
    found = None if inertial is None else inertial.child("inertia")
    if inertial is None or found is None:
        return np.zeros((3, 3))
    xx, xy, xz, yy, yz, zz = (
        float(numbers(found, key, (0.0,), where, source)[0])
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    rpy = numbers(inertial.child("origin"), "rpy", (0.0, 0.0, 0.0), where, source)
    turned = from_rpy(np.zeros(3), rpy)[:3, :3]
    return np.asarray(turned @ [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]] @ turned.T)


def root_of(links: Mapping[str, Element], joints: tuple[Joint, ...], source: str) -> str:
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


def origin_edit(raw: bytes, joint: Joint, write: Callable[[Array], tuple[str, str]]) -> Edit:
    """The change of bytes that gives a joint another origin.

    write: from the roll, pitch, yaw that stand there to the new xyz and rpy.
    """
    place = joint.element.child("origin")
    if place is None:
        xyz, rpy = write(np.zeros(3))
        before = raw[: joint.element.start]
        line = before[before.rfind(b"\n") + 1 :]
        newline = b"\r\n" if before.endswith(b"\r\n" + line) else b"\n"
        indent = newline + line + b"  " if b"\n" in before and not line.strip() else b""
        new = f'<origin xyz="{xyz}" rpy="{rpy}"/>'.encode()
        return joint.element.end, joint.element.end, indent + new
    old = raw[place.start : place.end]
    rpy_now = np.array([float(v) for v in place.attributes.get("rpy", "0 0 0").split()])
    values = dict(zip((b"xyz", b"rpy"), write(rpy_now), strict=True))

    def replaced(found: re.Match[bytes]) -> bytes:
        if found[1] not in values:
            return found[0]
        quote = found[2][:1]
        return found[0][: -len(found[2])] + quote + values.pop(found[1]).encode() + quote

    new = ATTRIBUTE.sub(replaced, old)
    missing = b"".join(b" " + n + b'="' + text.encode() + b'"' for n, text in values.items())
    return place.start, place.end, new.replace(b"<origin", b"<origin" + missing, 1)


def edited(raw: bytes, edits: Sequence[Edit]) -> bytes:
    """Bytes with all edits made."""
    for start, end, new in sorted(edits, reverse=True):
        raw = raw[:start] + new + raw[end:]
    return raw
