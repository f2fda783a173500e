"""What cameras saw, as an instrument: the pixels of corners or tags.

A target w stands still in the base and the camera rides on the flange, or the target rides and the
camera stands.  With the flange (R, o), and the camera (Rc, tc) in what it is fixed to, the target
in the camera's axes is p = Rc' (R' (w - o) - tc), or p = Rc' (R w + o - tc); its pixel is the
lens's of p.  At given depths z the error (p_xy - u p_z) f / z, u the direction that was seen, is
exactly affine in all lengths (`Sight`).

Beside other instruments pixels count in metres at a typical target; alone as they are.  Which of
them are wrong and how noisy they are, they say by themselves, in a fit of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.camera import INTRINSICS, distorted, slopes
from minimax_cal.instruments.instrument import UNREADY, Instrument, Words, anywhere
from minimax_cal.instruments.pixels import PixelData
from minimax_cal.instruments.protocol import OF_NONE, FlangePoses, ResidualRows
from minimax_cal.measuring.grouping import groups
from minimax_cal.robots.kinematics import right_jacobian, rotation, rotation_vector
from minimax_cal.robots.robot import Robot

AXES = ("x", "y", "z", "rx", "ry", "rz")
LENS = len(INTRINSICS)
PLENTY = 60  # poses that show what no poses could tell
WHOLE = 4  # targets of a board that stand for all


class Sight(NamedTuple):
    """Where depth is given, so that errors are lengths scaled to pixels.

    depth: (N,) of each target in the camera's axes [m].  direction: (2, N) that was seen.
    """

    depth: Array
    direction: Array


class Seen(NamedTuple):
    """The N targets in the base and in the cameras.

    base, point: (N, 3) in the base and in the camera's axes [m].  axes: (N, 3, 3) of the flange.
    view: (N, 3, 3) rotation into the camera from what it is fixed to.
    """

    base: Array
    point: Array
    axes: Array
    view: Array


@dataclass(frozen=True, eq=False)
class Images(Instrument):
    """Pixels, at these poses.

    Its e own parameters are the poses of cameras, the pose of the board or the places of targets,
    and lenses.  on_flange: whether the cameras ride.  turn: (c, 3, 3), or with a board (c + 1, 3,
    3), from where the turns of cameras and board are counted.  weight: (N,) of the pixels.  doubt:
    (c, 9) how well the files know the lenses, as rows beside pixels as noisy as `noise` [px].
    lens_held: whether lenses stay.  metre: what a pixel counts [m].  sight: None for pixels.
    bearings: whether rows are directions to targets, which need no camera that sees them.
    """

    pixels: PixelData
    on_flange: bool = True
    turn: Array = UNREADY
    weight: Array = UNREADY
    doubt: Array = field(default_factory=lambda: np.zeros((0, LENS)))
    noise: float = 0.0
    lens_held: bool = False
    metre: float = 1.0
    sight: Sight | None = None
    bearings: bool = False

    kind = "pixels"
    words = Words(
        quantity="pixel at the target",
        caution="A pixel is no position: what moves along the line of sight does not show in it. ",
        whole="cameras and targets moved together",
        fitted="base and tool are",
    )
    chosen: ClassVar[tuple[str, ...]] = (
        "on_flange",
        "turn",
        "doubt",
        "noise",
        "lens_held",
        "metre",
    )
    options = ("camera_on", "fix_camera", "camera_prior")
    targets_at = slice(0, 0)
    refines = False
    alone = (
        "it holds pixels alone: give it to calibrate as pixels=, or add files of other instruments"
    )
    alone_bends = True
    on_arm = False
    noise_given = False
    unmoved = "turns no direction"
    drawn_scale = True

    @staticmethod
    def placed_at(
        data: PixelData, cameras: Array, board: Array, points: Array, *, on_flange: bool
    ) -> tuple[Images, Array]:
        """All pixels of the data, alike, and the own parameters; turns are counted from here.

        cameras: (c, 4, 4), board: (4, 4) poses, or points: (k, 3) targets of unknown place, in
        what they are fixed to [m].
        """
        every = np.concatenate([cameras, board[None]]) if len(data.board) else cameras
        one = Images(data.at, data, on_flange, every[:, :3, :3], np.ones(data.count))
        spots, lens = np.zeros(0) if len(data.board) else points, one.intrinsic[:, :LENS]
        six = np.pad(every[:, :3, 3], ((0, 0), (0, 3)))
        return one, np.concatenate([part.reshape(-1) for part in (six, spots, lens)])

    # ---- what was measured -------------------------------------------------------------------

    @property
    def images(self) -> PixelData:
        """The pixels at these poses."""
        return replace(self.pixels, at=self.at)

    @property
    def numbers(self) -> Array:
        """(m,) two a pixel."""
        return 2 * np.bincount(self.pixels.pose, minlength=self.poses)

    @property
    def independent(self) -> int:
        """Six for each different pose: many targets in an image are one pose of a camera."""
        return 6 * len(np.unique(groups(self.at)[self.pixels.pose]))

    def take(self, rows: Array) -> Images:
        """The images at some poses only.  rows: indices or a mask."""
        return replace(self, at=self.at.take(rows), pixels=self.pixels.take(rows))

    @property
    def parts(self) -> tuple[str, ...]:
        """The targets, in each camera."""
        return self.pixels.parts

    @property
    def counted(self) -> Array:
        """(N,) True for pixels that count."""
        return np.asarray(self.weight > 0.0)

    @property
    def points(self) -> int:
        """Number of pixels that count."""
        return int(self.counted.sum())

    @property
    def degrees(self) -> int:
        """Two a pixel, and as many as the files know of the lenses."""
        return 2 * self.points + self.lens_rows

    @property
    def lens_rows(self) -> int:
        """What the files know of the lenses, unless these are held."""
        return 0 if self.lens_held else self.doubt.size

    @property
    def has_length(self) -> bool:
        """A board has lengths."""
        return bool(len(self.pixels.board))

    # ---- its own parameters ------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Cameras, board or targets, lenses."""
        cameras = [f"camera_{camera.name}" for camera in self.pixels.cameras]
        own = [f"{camera}_{axis}" for camera in cameras for axis in AXES]
        if self.has_length:
            own += [f"board_{axis}" for axis in AXES]
        else:
            own += [f"target_{name}_{axis}" for name in self.pixels.targets for axis in AXES[:3]]
        return (*own, *(f"{camera}_{each}" for camera in cameras for each in INTRINSICS))

    @property
    def units(self) -> tuple[str, ...]:
        """SI; pixels where a lens has them."""
        lens = (*["px"] * 4, *[""] * (LENS - 4)) * len(self.pixels.cameras)
        placed = self.names[: -len(lens)]
        return (*("rad" if name.endswith(AXES[3:]) else "m" for name in placed), *lens)

    @property
    def intrinsic(self) -> Array:
        """(c, 16) of the cameras, as their files say."""
        return np.stack([camera.intrinsic for camera in self.pixels.cameras])

    def lens(self, own: Array) -> Array:
        """(c, 9) `INTRINSICS` of the cameras."""
        return own[-LENS * len(self.pixels.cameras) :].reshape(-1, LENS)

    def frames(self, own: Array) -> tuple[Array, Array]:
        """Rotations and origins of cameras and board in what they are fixed to [m]."""
        six = own[: 6 * len(self.turn)].reshape(-1, 6)
        return self.turn @ rotation(six[:, 3:]), six[:, :3]

    def spots(self, own: Array) -> Array:
        """(k, 3) targets in the base or in the flange [m]."""
        if not self.has_length:
            c = len(self.pixels.cameras)
            return own[6 * c : -LENS * c].reshape(-1, 3)
        turn, place = self.frames(own)
        return np.asarray(self.pixels.board @ turn[-1].T + place[-1])

    def counted_from(self, own: Array, turn: Array) -> Array:
        """(e,) the same, its turns counted from others (..., 3, 3)."""
        out, now = own.copy(), self.frames(own)[0]
        for six, start, end in zip(range(0, 6 * len(now), 6), 0.0 * now + turn, now, strict=True):
            out[six + 3 : six + 6] = rotation_vector(start.T @ end)
        return out

    def read_out(self, own: Array) -> Array:
        """Turns as rotation vectors of the poses."""
        return self.counted_from(own, np.eye(3))

    # ---- in a fit ----------------------------------------------------------------------------

    def in_view(self, arm: FlangePoses, own: Array) -> Seen:
        """Where the targets are."""
        turn, place = self.frames(own)
        pose, camera = self.pixels.pose, self.pixels.camera
        base, axes, origin = self.spots(own)[self.pixels.target], arm.rotation[pose], arm.origin
        if self.on_flange:
            fixed = np.einsum("nji,nj->ni", axes, base - origin[pose])
        else:
            fixed = base = np.einsum("nij,nj->ni", axes, base) + origin[pose]
        view = turn.swapaxes(1, 2)[camera]
        return Seen(base, np.einsum("nij,nj->ni", view, fixed - place[camera]), axes, view)

    def lenses(self, own: Array) -> Array:
        """(16, N) numbers of each pixel's camera, (16, 1) of a single one."""
        every = np.concatenate([self.lens(own), self.intrinsic[:, LENS:]], axis=1).T
        return every if every.shape[1] == 1 else every[:, self.pixels.camera]

    def off(self, arm: FlangePoses, own: Array) -> Array:
        """(2, N) measured minus predicted [px]."""
        x, y, z = self.in_view(arm, own).point.T
        return np.asarray(self.pixels.pixel.T - distorted(self.lenses(own), x / z, y / z))

    def depth(self, arm: FlangePoses, own: Array) -> Array:
        """(N,) of the targets in the cameras [m]."""
        return self.in_view(arm, own).point[:, 2]

    def looked(self, seen: Seen, own: Array) -> tuple[Array, Array, Array]:
        """Errors (r, N), their slopes (r, N, 3) by the targets in the cameras, (9, r, N) by lens.

        Of pixels, of lengths at given depths, or of directions.
        """
        point = seen.point
        if self.bearings:
            size = np.linalg.norm(point, axis=1)
            unit = (point.T / size)[..., None]
            by = (np.eye(3)[:, None] - unit * unit[..., 0].T) / size[:, None]
            return np.zeros(by.shape[:2]), by, np.zeros((LENS, *by.shape[:2]))
        if self.sight is not None:
            focal = self.intrinsic[self.pixels.camera, :2].T / self.sight.depth
            by = np.tile(np.eye(2, 3)[:, None], (1, len(point), 1))
            by[..., 2] = -self.sight.direction
            by *= focal[..., None]
            return -np.einsum("rnp,np->rn", by, point), by, np.zeros((LENS, *focal.shape))
        flat = point[:, :2] / point[:, 2:]
        pixel, across, lens = slopes(self.lenses(own), *flat.T)
        across = np.moveaxis(across, 0, -1) / point[:, 2:]  # by the plane at depth one
        by = np.concatenate([across, -(across * flat).sum(axis=2, keepdims=True)], axis=2)
        return self.pixels.pixel.T - pixel, by, lens

    def read(self, arm: FlangePoses, own: Array) -> ResidualRows:
        """Errors of pixels, then of the lenses."""
        seen, pixels = self.in_view(arm, own), self.pixels
        error, by, lens = self.looked(seen, own)
        if not self.bearings:
            root = self.metre * np.sqrt(self.weight)
            error, by, lens = error * root, by * root[:, None], lens * root
        by_fixed = np.einsum("rnp,npi->rni", by, seen.view)
        if self.on_flange:
            by_spot = np.einsum("rni,nji->rnj", by_fixed, seen.axes)
            by_base = -by_spot
        else:
            by_spot, by_base = np.einsum("rni,nij->rnj", by_fixed, seen.axes), by_fixed
        by_own, c = np.zeros((len(own), *error.shape)), len(pixels.cameras)
        turning = np.cross(by, seen.point)
        for i in range(c):
            mine = pixels.camera == i
            by_own[6 * i : 6 * i + 3] = np.moveaxis(-by_fixed * mine[:, None], -1, 0)
            by_own[6 * i + 3 : 6 * i + 6] = np.moveaxis(turning * mine[:, None], -1, 0)
            if not self.lens_held:
                by_own[len(own) - LENS * (c - i) :][:LENS] = lens * mine
        if self.has_length:
            about = np.cross(pixels.board[pixels.target], by_spot @ self.frames(own)[0][-1])
            by_own[6 * c : 6 * c + 6] = np.moveaxis(np.dstack([by_spot, about]), -1, 0)
        else:
            at = np.arange(len(pixels.pose))
            for axis in range(3):
                by_own[6 * c + 3 * pixels.target + axis, :, at] = by_spot[..., axis].T
        for six in range(0, 6 * len(self.turn), 6):
            turn = right_jacobian(own[six + 3 : six + 6])
            by_own[six + 3 : six + 6] = np.tensordot(turn.T, by_own[six + 3 : six + 6], 1)
        short, known = self.lens_known(own)
        none, count = np.zeros((len(short), 3)), len(error)
        along = by_base.reshape(-1, 3)
        return ResidualRows(
            residual=np.concatenate([error.reshape(-1), short]),
            pose=np.concatenate([np.tile(pixels.pose, count), np.zeros(len(short), dtype=int)]),
            point=np.concatenate([np.tile(seen.base, (count, 1)), none]),
            by_point=np.concatenate([along, none]),
            by_rotation=np.zeros((len(along) + len(none), 3)),
            by_own=np.concatenate([by_own.reshape(len(own), -1), known], axis=1).T,
            part=np.concatenate([np.tile(pixels.part, count), np.full(len(short), OF_NONE)]),
        )

    def lens_known(self, own: Array) -> tuple[Array, Array]:
        """What the lenses differ from their files, by their doubts, as heavy as pixels: (l,).

        And its derivative, (e, l).
        """
        count = self.lens_rows
        rows = np.zeros((len(own), count))
        if not count:
            return np.zeros(0), rows
        by = (1.0 if self.bearings else self.metre * self.noise) / self.doubt.reshape(-1)
        rows[-count:] = np.diag(by)
        return (self.intrinsic[:, :LENS].reshape(-1) - own[-count:]) * by, rows

    def elsewhere(self, robot: Robot, own: Array) -> Images:
        """Directions to the targets from every camera at plenty of poses; to some of a board."""
        targets, board = np.unique(self.pixels.target), self.pixels.board
        if len(board):
            chosen = np.linspace(0, len(targets) - 1, min(len(targets), WHOLE)).astype(int)
            away = np.linalg.norm(board[targets] - board.mean(axis=0), axis=1)
            targets = targets[np.argsort(away)[chosen]]
        every = np.arange(PLENTY), np.arange(len(self.pixels.cameras)), targets
        pose, camera, target = (part.reshape(-1) for part in np.meshgrid(*every, indexing="ij"))
        pixels = replace(
            self.pixels, pose=pose, camera=camera, target=target, pixel=np.zeros((len(pose), 2))
        )
        at = anywhere(robot, PLENTY)
        doubt = np.ones((len(every[1]), LENS))  # lenses turn nothing, and are no rank's concern
        return replace(
            self, at=at, pixels=pixels, weight=np.ones(len(pose)), doubt=doubt, bearings=True
        )

    # ---- how well it is fitted ---------------------------------------------------------------

    def at_targets(self, arm: FlangePoses, own: Array) -> Array:
        """(2, N) errors at the targets [m]."""
        focal = self.lens(own)[self.pixels.camera, :2].T
        return np.asarray(self.off(arm, own) * np.abs(self.depth(arm, own)) / focal)

    def mean_square(self, arm: FlangePoses, own: Array) -> float:
        """Of the errors at the targets [m^2]."""
        return float((self.at_targets(arm, own)[:, self.counted] ** 2).sum(axis=0).mean())

    def table(self, arm: FlangePoses, own: Array, counts: Array) -> Array:
        """(m, parts, 3) errors at the targets, NaN where not measured [m].  counts: (N,) mask."""
        pixels, error = self.pixels, self.at_targets(arm, own)[:, counts].T
        out = np.full((self.poses, len(pixels.parts), 3), np.nan)
        out[pixels.pose[counts], pixels.part[counts]] = np.pad(error, ((0, 0), (0, 1)))
        return out
