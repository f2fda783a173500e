"""Joint origins as YAML, for launch files and xacro that take parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from minimax_cal.correcting.exporters.job import Export, Job, joint_names, origins
from minimax_cal.robots.transforms import to_rpy

HEADER = (
    "# Written by minimax-cal.  Origin of each joint in the link before it [m, rad], as a URDF's\n"
    "# <origin>: Txyz Rz(yaw) Ry(pitch) Rx(roll).  `flange` is fixed to the last link.\n"
)


def write(job: Job) -> Export:
    """One entry a joint: type, axis, origin, limits; then the flange."""
    robot, joints = job.robot, dict[str, Any]()
    for i, (name, pose) in enumerate(
        zip((*joint_names(robot), "flange"), origins(robot), strict=True)
    ):
        place = {"xyz": pose[:3, 3].tolist(), "rpy": to_rpy(pose).tolist()}
        if i == robot.joints:
            joints[name] = {"type": "fixed", "origin": place}
            continue
        kind = "prismatic" if robot.prismatic[i] else "revolute"
        joints[name] = {"type": kind, "axis": [0, 0, int(robot.sign[i])], "origin": place}
        ends = {"lower": float(robot.lower[i]), "upper": float(robot.upper[i])}
        joints[name] |= {key: value for key, value in ends.items() if np.isfinite(value)}
    content = {"robot": robot.name, "joints": joints}
    return Export.of(
        HEADER + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200)
    )
