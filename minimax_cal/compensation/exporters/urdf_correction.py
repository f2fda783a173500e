"""A given URDF with the joint origins of the calibrated arm; every other byte stays.

Each link keeps its place relative to its own joint axis, so meshes, masses and side branches move
with the corrected axis.  Frames: N_i of the nominal robot and C_i of the calibrated one, both laid
into the root link; a link frame is U_i = N_i-1 X_i, and its corrected one C_i-1 X_i.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from minimax_cal.compensation.exporters.export_job import (
    ExportedFile,
    ExportJob,
    format_number_triple,
    is_identity_transform,
)
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.robots.kinematics import rotation_to_vector
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import (
    MAX_EQUAL_TRANSFORM_DIFFERENCE,
    build_transform,
    fit_shared_base,
    invert_transform,
    link_transform,
    max_entry_difference,
    pose_to_rpy,
    rotation_from_z_to_direction,
    transform_from_xyz_rpy,
)
from minimax_cal.robots.urdf_file import (
    Urdf,
    UrdfJoint,
    apply_byte_edits,
    build_origin_edit,
    parse_urdf,
)
from minimax_cal.robots.urdf_robot import (
    MAX_FORWARD_KINEMATICS_ERROR,
    UrdfRobot,
    build_mimic_map,
    convert_urdf_to_robot,
    random_joint_values_in_limits,
    tip_poses,
)

MAX_URDF_MISFIT = 0.02  # the nominal robot and the URDF may differ by so much [m, rad]
MIN_NOTED_URDF_MISFIT = 1e-6  # from here on the difference is worth a notice [m, rad]


def correct_urdf_origins(job: ExportJob, urdf: Urdf) -> ExportedFile:
    """The URDF with corrected joint origins, checked by forward kinematics."""
    model = convert_urdf_to_robot(urdf, job.tip)
    chain, moving = model.chain, [joint for joint in model.chain if joint.is_moving]
    base, misfit = match_robot_to_urdf(job.nominal, model)
    frames = [
        tip_poses(chain[: chain.index(j) + 1], zero_joint_values(chain, j))[0] for j in moving
    ]
    links = [
        align_frame_with_joint_axis(invert_transform(before) @ frame, joint, sign)
        for before, frame, joint, sign in zip(
            link_frames_at_zero(job.nominal, base), frames, moving, job.nominal.sign, strict=False
        )
    ]
    tip = invert_transform(frames[-1]) @ tip_poses(chain, np.zeros((1, len(moving))))[0]
    tool = invert_transform(link_transform(job.nominal.mdh[-1])) @ links[-1] @ tip
    placed = link_frames_at_zero(job.robot, base)
    targets = [pose @ x for pose, x in zip(placed, links, strict=False)]
    raw = replace_urdf_origins(urdf, chain, targets, placed[-1] @ tool)
    q = random_joint_values_in_limits(job.robot.lower, job.robot.upper)
    written = tip_poses(
        convert_urdf_to_robot(parse_urdf(raw, urdf.source), job.tip or chain[-1].child).chain, q
    )
    if (
        worst := max_entry_difference(written, base @ job.robot.pose(q) @ tool)
    ) > MAX_FORWARD_KINEMATICS_ERROR:
        raise OptionError(f"{urdf.source}: cannot hold this geometry (off by {worst:.1e} m)")
    notices = [*describe_constant_transforms(base, tool, chain[0].parent, chain[-1].child)]
    if misfit > MIN_NOTED_URDF_MISFIT:
        notices.append(
            f"{urdf.source} and the nominal robot differ by up to {1e3 * misfit:.3g} mm or mrad: "
            "the written file follows the calibrated robot"
        )
    return ExportedFile(raw, tuple(notices))


def zero_joint_values(chain: Sequence[UrdfJoint], last_joint: UrdfJoint) -> Array:
    """Joint values 0 of the chain up to a joint: (1, n)."""
    return np.zeros((1, sum(joint.is_moving for joint in chain[: chain.index(last_joint) + 1])))


def link_frames_at_zero(robot: Robot, base: Array) -> list[Array]:
    """The robot's frames 0 ... n at joint values 0 in the root link."""
    out = [base]
    for row in robot.mdh:
        out.append(out[-1] @ link_transform(row))
    return out


class UrdfMatch(NamedTuple):
    """Frame 0 of a robot in the URDF's root link (4, 4), and how far the arms differ [m]."""

    base: Array
    misfit: float


def match_robot_to_urdf(nominal: Robot, urdf_robot: UrdfRobot) -> UrdfMatch:
    """Frame 0 of the nominal robot in the URDF's root link, and how well the arms agree [m].

    Each joint alone, and random poses: what they do to space must be the same up to one constant
    transform, whatever frames either file chose.  Raises OptionError where it is not.
    """
    chain, source = urdf_robot.chain, urdf_robot.urdf.source
    moving = [joint for joint in chain if joint.is_moving]
    n = len(moving)
    if n != nominal.joints:
        raise OptionError(
            f"{source}: its chain to {chain[-1].child!r} has {n} moving joints, "
            f"the robot {nominal.joints}; name another last link with tip"
        )
    slides = np.array([joint.kind == "prismatic" for joint in moving])
    if (slides != nominal.prismatic).any():
        number = int(np.argmax(slides != nominal.prismatic))
        raise OptionError(
            f"{source}: joint {number + 1} ({moving[number].name}) slides in one of URDF "
            "and robot and turns in the other"
        )
    rest = np.zeros((1, n))
    q = np.vstack(
        [0.5 * np.eye(n), random_joint_values_in_limits(np.full(n, -1.0), np.full(n, 1.0), 3 * n)]
    )
    urdf = tip_poses(chain, q) @ invert_transform(tip_poses(chain, rest)[0])
    ours = nominal.pose(q) @ invert_transform(nominal.pose(rest)[0])
    for base in (urdf_robot.base, fit_shared_base(urdf, ours)):
        pairs = zip(urdf @ base, base @ ours, strict=True)
        gap = np.array([pose_difference(a, b) for a, b in pairs])
        if gap.max() <= MAX_FORWARD_KINEMATICS_ERROR:
            break
    if gap.max() > MAX_URDF_MISFIT:
        worst = int(np.argmax(gap[:n]))
        raise OptionError(
            f"{source}: moves otherwise than the nominal robot of the fit, up to "
            f"{1e3 * gap.max():.3g} mm or mrad, most at joint {worst + 1} ({moving[worst].name}): "
            "another robot, another zero position or another sense of a joint?"
        )
    return UrdfMatch(base, float(gap.max()))


def pose_difference(first_pose: Array, second_pose: Array) -> float:
    """How far two poses lie apart, the larger of metres and radians."""
    turned = rotation_to_vector(first_pose[:3, :3].T @ second_pose[:3, :3])
    return float(
        max(np.linalg.norm(first_pose[:3, 3] - second_pose[:3, 3]), np.linalg.norm(turned))
    )


def align_frame_with_joint_axis(frame: Array, joint: UrdfJoint, sign: float) -> Array:
    """A link frame moved as little as possible so that its joint axis is z (times sign).

    For a joint that turns, its origin comes to lie on the axis.
    """
    axis = frame[:3, :3] @ joint.axis * sign
    rotation = rotation_from_z_to_direction(axis).T @ frame[:3, :3]
    keep = np.ones(3) if joint.kind == "prismatic" else np.array([0.0, 0.0, 1.0])
    return build_transform(rotation, frame[:3, 3] * keep)


def replace_urdf_origins(
    urdf: Urdf, chain: Sequence[UrdfJoint], link_poses: Sequence[Array], tip_pose: Array
) -> bytes:
    """The bytes of the URDF with each moving joint's link where targets say, and the tip at tip."""
    wanted: dict[str, Array] = {}
    at, number = np.eye(4), 0
    rest = build_mimic_map(chain).offset  # of mimics at joint values 0
    for joint in chain:
        if joint.is_moving:
            there = invert_transform(joint.motion_transforms(rest[[number]])[0])
            wanted[joint.name] = invert_transform(at) @ link_poses[number] @ there
            at, number = link_poses[number], number + 1
        else:
            at = at @ joint.origin
    last = max(i for i, joint in enumerate(chain) if joint.is_moving)
    after = tip_poses(chain[last + 1 :], np.zeros((1, 0)))[0]
    if (
        max_entry_difference(invert_transform(link_poses[-1]) @ tip_pose, after)
        > MAX_EQUAL_TRANSFORM_DIFFERENCE
    ):  # the last link was calibrated too
        if last + 1 < len(chain):
            beyond = tip_poses(chain[last + 2 :], np.zeros((1, 0)))[0]
            wanted[chain[last + 1].name] = (
                invert_transform(link_poses[-1]) @ tip_pose @ invert_transform(beyond)
            )
        else:
            wanted[chain[last].name] = (
                wanted[chain[last].name] @ invert_transform(link_poses[-1]) @ tip_pose
            )

    edits = []
    for joint in chain:
        new = wanted.get(joint.name, joint.origin)
        if max_entry_difference(new, joint.origin) > MAX_EQUAL_TRANSFORM_DIFFERENCE:
            edits.append(build_origin_edit(urdf.raw, joint, partial(format_urdf_origin, new)))
    return apply_byte_edits(urdf.raw, edits)


class UrdfOrigin(NamedTuple):
    """The attributes of an origin."""

    xyz: str
    rpy: str


def format_urdf_origin(pose: Array, previous_rpy: Array) -> UrdfOrigin:
    """xyz and rpy of an origin, the rpy near those that stood there.

    A rotation that stayed keeps its numbers, as far as a rounding error goes.
    """
    same = (
        np.abs(transform_from_xyz_rpy(np.zeros(3), previous_rpy)[:3, :3] - pose[:3, :3]).max()
        <= MAX_EQUAL_TRANSFORM_DIFFERENCE
    )
    return UrdfOrigin(
        format_number_triple(pose[:3, 3]),
        format_number_triple(previous_rpy if same else pose_to_rpy(pose, previous_rpy)),
    )


def describe_constant_transforms(
    base: Array, tool: Array, root_link: str, tip_link: str
) -> list[str]:
    """What stands between the robot and the URDF, for people."""
    out = []
    for what, pose in (
        (f"{root_link} to the robot's base", base),
        (f"last frame to {tip_link}", tool),
    ):
        if not is_identity_transform(pose):
            xyz = ", ".join(f"{1e3 * v:.4f}" for v in pose[:3, 3])
            rpy = ", ".join(f"{v:.6f}" for v in pose_to_rpy(pose))
            out.append(f"constant transform {what}: xyz ({xyz}) mm, rpy ({rpy}) rad")
    return out
