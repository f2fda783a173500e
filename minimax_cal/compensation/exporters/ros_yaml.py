"""Joint origins as YAML, for launch files and xacro that take parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from minimax_cal.compensation.exporters.export_job import (
    ExportedFile,
    ExportJob,
    joint_origins,
    list_joint_names,
)
from minimax_cal.robots.transforms import pose_to_rpy

ROS_YAML_HEADER = (
    "# Written by minimax-cal.  Origin of each joint in the link before it [m, rad], as a URDF's\n"
    "# <origin>: Txyz Rz(yaw) Ry(pitch) Rx(roll).  `flange` is fixed to the last link.\n"
)


def build_ros_yaml(job: ExportJob) -> ExportedFile:
    """One entry a joint: type, axis, origin, limits; then the flange."""
    robot, joints = job.robot, dict[str, Any]()
    for i, (name, pose) in enumerate(
        zip((*list_joint_names(robot), "flange"), joint_origins(robot), strict=True)
    ):
        place = {"xyz": pose[:3, 3].tolist(), "rpy": pose_to_rpy(pose).tolist()}
        if i == robot.joints:
            joints[name] = {"type": "fixed", "origin": place}
            continue
        kind = "prismatic" if robot.prismatic[i] else "revolute"
        joints[name] = {"type": kind, "axis": [0, 0, int(robot.sign[i])], "origin": place}
        ends = {"lower": float(robot.lower[i]), "upper": float(robot.upper[i])}
        joints[name] |= {key: value for key, value in ends.items() if np.isfinite(value)}
    content = {"robot": robot.name, "joints": joints}
    return ExportedFile.from_text(
        ROS_YAML_HEADER
        + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200)
    )
