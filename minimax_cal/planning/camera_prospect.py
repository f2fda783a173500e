"""What an image would tell of an arm, before it is taken.

The information of a pose is J'V^-1 J over all that pixels determine, arm, cameras, lenses and
board; V = s^2 + t^2 S S', s the noise of a pixel and t the jitter of the joints, S the motion of
the pixels per unit of each joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from minimax_cal.fitting.identify import RESOLUTION
from minimax_cal.fitting.pixels.camera import Camera
from minimax_cal.fitting.pixels.data import PixelData
from minimax_cal.fitting.pixels.identify import identified
from minimax_cal.fitting.pixels.judge import free_motion
from minimax_cal.fitting.pixels.model import LENS, PixelModel, Scene, lens_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Apart, Fact
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.parameters import zero_positions
from minimax_cal.planning.camera_sight import CameraSight
from minimax_cal.planning.prospect import Instrument
from minimax_cal.planning.visibility import Room, View

CHUNK = 128  # poses whose pixels are derived at a time
SAMPLE = 200  # poses that tell which parameters are identifiable
RELATIVE = 6  # numbers of a board's pose in a camera: an image tells these, and its lens


@dataclass(frozen=True)
class PixelNoise(Instrument):
    """Noise of u and v [px], whatever the range, and jitter of each joint [rad, m]."""

    noise: Annotated[float, Fact(unit="px")]
    per_metre: Apart[float] = 0.0


@dataclass(frozen=True, eq=False)
class CameraProspect:
    """A camera cell and what poses can tell about it; as `prospect.Prospect`.

    cameras: of the sight.  active: (p,) parameters that pixels identify; f of them, `names`.
    scale: (f,) root mean square motion of the board's corners per unit of each [m per unit].
    """

    cell: Cell
    room: Room
    sight: CameraSight
    cameras: tuple[Camera, ...]
    noise: PixelNoise
    active: Array
    names: tuple[str, ...]
    scale: Array

    @staticmethod
    def of(
        cell: Cell, room: Room, sight: CameraSight, cameras: tuple[Camera, ...], noise: PixelNoise,
        q: Array, seen: Array,
    ) -> CameraProspect:  # fmt: skip
        """What poses (m, n) can tell; parameters are identified as in a calibration."""
        nothing = np.zeros(0)
        plain = CameraProspect(cell, room, sight, cameras, noise, nothing, (), nothing)
        model, x, _ = plain.images(q[:SAMPLE], seen[:SAMPLE])
        every = np.ones(model.names.count, dtype=bool)
        found = identified(cell.robot, model, x, every, ~every, RESOLUTION).identification
        active = found.active
        names = tuple(n for n, free in zip(model.names.all, active, strict=True) if free)
        pixel = np.median(model.seen(x).point[2] / model.intrinsic[model.camera, 0])
        return CameraProspect(
            cell, room, sight, cameras, noise, active, names, pixel * found.scale[active]
        )

    def images(self, q: Array, seen: Array) -> tuple[PixelModel, Scene, Array]:
        """The pixels that would be seen, the scene, and (m, c * k) True where they are."""
        sight, robot, count = self.sight, self.cell.robot, len(self.sight.corners)
        inside = np.moveaxis(sight.inside(sight.relative(View(self.room, sight, q))), 0, 1)
        inside = (inside & seen[..., None]).reshape(len(q), -1)
        pose, place = np.nonzero(inside)
        at = still(q, (), robot)
        data = PixelData(
            at, tuple(map(str, at.line)), self.cameras, tuple(map(str, range(count))),
            sight.corners, pose, place // count, place % count, np.zeros((len(pose), 2)), pose,
        )  # fmt: skip
        x = Scene(
            robot.mdh[None], sight.camera[None, :, :3, :3], sight.camera[None, :, :3, 3],
            sight.board[None, :3, :3], sight.board[None, :3, 3], np.zeros((1, 0, 3)),
            lens_of(self.cameras),
        )  # fmt: skip
        return PixelModel.of(robot, data, sight.on_flange), x, inside

    def ahead(self, q: Array, seen: Array) -> Array:
        """(m, r, f) rows whose squares are the information of each pose.  seen: (m, c)."""
        return self.roots(q, seen, self.noise.jitter) / self.noise.noise

    def jacobian(self, q: Array, seen: Array) -> Array:
        """(N, f) rows whose squares are those of all pixels, without noise [px / m]."""
        return self.roots(q, seen, 0.0).reshape(-1, len(self.names))

    def predictions(self, q: Array) -> Array:
        """B (w, 3, f): tr(B C B') is a position's variance, base and tool fitted at all poses."""
        links = self.active[: 5 * self.cell.robot.joints]
        out = np.zeros((3 * len(q), len(self.names)))
        out[:, : links.sum()] = free_motion(self.cell.robot, q)[0][:, links]
        return np.asarray((out / self.scale).reshape(len(q), 3, -1))

    def known(self, lens_sigma: Array) -> Array:
        """(f, f) information of the lenses' files.  lens_sigma: (c, 9)."""
        told = np.zeros(len(self.active))
        told[-lens_sigma.size :] = lens_sigma.reshape(-1) ** -2.0
        return np.diag(told[self.active] / self.scale**2)

    def roots(self, q: Array, seen: Array, jitter: float) -> Array:
        """(m, r, f) roots of J'V^-1 J for pixels of noise one."""
        most = min((RELATIVE + LENS) * len(self.cameras), len(self.names))
        out = np.zeros((len(q), most, len(self.names)))
        for start in range(0, len(q), CHUNK):
            some = slice(start, start + CHUNK)
            size, axes = np.linalg.eigh(self.information(q[some], seen[some], jitter))
            root = np.sqrt(np.maximum(size[:, -most:], 0.0))
            out[some] = np.swapaxes(axes[..., -most:] * root[:, None], 1, 2)
        return out

    def information(self, q: Array, seen: Array, jitter: float) -> Array:
        """(m, f, f) of each pose, for pixels of noise one."""
        model, x, inside = self.images(q, seen)
        joints = np.zeros(len(self.active), dtype=bool)
        joints[zero_positions(model.prismatic)] = True
        own = model.rows(x, self.active)[1] / self.scale[:, None, None]
        rows = np.concatenate([own, model.rows(x, joints)[1]])
        whole = np.zeros((*rows.shape[:2], inside.size))
        whole[..., np.flatnonzero(inside)] = rows
        by_pose = whole.reshape(len(rows), 2, len(q), -1).transpose(2, 0, 1, 3)
        flat = by_pose.reshape(len(q), len(rows), -1)
        gram, f = flat @ np.swapaxes(flat, 1, 2), len(self.names)
        told = gram[:, :f, :f]
        if not jitter:
            return np.asarray(told)
        spread = gram[:, f:, f:] + (self.noise.noise / jitter) ** 2 * np.eye(len(rows) - f)
        across = gram[:, :f, f:]
        return np.asarray(told - across @ np.linalg.solve(spread, np.swapaxes(across, 1, 2)))
