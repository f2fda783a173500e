"""What cameras see of a board: corners in the image, incidence, distance, and nothing between.

A camera rides on the flange and the board stands, or the other way round.  What rides is a target
of the arm's `Room`, once for each camera: the camera's centre, or the board's middle.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationWarning
from minimax_cal.instruments.camera import distorted
from minimax_cal.planning.visibility import Condition, Room, Sight, View, unobstructed, within_range
from minimax_cal.robots.transforms import inverse, transform

TRIES = 2**11  # poses proposed at a time
AIM = 0.5  # of the image about its middle: where a candidate has the board's middle


@dataclass(frozen=True, eq=False)
class CameraSight(Sight):
    """Cameras and a board, approximately.

    camera: (c, 4, 4) poses in the flange or base.  intrinsic: (c, 16).  size: (c, 2) [px].
    corners: (k, 3) in the board's frame, board: (4, 4) pose of that in the base or flange [m].
    side: +1 where the print looks along z, -1 where against it.  least: share of the corners in
    an image.  incidence: largest angle to the board's normal [rad].
    """

    tries: ClassVar[tuple[int, int]] = (2**13, 2**16)

    camera: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    intrinsic: Array = field(default_factory=lambda: np.zeros((0, 16)))
    size: Array = field(default_factory=lambda: np.zeros((0, 2)))
    corners: Array = field(default_factory=lambda: np.zeros((0, 3)))
    board: Array = field(default_factory=lambda: np.eye(4))
    on_flange: bool = True
    side: float = -1.0
    least: float = 0.8
    incidence: float = np.radians(65.0)

    @property
    def conditions(self) -> Mapping[str, Condition]:
        """What a pose has to meet, for each camera."""
        own: dict[str, Condition] = {
            "image": self.shows,
            "incidence": self.faces,
            "range": within_range,
        }
        return own if self.on_flange else {**own, "line of sight": unobstructed}

    def relative(self, view: View) -> Array:
        """(c, m, 4, 4) the board in each camera."""
        flange = view.room.robot.pose(view.q)
        if self.on_flange:
            return np.asarray(inverse(flange @ self.camera[:, None]) @ self.board)
        return np.asarray(inverse(self.camera)[:, None] @ (flange @ self.board))

    def inside(self, relative: Array) -> Array:
        """(c, m, k) which corners lie in the images.  relative: (c, m, 4, 4)."""
        point = np.einsum("cmij,kj->icmk", relative[..., :3, :3], self.corners)
        point = point + np.moveaxis(relative[..., :3, 3], -1, 0)[..., None]
        before = point[2] > self.near / 10.0
        x, y = point[:2] / np.where(before, point[2], 1.0)
        c, m, k = x.shape
        lens = self.intrinsic.T[:, :, None]
        pixel = distorted(lens, x.reshape(c, -1), y.reshape(c, -1)).reshape(c, 2, m, k)
        room = (self.size - 1.0)[:, :, None, None]
        straight = np.hypot(x, y) < 1.05 * self.widest[:, None, None]  # where a lens does not fold
        return np.asarray(before & straight & ((pixel >= 0.0) & (pixel <= room)).all(axis=1))

    @property
    def widest(self) -> Array:
        """(c,) tangent of the angle to an image's corner, without distortion."""
        fx, fy, cx, cy = self.intrinsic.T[:4]
        wide, high = self.size.T
        wide, high = np.maximum(cx, wide - cx) / fx, np.maximum(cy, high - cy) / fy
        return np.asarray(np.hypot(wide, high))

    def shows(self, view: View) -> Array:
        """Enough corners lie in the image."""
        return np.asarray(self.inside(self.relative(view)).mean(axis=-1) >= self.least)

    def faces(self, view: View) -> Array:
        """The print is seen, and not too flatly."""
        relative = self.relative(view)
        middle = (relative @ np.append(self.corners.mean(axis=0), 1.0))[..., :3]
        normal = self.side * relative[..., :3, 2]
        along = -np.einsum("cmi,cmi->cm", normal, middle)
        return np.asarray(along > np.cos(self.incidence) * np.linalg.norm(middle, axis=-1))

    def proposals(self, room: Room, seed: int) -> Iterator[Array]:
        """(b, n) joint values at which a camera looks at the board, from any way of the arm."""
        rng, robot = np.random.default_rng(seed), room.robot
        while True:
            near = room.lower + (room.upper - room.lower) * rng.random((TRIES, robot.joints))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CalibrationWarning)  # out of reach
                q = robot.inverse(self.looking(rng, TRIES), near)
            turned = (q + np.pi) % (2.0 * np.pi) - np.pi  # within the limits if any turn of it is
            q = np.where(robot.prismatic, q, turned)
            yield np.clip(q, room.lower, room.upper)

    def looking(self, rng: np.random.Generator, count: int) -> Array:
        """(count, 4, 4) poses of the flange at which a camera, each in turn, looks at the board."""
        which = np.arange(count) % len(self.camera)
        focal = self.intrinsic[which, :2]
        away = rng.uniform(self.near, self.far, count)
        tilt = np.arccos(rng.uniform(np.cos(self.incidence), 1.0, count))
        angles = np.stack([*rng.uniform(-np.pi, np.pi, (2, count)), tilt], axis=1)[:, [0, 2, 1]]
        turn = Rotation.from_euler("ZXZ", angles).as_matrix()  # of the board in the camera
        if self.side > 0.0:
            turn = turn @ np.diag([1.0, -1.0, -1.0])
        spot = AIM * rng.uniform(-0.5, 0.5, (count, 2)) * self.size[which]
        middle = np.concatenate([spot / focal, np.ones((count, 1))], axis=1)
        middle *= (away / np.linalg.norm(middle, axis=1))[:, None]
        seen = transform(turn, middle - turn @ self.corners.mean(axis=0))
        if self.on_flange:
            return np.asarray(self.board @ inverse(self.camera[which] @ seen))
        return np.asarray(self.camera[which] @ seen @ inverse(self.board))
