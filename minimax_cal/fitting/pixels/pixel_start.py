"""Where cameras and targets are, without a guess.

With a flat board each image tells the camera's pose by itself (a homography), so that poses start
it; with tags of unknown place, or where images show too few corners, a search over the camera's
rotation does: everything else is then linear.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, CalibrationWarning
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.multi_instrument.instrument_stack import build_own_state
from minimax_cal.fitting.session_frames import fit_rigid_motion
from minimax_cal.instruments.camera_images import CameraImages
from minimax_cal.instruments.camera_model import undistort_pixels
from minimax_cal.instruments.pixel_data import PixelData
from minimax_cal.instruments.protocol import FlangeKinematics
from minimax_cal.instruments.virtual_reflectors import (
    DEFAULT_ROTATION_LEVER,
    build_virtual_reflectors,
    fit_poses_to_points,
    virtual_reflector_positions,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform, nearest_rotations

MIN_PLANE_CORNERS = 6  # in an image: fewer do not tell a wrong one by the others
MIN_CAMERA_IMAGES = 4  # whose poses tell where a camera and a board are
MAX_PLANE_THICKNESS_RATIO = 1e-3  # of a board's size: what it may stick out of its plane
REWEIGHTING_ROUNDS = 5  # rounds that take wrong corners, or wrong images, out
ROBUST_MEDIAN_RATIO = 3.0  # times the typical error: beyond it a corner counts less
SEARCHED_ROTATIONS = 600  # of a camera that are looked at, some 25 degrees from each other
MAX_SEARCH_TARGETS = 6  # of unknown place, which tell one rotation from another
MAX_REFINING_RAYS, MAX_SCREENING_RAYS = (
    300,
    100,
)  # of their pixels, for the few that go on and for all
REFINED_ROTATIONS, MAX_CAMERA_ROTATION_STEPS = (
    6,
    15,
)  # rotations that go on, and how often each is improved
DEPTH_ITERATIONS = 3  # rounds in which depths follow the lengths
RAY_GRAM_RIDGE = 1e-12  # of the normal equations' typical entry, for what no ray tells
MIN_DEPTH = 1e-3  # least depth of a target [m]
MIN_DEPTH_RATIO = 0.05  # of the largest depth: what is nearer counts no more
MAX_CLIPPED_ERROR = 0.2  # error of what lies behind a camera, as a tangent
SOFT_ROTATION_ERROR = 0.01  # errors count less from here on
ImagePoses = tuple[Array, Array]  # (i,) rows of poses, and (i, 4, 4) pose of a board at each


@dataclass(frozen=True, eq=False)
class PixelStart:
    """The arm as drawn, among cameras and targets that fit it.

    images: all pixels, alike.  direction: (2, N) that was seen, in the plane at depth one.  depth:
    (N,) of each target as its image tells it alone, 0 where it does not [m].  nearest: least depth
    of a target [m].  begin: where a fit begins, None for the drawn arm.
    """

    images: CameraImages
    state: ParameterValues
    direction: Array
    depth: Array
    nearest: float = MIN_DEPTH
    begin: ParameterValues | None = None

    def median_target_error(self, robot: Robot) -> float:
        """Typical error at the targets, infinite where most lie behind a camera [m]."""
        one, own = self.images, self.state.effects
        arm = FlangeKinematics.from_robot(robot, one.at.q).compute_flange_poses(self.state.mdh)
        size = np.linalg.norm(one.errors_at_targets(arm, own), axis=0)
        return float(np.median(np.where(one.target_depths(arm, own) > self.nearest, size, np.inf)))


def start_scene(robot: Robot, data: PixelData, on_flange: bool) -> PixelStart:
    """Cameras and targets that fit the arm as drawn."""
    seen, every = undistorted_directions(data), range(len(data.cameras))
    image = board_poses_in_images(data, seen)
    found = place_cameras_by_board_poses(robot, data, on_flange, image)
    if not found:
        found = [
            place_camera_by_rotation_search(robot, data, on_flange, seen, camera)
            for camera in every
        ]
    images, own = merge_camera_placements(data, on_flange, found)
    return PixelStart(images, build_own_state(robot.mdh, own), seen, target_depths(data, image))


def start_from_far(robot: Robot, data: PixelData, started: PixelStart) -> PixelStart:
    """The same where the drawn arm is far off: a fit begins at what the images' poses alone tell.

    A pose from each image is what a tracker of whole poses sees: `calibrate` finds the arm from
    any start.
    """
    on_flange, image = started.images.on_flange, board_poses_in_images(data, started.direction)
    rows, pose = image[int(np.bincount(data.camera).argmax())]
    if len(rows) < MIN_CAMERA_IMAGES:
        return started
    targets = virtual_reflectors(data, on_flange, rows, pose)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        try:
            fit = calibrate(
                replace(robot, rough=True), targets, "sum", holdout=0.0, simulated=True,
                allow_large_changes=True,
            )  # fmt: skip
        except CalibrationError:  # too few poses for all parameters, say
            return started
    arm = robot.with_mdh(fit.cell.robot.mdh)
    found = place_cameras_by_board_poses(arm, data, on_flange, image)
    if not found:
        return started
    images, own = merge_camera_placements(data, on_flange, found)
    own = images.count_rotations_from(own, started.images.turn)
    return replace(started, begin=build_own_state(arm.mdh, own))


def target_depths(data: PixelData, image: Sequence[ImagePoses]) -> Array:
    """(N,) of each target by the pose of its board in its image, 0 where there is none [m]."""
    out = np.zeros(data.pixel_count)
    for camera, shown in enumerate(image):
        for row, found in zip(*shown, strict=True):
            mine = (data.camera == camera) & (data.pose == row)
            out[mine] = data.board[data.target[mine]] @ found[2, :3] + found[2, 3]
    return out


def undistorted_directions(data: PixelData) -> Array:
    """(2, N) what was seen, in the plane at depth one, by the lenses as their files say."""
    lens = np.stack([camera.intrinsic for camera in data.cameras])
    return undistort_pixels(lens[data.camera].T, data.pixel.T)


# ---- a flat board: a pose from each image ----------------------------------------------------


def board_poses_in_images(data: PixelData, seen: Array) -> list[ImagePoses]:
    """Of each camera where a flat board shows, and its pose in the camera there [m]."""
    nothing = [(np.zeros(0, dtype=int), np.zeros((0, 4, 4)))] * len(data.cameras)
    if not len(data.board):
        return nothing
    centre = data.board.mean(axis=0)
    _, size, axes = np.linalg.svd(data.board - centre)
    if size[2] >= MAX_PLANE_THICKNESS_RATIO * size[0]:
        return nothing

    # A frame in the board's whose z = 0 holds all its targets.
    axes[2] *= np.linalg.det(axes)
    plane = build_transform(axes.T, centre)
    local = (data.board - plane[:3, 3]) @ plane[:3, :3]
    out = []
    for camera in range(len(data.cameras)):
        every = {}
        for pose in np.unique(data.pose[data.camera == camera]):
            rows = np.flatnonzero((data.camera == camera) & (data.pose == pose))
            if len(rows) >= MIN_PLANE_CORNERS:
                found = plane_pose_by_dlt(local[data.target[rows], :2], seen[:, rows].T)
                if found is not None:
                    every[pose] = found @ np.linalg.inv(plane)
        out.append((np.array([*every], dtype=int), np.array([*every.values()]).reshape(-1, 4, 4)))
    return out


def plane_pose_by_dlt(corner: Array, direction: Array) -> Array | None:
    """Pose (4, 4) of a plane from where its corners are seen; None where they do not tell.

    corner: (c, 2) in the plane [m].  direction: (c, 2) in the camera's plane at depth one.
    Direct linear transform with wrong corners weighed down, then the nearest rotation.
    """
    (a, moved), (b, shown) = normalise_image_points(corner), normalise_image_points(direction)
    ones, none = np.ones((len(moved), 1)), np.zeros((len(moved), 3))
    point = np.hstack([moved, ones])
    rows = np.stack(
        [
            np.hstack([point, none, -shown[:, :1] * point]),
            np.hstack([none, point, -shown[:, 1:] * point]),
        ],
        axis=1,
    )
    weight = np.ones(len(moved))
    for _ in range(REWEIGHTING_ROUNDS):
        size, axes = np.linalg.svd((weight[:, None, None] * rows).reshape(-1, 9))[1:]
        if size[7] < 1e-6 * size[0]:
            return None
        flat = axes[8].reshape(3, 3)
        image = point @ flat.T
        error = np.linalg.norm(image[:, :2] / image[:, 2:] - shown, axis=1)
        limit = ROBUST_MEDIAN_RATIO * np.median(error)
        weight = np.where(error > limit, limit / np.maximum(error, 1e-300), 1.0) ** 2
    whole = np.linalg.inv(b) @ flat @ a
    whole /= np.sqrt(np.linalg.norm(whole[:, 0]) * np.linalg.norm(whole[:, 1]))
    whole *= np.sign(whole[2, 2])  # before the camera
    first, second, place = whole.T
    rotation = nearest_rotations(np.stack([first, second, np.cross(first, second)], axis=1))
    return build_transform(rotation, place)


def normalise_image_points(points: Array) -> tuple[Array, Array]:
    """The map (3, 3) that brings places (c, 2) about zero and to size one, and what it gives."""
    middle = points.mean(axis=0)
    size = np.sqrt(((points - middle) ** 2).sum(axis=1).mean() / 2.0)
    scale = 1.0 / max(float(size), 1e-300)
    change = np.array([[scale, 0.0, -scale * middle[0]], [0.0, scale, -scale * middle[1]],
                       [0.0, 0.0, 1.0]])  # fmt: skip
    return change, scale * (points - middle)


def place_cameras_by_board_poses(
    robot: Robot, data: PixelData, on_flange: bool, image: Sequence[ImagePoses]
) -> list[tuple[Array, Array, Array]]:
    """`place_camera_by_board_poses` of each camera; none where one of them has too few images."""
    if any(len(rows) < MIN_CAMERA_IMAGES for rows, _ in image):
        return []
    return [place_camera_by_board_poses(robot, data, on_flange, *shown) for shown in image]


def place_camera_by_board_poses(
    robot: Robot, data: PixelData, on_flange: bool, rows: Array, pose: Array
) -> tuple[Array, Array, Array]:
    """Pose (4, 4) of a camera, pose (4, 4) of the board, and the places (k, 3) of its targets.

    As a tracker sees whole poses: the still one of camera and board is the tracker.  rows, pose:
    as `ImagePoses`.
    """
    targets = virtual_reflectors(data, on_flange, rows, pose)
    for _ in range(REWEIGHTING_ROUNDS):  # images that the arm contradicts are left out
        found = fit_base_and_targets(build_point_model(robot, targets), robot.mdh).state
        error = np.linalg.norm(build_point_model(robot, targets).point_errors(found), axis=-1).max(
            axis=1
        )
        kept = error <= 2.0 * ROBUST_MEDIAN_RATIO * np.median(error)
        if kept.all() or kept.sum() < MIN_CAMERA_IMAGES:
            break
        targets = targets.take(kept)
    tool = fit_poses_to_points(
        found.target_positions, virtual_reflector_positions(DEFAULT_ROTATION_LEVER)
    )
    still = np.linalg.inv(found.base_pose)
    place, board = (tool, still) if on_flange else (still, tool)
    return place, board, data.board @ board[:3, :3].T + board[:3, 3]


def virtual_reflectors(data: PixelData, on_flange: bool, rows: Array, pose: Array) -> Measurements:
    """What cameras saw as virtual reflectors, which say the same [m].  rows, pose: as
    `ImagePoses`.
    """
    at = replace(data.at.take(rows), columns={})
    return build_virtual_reflectors(at, np.linalg.inv(pose) if on_flange else pose)


# ---- anything else: a search over rotations --------------------------------------------------


@dataclass(frozen=True, eq=False)
class CameraRays:
    """What is linear in the places of one camera and of its targets, once its rotation is given.

    A target w is at R' (turn w - off - t) in the camera's axes, R its rotation and t its place.
    turn: (N, 3, 3).  off: (N, 3) [m].  direction: (N, 2).  target: (N,) numbers from 0, each there.
    """

    turn: Array
    off: Array
    direction: Array
    target: Array

    def select_rays(self, rows: Array) -> CameraRays:
        """Some of the rays, their targets numbered anew."""
        _, target = np.unique(self.target[rows], return_inverse=True)
        return CameraRays(self.turn[rows], self.off[rows], self.direction[rows], target.reshape(-1))

    def thin(self, most: int) -> CameraRays:
        """Rays that determine a rotation: at most so many, of the targets seen most often."""
        chosen = np.argsort(-np.bincount(self.target), kind="stable")[:MAX_SEARCH_TARGETS]
        rows = np.flatnonzero(np.isin(self.target, chosen))
        spread = np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)
        return self.select_rays(np.asarray(rows[spread]))

    def mean_error(self, view: Array) -> float:
        """Mean size of the errors for a rotation R', wrong ones clipped at `MAX_CLIPPED_ERROR`."""
        size = np.linalg.norm(self.solve_place_and_targets(view)[2], axis=1)
        return float(np.minimum(size, MAX_CLIPPED_ERROR).mean())

    def perpendicular_rows(self, view: Array) -> Array:
        """(N, 2, 3) what makes a point's two errors of the point.  view: (3, 3) R'."""
        return np.asarray(view[None, :2] - self.direction[..., None] * view[2])

    def solve_place_and_targets(self, view: Array) -> tuple[Array, Array, Array]:
        """Place (3,), targets (k, 3) [m] and errors (N, 2) in the plane at depth one, robustly.

        Errors of what lies behind the camera are `MAX_CLIPPED_ERROR`.
        """
        across, count = self.perpendicular_rows(view), int(self.target.max()) + 1
        rows = np.zeros((len(self.off), 2, 3 * count + 3))
        own = across @ self.turn
        for axis in range(3):
            rows[np.arange(len(rows)), :, 3 * self.target + axis] = own[..., axis]
        rows[..., -3:] = -across
        right = (across @ self.off[..., None])[..., 0]
        weight = np.ones(len(rows))
        for _ in range(DEPTH_ITERATIONS):
            matrix = (weight[:, None, None] * rows).reshape(-1, rows.shape[-1])
            gram = matrix.T @ matrix
            gram += RAY_GRAM_RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
            found = np.linalg.solve(gram, matrix.T @ (weight[:, None] * right).reshape(-1))
            spots, place = found[:-3].reshape(-1, 3), found[-3:]
            depth = self.depth(view, place, spots[self.target])
            error = (rows @ found - right) / np.maximum(depth, MIN_DEPTH)[:, None]
            error = np.where(depth[:, None] > MIN_DEPTH, error, MAX_CLIPPED_ERROR)
            size = np.linalg.norm(error, axis=1)
            limit = ROBUST_MEDIAN_RATIO * np.median(size) + 1e-12
            weight = np.minimum(1.0, limit / np.maximum(size, 1e-300))
            weight /= np.maximum(depth, MIN_DEPTH_RATIO * np.abs(depth).max())
        return place, spots, error

    def depth(self, view: Array, place: Array, spot: Array) -> Array:
        """(N,) of the targets before the camera [m]."""
        fixed = (self.turn @ spot[..., None])[..., 0] - self.off - place
        return np.asarray(fixed @ view[2])


def build_camera_rays(
    robot: Robot, data: PixelData, on_flange: bool, seen: Array, camera: int
) -> CameraRays:
    """Those of one camera, for the arm as drawn.  The targets' numbers are those of the data."""
    rows = np.flatnonzero(data.camera == camera)
    flange = robot.pose(data.at.q)[data.pose[rows]]
    turn, origin = flange[:, :3, :3], flange[:, :3, 3]
    target, direction = data.target[rows], seen[:, rows].T
    if on_flange:
        axes = turn.swapaxes(1, 2)
        return CameraRays(axes, (axes @ origin[..., None])[..., 0], direction, target)
    return CameraRays(turn, -origin, direction, target)


def place_camera_by_rotation_search(
    robot: Robot, data: PixelData, on_flange: bool, seen: Array, camera: int
) -> tuple[Array, Array, Array]:
    """As `place_camera_by_board_poses`, for targets taken as of unknown place, NaN where one camera
    cannot tell it.
    """
    rays = build_camera_rays(robot, data, on_flange, seen, camera)
    few, fewest = rays.thin(MAX_REFINING_RAYS), rays.thin(MAX_SCREENING_RAYS)
    looks = Rotation.random(SEARCHED_ROTATIONS, rng=np.random.default_rng(0)).as_matrix()
    best = np.argsort([fewest.mean_error(look) for look in looks])[:REFINED_ROTATIONS]
    view = min((refine_rotation(few, looks[i]) for i in best), key=few.mean_error)
    place = few.solve_place_and_targets(view)[0]
    spots = np.full((len(data.targets), 3), np.nan)
    for target in np.unique(rays.target):
        rows = np.flatnonzero(rays.target == target)
        if len(rows) > 1:
            spots[target] = intersect_rays(rays.select_rays(rows), view, place)
    camera_pose = build_transform(view.T, place)
    if not len(data.board):
        return camera_pose, np.eye(4), spots
    known = np.isfinite(spots[:, 0])
    board = fit_rigid_motion(data.board[known], spots[known])
    return camera_pose, board, np.asarray(data.board @ board[:3, :3].T + board[:3, 3])


def refine_rotation(rays: CameraRays, view: Array) -> Array:
    """The rotation (3, 3) near one that fits the rays best."""

    def errors(turn: Array) -> Array:
        return rays.solve_place_and_targets(kinematics.rotation_from_vector(turn) @ view)[
            2
        ].reshape(-1)

    found = scipy.optimize.least_squares(
        errors,
        np.zeros(3),
        loss="soft_l1",
        f_scale=SOFT_ROTATION_ERROR,
        max_nfev=MAX_CAMERA_ROTATION_STEPS,
    )
    return np.asarray(kinematics.rotation_from_vector(found.x) @ view)


def intersect_rays(rays: CameraRays, view: Array, place: Array) -> Array:
    """(3,) where the rays of one target cross best [m]."""
    across = rays.perpendicular_rows(view)
    rows = across @ rays.turn
    right = (across @ (rays.off + place)[..., None])[..., 0]
    weight = np.ones(len(rows))
    for _ in range(DEPTH_ITERATIONS):
        matrix = (weight[:, None, None] * rows).reshape(-1, 3)
        spot = np.linalg.lstsq(matrix, (weight[:, None] * right).reshape(-1), rcond=1e-9)[0]
        size = np.linalg.norm(rows @ spot - right, axis=1)
        limit = ROBUST_MEDIAN_RATIO * np.median(size) + 1e-12
        weight = np.minimum(1.0, limit / np.maximum(size, 1e-300))
    return np.asarray(spot)


def merge_camera_placements(
    data: PixelData, on_flange: bool, found: Sequence[tuple[Array, Array, Array]]
) -> tuple[CameraImages, Array]:
    """What each camera told by itself in one; the board as the one that saw most tells it."""
    poses = np.stack([place for place, _, _ in found])
    _, board, points = found[int(np.bincount(data.camera).argmax())]
    for _, _, more in found:
        points = np.where(np.isfinite(points), points, more)
    if not len(data.board):
        points = np.where(np.isfinite(points), points, np.nanmean(points, axis=0))
    return CameraImages.build_with_start(data, poses, board, points, on_flange=on_flange)
