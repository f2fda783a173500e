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

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import Chain
from minimax_cal.robots.robot import Robot

THICK = 0.04  # radius of the body, as a share of the arm's reach
ANYWHERE = np.pi  # acceptance of a target that can be seen from everywhere [rad]
NEIGHBOUR_RADII = 2.5  # radii of arm between two segments below which they are neighbours
NORMALS = ("flange", "radial")


@dataclass(frozen=True, eq=False)
class Sight:
    """Where the instrument stands and what it can see.

    place: (3,) in base axes [m].  up: (3,) its vertical, that of the world.
    acceptance: half angle of a target's cone [rad].  near, far: limits of range [m].
    low, high: limits of elevation [rad].
    """

    place: Array
    up: Array
    acceptance: float = np.radians(30.0)
    near: float = 0.5
    far: float = 50.0
    low: float = np.radians(-50.0)
    high: float = np.radians(75.0)


@dataclass(frozen=True, eq=False)
class Room:
    """An arm with targets, and where it may go.

    target_positions, normals: (k, 3) of the targets in the last frame [m], unit vectors.
    lower, upper: (n,) of the joints [rad, m].  radius: of the body [m].
    floor: height of the floor above the base's origin [m].
    low, high: (3,) box in base axes in which the flange must stay, infinite where open [m].
    whole: whether a pose counts only if every target is seen.
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
    whole: bool = False


def normals_of(spots: Array, kind: str) -> Array:
    """(k, 3) outward normals of targets: along the flange's axis, or away from it.

    A target on the axis looks along it.  Raises OptionError.
    """
    if kind not in NORMALS:
        raise OptionError(f"no normals {kind!r}; choose {' or '.join(NORMALS)}")
    out = np.zeros_like(spots)
    out[:, 2] = 1.0
    aside = np.linalg.norm(spots[:, :2], axis=1)
    if kind == "radial":
        off = aside > 1e-9
        out[off] = 0.0
        out[off, :2] = spots[off, :2] / aside[off, None]
    return out


# ---- the arm at some poses ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class View:
    """An arm at m poses, before an instrument."""

    room: Room
    sight: Sight
    q: Array

    @cached_property
    def links(self) -> Chain:
        """The chain of the arm."""
        robot = self.room.robot
        return kinematics.chain(robot.mdh, robot.turned(self.q), robot.prismatic)

    @cached_property
    def points(self) -> Array:
        """(k, 3, m) the targets [m]."""
        return kinematics.points(self.links, self.room.target_positions)

    @cached_property
    def sights(self) -> Array:
        """(k, 3, m) from the targets to the instrument [m]."""
        return np.asarray(self.sight.place[:, None] - self.points)

    @cached_property
    def ranges(self) -> Array:
        """(k, m) distances of the targets from the instrument [m]."""
        return np.asarray(np.linalg.norm(self.sights, axis=1))

    @cached_property
    def skeleton(self) -> Array:
        """(2n + 1, 3, m) corners of the arm: along z, then along x, link by link [m]."""
        links = self.links
        a = self.room.robot.mdh[:, kinematics.A, None, None]
        corner = links.after - a * links.x
        both = np.stack([corner, links.after], axis=1).reshape(-1, *corner.shape[1:])
        return np.concatenate([links.before[:1], both])

    @cached_property
    def bones(self) -> list[int]:
        """Segments of the skeleton that have a length, by their first corner."""
        length = np.linalg.norm(np.diff(self.skeleton, axis=0), axis=1).max(axis=1)
        return [int(i) for i in np.flatnonzero(length > 1e-6)]


def above_floor(view: View) -> Array:
    """All beyond the end of link 2, it included, stays its own radius above the floor."""
    room = view.room
    moving = np.concatenate([view.skeleton[4:], view.points])
    height = np.einsum("i,vim->vm", room.robot.up, moving)
    return np.asarray(height.min(axis=0) > room.floor + room.radius)


def in_box(view: View) -> Array:
    """The flange stays in the box."""
    flange = view.links.origin
    low, high = view.room.low[:, None], view.room.high[:, None]
    return np.asarray(((flange >= low) & (flange <= high)).all(axis=0))


def clear_of_itself(view: View) -> Array:
    """Segments of the arm that are not near neighbours stay two radii apart."""
    bones, corner = view.bones, view.skeleton
    length = np.linalg.norm(np.diff(corner, axis=0), axis=1).max(axis=1)
    free = np.ones(len(view.q), dtype=bool)
    for place, one in enumerate(bones):
        for other in bones[place + 1 :]:
            # with less between them they touch wherever the joints between them are
            if length[one + 1 : other].sum() > NEIGHBOUR_RADII * view.room.radius:
                ends = (corner[one], corner[one + 1], corner[other], corner[other + 1])
                free &= gap(*ends) > 2.0 * view.room.radius
    return free


def faces(view: View) -> Array:
    """The instrument is inside the target's cone."""
    if view.sight.acceptance >= ANYWHERE:
        return np.ones(view.ranges.shape, dtype=bool)
    axes = view.links.axes
    normal = (view.room.normals @ axes.reshape(3, -1)).reshape(-1, *axes.shape[1:])
    along = (normal * view.sights).sum(axis=1)
    return np.asarray(along > np.cos(view.sight.acceptance) * view.ranges)


def within_range(view: View) -> Array:
    """Neither too near nor too far."""
    return np.asarray((view.ranges >= view.sight.near) & (view.ranges <= view.sight.far))


def within_elevation(view: View) -> Array:
    """The instrument can look so high and so low."""
    rise = -np.einsum("i,kim->km", view.sight.up, view.sights)
    angle = np.arcsin(np.clip(rise / np.maximum(view.ranges, 1e-9), -1.0, 1.0))
    return np.asarray((angle >= view.sight.low) & (angle <= view.sight.high))


def unobstructed(view: View) -> Array:
    """The line of sight passes the body; two radii before the target the body is not looked at."""
    k, m = view.ranges.shape
    short = np.minimum(2.0 * view.room.radius / np.maximum(view.ranges, 1e-9), 1.0)[:, None]
    end = view.points + short * view.sights
    free = np.ones((k, m), dtype=bool)
    eye = view.points + view.sights
    for bone in view.bones:
        for target in range(k):
            away = gap(eye[target], end[target], view.skeleton[bone], view.skeleton[bone + 1])
            free[target] &= away > view.room.radius
    return free


Condition = Callable[[View], Array]
ARM: Mapping[str, Condition] = {  # (m,) of the arm
    "floor": above_floor,
    "volume": in_box,
    "self-collision": clear_of_itself,
}
TRACKER: Mapping[str, Condition] = {  # (k, m) of each target
    "acceptance": faces,
    "range": within_range,
    "elevation": within_elevation,
    "line of sight": unobstructed,
}


def gap(a: Array, b: Array, c: Array, d: Array) -> Array:
    """(m,) least distance between segments ab and cd.  a, b, c, d: (3, m).

    Of the nearest points of the two lines one is clamped to its segment, the other is the foot
    on the other segment, and back.
    """
    u, v, w = b - a, d - c, a - c
    uu, vv = ((x * x).sum(axis=0) for x in (u, v))
    uv, uw, vw = ((x * y).sum(axis=0) for x, y in ((u, v), (u, w), (v, w)))
    cross = uu * vv - uv * uv
    parallel = cross <= 1e-12 * uu * vv
    s = np.where(parallel, 0.0, (uv * vw - vv * uw) / np.where(parallel, 1.0, cross))
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, 1e-300), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(w + s * u - t * v, axis=0))
