"""What cameras saw, as an instrument: the pixels of corners or tags.

A target w stands still in the base and the camera rides on the flange, or the target rides and the
camera stands.  With the flange (R, o), and the camera (Rc, tc) in what it is fixed to, the target
in the camera's axes is p = Rc' (R' (w - o) - tc), or p = Rc' (R w + o - tc); its pixel is the
lens's of p.  At given depths z the error (p_xy - u p_z) f / z, u the direction that was seen, is
exactly affine in all lengths (`TargetSight`).

Beside other instruments pixels count in metres at a typical target; alone as they are.  Which of
them are wrong and how noisy they are, they say by themselves, in a fit of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.instruments.camera_model import (
    FITTED_INTRINSICS,
    pixel_derivatives,
    project_to_pixels,
)
from minimax_cal.instruments.instrument import (
    NOT_READY,
    FramePose,
    Instrument,
    Words,
    build_random_poses,
)
from minimax_cal.instruments.pixel_data import PixelData
from minimax_cal.instruments.protocol import NO_PART, FlangePoses, ReducedRows, ResidualRows
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.robots.kinematics import (
    rotation_from_vector,
    rotation_to_vector,
    so3_right_jacobian,
)
from minimax_cal.robots.robot import Robot

POSE_AXIS_NAMES = ("x", "y", "z", "rx", "ry", "rz")
LENS_PARAMETER_COUNT = len(FITTED_INTRINSICS)
RANDOM_IMAGE_POSES = 60  # poses that show what no poses could tell
MAX_BOARD_TARGETS_SHOWN = 4  # targets of a board that stand for all


class TargetSight(NamedTuple):
    """Where depth is given, so that errors are lengths scaled to pixels.

    depth: (N,) of each target in the camera's axes [m].  direction: (2, N) that was seen.
    """

    depth: Array
    direction: Array


class TargetView(NamedTuple):
    """The N targets in the base and in the cameras.

    base, point: (N, 3) in the base and in the camera's axes [m].  axes: (N, 3, 3) of the flange.
    view: (N, 3, 3) rotation into the camera from what it is fixed to.
    """

    base: Array
    point: Array
    axes: Array
    view: Array


class CameraImagesStart(NamedTuple):
    """Images of cameras, and start values (e,) of their unknowns."""

    images: CameraImages
    unknowns: Array


class ErrorsWithSlopes(NamedTuple):
    """Errors (r, N), their slopes (r, N, 3) by targets in the cameras, and (9, r, N) by lenses."""

    errors: Array
    slopes_by_target: Array
    slopes_by_lens: Array


@dataclass(frozen=True, eq=False)
class CameraImages(Instrument):
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
    turn: Array = NOT_READY
    weight: Array = NOT_READY
    doubt: Array = field(default_factory=lambda: np.zeros((0, LENS_PARAMETER_COUNT)))
    noise: float = 0.0
    lens_held: bool = False
    metre: float = 1.0
    sight: TargetSight | None = None
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
    def build_with_start(
        data: PixelData,
        camera_poses: Array,
        board_pose: Array,
        target_points: Array,
        *,
        on_flange: bool,
    ) -> CameraImagesStart:
        """All pixels of the data, alike, and the own parameters; turns are counted from here.

        camera_poses: (c, 4, 4), board_pose: (4, 4) poses, or target_points: (k, 3) targets of
        unknown place, in what they are fixed to [m].
        """
        every = (
            np.concatenate([camera_poses, board_pose[None]]) if len(data.board) else camera_poses
        )
        one = CameraImages(data.at, data, on_flange, every[:, :3, :3], np.ones(data.pixel_count))
        spots, lens = (
            np.zeros(0) if len(data.board) else target_points,
            one.intrinsic[:, :LENS_PARAMETER_COUNT],
        )
        six = np.pad(every[:, :3, 3], ((0, 0), (0, 3)))
        return CameraImagesStart(
            one, np.concatenate([part.reshape(-1) for part in (six, spots, lens)])
        )

    # ---- what was measured -------------------------------------------------------------------

    @property
    def pixel_data_at_poses(self) -> PixelData:
        """The pixels at these poses."""
        return replace(self.pixels, at=self.at)

    @property
    def numbers_per_pose(self) -> Array:
        """(m,) two a pixel."""
        return 2 * np.bincount(self.pixels.pose, minlength=self.poses)

    @property
    def independent_number_count(self) -> int:
        """Six for each different pose: many targets in an image are one pose of a camera."""
        return 6 * len(np.unique(group_repeated_poses(self.at)[self.pixels.pose]))

    def take_rows(self, rows: Array) -> CameraImages:
        """The images at some poses only.  rows: indices or a mask."""
        return replace(self, at=self.at.take(rows), pixels=self.pixels.take_poses(rows))

    @property
    def part_names(self) -> tuple[str, ...]:
        """The targets, in each camera."""
        return self.pixels.part_names

    @property
    def counted_pixel_mask(self) -> Array:
        """(N,) True for pixels that count."""
        return np.asarray(self.weight > 0.0)

    @property
    def point_count(self) -> int:
        """Number of pixels that count."""
        return int(self.counted_pixel_mask.sum())

    @property
    def degrees_of_freedom(self) -> int:
        """Two a pixel, and as many as the files know of the lenses."""
        return 2 * self.point_count + self.lens_row_count

    @property
    def lens_row_count(self) -> int:
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
        own = [f"{camera}_{axis}" for camera in cameras for axis in POSE_AXIS_NAMES]
        if self.has_length:
            own += [f"board_{axis}" for axis in POSE_AXIS_NAMES]
        else:
            own += [
                f"target_{name}_{axis}"
                for name in self.pixels.targets
                for axis in POSE_AXIS_NAMES[:3]
            ]
        return (*own, *(f"{camera}_{each}" for camera in cameras for each in FITTED_INTRINSICS))

    @property
    def units(self) -> tuple[str, ...]:
        """SI; pixels where a lens has them."""
        lens = (*["px"] * 4, *[""] * (LENS_PARAMETER_COUNT - 4)) * len(self.pixels.cameras)
        placed = self.names[: -len(lens)]
        return (*("rad" if name.endswith(POSE_AXIS_NAMES[3:]) else "m" for name in placed), *lens)

    @property
    def intrinsic(self) -> Array:
        """(c, 16) of the cameras, as their files say."""
        return np.stack([camera.intrinsic for camera in self.pixels.cameras])

    def lens_parameters(self, unknowns: Array) -> Array:
        """(c, 9) `FITTED_INTRINSICS` of the cameras."""
        return unknowns[-LENS_PARAMETER_COUNT * len(self.pixels.cameras) :].reshape(
            -1, LENS_PARAMETER_COUNT
        )

    def camera_and_board_frames(self, unknowns: Array) -> FramePose:
        """Rotations and origins of cameras and board in what they are fixed to [m]."""
        six = unknowns[: 6 * len(self.turn)].reshape(-1, 6)
        return FramePose(self.turn @ rotation_from_vector(six[:, 3:]), six[:, :3])

    def target_positions(self, unknowns: Array) -> Array:
        """(k, 3) targets in the base or in the flange [m]."""
        if not self.has_length:
            c = len(self.pixels.cameras)
            return unknowns[6 * c : -LENS_PARAMETER_COUNT * c].reshape(-1, 3)
        turn, place = self.camera_and_board_frames(unknowns)
        return np.asarray(self.pixels.board @ turn[-1].T + place[-1])

    def count_rotations_from(self, unknowns: Array, reference_rotations: Array) -> Array:
        """(e,) the same, its turns counted from others (..., 3, 3)."""
        out, now = unknowns.copy(), self.camera_and_board_frames(unknowns)[0]
        for six, start, end in zip(
            range(0, 6 * len(now), 6), 0.0 * now + reference_rotations, now, strict=True
        ):
            out[six + 3 : six + 6] = rotation_to_vector(start.T @ end)
        return out

    def unknowns_for_report(self, unknowns: Array) -> Array:
        """Turns as rotation vectors of the poses."""
        return self.count_rotations_from(unknowns, np.eye(3))

    # ---- in a fit ----------------------------------------------------------------------------

    def view_targets(self, arm: FlangePoses, unknowns: Array) -> TargetView:
        """Where the targets are."""
        turn, place = self.camera_and_board_frames(unknowns)
        pose, camera = self.pixels.pose, self.pixels.camera
        base, axes, origin = (
            self.target_positions(unknowns)[self.pixels.target],
            arm.rotation[pose],
            arm.origin,
        )
        if self.on_flange:
            fixed = np.einsum("nji,nj->ni", axes, base - origin[pose])
        else:
            fixed = base = np.einsum("nij,nj->ni", axes, base) + origin[pose]
        view = turn.swapaxes(1, 2)[camera]
        return TargetView(base, np.einsum("nij,nj->ni", view, fixed - place[camera]), axes, view)

    def intrinsics_of_pixels(self, unknowns: Array) -> Array:
        """(16, N) numbers of each pixel's camera, (16, 1) of a single one."""
        every = np.concatenate(
            [self.lens_parameters(unknowns), self.intrinsic[:, LENS_PARAMETER_COUNT:]], axis=1
        ).T
        return every if every.shape[1] == 1 else every[:, self.pixels.camera]

    def pixel_errors(self, arm: FlangePoses, unknowns: Array) -> Array:
        """(2, N) measured minus predicted [px]."""
        x, y, z = self.view_targets(arm, unknowns).point.T
        return np.asarray(
            self.pixels.pixel.T
            - project_to_pixels(self.intrinsics_of_pixels(unknowns), x / z, y / z)
        )

    def target_depths(self, arm: FlangePoses, unknowns: Array) -> Array:
        """(N,) of the targets in the cameras [m]."""
        return self.view_targets(arm, unknowns).point[:, 2]

    def errors_and_slopes(self, seen: TargetView, unknowns: Array) -> ErrorsWithSlopes:
        """Errors (r, N), their slopes (r, N, 3) by the targets in the cameras, (9, r, N) by lens.

        Of pixels, of lengths at given depths, or of directions.
        """
        point = seen.point
        if self.bearings:
            size = np.linalg.norm(point, axis=1)
            unit = (point.T / size)[..., None]
            by = (np.eye(3)[:, None] - unit * unit[..., 0].T) / size[:, None]
            return ErrorsWithSlopes(
                np.zeros(by.shape[:2]), by, np.zeros((LENS_PARAMETER_COUNT, *by.shape[:2]))
            )
        if self.sight is not None:
            focal = self.intrinsic[self.pixels.camera, :2].T / self.sight.depth
            by = np.tile(np.eye(2, 3)[:, None], (1, len(point), 1))
            by[..., 2] = -self.sight.direction
            by *= focal[..., None]
            return ErrorsWithSlopes(
                -np.einsum("rnp,np->rn", by, point),
                by,
                np.zeros((LENS_PARAMETER_COUNT, *focal.shape)),
            )
        flat = point[:, :2] / point[:, 2:]
        pixel, across, lens = pixel_derivatives(self.intrinsics_of_pixels(unknowns), *flat.T)
        across = np.moveaxis(across, 0, -1) / point[:, 2:]  # by the plane at depth one
        by = np.concatenate([across, -(across * flat).sum(axis=2, keepdims=True)], axis=2)
        return ErrorsWithSlopes(self.pixels.pixel.T - pixel, by, lens)

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        """Errors of pixels, then of the lenses."""
        seen, pixels = self.view_targets(arm, unknowns), self.pixels
        error, by, lens = self.errors_and_slopes(seen, unknowns)
        if not self.bearings:
            root = self.metre * np.sqrt(self.weight)
            error, by, lens = error * root, by * root[:, None], lens * root
        by_fixed = np.einsum("rnp,npi->rni", by, seen.view)
        if self.on_flange:
            by_spot = np.einsum("rni,nji->rnj", by_fixed, seen.axes)
            by_base = -by_spot
        else:
            by_spot, by_base = np.einsum("rni,nij->rnj", by_fixed, seen.axes), by_fixed
        by_own, c = np.zeros((len(unknowns), *error.shape)), len(pixels.cameras)
        turning = np.cross(by, seen.point)
        for i in range(c):
            mine = pixels.camera == i
            by_own[6 * i : 6 * i + 3] = np.moveaxis(-by_fixed * mine[:, None], -1, 0)
            by_own[6 * i + 3 : 6 * i + 6] = np.moveaxis(turning * mine[:, None], -1, 0)
            if not self.lens_held:
                by_own[len(unknowns) - LENS_PARAMETER_COUNT * (c - i) :][:LENS_PARAMETER_COUNT] = (
                    lens * mine
                )
        if self.has_length:
            about = np.cross(
                pixels.board[pixels.target], by_spot @ self.camera_and_board_frames(unknowns)[0][-1]
            )
            by_own[6 * c : 6 * c + 6] = np.moveaxis(np.dstack([by_spot, about]), -1, 0)
        else:
            at = np.arange(len(pixels.pose))
            for axis in range(3):
                by_own[6 * c + 3 * pixels.target + axis, :, at] = by_spot[..., axis].T
        for six in range(0, 6 * len(self.turn), 6):
            turn = so3_right_jacobian(unknowns[six + 3 : six + 6])
            by_own[six + 3 : six + 6] = np.tensordot(turn.T, by_own[six + 3 : six + 6], 1)
        short, known = self.lens_prior_rows(unknowns)
        none, count = np.zeros((len(short), 3)), len(error)
        along = by_base.reshape(-1, 3)
        return ResidualRows(
            residual=np.concatenate([error.reshape(-1), short]),
            pose=np.concatenate([np.tile(pixels.pose, count), np.zeros(len(short), dtype=int)]),
            point=np.concatenate([np.tile(seen.base, (count, 1)), none]),
            by_point=np.concatenate([along, none]),
            by_rotation=np.zeros((len(along) + len(none), 3)),
            by_own=np.concatenate([by_own.reshape(len(unknowns), -1), known], axis=1).T,
            part=np.concatenate(
                [np.tile(pixels.part_of_pixels, count), np.full(len(short), NO_PART)]
            ),
        )

    def lens_prior_rows(self, unknowns: Array) -> ReducedRows:
        """What the lenses differ from their files, by their doubts, as heavy as pixels: (l,).

        And its derivative, (e, l).
        """
        count = self.lens_row_count
        rows = np.zeros((len(unknowns), count))
        if not count:
            return ReducedRows(np.zeros(0), rows)
        by = (1.0 if self.bearings else self.metre * self.noise) / self.doubt.reshape(-1)
        rows[-count:] = np.diag(by)
        return ReducedRows(
            (self.intrinsic[:, :LENS_PARAMETER_COUNT].reshape(-1) - unknowns[-count:]) * by, rows
        )

    def at_random_poses(self, robot: Robot, unknowns: Array) -> CameraImages:
        """Directions to the targets from every camera at plenty of poses; to some of a board."""
        targets, board = np.unique(self.pixels.target), self.pixels.board
        if len(board):
            chosen = np.linspace(
                0, len(targets) - 1, min(len(targets), MAX_BOARD_TARGETS_SHOWN)
            ).astype(int)
            away = np.linalg.norm(board[targets] - board.mean(axis=0), axis=1)
            targets = targets[np.argsort(away)[chosen]]
        every = np.arange(RANDOM_IMAGE_POSES), np.arange(len(self.pixels.cameras)), targets
        pose, camera, target = (part.reshape(-1) for part in np.meshgrid(*every, indexing="ij"))
        pixels = replace(
            self.pixels, pose=pose, camera=camera, target=target, pixel=np.zeros((len(pose), 2))
        )
        at = build_random_poses(robot, RANDOM_IMAGE_POSES)
        doubt = np.ones(
            (len(every[1]), LENS_PARAMETER_COUNT)
        )  # lenses turn nothing, and are no rank's concern
        return replace(
            self, at=at, pixels=pixels, weight=np.ones(len(pose)), doubt=doubt, bearings=True
        )

    # ---- how well it is fitted ---------------------------------------------------------------

    def errors_at_targets(self, arm: FlangePoses, unknowns: Array) -> Array:
        """(2, N) errors at the targets [m]."""
        focal = self.lens_parameters(unknowns)[self.pixels.camera, :2].T
        return np.asarray(
            self.pixel_errors(arm, unknowns) * np.abs(self.target_depths(arm, unknowns)) / focal
        )

    def mean_square_error(self, arm: FlangePoses, unknowns: Array) -> float:
        """Of the errors at the targets [m^2]."""
        return float(
            (self.errors_at_targets(arm, unknowns)[:, self.counted_pixel_mask] ** 2)
            .sum(axis=0)
            .mean()
        )

    def target_errors_by_part(self, arm: FlangePoses, unknowns: Array, pixel_mask: Array) -> Array:
        """(m, parts, 3) errors at the targets, NaN where not measured [m].  pixel_mask: (N,)
        mask.
        """
        pixels, error = self.pixels, self.errors_at_targets(arm, unknowns)[:, pixel_mask].T
        out = np.full((self.poses, len(pixels.part_names), 3), np.nan)
        out[pixels.pose[pixel_mask], pixels.part_of_pixels[pixel_mask]] = np.pad(
            error, ((0, 0), (0, 1))
        )
        return out
