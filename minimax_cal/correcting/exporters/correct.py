"""A given URDF with the joint origins of the calibrated arm; every other byte stays.

Each link keeps its place relative to its own joint axis, so meshes, masses and side branches move
with the corrected axis.  Frames: N_i of the nominal robot and C_i of the calibrated one, both laid
into the root link; a link frame is U_i = N_i-1 X_i, and its corrected one C_i-1 X_i.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from minimax_cal.correcting.exporters.job import Export, Job, is_identity, triple
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.robots.kinematics import rotation_vector
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import (
    SAME,
    along,
    difference,
    from_rpy,
    inverse,
    link,
    shared_base,
    to_rpy,
    transform,
)
from minimax_cal.robots.urdf import (
    EXACT,
    UrdfRobot,
    follow_of,
    random_joints,
    tip_poses,
    to_robot,
)
from minimax_cal.robots.urdf_file import Joint, Urdf, edited, origin_edit, parse_urdf

MISFIT = 0.02  # the nominal robot and the URDF may differ by so much [m, rad]
NOTED = 1e-6  # from here on the difference is worth a notice [m, rad]


def correct(job: Job, urdf: Urdf) -> Export:
    """The URDF with corrected joint origins, checked by forward kinematics."""
    model = to_robot(urdf, job.tip)
    chain, moving = model.chain, [joint for joint in model.chain if joint.moves]
    base, misfit = match(job.nominal, model)
    frames = [tip_poses(chain[: chain.index(j) + 1], zeros(chain, j))[0] for j in moving]
    links = [
        seated(inverse(before) @ frame, joint, sign)
        for before, frame, joint, sign in zip(
            laid(job.nominal, base), frames, moving, job.nominal.sign, strict=False
        )
    ]
    tip = inverse(frames[-1]) @ tip_poses(chain, np.zeros((1, len(moving))))[0]
    tool = inverse(link(job.nominal.mdh[-1])) @ links[-1] @ tip
    placed = laid(job.robot, base)
    targets = [pose @ x for pose, x in zip(placed, links, strict=False)]
    raw = rewritten(urdf, chain, targets, placed[-1] @ tool)
    q = random_joints(job.robot.lower, job.robot.upper)
    written = tip_poses(to_robot(parse_urdf(raw, urdf.source), job.tip or chain[-1].child).chain, q)
    if (worst := difference(written, base @ job.robot.pose(q) @ tool)) > EXACT:
        raise OptionError(f"{urdf.source}: cannot hold this geometry (off by {worst:.1e} m)")
    notices = [*constants(base, tool, chain[0].parent, chain[-1].child)]
    if misfit > NOTED:
        notices.append(
            f"{urdf.source} and the nominal robot differ by up to {1e3 * misfit:.3g} mm or mrad: "
            "the written file follows the calibrated robot"
        )
    return Export(raw, tuple(notices))


def zeros(chain: Sequence[Joint], last: Joint) -> Array:
    """Joint values 0 of the chain up to a joint: (1, n)."""
    return np.zeros((1, sum(joint.moves for joint in chain[: chain.index(last) + 1])))


def laid(robot: Robot, base: Array) -> list[Array]:
    """The robot's frames 0 ... n at joint values 0 in the root link."""
    out = [base]
    for row in robot.mdh:
        out.append(out[-1] @ link(row))
    return out


def match(nominal: Robot, model: UrdfRobot) -> tuple[Array, float]:
    """Frame 0 of the nominal robot in the URDF's root link, and how well the arms agree [m].

    Each joint alone, and random poses: what they do to space must be the same up to one constant
    transform, whatever frames either file chose.  Raises OptionError where it is not.
    """
    chain, source = model.chain, model.urdf.source
    moving = [joint for joint in chain if joint.moves]
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
    q = np.vstack([0.5 * np.eye(n), random_joints(np.full(n, -1.0), np.full(n, 1.0), 3 * n)])
    urdf = tip_poses(chain, q) @ inverse(tip_poses(chain, rest)[0])
    ours = nominal.pose(q) @ inverse(nominal.pose(rest)[0])
    for base in (model.base, shared_base(urdf, ours)):
        pairs = zip(urdf @ base, base @ ours, strict=True)
        gap = np.array([gap_of(a, b) for a, b in pairs])
        if gap.max() <= EXACT:
            break
    if gap.max() > MISFIT:
        worst = int(np.argmax(gap[:n]))
        raise OptionError(
            f"{source}: moves otherwise than the nominal robot of the fit, up to "
            f"{1e3 * gap.max():.3g} mm or mrad, most at joint {worst + 1} ({moving[worst].name}): "
            "another robot, another zero position or another sense of a joint?"
        )
    return base, float(gap.max())


def gap_of(one: Array, other: Array) -> float:
    """How far two poses lie apart, the larger of metres and radians."""
    turned = rotation_vector(one[:3, :3].T @ other[:3, :3])
    return float(max(np.linalg.norm(one[:3, 3] - other[:3, 3]), np.linalg.norm(turned)))


def seated(frame: Array, joint: Joint, sign: float) -> Array:
    """A link frame moved as little as possible so that its joint axis is z (times sign).

    For a joint that turns, its origin comes to lie on the axis.
    """
    axis = frame[:3, :3] @ joint.axis * sign
    rotation = along(axis).T @ frame[:3, :3]
    keep = np.ones(3) if joint.kind == "prismatic" else np.array([0.0, 0.0, 1.0])
    return transform(rotation, frame[:3, 3] * keep)


def rewritten(urdf: Urdf, chain: Sequence[Joint], targets: Sequence[Array], tip: Array) -> bytes:
    """The bytes of the URDF with each moving joint's link where targets say, and the tip at tip."""
    wanted: dict[str, Array] = {}
    at, number = np.eye(4), 0
    rest = follow_of(chain).offset  # of mimics at joint values 0
    for joint in chain:
        if joint.moves:
            there = inverse(joint.motion(rest[[number]])[0])
            wanted[joint.name] = inverse(at) @ targets[number] @ there
            at, number = targets[number], number + 1
        else:
            at = at @ joint.origin
    last = max(i for i, joint in enumerate(chain) if joint.moves)
    after = tip_poses(chain[last + 1 :], np.zeros((1, 0)))[0]
    if difference(inverse(targets[-1]) @ tip, after) > SAME:  # the last link was calibrated too
        if last + 1 < len(chain):
            beyond = tip_poses(chain[last + 2 :], np.zeros((1, 0)))[0]
            wanted[chain[last + 1].name] = inverse(targets[-1]) @ tip @ inverse(beyond)
        else:
            wanted[chain[last].name] = wanted[chain[last].name] @ inverse(targets[-1]) @ tip

    edits = []
    for joint in chain:
        new = wanted.get(joint.name, joint.origin)
        if difference(new, joint.origin) > SAME:
            edits.append(origin_edit(urdf.raw, joint, partial(origin_text, new)))
    return edited(urdf.raw, edits)


def origin_text(pose: Array, rpy: Array) -> tuple[str, str]:
    """xyz and rpy of an origin, the rpy near those that stood there.

    A rotation that stayed keeps its numbers, as far as a rounding error goes.
    """
    same = np.abs(from_rpy(np.zeros(3), rpy)[:3, :3] - pose[:3, :3]).max() <= SAME
    return triple(pose[:3, 3]), triple(rpy if same else to_rpy(pose, rpy))


def constants(base: Array, tool: Array, root: str, tip: str) -> list[str]:
    """What stands between the robot and the URDF, for people."""
    out = []
    for what, pose in ((f"{root} to the robot's base", base), (f"last frame to {tip}", tool)):
        if not is_identity(pose):
            xyz = ", ".join(f"{1e3 * v:.4f}" for v in pose[:3, 3])
            rpy = ", ".join(f"{v:.6f}" for v in to_rpy(pose))
            out.append(f"constant transform {what}: xyz ({xyz}) mm, rpy ({rpy}) rad")
    return out
