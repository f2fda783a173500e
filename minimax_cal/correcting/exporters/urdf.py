"""URDF out: the given file with corrected joint origins, or a new one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.correcting.exporters.correct import correct
from minimax_cal.correcting.exporters.job import (
    Export,
    Job,
    joint_names,
    mark_up,
    number,
    origins,
    triple,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.robots.gravity import LEAST_MASS, inertia_of, masses_of, weighed
from minimax_cal.robots.robot import LONGEST, Robot
from minimax_cal.robots.transforms import tail, to_rpy
from minimax_cal.robots.urdf_file import ASSUMED

EFFORT, VELOCITY = 1000.0, 10.0  # URDF wants them; nothing here knows them


def write(job: Job) -> Export:
    """The original with corrected origins if there is one, else a new URDF."""
    if job.originals:
        return correct(job, job.originals[0])
    placeholders = "limits of effort and velocity are placeholders: the robot file has none"
    return Export.of(new_urdf(job.robot), f"{placeholders}; {assumptions(job.robot)}")


def assumptions(robot: Robot) -> str:
    """What of masses and inertias nobody told, in a sentence."""
    inertias = "inertias are assumed: of solid bodies as long as the links"
    if weighed(robot).all():
        return inertias
    return f"masses that the robot file does not tell are assumed (uniform tubes), and {inertias}"


def new_urdf(robot: Robot) -> str:
    """Links base_link, link_1 ... link_n, flange; each joint along its own z."""
    names = joint_names(robot)
    links = ["base_link", *(name.replace("joint", "link") for name in names), "flange"]
    lines = [
        '<?xml version="1.0"?>',
        "<!-- written by minimax-cal; limits of effort and velocity are placeholders -->",
        f'<robot name="{mark_up(robot.name)}">',
        '  <link name="base_link"/>',
    ]
    lines += [body(robot, i, links[i + 1]) for i in range(robot.joints)]
    lines += [f'  <link name="{name}"/>' for name in between(robot)]
    lines.append('  <link name="flange"/>')
    for i, (name, pose) in enumerate(zip((*names, "flange_joint"), origins(robot), strict=True)):
        last = i == robot.joints
        parts = [Part(name, links[i], links[i + 1])] if last else parts_of(robot, i, links)
        for part in parts:
            bounded = np.isfinite([part.lower, part.upper]).any()
            kind = "fixed" if last else "prismatic" if robot.prismatic[i] else "continuous"
            kind = "revolute" if kind == "continuous" and bounded else kind
            lines += [
                f'  <joint name="{part.name}" type="{kind}">',
                f'    <origin xyz="{triple(pose[:3, 3])}" rpy="{triple(to_rpy(pose))}"/>',
                f'    <parent link="{part.parent}"/>',
                f'    <child link="{part.child}"/>',
            ]
            if not last:
                lines.append(f'    <axis xyz="0 0 {int(robot.sign[i])}"/>')
                lines.append(limit(part.lower, part.upper, kind))
            lines += [part.mimic] if part.mimic else []
            lines.append("  </joint>")
            pose = np.eye(4)
    return "\n".join([*lines, "</robot>", ""])


@dataclass(frozen=True)
class Part:
    """A joint of the URDF, with its limits.  mimic: its element, empty where it has a drive."""

    name: str
    parent: str
    child: str
    lower: float = -np.inf
    upper: float = np.inf
    mimic: str = ""


def parts_of(robot: Robot, i: int, links: Sequence[str]) -> list[Part]:
    """Joint i as joints on one axis: one for each other that it follows, then its own drive.

    Raises OptionError for a joint that takes another share than 1 of its own value.
    """
    name, limits = joint_names(robot)[i], (robot.lower[i], robot.upper[i])
    if not len(robot.coupling):
        return [Part(name, links[i], links[i + 1], *limits)]
    shares = robot.coupling[i]
    if shares[i] not in (0.0, 1.0):
        raise OptionError(f"urdf: joint {i + 1} takes {shares[i]:g} of its own value; use json")
    others = [int(j) for j in np.flatnonzero(shares) if j != i]
    ends = [links[i], *(f"link_{i + 1}_with_{j + 1}" for j in others)]
    ends = [*ends, links[i + 1]] if shares[i] else [*ends[:-1], links[i + 1]]
    drives, follow = joint_names(robot), []
    for at, j in enumerate(others):
        low, high = sorted(float(shares[j] * end) for end in (robot.lower[j], robot.upper[j]))
        mimic = f'    <mimic joint="{drives[j]}" multiplier="{number(shares[j])}"/>'
        follow.append(Part(f"{name}_with_{j + 1}", ends[at], ends[at + 1], low, high, mimic))
    return [*follow, Part(name, ends[-2], ends[-1], *limits)] if shares[i] else follow


def between(robot: Robot) -> list[str]:
    """Links between the joints on one axis, which have no body."""
    own = [f"link_{i + 1}" for i in range(robot.joints)]
    known = {*own, "base_link", "flange"}
    links = ["base_link", *own, "flange"]
    parts = [part for i in range(robot.joints) for part in parts_of(robot, i, links)]
    return [part.child for part in parts if part.child not in known]


def limit(lower: float, upper: float, kind: str) -> str:
    """The <limit> of a joint; an open end is as far as a robot file may go."""
    ends = f'lower="{number(max(lower, -LONGEST))}" upper="{number(min(upper, LONGEST))}" '
    ends = "" if kind == "continuous" else ends
    return f'    <limit {ends}effort="{EFFORT:g}" velocity="{VELOCITY:g}"/>'


def body(robot: Robot, i: int, name: str) -> str:
    """A <link> with its mass, as the robot tells it or assumed; simulators refuse one without."""
    masses, com = masses_of(robot, LEAST_MASS)
    mass = float(masses[i])
    size = number(inertia_of(robot.mdh, i, mass))
    inertia = f'ixx="{size}" ixy="0" ixz="0" iyy="{size}" iyz="0" izz="{size}"'
    return "\n".join(
        [
            f'  <link name="{name}">',
            "    <inertial>" if weighed(robot)[i] else f'    <inertial {ASSUMED}="true">',
            f'      <origin xyz="{triple(in_link(replace(robot, com=com), i))}" rpy="0 0 0"/>',
            f'      <mass value="{number(mass)}"/>',
            f"      <inertia {inertia}/>",
            "    </inertial>",
            "  </link>",
        ]
    )


def in_link(robot: Robot, i: int) -> Array:
    """The centre of gravity in the URDF's link, whose z is the joint axis: (3,) [m]."""
    rest = tail(robot.mdh[i])
    return np.asarray(rest[:3, :3] @ robot.com[i] + rest[:3, 3])
