"""What an arm can take and a tracker can see: floor, box, body, cones, range, line of sight.

The arm's body is a crude one: every link a pair of segments (along the joint axis, then along the
common normal) with one radius for all.  It knows nothing of cables, tools or the cell: nobody has
checked the poses for collisions.  Everything is in the robot's base axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import LinkFrames
from minimax_cal.robots.robot import Robot

BODY_RADIUS_FRACTION_OF_REACH = 0.04  # radius of the body, as a share of the arm's reach
FULL_ACCEPTANCE_ANGLE = np.pi  # acceptance of a target that can be seen from everywhere [rad]
MAX_NEIGHBOUR_DISTANCE_RADII = (
    2.5  # radii of arm between two segments below which they are neighbours
)
NORMAL_DIRECTIONS = ("flange", "radial")


@dataclass(frozen=True, eq=False)
class TrackerVisibility:
    """Where the instrument stands and what it can see.

    position: (3,) in base axes [m].  up: (3,) its vertical, that of the world.
    acceptance: half angle of a target's cone [rad].  near, far: limits of range [m].
    low, high: limits of elevation [rad].
    """

    position: Array
    up: Array
    acceptance: float = np.radians(30.0)
    near: float = 0.5
    far: float = 50.0
    low: float = np.radians(-50.0)
    high: float = np.radians(75.0)


@dataclass(frozen=True, eq=False)
class ArmWorkspace:
    """An arm with targets, and where it may go.

    target_positions, normals: (k, 3) of the targets in the last frame [m], unit vectors.
    lower, upper: (n,) of the joints [rad, m].  radius: of the body [m].
    floor: height of the floor above the base's origin [m].
    low, high: (3,) box in base axes in which the flange must stay, infinite where open [m].
    all_targets_required: whether a pose counts only if every target is seen.
    """

    robot: Robot
    target_positions: Array
    normals: Array
    lower: Array
    upper: Array
    radius: float
    floor: float = 0.0
    low: Array = field(default_factory=lambda: np.full(3, -np.inf))
    high: Array = field(default_factory=lambda: np.full(3, np.inf))
    all_targets_required: bool = False


def target_normals(target_positions: Array, normal_direction: str) -> Array:
    """(k, 3) outward normals of targets: along the flange's axis, or away from it.

    A target on the axis looks along it.  Raises OptionError.
    """
    if normal_direction not in NORMAL_DIRECTIONS:
        raise OptionError(
            f"no normals {normal_direction!r}; choose {' or '.join(NORMAL_DIRECTIONS)}"
        )
    out = np.zeros_like(target_positions)
    out[:, 2] = 1.0
    aside = np.linalg.norm(target_positions[:, :2], axis=1)
    if normal_direction == "radial":
        off = aside > 1e-9
        out[off] = 0.0
        out[off, :2] = target_positions[off, :2] / aside[off, None]
    return out


# ---- the arm at some poses ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ArmAtPoses:
    """An arm at m poses, before an instrument."""

    workspace: ArmWorkspace
    visibility: TrackerVisibility
    q: Array

    @cached_property
    def link_chain(self) -> LinkFrames:
        """The chain of the arm."""
        robot = self.workspace.robot
        return kinematics.compute_link_frames(
            robot.mdh, robot.chain_joint_values(self.q), robot.prismatic
        )

    @cached_property
    def target_points(self) -> Array:
        """(k, 3, m) the targets [m]."""
        return kinematics.targets_in_base(self.link_chain, self.workspace.target_positions)

    @cached_property
    def target_to_tracker_vectors(self) -> Array:
        """(k, 3, m) from the targets to the instrument [m]."""
        return np.asarray(self.visibility.position[:, None] - self.target_points)

    @cached_property
    def tracker_distances(self) -> Array:
        """(k, m) distances of the targets from the instrument [m]."""
        return np.asarray(np.linalg.norm(self.target_to_tracker_vectors, axis=1))

    @cached_property
    def skeleton_corners(self) -> Array:
        """(2n + 1, 3, m) corners of the arm: along z, then along x, link by link [m]."""
        links = self.link_chain
        a = self.workspace.robot.mdh[:, kinematics.A, None, None]
        corner = links.after - a * links.x
        both = np.stack([corner, links.after], axis=1).reshape(-1, *corner.shape[1:])
        return np.concatenate([links.before[:1], both])

    @cached_property
    def nonzero_segment_indices(self) -> list[int]:
        """Segments of the skeleton that have a length, by their first corner."""
        length = np.linalg.norm(np.diff(self.skeleton_corners, axis=0), axis=1).max(axis=1)
        return [int(i) for i in np.flatnonzero(length > 1e-6)]


def is_arm_above_floor(arm: ArmAtPoses) -> Array:
    """All beyond the end of link 2, it included, stays its own radius above the floor."""
    room = arm.workspace
    moving = np.concatenate([arm.skeleton_corners[4:], arm.target_points])
    height = np.einsum("i,vim->vm", room.robot.up, moving)
    return np.asarray(height.min(axis=0) > room.floor + room.radius)


def is_flange_in_box(arm: ArmAtPoses) -> Array:
    """The flange stays in the box."""
    flange = arm.link_chain.origin
    low, high = arm.workspace.low[:, None], arm.workspace.high[:, None]
    return np.asarray(((flange >= low) & (flange <= high)).all(axis=0))


def is_free_of_self_collision(arm: ArmAtPoses) -> Array:
    """Segments of the arm that are not near neighbours stay two radii apart."""
    bones, corner = arm.nonzero_segment_indices, arm.skeleton_corners
    length = np.linalg.norm(np.diff(corner, axis=0), axis=1).max(axis=1)
    free = np.ones(len(arm.q), dtype=bool)
    for place, one in enumerate(bones):
        for other in bones[place + 1 :]:
            # with less between them they touch wherever the joints between them are
            if length[one + 1 : other].sum() > MAX_NEIGHBOUR_DISTANCE_RADII * arm.workspace.radius:
                ends = (corner[one], corner[one + 1], corner[other], corner[other + 1])
                free &= segment_distances(*ends) > 2.0 * arm.workspace.radius
    return free


def is_tracker_in_target_cone(arm: ArmAtPoses) -> Array:
    """The instrument is inside the target's cone."""
    if arm.visibility.acceptance >= FULL_ACCEPTANCE_ANGLE:
        return np.ones(arm.tracker_distances.shape, dtype=bool)
    axes = arm.link_chain.axes
    normal = (arm.workspace.normals @ axes.reshape(3, -1)).reshape(-1, *axes.shape[1:])
    along = (normal * arm.target_to_tracker_vectors).sum(axis=1)
    return np.asarray(along > np.cos(arm.visibility.acceptance) * arm.tracker_distances)


def is_tracker_in_range(arm: ArmAtPoses) -> Array:
    """Neither too near nor too far."""
    return np.asarray(
        (arm.tracker_distances >= arm.visibility.near)
        & (arm.tracker_distances <= arm.visibility.far)
    )


def is_elevation_in_limits(arm: ArmAtPoses) -> Array:
    """The instrument can look so high and so low."""
    rise = -np.einsum("i,kim->km", arm.visibility.up, arm.target_to_tracker_vectors)
    angle = np.arcsin(np.clip(rise / np.maximum(arm.tracker_distances, 1e-9), -1.0, 1.0))
    return np.asarray((angle >= arm.visibility.low) & (angle <= arm.visibility.high))


def is_line_of_sight_free(arm: ArmAtPoses) -> Array:
    """The line of sight passes the body; two radii before the target the body is not looked at."""
    k, m = arm.tracker_distances.shape
    short = np.minimum(2.0 * arm.workspace.radius / np.maximum(arm.tracker_distances, 1e-9), 1.0)[
        :, None
    ]
    end = arm.target_points + short * arm.target_to_tracker_vectors
    free = np.ones((k, m), dtype=bool)
    eye = arm.target_points + arm.target_to_tracker_vectors
    for bone in arm.nonzero_segment_indices:
        for target in range(k):
            away = segment_distances(
                eye[target], end[target], arm.skeleton_corners[bone], arm.skeleton_corners[bone + 1]
            )
            free[target] &= away > arm.workspace.radius
    return free


PoseCondition = Callable[[ArmAtPoses], Array]
ARM_CONDITIONS: Mapping[str, PoseCondition] = {  # (m,) of the arm
    "floor": is_arm_above_floor,
    "volume": is_flange_in_box,
    "self-collision": is_free_of_self_collision,
}
TARGET_CONDITIONS: Mapping[str, PoseCondition] = {  # (k, m) of each target
    "acceptance": is_tracker_in_target_cone,
    "range": is_tracker_in_range,
    "elevation": is_elevation_in_limits,
    "line of sight": is_line_of_sight_free,
}


def segment_distances(
    first_start: Array, first_end: Array, second_start: Array, second_end: Array
) -> Array:
    """(m,) least distance between segments ab and cd.  first_start, first_end, second_start,
    second_end: (3, m).

    Of the nearest points of the two lines one is clamped to its segment, the other is the foot
    on the other segment, and back.
    """
    u, v, w = first_end - first_start, second_end - second_start, first_start - second_start
    uu, vv = ((x * x).sum(axis=0) for x in (u, v))
    uv, uw, vw = ((x * y).sum(axis=0) for x, y in ((u, v), (u, w), (v, w)))
    cross = uu * vv - uv * uv
    parallel = cross <= 1e-12 * uu * vv
    s = np.where(parallel, 0.0, (uv * vw - vv * uw) / np.where(parallel, 1.0, cross))
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, 1e-300), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(w + s * u - t * v, axis=0))
