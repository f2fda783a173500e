"""Universal Robots' files of a calibrated arm: `calibration.conf`, `ur_description`'s YAML."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.core.files import read_text
from minimax_cal.robots.parallel_axes import move_frames_along_parallel_axes
from minimax_cal.robots.robot import Robot, builtin_robots, load_builtin_robot, robot_from_dict
from minimax_cal.robots.transforms import transform_from_xyz_rpy
from minimax_cal.robots.urdf_file import Urdf, UrdfJoint
from minimax_cal.robots.urdf_robot import convert_urdf_to_robot

UR_LINK_NAMES = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
UR_ORIGIN_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
UR_DELTA_KEYS = ("delta_a", "delta_d", "delta_theta", "delta_alpha")  # as columns of the links
UR_JOINT_COUNT = 6
MAX_UR_LENGTH_DEVIATION = 0.01  # of a made arm from its drawing [m]


def read_ur_calibration(path: Path, model_name: str = "") -> Robot:
    """The arm of a `calibration.conf`: a built-in UR with the deviations of the file added.

    model_name: of the built-in robot; by default the only one whose lengths the file leaves alike.
    Raises RobotError.
    """
    text = read_text(path, error_type=RobotError)
    deltas = np.zeros((UR_JOINT_COUNT, 5))
    for column, key in enumerate(UR_DELTA_KEYS):
        found = re.search(rf"^\s*{key}\s*=\s*\[([^\]]*)\]", text, re.M)
        try:
            numbers = [float(cell) for cell in found[1].split(",")] if found else []
        except ValueError:
            numbers = []
        if len(numbers) != UR_JOINT_COUNT or not np.isfinite(numbers).all():
            raise RobotError(f"{path}: needs {key} = [...] with six numbers, as UR's file has it")
        deltas[:, column] = numbers
    names = [name for name in builtin_robots() if re.fullmatch(r"ur\d+e?", name)]
    if model_name and model_name not in names:
        raise RobotError(f"{path}#{model_name}: no such UR; choose one of {', '.join(names)}")
    robots = [load_builtin_robot(name) for name in ([model_name] if model_name else names)]
    deviations = [largest_length_change(robot, deltas) for robot in robots]
    fitting = [i for i, size in enumerate(deviations) if size < MAX_UR_LENGTH_DEVIATION]
    if not model_name and len(fitting) != 1:
        near = [names[i] for i in fitting] or names  # the lengths of a UR5 and a UR5e are alike
        raise RobotError(
            f"{path}: does not say of which UR it is; name it, as {path.name}#{near[0]} "
            f"({', '.join(near)} are possible)"
        )
    drawn = robots[0] if model_name else robots[fitting[0]]
    return replace(
        drawn,
        name=f"{drawn.name} ({path.name})",
        mdh=move_frames_along_parallel_axes(drawn.mdh + deltas).mdh,
        notices=(f"{path.name}: deviations of {drawn.name}'s links, frames on its parallel axes",),
    )


def largest_length_change(robot: Robot, deltas: Array) -> float:
    """How far a length of a UR changes by the deviations (6, 5) of its links [m]."""
    moved = move_frames_along_parallel_axes(robot.mdh + deltas).mdh
    return float(np.abs(moved[:, :2] - robot.mdh[:, :2]).max())


def is_ur_kinematics(content: Mapping[str, Any]) -> bool:
    """Whether a YAML document has the keys of `ur_description`'s kinematics."""
    table = content.get("kinematics")
    return isinstance(table, Mapping) and {*UR_LINK_NAMES} <= {*table}


def convert_ur_kinematics(content: Mapping[str, Any], source: str) -> Robot:
    """The arm of `ur_description`'s kinematics YAML: origins of joints that turn about their z.

    Raises RobotError.
    """
    joints: list[UrdfJoint] = []
    parent = root = "base"
    for name in UR_LINK_NAMES:
        row = content["kinematics"][name]
        try:
            numbers = np.array([float(row[key]) for key in UR_ORIGIN_KEYS])
            if not np.isfinite(numbers).all():
                raise ValueError
        except (KeyError, TypeError, ValueError) as error:
            keys = ", ".join(UR_ORIGIN_KEYS)
            raise RobotError(f"{source}: {name} needs the numbers {keys}") from error
        joints.append(
            UrdfJoint(
                name=f"{name}_joint",
                kind="continuous",
                parent=parent,
                child=name,
                origin=transform_from_xyz_rpy(numbers[:3], numbers[3:]),
                axis=np.array([0.0, 0.0, 1.0]),
                lower=-np.inf,
                upper=np.inf,
                mimic=None,
            )
        )
        parent = name
    found = convert_urdf_to_robot(Urdf(source, b"", "ur", root, tuple(joints), {}))
    robot = robot_from_dict(found.content | {"name": Path(source).stem}, source)
    return replace(robot, notices=found.base_and_tool_notices)
