"""Plan the images of a camera cell: poses that see the board and tell most of the arm.

Arm, cameras, lenses and board are unknown together, as in `fitting.pixels`; what counts is what is
then known of positions of the arm, base and tool fitted.

The information of a pose is J'V^-1 J over all that pixels determine, arm, cameras, lenses and
board; V = s^2 + t^2 S S', s the noise of a pixel and t the jitter of the joints, S the motion of
the pixels per unit of each joint.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from minimax_cal.fitting.identify import RESOLUTION
from minimax_cal.fitting.pixels.fit import PixelSquares
from minimax_cal.fitting.pixels.judge import everywhere, free_motion
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.several.result import PixelCalibration
from minimax_cal.fitting.several.stack import own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import Apart, Fact
from minimax_cal.ground.files import plain, saved_content
from minimax_cal.ground.options import takes
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.instruments.camera import FLANGE, GROUND, Camera, read_camera
from minimax_cal.instruments.images import LENS, Images
from minimax_cal.instruments.pixels import PixelData, read_board
from minimax_cal.modelling.cell import Cell, pose_from_dict, still
from minimax_cal.modelling.parameters import State
from minimax_cal.planning.camera_options import FOR_CAMERAS, SIDES, CameraOptions, check_cameras
from minimax_cal.planning.camera_sight import CameraSight
from minimax_cal.planning.options import USUAL, PlanOptions, check_options
from minimax_cal.planning.plan import chosen, enough
from minimax_cal.planning.prospect import Instrument
from minimax_cal.planning.result import Plan
from minimax_cal.planning.task import Ground, Task, check_same, surroundings
from minimax_cal.planning.visibility import Room, View
from minimax_cal.robots.robot import Robot, load_robot

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
        problem, x, _ = plain.images(q[:SAMPLE], seen[:SAMPLE])
        images, every = problem.images, problem.stack.movable
        found = problem.identified(cell.robot, x, every, every & ~every, RESOLUTION)
        free = tuple(problem.names.all[i] for i in np.flatnonzero(found.active))
        focal = images.intrinsic[images.pixels.camera, 0]
        pixel = np.median(images.depth(*problem.at(x)) / focal)
        return CameraProspect(
            cell, room, sight, cameras, noise, found.active, free, pixel * found.scale[found.active]
        )

    def images(self, q: Array, seen: Array) -> tuple[PixelSquares, State, Array]:
        """The pixels that would be seen, the state, and (m, c * k) True where they are."""
        sight, robot, count = self.sight, self.cell.robot, len(self.sight.corners)
        inside = np.moveaxis(sight.inside(sight.relative(View(self.room, sight, q))), 0, 1)
        inside = (inside & seen[..., None]).reshape(len(q), -1)
        pose, place = np.nonzero(inside)
        at = still(q, (), robot)
        data = PixelData(
            at, tuple(map(str, at.line)), self.cameras, tuple(map(str, range(count))),
            sight.corners, pose, place // count, place % count, np.zeros((len(pose), 2)), pose,
        )  # fmt: skip
        images, own = Images.placed_at(
            data, sight.camera, sight.board, sight.corners, on_flange=sight.on_flange
        )
        return PixelSquares.of(robot, images), own_state(robot.mdh, own), inside

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
        problem, x, inside = self.images(q, seen)
        own = problem.rows(x, self.active)[1] / self.scale[:, None]
        rows = np.concatenate([own, problem.by_joints(x)])
        rows = rows.reshape(len(rows), 2, -1)
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


# ---- the plan ------------------------------------------------------------------------------------


@takes(sees=CameraOptions, options=(PlanOptions, FOR_CAMERAS))
def plan_cameras(
    robot: Robot | str | Path,
    poses: int,
    camera: Mapping[str, Path | str],
    board: Path | str,
    *,
    fit: Mapping[str, Any] | Path | str | None = None,
    sees: CameraOptions,
    options: PlanOptions,
    progress: Progress = silent,
) -> Plan:
    """Which images of a board to take with cameras, and how well they will tell the arm.

    Parameters
    ----------
    robot
        Loaded, or a name or path.
    poses
        How many.
    camera
        Files of K, D and image size by the cameras' names (OpenCV or ROS, YAML).
    board
        Places of the board's corners (target, x_mm, y_mm, z_mm).
    fit
        A calibration by cameras: arm, cameras and board are where it has them.
    sees
        See `CameraOptions`.
    options
        See `PlanOptions`.
    progress
        Called with a word on each stage.

    Returns
    -------
    Plan
        The poses in order; its sigma of positions is that of `calibrate_pixels`, of noise alone.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> found = mc.plan_cameras("ur5", 30, {"cam": "camera.yaml"}, "board.csv", fit="fit.json")
    """
    options = replace(options, whole=len(camera) == 1)
    began = time.perf_counter()
    robot = load_robot(robot)
    check_options(options, poses, robot)
    progress("start")
    if fit is not None:
        robot, sees = placed_by(robot, fit, list(camera), sees)
    check_cameras(sees, len(camera))
    cameras = tuple(read_camera(name, path) for name, path in camera.items())
    corners = np.array(list(read_board(board).values()))
    return planned_images(robot, poses, cameras, corners, options, sees, progress, began)


def planned_images(
    robot: Robot,
    poses: int,
    cameras: tuple[Camera, ...],
    corners: Array,
    options: PlanOptions,
    sees: CameraOptions,
    progress: Progress,
    began: float,
) -> Plan:
    """As `plan_cameras`, of files that are read.  began: by `time.perf_counter`."""
    sight = sight_of(robot, sees, cameras, corners)
    jitter = USUAL.jitter if options.jitter is None else options.jitter
    noise = PixelNoise(sees.pixel_noise, jitter=jitter)
    middle = np.tile(middle_of(sight), (len(cameras), 1))
    rides = sight.camera[:, :3, 3] if sight.on_flange else middle
    names = tuple(one.name for one in cameras)
    cell = Cell(robot, np.eye(4), names, rides)
    room, _, said = surroundings(cell, options)
    progress("candidate poses")
    found = enough(room, sight, options, poses)
    ahead = CameraProspect.of(cell, room, sight, cameras, noise, found.q, found.seen)
    text = (
        f"noise of a pixel {noise.noise:.3g} px, jitter of a joint {1e6 * noise.jitter:.3g} urad; "
        "errors that no link holds come on top of the predicted sigma"
    )
    lenses = PixelOptions(camera_prior=sees.camera_prior).lens_sigma(sight.intrinsic)
    ground = Ground(cell, (), noise, (text,))
    task = Task(options, ground, room, sight, ahead, everywhere(robot), ahead.known(lenses), ())
    out = chosen(task, found, poses, said, progress, began)
    return replace(
        out,
        cell=Cell(robot, np.eye(4), (), np.zeros((0, 3))),
        expected=np.zeros((poses, 0, 3)),
        cameras=names,
        still="board" if sight.on_flange else "camera",
        settings={**out.settings, **plain(vars(sees))},
    )


def middle_of(sight: CameraSight) -> Array:
    """(3,) of the board, in the base or flange [m]."""
    return np.asarray((sight.board @ np.append(sight.corners.mean(axis=0), 1.0))[:3])


def sight_of(
    robot: Robot, sees: CameraOptions, cameras: Sequence[Camera], corners: Array
) -> CameraSight:
    """What the cameras see.  corners: (k, 3) in the board's frame [m].  Raises OptionError."""
    for one in cameras:
        if not all(one.size):
            raise OptionError(
                f"{one.source}: image_width and image_height are missing; give them: they "
                "say what is in the image"
            )
    near, far = sees.distance
    poses, board = np.stack(sees.camera_at), np.asarray(sees.board_at)
    sight = CameraSight(
        place=poses[:, :3, 3], up=robot.up, near=near, far=far, camera=poses,
        intrinsic=np.stack([one.intrinsic for one in cameras]),
        size=np.array([one.size for one in cameras], dtype=float), corners=corners, board=board,
        on_flange=sees.camera_on == FLANGE, side=SIDES[sees.print_looks], least=sees.share,
        incidence=sees.incidence,
    )  # fmt: skip
    return replace(sight, place=middle_of(sight)) if sight.on_flange else sight


def placed_by(
    robot: Robot, fit: Mapping[str, Any] | Path | str, names: Sequence[str], sees: CameraOptions
) -> tuple[Robot, CameraOptions]:
    """Arm, cameras and board as a calibration by cameras has them.  Raises CalibrationError."""
    if len(sees.camera_at) or sees.board_at is not None:
        raise OptionError(
            "the fit tells where cameras and board are: leave camera_at= and board_at= out"
        )
    content, source = (fit, "fit") if isinstance(fit, Mapping) else (saved_content(fit), str(fit))
    known = PixelCalibration.from_dict(content, source)
    check_same(robot, known.calibrated or known.robot)
    poses, board = known.instrument["cameras"], known.instrument.get("board")
    strange = [name for name in names if name not in poses]
    if strange or board is None:
        what = f"camera {strange[0]}" if strange else "board"
        raise OptionError(f"{source}: has no {what}; give camera_at= and board_at= instead")
    on = FLANGE if known.instrument["cameras_in"] == FLANGE else GROUND
    at = tuple(pose_from_dict(poses[name]["pose"]) for name in names)
    placed = replace(sees, camera_on=on, camera_at=at, board_at=pose_from_dict(board))
    return known.calibrated or known.robot, placed
