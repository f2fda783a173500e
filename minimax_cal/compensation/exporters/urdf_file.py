"""URDF out: the given file with corrected joint origins, or a new one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.compensation.exporters.export_job import (
    ExportedFile,
    ExportJob,
    escape_xml_text,
    format_exact_number,
    format_number_triple,
    joint_origins,
    list_joint_names,
)
from minimax_cal.compensation.exporters.urdf_correction import correct_urdf_origins
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.robots.gravity_torques import (
    MIN_SIMULATED_LINK_MASS,
    assumed_link_inertia,
    known_link_mass_mask,
    link_masses_and_centres,
)
from minimax_cal.robots.robot import MAX_LINK_LENGTH, Robot
from minimax_cal.robots.transforms import a_alpha_beta_transform, pose_to_rpy
from minimax_cal.robots.urdf_file import ASSUMED_MASS_ATTRIBUTE

PLACEHOLDER_EFFORT_LIMIT, PLACEHOLDER_VELOCITY_LIMIT = (
    1000.0,
    10.0,
)  # URDF wants them; nothing here knows them


def build_urdf(job: ExportJob) -> ExportedFile:
    """The original with corrected origins if there is one, else a new URDF."""
    if job.originals:
        return correct_urdf_origins(job, job.originals[0])
    placeholders = "limits of effort and velocity are placeholders: the robot file has none"
    return ExportedFile.from_text(
        format_new_urdf(job.robot), f"{placeholders}; {describe_inertia_assumptions(job.robot)}"
    )


def describe_inertia_assumptions(robot: Robot) -> str:
    """What of masses and inertias nobody told, in a sentence."""
    inertias = "inertias are assumed: of solid bodies as long as the links"
    if known_link_mass_mask(robot).all():
        return inertias
    return f"masses that the robot file does not tell are assumed (uniform tubes), and {inertias}"


def format_new_urdf(robot: Robot) -> str:
    """Links base_link, link_1 ... link_n, flange; each joint along its own z."""
    names = list_joint_names(robot)
    links = ["base_link", *(name.replace("joint", "link") for name in names), "flange"]
    lines = [
        '<?xml version="1.0"?>',
        "<!-- written by minimax-cal; limits of effort and velocity are placeholders -->",
        f'<robot name="{escape_xml_text(robot.name)}">',
        '  <link name="base_link"/>',
    ]
    lines += [format_link_element(robot, i, links[i + 1]) for i in range(robot.joints)]
    lines += [f'  <link name="{name}"/>' for name in list_massless_links(robot)]
    lines.append('  <link name="flange"/>')
    for i, (name, pose) in enumerate(
        zip((*names, "flange_joint"), joint_origins(robot), strict=True)
    ):
        last = i == robot.joints
        parts = (
            [UrdfJointPart(name, links[i], links[i + 1])]
            if last
            else split_coupled_joint(robot, i, links)
        )
        for part in parts:
            bounded = np.isfinite([part.lower, part.upper]).any()
            kind = "fixed" if last else "prismatic" if robot.prismatic[i] else "continuous"
            kind = "revolute" if kind == "continuous" and bounded else kind
            lines += [
                f'  <joint name="{part.name}" type="{kind}">',
                (
                    f'    <origin xyz="{format_number_triple(pose[:3, 3])}" '
                    f'rpy="{format_number_triple(pose_to_rpy(pose))}"/>'
                ),
                f'    <parent link="{part.parent}"/>',
                f'    <child link="{part.child}"/>',
            ]
            if not last:
                lines.append(f'    <axis xyz="0 0 {int(robot.sign[i])}"/>')
                lines.append(format_limit_element(part.lower, part.upper, kind))
            lines += [part.mimic] if part.mimic else []
            lines.append("  </joint>")
            pose = np.eye(4)
    return "\n".join([*lines, "</robot>", ""])


@dataclass(frozen=True)
class UrdfJointPart:
    """A joint of the URDF, with its limits.  mimic: its element, empty where it has a drive."""

    name: str
    parent: str
    child: str
    lower: float = -np.inf
    upper: float = np.inf
    mimic: str = ""


def split_coupled_joint(
    robot: Robot, joint_index: int, link_names: Sequence[str]
) -> list[UrdfJointPart]:
    """Joint i as joints on one axis: one for each other that it follows, then its own drive.

    Raises OptionError for a joint that takes another share than 1 of its own value.
    """
    name, limits = (
        list_joint_names(robot)[joint_index],
        (robot.lower[joint_index], robot.upper[joint_index]),
    )
    if not len(robot.coupling):
        return [UrdfJointPart(name, link_names[joint_index], link_names[joint_index + 1], *limits)]
    shares = robot.coupling[joint_index]
    if shares[joint_index] not in (0.0, 1.0):
        raise OptionError(
            f"urdf: joint {joint_index + 1} takes "
            f"{shares[joint_index]:g} of its own value; use json"
        )
    others = [int(j) for j in np.flatnonzero(shares) if j != joint_index]
    ends = [link_names[joint_index], *(f"link_{joint_index + 1}_with_{j + 1}" for j in others)]
    ends = (
        [*ends, link_names[joint_index + 1]]
        if shares[joint_index]
        else [*ends[:-1], link_names[joint_index + 1]]
    )
    drives, follow = list_joint_names(robot), []
    for at, j in enumerate(others):
        low, high = sorted(float(shares[j] * end) for end in (robot.lower[j], robot.upper[j]))
        mimic = f'    <mimic joint="{drives[j]}" multiplier="{format_exact_number(shares[j])}"/>'
        follow.append(
            UrdfJointPart(f"{name}_with_{j + 1}", ends[at], ends[at + 1], low, high, mimic)
        )
    return (
        [*follow, UrdfJointPart(name, ends[-2], ends[-1], *limits)]
        if shares[joint_index]
        else follow
    )


def list_massless_links(robot: Robot) -> list[str]:
    """Links between the joints on one axis, which have no body."""
    own = [f"link_{i + 1}" for i in range(robot.joints)]
    known = {*own, "base_link", "flange"}
    links = ["base_link", *own, "flange"]
    parts = [part for i in range(robot.joints) for part in split_coupled_joint(robot, i, links)]
    return [part.child for part in parts if part.child not in known]


def format_limit_element(lower: float, upper: float, joint_type: str) -> str:
    """The <limit> of a joint; an open end is as far as a robot file may go."""
    ends = (
        f'lower="{format_exact_number(max(lower, -MAX_LINK_LENGTH))}" '
        f'upper="{format_exact_number(min(upper, MAX_LINK_LENGTH))}" '
    )
    ends = "" if joint_type == "continuous" else ends
    return (
        f'    <limit {ends}effort="{PLACEHOLDER_EFFORT_LIMIT:g}'
        f'" velocity="{PLACEHOLDER_VELOCITY_LIMIT:g}"/>'
    )


def format_link_element(robot: Robot, link_index: int, link_name: str) -> str:
    """A <link> with its mass, as the robot tells it or assumed; simulators refuse one without."""
    masses, com = link_masses_and_centres(robot, MIN_SIMULATED_LINK_MASS)
    mass = float(masses[link_index])
    centre = centre_of_gravity_in_urdf_link(replace(robot, com=com), link_index)
    size = format_exact_number(assumed_link_inertia(robot.mdh, link_index, mass))
    inertia = f'ixx="{size}" ixy="0" ixz="0" iyy="{size}" iyz="0" izz="{size}"'
    return "\n".join(
        [
            f'  <link name="{link_name}">',
            "    <inertial>"
            if known_link_mass_mask(robot)[link_index]
            else f'    <inertial {ASSUMED_MASS_ATTRIBUTE}="true">',
            f'      <origin xyz="{format_number_triple(centre)}" rpy="0 0 0"/>',
            f'      <mass value="{format_exact_number(mass)}"/>',
            f"      <inertia {inertia}/>",
            "    </inertial>",
            "  </link>",
        ]
    )


def centre_of_gravity_in_urdf_link(robot: Robot, link_index: int) -> Array:
    """The centre of gravity in the URDF's link, whose z is the joint axis: (3,) [m]."""
    rest = a_alpha_beta_transform(robot.mdh[link_index])
    return np.asarray(rest[:3, :3] @ robot.com[link_index] + rest[:3, 3])
