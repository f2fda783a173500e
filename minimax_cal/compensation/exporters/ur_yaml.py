"""Universal Robots kinematics YAML, as `ur_description` takes it (`kinematics_params`)."""

from __future__ import annotations

import hashlib

import numpy as np
import yaml

from minimax_cal.compensation.exporters.export_job import (
    ExportedFile,
    ExportJob,
    is_identity_transform,
    joint_origins,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.robots.transforms import axis_rotation, pose_to_rpy

UR_LINK_NAMES = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
MAX_UR_AXIS_MISALIGNMENT = 0.1  # sine of the angle by which an axis may be off
UR_ORIGIN_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
UR_YAML_HEADER = (
    "# Written by minimax-cal.  Joint origins in metres and radians, from the controller's base\n"
    "# frame; each joint turns about its own z.  The hash is of these numbers.\n"
)


def build_ur_yaml(job: ExportJob) -> ExportedFile:
    """Six turning joints; a joint of sign -1 is turned over exactly.  Raises OptionError."""
    robot = job.robot
    if robot.joints != len(UR_LINK_NAMES) or robot.prismatic.any():
        raise OptionError("ur-yaml: the format is for arms with six turning joints")
    over = [axis_rotation(0, 0.0 if sign > 0 else np.pi) for sign in robot.sign]
    poses = joint_origins(robot)
    for i, flip in enumerate(over):  # Rz(-q) = Rx(pi) Rz(q) Rx(pi)
        poses[i], poses[i + 1] = poses[i] @ flip, flip.T @ poses[i + 1]
    if not is_identity_transform(poses[-1]):
        raise OptionError(
            "ur-yaml: the format ends at the last joint's own frame and has no place for a, "
            "alpha, beta (or a sign of -1) of the last link; use urdf or ros-yaml"
        )
    table = {
        name: dict(
            zip(
                UR_ORIGIN_KEYS,
                (float(v) + 0.0 for v in (*pose[:3, 3], *pose_to_rpy(pose))),
                strict=True,
            )
        )
        for name, pose in zip(UR_LINK_NAMES, poses, strict=False)
    }
    text = yaml.safe_dump(
        {"kinematics": table | {"hash": hash_kinematics_table(table)}}, sort_keys=False
    )
    return ExportedFile.from_text(
        UR_YAML_HEADER + text,
        *warn_of_non_ur_axes(job),
        "the hash is of these numbers and is not the controller's checksum: the driver will warn "
        "that the two differ",
    )


def warn_of_non_ur_axes(job: ExportJob) -> tuple[str, ...]:
    """A notice where the axes are not those of a Universal Robots arm: 2, 3 and 4 are parallel."""
    alpha = job.robot.mdh[:, 3]
    parallel, square = np.sin(alpha[[1, 2]]), np.cos(alpha[[0, 3, 4]])
    if max(np.abs(parallel).max(), np.abs(square).max()) < MAX_UR_AXIS_MISALIGNMENT:
        return ()
    return (
        f"{job.robot.name} has not the axes of a Universal Robots arm, and only their driver and "
        "ur_description read this file; for others use urdf or ros-yaml",
    )


def hash_kinematics_table(table: dict[str, dict[str, float]]) -> str:
    """calib_<n>, a function of the numbers alone."""
    text = ";".join(f"{name}:{key}={v!r}" for name, row in table.items() for key, v in row.items())
    return f"calib_{int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], 'big')}"
