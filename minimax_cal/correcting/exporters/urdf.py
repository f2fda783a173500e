"""URDF out: the given file with corrected joint origins, or a new one."""

from __future__ import annotations

from dataclasses import replace

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
    lines.append('  <link name="flange"/>')
    for i, (name, pose) in enumerate(zip((*names, "flange_joint"), origins(robot), strict=True)):
        last = i == robot.joints
        bounded = not last and np.isfinite([robot.lower[i], robot.upper[i]]).any()
        kind = "fixed" if last else "prismatic" if robot.prismatic[i] else "continuous"
        kind = "revolute" if kind == "continuous" and bounded else kind
        rpy = to_rpy(pose)
        lines += [
            f'  <joint name="{name}" type="{kind}">',
            f'    <origin xyz="{triple(pose[:3, 3])}" rpy="{triple(rpy)}"/>',
            f'    <parent link="{links[i]}"/>',
            f'    <child link="{links[i + 1]}"/>',
        ]
        if not last:
            lines.append(f'    <axis xyz="0 0 {int(robot.sign[i])}"/>')
            lines.append(limit(robot.lower[i], robot.upper[i], kind))
        lines.append("  </joint>")
    return "\n".join([*lines, "</robot>", ""])


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
