"""URDF and MJCF in: any serial chain of it, as links ``Rz Tz Tx Rx Ry`` of our convention."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.ground.files import read_raw
from minimax_cal.robots import kinematics
from minimax_cal.robots.ranges import near_zero
from minimax_cal.robots.transforms import (
    SAME,
    along,
    difference,
    inverse,
    link,
    link_to,
    link_to_tip,
    to_rpy,
    transform,
)
from minimax_cal.robots.urdf_file import MOVING, Joint, Mimic, Urdf, parse_xml, read_urdf

EXACT = 1e-9  # forward kinematics must agree to this [m, rad]
TIPS = ("tool0", "flange", "attachment_site")  # how the frame that is meant ends, of several
MODELS = (".xml", ".mjcf")  # files of a simulator's own model


@dataclass(frozen=True, eq=False)
class UrdfRobot:
    """A chain of a URDF in our convention: pose of the tip = base @ robot.pose(q) @ tool.

    content: the robot in the file schema, metres and radians.  chain: joints from root to tip.
    base: (4, 4) frame 0 of the robot in the root link; tool: (4, 4) the tip in the last frame [m].
    drivers: joints beside the chain whose values move it, by the place of the joint of the robot
    that has their value.
    """

    content: dict[str, Any]
    urdf: Urdf
    chain: tuple[Joint, ...]
    base: Array
    tool: Array
    drivers: Mapping[int, Joint]

    @property
    def remaining(self) -> tuple[str, ...]:
        """What lies between its links and the frames of the robot, for people."""
        every = (
            ("root link is not the robot's base, which stands in it", self.base),
            ("tip is not the robot's last frame, in which it stands", self.tool),
        )
        return tuple(
            f"{self.urdf.source}: the {what} at {pose_in_words(pose)}"
            for what, pose in every
            if difference(pose, np.eye(4)) > SAME
        )

    @property
    def notices(self) -> tuple[str, ...]:
        """What is not in the robot, for people."""
        out, source = [*self.urdf.notices], self.urdf.source
        if self.chain[0].parent != self.urdf.root:
            out.append(f"{source}: the chain begins at {self.chain[0].parent!r}")
        out += self.remaining
        held = {joint.name for joint in self.chain} | {d.name for d in self.drivers.values()}
        aside = [joint.name for joint in self.urdf.joints if joint.moves and joint.name not in held]
        if aside:
            out.append(
                f"{source}: joints outside the chain, and masses beyond them, are not in the "
                f"robot: {', '.join(aside[:8])}"
            )
        return tuple(out)


def pose_in_words(pose: Array) -> str:
    """A pose (4, 4) [m] for people: its place, and its angles where it is turned."""
    place = f"({', '.join(f'{1e3 * v:.6g}' for v in pose[:3, 3])}) mm"
    if difference(transform(pose[:3, :3], np.zeros(3)), np.eye(4)) <= SAME:
        return place
    c, b, a = np.degrees(to_rpy(pose)).round(6) + 0.0
    return f"{place}, turned by A {a:.6g} B {b:.6g} C {c:.6g} deg, Rz(A) Ry(B) Rx(C)"


def chain_to(urdf: Urdf, tip: str = "") -> tuple[Joint, ...]:
    """The joints to the tip, or to the only end there is; ``root:tip`` names both ends.

    Without a root, from the last joint before the tip that floats, else from the file's root.
    A joint that mimics another one follows the last of a row of mimics.  Raises RobotError.
    """
    links = {urdf.root, *(joint.child for joint in urdf.joints)}
    root, last = both_ends(tip, links)
    for name in (root, last):
        if name and name not in links:
            leaves = sorted(name for name in links if not urdf.from_link(name))
            raise RobotError(f"{urdf.source}: no link {name!r}; its ends are {', '.join(leaves)}")
    last = last or only_tip(urdf, sorted(links), root)
    chain = urdf.to_link(last)
    starts = [joint.parent for joint in chain]
    if root and root not in starts:
        raise RobotError(f"{urdf.source}: link {last!r} does not hang on {root!r}")
    behind = [i + 1 for i, joint in enumerate(chain) if joint.kind not in (*MOVING, "fixed")]
    chain = chain[starts.index(root) if root else max(behind, default=0) :]
    for joint in chain:
        if joint.kind not in (*MOVING, "fixed"):
            raise RobotError(
                f"{urdf.source}:{joint.element.line}: joint {joint.name!r} on the way to {last!r} "
                f"is {joint.kind}; only revolute, continuous, prismatic and fixed joints are "
                "supported"
            )
    if not any(joint.moves for joint in chain):
        why = [f"{urdf.source}: no moving joint leads to {last!r}", *urdf.notices]
        raise RobotError("; ".join(why))
    return tuple(replace(joint, mimic=resolve_mimic(joint, urdf)) for joint in chain)


def resolve_mimic(joint: Joint, urdf: Urdf) -> Mimic | None:
    """What a joint follows: the joint with a drive at the end of its row of mimics, if any.

    Raises RobotError for a ring, and for a joint that does not move or is not there.
    """
    every = {one.name: one for one in urdf.joints if one.moves}
    factor, offset, seen, one = 1.0, 0.0, {joint.name}, joint
    while one.mimic:
        offset += factor * one.mimic.offset
        factor *= one.mimic.multiplier
        if one.mimic.joint not in every or one.mimic.joint in seen:
            what = "a ring" if one.mimic.joint in seen else "no moving joint of the file"
            raise RobotError(
                f"{urdf.source}:{one.element.line}: joint {one.name!r} mimics {one.mimic.joint!r}, "
                f"{what}; correct its <mimic>"
            )
        seen.add(one.mimic.joint)
        one = every[one.mimic.joint]
    return None if one is joint else Mimic(one.name, factor, offset)


def only_tip(urdf: Urdf, links: Sequence[str], root: str) -> str:
    """The end of the only chain, beyond a root if one is named.  Raises RobotError for several.

    Ends on a body that carries a longer chain do not count (a camera at the elbow), nor what hangs
    on more joints in common with another end than of its own (a gripper's finger).  Of several
    links on the last moving body, `tool0` or `flange` is taken, else the one where they part.
    """
    ways = {name: urdf.to_link(name) for name in links}
    if root:
        ways = {name: way for name, way in ways.items() if root in [j.parent for j in way]}
    moving = {name: [j.name for j in way if j.moves] for name, way in ways.items()}
    leaves = [name for name in ways if not urdf.from_link(name)]
    ends = {leaf: without_fingers(moving[leaf], [moving[one] for one in leaves]) for leaf in leaves}
    inner = [end[:i] for end in ends.values() for i in range(len(end))]
    tips: list[str] = []
    for end in {tuple(end): end for end in ends.values() if end and end not in inner}.values():
        beyond = [ways[leaf] for leaf in leaves if moving[leaf][: len(end)] == end]
        shared = [same[0].child for same in zip(*beyond, strict=False) if len(set(same)) == 1]
        named = [n for word in TIPS for n in ways if n.endswith(word) and moving[n] == end]
        tips.append(shared[-1] if len(beyond) == 1 else [*named, shared[-1]][0])
    tips.sort(key=lambda name: not name.endswith(TIPS))
    if len(tips) > 1:
        raise RobotError(
            f"{urdf.source}: several chains: they end in {', '.join(tips)}; name the last "
            f"link, as {Path(urdf.source).name}#{tips[0]} or with tip="
        )
    if not tips:
        held = [j for j in urdf.joints if j.kind != j.element.attributes.get("type", j.kind)]
        only = " that its limits (lower = upper) do not hold" if held else ""
        raise RobotError(f"{urdf.source}: has no revolute, continuous or prismatic joint{only}")
    return tips[0]


def without_fingers(end: list[str], others: Sequence[list[str]]) -> list[str]:
    """The moving joints to an end, to where a gripper begins if it is a finger of one."""
    cuts = [len(end)]
    for other in others:
        same = [one == two for one, two in zip(end, other, strict=False)]
        if not all(same) and 2 * same.index(False) > len(end):
            cuts.append(same.index(False))
    return end[: min(cuts)]


@dataclass(frozen=True, eq=False)
class Follow:
    """How the n moving joints of a chain follow joint values: ratio @ q + offset.

    ratio: (n, n), its column empty for a joint that mimics others.  offset: (n,) [rad, m].
    """

    ratio: Array
    offset: Array


def follow_of(chain: Sequence[Joint]) -> Follow:
    """Of a chain whose mimics are resolved.

    The first joint that follows one beside the chain has that one's value for its own.
    """
    moving = [joint for joint in chain if joint.moves]
    places = {joint.name: place for place, joint in enumerate(moving)}
    ratio, offset = np.eye(len(moving)), np.zeros(len(moving))
    for place, joint in enumerate(moving):
        if joint.mimic:
            ratio[place, place], offset[place] = 0.0, joint.mimic.offset
            ratio[place, places.setdefault(joint.mimic.joint, place)] = joint.mimic.multiplier
    return Follow(ratio, offset)


def drivers_of(chain: Sequence[Joint], urdf: Urdf) -> dict[int, Joint]:
    """Joints beside a chain that move it, by the first of its moving joints that follows each."""
    moving = [joint for joint in chain if joint.moves]
    known = {joint.name for joint in moving}
    out: dict[int, Joint] = {}
    for place, joint in enumerate(moving):
        if joint.mimic and joint.mimic.joint not in known:
            known.add(joint.mimic.joint)
            out[place] = next(one for one in urdf.joints if one.name == joint.mimic.joint)
    return out


def tip_poses(chain: Sequence[Joint], q: Array) -> Array:
    """The tip in the root link, by the URDF's own transforms: (m, 4, 4).  q: (m, n) [rad, m]."""
    follow = follow_of(chain)
    q = q[:, : len(follow.ratio)] @ follow.ratio.T + follow.offset
    pose, column = np.broadcast_to(np.eye(4), (len(q), 4, 4)), 0
    for joint in chain:
        pose = pose @ joint.origin
        if joint.moves:
            pose = pose @ joint.motion(q[:, column])
            column += 1
    return np.asarray(pose)


def rest_frames(urdf: Urdf, start: str, pose: Array, *, moving: bool) -> dict[str, Array]:
    """Poses at joint values 0 of a link and those below it, beyond moving joints or only fixed."""
    out, queue = {start: pose}, [start]
    for name in queue:  # grows while it is walked
        for joint in urdf.from_link(name):
            if moving or not joint.moves:
                out[joint.child] = out[name] @ joint.origin
                queue.append(joint.child)
    return out


def random_joints(lower: Array, upper: Array, count: int = 60) -> Array:
    """Joint values within limits, of at most a turn, and all zero: (count, n)."""
    q = np.random.default_rng(0).uniform(*near_zero(lower, upper), (count, len(lower)))
    q[0] = 0.0
    return np.asarray(q)


def to_robot(urdf: Urdf, tip: str = "") -> UrdfRobot:
    """A chain of a URDF as a robot, checked by forward kinematics.  Raises RobotError."""
    chain = chain_to(urdf, tip)
    start = rest_frames(urdf, urdf.root, np.eye(4), moving=True)[chain[0].parent]
    frames = rest_frames(urdf, chain[0].parent, np.eye(4), moving=True)
    moving = [joint for joint in chain if joint.moves]
    sign = np.array([-1.0 if joint.axis[np.abs(joint.axis).argmax()] < 0 else 1.0
                     for joint in moving])  # fmt: skip
    up = float((frames[moving[0].child][:3, :3] @ moving[0].axis)[2])
    if abs(up) > 0.5:  # the base's z stays upright where joint 1 allows it
        sign[0] = np.sign(up)
    axes = [frames[joint.child][:3, :3] @ joint.axis * s
            for joint, s in zip(moving, sign, strict=True)]  # fmt: skip
    points = [frames[joint.child][:3, 3] for joint in moving]
    if moving[0].kind == "prismatic":
        points[0] = np.zeros(3)
    base = transform(along(axes[0]), points[0] - (points[0] @ axes[0]) * axes[0])
    ends, rows = [base], []
    for point, axis in zip(points[1:], axes[1:], strict=True):
        back = inverse(ends[-1])
        rows.append(link_to(back[:3, :3] @ point + back[:3, 3], back[:3, :3] @ axis))
        ends.append(ends[-1] @ link(rows[-1]))
    tip_pose = frames[chain[-1].child]
    rows.append(link_to_tip(inverse(ends[-1]) @ tip_pose))
    ends.append(ends[-1] @ link(rows[-1]))
    tool = inverse(ends[-1]) @ tip_pose
    mdh, slides = np.array(rows), np.array([joint.kind == "prismatic" for joint in moving])
    follow, drivers = follow_of(chain), drivers_of(chain, urdf)
    mdh[np.arange(len(mdh)), np.where(slides, kinematics.D, kinematics.THETA)] += (
        sign * follow.offset
    )
    driven = [drivers.get(place, joint) for place, joint in enumerate(moving)]
    lower, upper = (np.array([getattr(j, n) for j in driven]) for n in ("lower", "upper"))
    q = random_joints(lower, upper)
    pose = base @ kinematics.forward(mdh, q @ follow.ratio.T * sign, slides) @ tool
    if not (worst := difference(pose, tip_poses(chain, q))) <= EXACT:
        raise RobotError(
            f"{urdf.source}: poses would be off by {worst:.1e} m; check its units (metres)"
        )
    joints = [
        joint_content(joint, row, s, centre)
        for joint, row, s, centre in zip(
            driven, mdh, sign, centres(urdf, moving, frames, ends[1:]), strict=True
        )
    ]
    content = {
        "name": urdf.name,
        "units": {"length": "m", "angle": "rad"},
        "up": (base[:3, :3].T @ start[:3, :3].T @ urdf.up).tolist(),
        "joints": joints,
        **({"coupling": follow.ratio.tolist()} if any(j.mimic for j in moving) else {}),
    }
    return UrdfRobot(content, urdf, chain, base, tool, drivers)


def centres(
    urdf: Urdf, moving: Sequence[Joint], frames: Mapping[str, Array], ends: Sequence[Array]
) -> list[tuple[float, Array, Array]]:
    """Mass and centre of gravity, in frame i [m], of what joint i carries up to the next joint.

    And its inertia (6,) about that centre in the axes of frame i; empty where a part has none.
    """
    out = []
    for joint, end in zip(moving, ends, strict=True):
        body = rest_frames(urdf, joint.child, frames[joint.child], moving=False)
        parts = [(urdf.masses[n], body[n]) for n in body if n in urdf.masses]
        mass = sum(m for (m, _), _ in parts)
        at = sum((m * (pose[:3, :3] @ c + pose[:3, 3]) for (m, c), pose in parts), np.zeros(3))
        back = inverse(end)
        centre = at / (mass or 1.0)
        inertia = np.zeros(0)
        if mass and all(n in urdf.inertias for n in body if n in urdf.masses):
            whole = np.zeros((3, 3))
            for name in (n for n in body if n in urdf.masses):
                (m, c), pose = urdf.masses[name], body[name]
                arm = pose[:3, :3] @ c + pose[:3, 3] - centre
                whole += pose[:3, :3] @ urdf.inertias[name] @ pose[:3, :3].T
                whole += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
            inertia = (back[:3, :3] @ whole @ back[:3, :3].T)[np.triu_indices(3)]
        out.append((mass, back[:3, :3] @ centre + back[:3, 3], inertia))
    return out


def joint_content(
    joint: Joint, row: Array, sign: float, centre: tuple[float, Array, Array]
) -> dict[str, Any]:
    """A joint in the file schema."""
    out: dict[str, Any] = dict(zip(kinematics.MDH_NAMES, row.tolist(), strict=True))
    out |= {"name": joint.name, "sign": int(sign)}
    if joint.kind == "prismatic":
        out["type"] = "prismatic"
    if np.isfinite(joint.lower) and not joint.mimic:
        out |= {"lower": joint.lower, "upper": joint.upper}
    mass, com, inertia = centre
    if mass > 0.0:
        out |= {"mass_kg": mass, "com_mm": (com * 1e3).tolist()}
    if inertia.size:
        out["inertia"] = inertia.tolist()
    return out


def load_urdf(source: Path | str) -> UrdfRobot:
    """A robot of a URDF or MJCF; ``FILE#tip`` names the last link, ``FILE#root:tip`` both ends.

    Raises RobotError.
    """
    name, tip = ends_of(source)
    is_plain = name.lower().endswith(".urdf")
    if not is_plain and parse_xml(read_raw(name, kind=RobotError), name).tag != "robot":
        from minimax_cal.robots.mjcf import read_mjcf  # few robots come as one

        return to_robot(read_mjcf(name), tip)
    return to_robot(read_urdf(name), tip)


def both_ends(tip: str, known: Iterable[str]) -> tuple[str, str]:
    """The root, empty where none is named, and the tip of ``root:tip``; names may hold colons."""
    names = {*known}
    ways = [(tip[:at], tip[at + 1 :]) for at, mark in enumerate(tip) if mark == ":"]
    whole = [("", tip)] if tip in names or not ways else []
    return [*whole, *(way for way in ways if {*way} <= names), *ways[::-1]][0]


def ends_of(source: Path | str) -> tuple[str, str]:
    """The file and the links that a robot's name means."""
    name, mark, tip = str(source).rpartition("#")
    return (name, tip) if mark and not Path(source).exists() else (str(source), "")


def is_urdf(source: Path | str) -> bool:
    """Whether a robot's name means a URDF file."""
    return ends_of(source)[0].lower().endswith(".urdf")


def has_links(source: Path | str) -> bool:
    """Whether a robot's name means a file of links and joints, a URDF or MJCF."""
    return ends_of(source)[0].lower().endswith((".urdf", *MODELS))
