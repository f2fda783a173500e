"""URDF and MJCF in: any serial chain of it, as links ``Rz Tz Tx Rx Ry`` of our convention."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.core.files import read_bytes
from minimax_cal.robots import kinematics
from minimax_cal.robots.joint_ranges import clip_range_near_zero
from minimax_cal.robots.transforms import (
    MAX_EQUAL_TRANSFORM_DIFFERENCE,
    build_transform,
    invert_transform,
    link_row_to_axis,
    link_row_to_tip,
    link_transform,
    max_entry_difference,
    pose_to_rpy,
    rotation_from_z_to_direction,
)
from minimax_cal.robots.urdf_file import (
    MOVING_JOINT_KINDS,
    Mimic,
    Urdf,
    UrdfJoint,
    parse_xml_without_entities,
    read_urdf,
)

MAX_FORWARD_KINEMATICS_ERROR = 1e-9  # forward kinematics must agree to this [m, rad]
TIP_NAME_ENDINGS = (
    "tool0",
    "flange",
    "attachment_site",
)  # how the frame that is meant ends, of several
MJCF_SUFFIXES = (".xml", ".mjcf")  # files of a simulator's own model


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
    chain: tuple[UrdfJoint, ...]
    base: Array
    tool: Array
    drivers: Mapping[int, UrdfJoint]

    @property
    def base_and_tool_notices(self) -> tuple[str, ...]:
        """What lies between its links and the frames of the robot, for people."""
        every = (
            ("root link is not the robot's base, which stands in it", self.base),
            ("tip is not the robot's last frame, in which it stands", self.tool),
        )
        return tuple(
            f"{self.urdf.source}: the {what} at {describe_pose(pose)}"
            for what, pose in every
            if max_entry_difference(pose, np.eye(4)) > MAX_EQUAL_TRANSFORM_DIFFERENCE
        )

    @property
    def notices(self) -> tuple[str, ...]:
        """What is not in the robot, for people."""
        out, source = [*self.urdf.notices], self.urdf.source
        if self.chain[0].parent != self.urdf.root:
            out.append(f"{source}: the chain begins at {self.chain[0].parent!r}")
        out += self.base_and_tool_notices
        held = {joint.name for joint in self.chain} | {d.name for d in self.drivers.values()}
        aside = [
            joint.name for joint in self.urdf.joints if joint.is_moving and joint.name not in held
        ]
        if aside:
            out.append(
                f"{source}: joints outside the chain, and masses beyond them, are not in the "
                f"robot: {', '.join(aside[:8])}"
            )
        return tuple(out)


def describe_pose(pose: Array) -> str:
    """A pose (4, 4) [m] for people: its place, and its angles where it is turned."""
    place = f"({', '.join(f'{1e3 * v:.6g}' for v in pose[:3, 3])}) mm"
    if (
        max_entry_difference(build_transform(pose[:3, :3], np.zeros(3)), np.eye(4))
        <= MAX_EQUAL_TRANSFORM_DIFFERENCE
    ):
        return place
    c, b, a = np.degrees(pose_to_rpy(pose)).round(6) + 0.0
    return f"{place}, turned by A {a:.6g} B {b:.6g} C {c:.6g} deg, Rz(A) Ry(B) Rx(C)"


def find_chain_to_tip(urdf: Urdf, tip: str = "") -> tuple[UrdfJoint, ...]:
    """The joints to the tip, or to the only end there is; ``root:tip`` names both ends.

    Without a root, from the last joint before the tip that floats, else from the file's root.
    A joint that mimics another one follows the last of a row of mimics.  Raises RobotError.
    """
    links = {urdf.root, *(joint.child for joint in urdf.joints)}
    root, last = split_root_and_tip(tip, links)
    for name in (root, last):
        if name and name not in links:
            leaves = sorted(name for name in links if not urdf.joints_on_link(name))
            raise RobotError(f"{urdf.source}: no link {name!r}; its ends are {', '.join(leaves)}")
    last = last or find_only_tip(urdf, sorted(links), root)
    chain = urdf.joints_from_root_to_link(last)
    starts = [joint.parent for joint in chain]
    if root and root not in starts:
        raise RobotError(f"{urdf.source}: link {last!r} does not hang on {root!r}")
    behind = [
        i + 1 for i, joint in enumerate(chain) if joint.kind not in (*MOVING_JOINT_KINDS, "fixed")
    ]
    chain = chain[starts.index(root) if root else max(behind, default=0) :]
    for joint in chain:
        if joint.kind not in (*MOVING_JOINT_KINDS, "fixed"):
            raise RobotError(
                f"{urdf.source}:{joint.element.line}: joint {joint.name!r} on the way to {last!r} "
                f"is {joint.kind}; only revolute, continuous, prismatic and fixed joints are "
                "supported"
            )
    if not any(joint.is_moving for joint in chain):
        why = [f"{urdf.source}: no moving joint leads to {last!r}", *urdf.notices]
        raise RobotError("; ".join(why))
    return tuple(replace(joint, mimic=resolve_mimic(joint, urdf)) for joint in chain)


def resolve_mimic(joint: UrdfJoint, urdf: Urdf) -> Mimic | None:
    """What a joint follows: the joint with a drive at the end of its row of mimics, if any.

    Raises RobotError for a ring, and for a joint that does not move or is not there.
    """
    every = {one.name: one for one in urdf.joints if one.is_moving}
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


def find_only_tip(urdf: Urdf, link_names: Sequence[str], root_link: str) -> str:
    """The end of the only chain, beyond a root if one is named.  Raises RobotError for several.

    Ends on a body that carries a longer chain do not count (a camera at the elbow), nor what hangs
    on more joints in common with another end than of its own (a gripper's finger).  Of several
    links on the last moving body, `tool0` or `flange` is taken, else the one where they part.
    """
    ways = {name: urdf.joints_from_root_to_link(name) for name in link_names}
    if root_link:
        ways = {name: way for name, way in ways.items() if root_link in [j.parent for j in way]}
    moving = {name: [j.name for j in way if j.is_moving] for name, way in ways.items()}
    leaves = [name for name in ways if not urdf.joints_on_link(name)]
    ends = {
        leaf: cut_gripper_fingers(moving[leaf], [moving[one] for one in leaves]) for leaf in leaves
    }
    inner = [end[:i] for end in ends.values() for i in range(len(end))]
    tips: list[str] = []
    for end in {tuple(end): end for end in ends.values() if end and end not in inner}.values():
        beyond = [ways[leaf] for leaf in leaves if moving[leaf][: len(end)] == end]
        shared = [same[0].child for same in zip(*beyond, strict=False) if len(set(same)) == 1]
        named = [
            n for word in TIP_NAME_ENDINGS for n in ways if n.endswith(word) and moving[n] == end
        ]
        tips.append(shared[-1] if len(beyond) == 1 else [*named, shared[-1]][0])
    tips.sort(key=lambda name: not name.endswith(TIP_NAME_ENDINGS))
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


def cut_gripper_fingers(joint_path: list[str], other_paths: Sequence[list[str]]) -> list[str]:
    """The moving joints to an end, to where a gripper begins if it is a finger of one."""
    cuts = [len(joint_path)]
    for other in other_paths:
        same = [one == two for one, two in zip(joint_path, other, strict=False)]
        if not all(same) and 2 * same.index(False) > len(joint_path):
            cuts.append(same.index(False))
    return joint_path[: min(cuts)]


@dataclass(frozen=True, eq=False)
class MimicMap:
    """How the n moving joints of a chain follow joint values: ratio @ q + offset.

    ratio: (n, n), its column empty for a joint that mimics others.  offset: (n,) [rad, m].
    """

    ratio: Array
    offset: Array


def build_mimic_map(chain: Sequence[UrdfJoint]) -> MimicMap:
    """Of a chain whose mimics are resolved.

    The first joint that follows one beside the chain has that one's value for its own.
    """
    moving = [joint for joint in chain if joint.is_moving]
    places = {joint.name: place for place, joint in enumerate(moving)}
    ratio, offset = np.eye(len(moving)), np.zeros(len(moving))
    for place, joint in enumerate(moving):
        if joint.mimic:
            ratio[place, place], offset[place] = 0.0, joint.mimic.offset
            ratio[place, places.setdefault(joint.mimic.joint, place)] = joint.mimic.multiplier
    return MimicMap(ratio, offset)


def find_drivers_outside_chain(chain: Sequence[UrdfJoint], urdf: Urdf) -> dict[int, UrdfJoint]:
    """Joints beside a chain that move it, by the first of its moving joints that follows each."""
    moving = [joint for joint in chain if joint.is_moving]
    known = {joint.name for joint in moving}
    out: dict[int, UrdfJoint] = {}
    for place, joint in enumerate(moving):
        if joint.mimic and joint.mimic.joint not in known:
            known.add(joint.mimic.joint)
            out[place] = next(one for one in urdf.joints if one.name == joint.mimic.joint)
    return out


def tip_poses(chain: Sequence[UrdfJoint], q: Array) -> Array:
    """The tip in the root link, by the URDF's own transforms: (m, 4, 4).  q: (m, n) [rad, m]."""
    follow = build_mimic_map(chain)
    q = q[:, : len(follow.ratio)] @ follow.ratio.T + follow.offset
    pose, column = np.broadcast_to(np.eye(4), (len(q), 4, 4)), 0
    for joint in chain:
        pose = pose @ joint.origin
        if joint.is_moving:
            pose = pose @ joint.motion_transforms(q[:, column])
            column += 1
    return np.asarray(pose)


def link_poses_at_zero(
    urdf: Urdf, start_link: str, start_pose: Array, *, through_moving_joints: bool
) -> dict[str, Array]:
    """Poses at joint values 0 of a link and those below it, beyond moving joints or only fixed."""
    out, queue = {start_link: start_pose}, [start_link]
    for name in queue:  # grows while it is walked
        for joint in urdf.joints_on_link(name):
            if through_moving_joints or not joint.is_moving:
                out[joint.child] = out[name] @ joint.origin
                queue.append(joint.child)
    return out


def random_joint_values_in_limits(lower: Array, upper: Array, count: int = 60) -> Array:
    """Joint values within limits, of at most a turn, and all zero: (count, n)."""
    q = np.random.default_rng(0).uniform(*clip_range_near_zero(lower, upper), (count, len(lower)))
    q[0] = 0.0
    return np.asarray(q)


def convert_urdf_to_robot(urdf: Urdf, tip: str = "") -> UrdfRobot:
    """A chain of a URDF as a robot, checked by forward kinematics.  Raises RobotError."""
    chain = find_chain_to_tip(urdf, tip)
    start = link_poses_at_zero(urdf, urdf.root, np.eye(4), through_moving_joints=True)[
        chain[0].parent
    ]
    frames = link_poses_at_zero(urdf, chain[0].parent, np.eye(4), through_moving_joints=True)
    moving = [joint for joint in chain if joint.is_moving]
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
    base = build_transform(
        rotation_from_z_to_direction(axes[0]), points[0] - (points[0] @ axes[0]) * axes[0]
    )
    ends, rows = [base], []
    for point, axis in zip(points[1:], axes[1:], strict=True):
        back = invert_transform(ends[-1])
        rows.append(link_row_to_axis(back[:3, :3] @ point + back[:3, 3], back[:3, :3] @ axis))
        ends.append(ends[-1] @ link_transform(rows[-1]))
    tip_pose = frames[chain[-1].child]
    rows.append(link_row_to_tip(invert_transform(ends[-1]) @ tip_pose))
    ends.append(ends[-1] @ link_transform(rows[-1]))
    tool = invert_transform(ends[-1]) @ tip_pose
    mdh, slides = np.array(rows), np.array([joint.kind == "prismatic" for joint in moving])
    follow, drivers = build_mimic_map(chain), find_drivers_outside_chain(chain, urdf)
    mdh[np.arange(len(mdh)), np.where(slides, kinematics.D, kinematics.THETA)] += (
        sign * follow.offset
    )
    driven = [drivers.get(place, joint) for place, joint in enumerate(moving)]
    lower, upper = (np.array([getattr(j, n) for j in driven]) for n in ("lower", "upper"))
    q = random_joint_values_in_limits(lower, upper)
    pose = base @ kinematics.forward_kinematics(mdh, q @ follow.ratio.T * sign, slides) @ tool
    if (
        not (worst := max_entry_difference(pose, tip_poses(chain, q)))
        <= MAX_FORWARD_KINEMATICS_ERROR
    ):
        raise RobotError(
            f"{urdf.source}: poses would be off by {worst:.1e} m; check its units (metres)"
        )
    joints = [
        build_joint_content(joint, row, s, centre)
        for joint, row, s, centre in zip(
            driven, mdh, sign, joint_mass_properties(urdf, moving, frames, ends[1:]), strict=True
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


def joint_mass_properties(
    urdf: Urdf,
    moving_joints: Sequence[UrdfJoint],
    link_poses: Mapping[str, Array],
    joint_frames: Sequence[Array],
) -> list[tuple[float, Array, Array]]:
    """Mass and centre of gravity, in frame i [m], of what joint i carries up to the next joint.

    And its inertia (6,) about that centre in the axes of frame i; empty where a part has none.
    """
    out = []
    for joint, end in zip(moving_joints, joint_frames, strict=True):
        body = link_poses_at_zero(
            urdf, joint.child, link_poses[joint.child], through_moving_joints=False
        )
        parts = [(urdf.masses[n], body[n]) for n in body if n in urdf.masses]
        mass = sum(m for (m, _), _ in parts)
        at = sum((m * (pose[:3, :3] @ c + pose[:3, 3]) for (m, c), pose in parts), np.zeros(3))
        back = invert_transform(end)
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


def build_joint_content(
    joint: UrdfJoint, link_row: Array, sign: float, mass_properties: tuple[float, Array, Array]
) -> dict[str, Any]:
    """A joint in the file schema."""
    out: dict[str, Any] = dict(zip(kinematics.MDH_NAMES, link_row.tolist(), strict=True))
    out |= {"name": joint.name, "sign": int(sign)}
    if joint.kind == "prismatic":
        out["type"] = "prismatic"
    if np.isfinite(joint.lower) and not joint.mimic:
        out |= {"lower": joint.lower, "upper": joint.upper}
    mass, com, inertia = mass_properties
    if mass > 0.0:
        out |= {"mass_kg": mass, "com_mm": (com * 1e3).tolist()}
    if inertia.size:
        out["inertia"] = inertia.tolist()
    return out


def load_urdf(source: Path | str) -> UrdfRobot:
    """A robot of a URDF or MJCF; ``FILE#tip`` names the last link, ``FILE#root:tip`` both ends.

    Raises RobotError.
    """
    name, tip = split_file_and_link_names(source)
    is_plain = name.lower().endswith(".urdf")
    if (
        not is_plain
        and parse_xml_without_entities(read_bytes(name, error_type=RobotError), name).tag != "robot"
    ):
        from minimax_cal.robots.mjcf_import import read_mjcf  # few robots come as one

        return convert_urdf_to_robot(read_mjcf(name), tip)
    return convert_urdf_to_robot(read_urdf(name), tip)


class ChainEnds(NamedTuple):
    """Names of the first and the last link of a chain, '' where none is named."""

    root: str
    tip: str


def split_root_and_tip(tip_text: str, link_names: Iterable[str]) -> ChainEnds:
    """The root, empty where none is named, and the tip of ``root:tip``; names may hold colons."""
    names = {*link_names}
    ways = [(tip_text[:at], tip_text[at + 1 :]) for at, mark in enumerate(tip_text) if mark == ":"]
    whole = [("", tip_text)] if tip_text in names or not ways else []
    return ChainEnds(*[*whole, *(way for way in ways if {*way} <= names), *ways[::-1]][0])


class FileAndLinkNames(NamedTuple):
    """A file's path, and the text after its #."""

    file: str
    link_names: str


def split_file_and_link_names(source: Path | str) -> FileAndLinkNames:
    """The file and the links that a robot's name means."""
    name, mark, tip = str(source).rpartition("#")
    if mark and not Path(source).exists():
        return FileAndLinkNames(name, tip)
    return FileAndLinkNames(str(source), "")


def is_urdf_source(source: Path | str) -> bool:
    """Whether a robot's name means a URDF file."""
    return split_file_and_link_names(source)[0].lower().endswith(".urdf")


def is_urdf_or_mjcf_source(source: Path | str) -> bool:
    """Whether a robot's name means a file of links and joints, a URDF or MJCF."""
    return split_file_and_link_names(source)[0].lower().endswith((".urdf", *MJCF_SUFFIXES))
