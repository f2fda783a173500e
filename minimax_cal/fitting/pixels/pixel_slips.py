"""Slips of pixels that no fit should explain: flipped axes, board, lens, images of other poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import DataError
from minimax_cal.fitting.common_scale import LengthScale
from minimax_cal.fitting.data_slips import MAX_CALIBRATION_ERROR_OF_REACH, raise_for_best_mend
from minimax_cal.fitting.outcome import MAX_MISS_OF_REACH
from minimax_cal.fitting.pixels.fit import MAX_LENS_SIGMAS, PixelFit
from minimax_cal.fitting.pixels.pixel_start import (
    MIN_CAMERA_IMAGES,
    PixelStart,
    board_poses_in_images,
    start_scene,
)
from minimax_cal.instruments.camera_model import FITTED_INTRINSICS
from minimax_cal.instruments.pixel_data import PixelData
from minimax_cal.robots.robot import Robot

MAX_MENDED_ERROR_RATIO = 0.3  # of the error: a slip whose mending leaves no more is the cause
MAX_EQUAL_ERROR_RATIO = 1.2  # errors that differ by less do not tell one slip from another
MENDED_ERROR_TEXT = "the drawn arm then misses by {:.3g} mm at the target, not {:.3g} mm"
MAX_SET_ASIDE_FRACTION = (
    1.0 / 3.0
)  # of the pixels: where more stand out, none of them is to be believed
MAX_LISTED_IMAGES = 5  # lines, or images, that a notice names
MIN_WHOLE_IMAGE_FRACTION = (
    0.5  # of an image: where more pixels stand out, its pose is wrong, not its pixels
)
MIN_OTHER_LENS_CHANGE = 0.05  # of the focal length: no lens changes so much, it is another one
OTHER_SIZE, ODD_SIZE = 1e-6, 0.01  # p-values of a board of another size: it fails, a notice
MIN_OTHER_SIZE = 3e-3  # share of a board's size: by less it is no other board
MAX_PAIRED_IMAGES = 300  # images whose pairing with poses is looked into
SHIFTS, PAIRINGS = 3, 20  # images lost in a row that are tried; rounds of a pairing
BOARD_UNIT_FACTORS = (1e-3, 1e3, 0.1, 10.0, 25.4, 1.0 / 25.4)  # slips of a board's unit
SIZES, STEP = (0.5, 2.0), 0.02  # of a board, or a lens, that are tried; a step that tells a slope
MAX_UNIT_FACTOR_ERROR = 0.02  # a board so far off is another one, before links are fitted


def check_pixel_slips(robot: Robot, data: PixelData, started: PixelStart) -> None:
    """Raise DataError for slips that show where the arm as drawn is fitted."""
    miss, good = started.median_target_error(robot), MAX_CALIBRATION_ERROR_OF_REACH * robot.reach()
    check_board_size(robot, data, started, miss)
    if miss <= good:
        return

    def tried(mended: PixelData) -> tuple[float, float]:
        square = (
            start_scene(robot, mended, started.images.on_flange).median_target_error(robot) ** 2
        )
        return square, square

    every = (*list_pixel_slips(data), *find_pose_shift_slip(robot, data, started.direction))
    given = miss**2, miss**2
    raise_for_best_mend(
        data.source,
        given,
        [every],
        tried,
        good,
        1.0,
        MAX_MENDED_ERROR_RATIO**2,
        MAX_EQUAL_ERROR_RATIO**2,
        MENDED_ERROR_TEXT,
    )


def check_board_size(robot: Robot, data: PixelData, started: PixelStart, miss: float) -> None:
    """Raise DataError where the arm's own motion says that board or lens are of another size.

    A board s times larger is s times farther away, and the arm says by how much that moves; a
    longer lens leaves the board's size and moves the depths alone.  What leaves hardly anything is
    named where the other does not.  miss: as it is [m].
    """
    if not len(data.board):
        return

    def left(size: float, focal: float) -> float:
        times = np.ones(len(data.cameras[0].intrinsic))
        times[:2] = focal
        cameras = tuple(replace(one, intrinsic=times * one.intrinsic) for one in data.cameras)
        some = replace(data, board=size * data.board, cameras=cameras)
        return start_scene(robot, some, started.images.on_flange).median_target_error(robot)

    def least(of: Callable[[float], float]) -> tuple[float, float]:
        """What is left of the error by the best factor, and that factor."""
        if min(of(1.0 - STEP), of(1.0 + STEP)) > (1.0 - 0.5 * STEP) * miss:
            return miss, 1.0
        found = scipy.optimize.minimize_scalar(
            lambda x: of(float(np.exp(x))), bounds=(math.log(SIZES[0]), math.log(SIZES[1])),
            method="bounded",
            options={"xatol": 1e-4, "maxiter": 40},
        )  # fmt: skip
        return float(found.fun), float(np.exp(found.x))

    board, size = least(lambda x: left(x, 1.0))
    lens, _ = least(lambda x: left(1.0, x))
    if (
        board > MAX_MENDED_ERROR_RATIO * miss
        or abs(size - 1.0) < MAX_UNIT_FACTOR_ERROR
        or board * MAX_EQUAL_ERROR_RATIO > lens
    ):
        return
    raise DataError(
        f"{data.source}: the robot's own motion says that the board is {size:.4g} times as large "
        f"as its file says (board): measure its squares "
        f"({MENDED_ERROR_TEXT.format(1e3 * board, 1e3 * miss)})"
    )


def list_pixel_slips(data: PixelData) -> Iterator[tuple[str, PixelData]]:
    """Slips worth testing: what to say, and the data with the slip mended."""
    u, v = data.pixel.T
    size = np.array([image_extent(data, i) for i in range(len(data.cameras))])
    width, height = size[data.camera].T
    for text, pixel in (
        ("v_px counts from the bottom of the image; v is to count from the top", (u, height - v)),
        ("u_px counts from the right of the image; u is to count from the left", (width - u, v)),
        ("u_px and v_px look exchanged", (v, u)),
    ):
        yield text, replace(data, pixel=np.stack(pixel, axis=1))
    for factor in BOARD_UNIT_FACTORS if len(data.board) else ():
        text = f"the board's places look {1.0 / factor:g} times too large: check their unit"
        yield text, replace(data, board=factor * data.board)


def find_pose_shift_slip(robot: Robot, data: PixelData, seen: Array) -> list[tuple[str, PixelData]]:
    """The slip that images are paired with other poses, as `list_pixel_slips` yields it.

    The angle by which a board turns between two images is that of the arm between their poses,
    wherever the camera and the board are.  seen: (2, N) directions.
    """
    rows, shown = board_poses_in_images(data, seen)[int(np.bincount(data.camera).argmax())]
    if not MIN_CAMERA_IMAGES < len(rows) <= MAX_PAIRED_IMAGES:
        return []
    pose = pair_images_with_poses(
        pairwise_rotation_angles(shown), pairwise_rotation_angles(robot.pose(data.at.q)), rows
    )
    place = np.arange(data.at.poses)
    place[rows] = pose
    known = np.isin(data.pose, rows)
    if (pose == rows).all():
        return []
    wrong = np.flatnonzero(pose != rows)
    text = (
        f"{len(wrong)} of {len(rows)} images are paired with other poses: that of pose "
        f"{data.labels[rows[wrong[0]]]} is of pose {data.labels[pose[wrong[0]]]}; was an image or "
        "a row lost? pair images and joint values again"
    )
    some = data.take_pixels(known)
    return [(text, replace(some, pose=place[some.pose]))]


def pairwise_rotation_angles(pose: Array) -> Array:
    """(m, m) angle between the rotations of each two poses (m, 4, 4) [rad]."""
    trace = np.einsum("iab,jab->ij", pose[:, :3, :3], pose[:, :3, :3])
    return np.asarray(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


def pair_images_with_poses(shown: Array, turned: Array, rows: Array) -> Array:
    """(i,) the pose of each image by the angles (i, i) of the images and (m, m) of the arm.

    Each image goes where its angles to all others fit best, from several pairings; rows: (i,) the
    given one.
    """
    share = np.linspace(0.0, 1.0, len(rows))
    alike = [np.quantile(angle, share, axis=1).T for angle in (shown, turned)]
    starts = [np.clip(rows + k, 0, len(turned) - 1) for k in range(-SHIFTS, SHIFTS + 1)]
    starts += [
        rows[::-1],
        minimum_cost_assignment(np.abs(alike[0][:, None] - alike[1]).mean(axis=-1)),
    ]
    found = []
    for pose in starts:
        for _ in range(PAIRINGS):
            before = pose
            pose = minimum_cost_assignment(np.abs(shown[:, None] - turned[:, pose]).mean(axis=-1))
            if (pose == before).all():
                break
        found.append((float(np.abs(shown - turned[np.ix_(pose, pose)]).mean()), pose))
    given = float(np.abs(shown - turned[np.ix_(rows, rows)]).mean())
    best = min(found, key=lambda each: each[0])
    return best[1] if best[0] < MAX_MENDED_ERROR_RATIO * given else rows


def minimum_cost_assignment(cost: Array) -> Array:
    """(i,) columns, each once, of least cost (i, m) [Kuhn 1955]."""
    return np.asarray(scipy.optimize.linear_sum_assignment(cost)[1])


def image_extent(data: PixelData, camera: int) -> tuple[float, float]:
    """The largest pixel of a camera's image, or twice its centre where the size is not told."""
    each = data.cameras[camera]
    width, height = (
        extent - 1.0 if extent else 2.0 * centre
        for extent, centre in zip(each.size, each.intrinsic[2:4], strict=True)
    )
    return float(width), float(height)


def describe_pixel_objection(robot: Robot, fit: PixelFit, scale: LengthScale | None) -> str:
    """What pixels themselves hold against a fit; empty for nothing."""
    (arm, own), images = fit.problem.flange_and_own_parameters(fit.state), fit.images
    focal = images.intrinsic[images.pixels.camera, 0]
    size = (
        np.linalg.norm(images.pixel_errors(arm, own), axis=0)
        * np.abs(images.target_depths(arm, own))
        / focal
    )
    miss, aside = float(np.median(size)), float((~images.counted_pixel_mask).mean())
    said = ""
    if miss > MAX_MISS_OF_REACH * robot.reach():
        said = f"the calibrated arm misses by {1e3 * miss:.3g} mm at the target"
    elif aside > MAX_SET_ASIDE_FRACTION:
        said = f"{100 * aside:.0f} % of the pixels are outliers"
    if said:
        return (
            f"{said}: check that joints, detections, board and camera files belong together, and "
            "what the cameras are fixed to (camera_on)"
        )
    return describe_other_lens(fit) or describe_other_board_size(scale, OTHER_SIZE, MIN_OTHER_SIZE)


def describe_other_lens(fit: PixelFit) -> str:
    """Which camera's file is of another lens; empty where none is."""
    for camera, lens in zip(fit.images.pixels.cameras, fit.lens, strict=True):
        file = camera.intrinsic[:2]
        if (np.abs(lens[:2] / file - 1.0) > MIN_OTHER_LENS_CHANGE).any():
            return (
                f"{camera.source}: the pixels of {camera.name} fit fx {lens[0]:.5g}, fy "
                f"{lens[1]:.5g}, not {file[0]:.5g}, {file[1]:.5g}: it is the file of another "
                "camera, of another image size, or of another focus"
            )
    return ""


def describe_other_board_size(scale: LengthScale | None, limit: float, least: float = 0.0) -> str:
    """That the board is of another size than its file says; empty where it is not.

    limit: p-value from which on it is.  Pixels leave it open how large all is: with a board of
    another size the arm comes out larger by the same factor, in all its lengths alike.
    """
    if scale is None or scale.p_value > limit or abs(scale.share) < least:
        return ""
    larger, board = ("longer", "smaller") if scale.share > 0.0 else ("shorter", "larger")
    own = abs(scale.share / (1.0 + scale.share))
    return (
        f"all lengths of the arm come out {100 * abs(scale.share):.2f} % {larger} than drawn: the "
        f"board is {100 * own:.2f} % (sigma {100 * scale.sigma:.2f} %) {board} than its file says "
        "(board): measure its squares"
    )


def list_file_notices(fit: PixelFit, scale: LengthScale | None) -> list[str]:
    """Notices of lenses that are far from their files, and of a board of another size."""
    file = fit.images.intrinsic[:, : len(FITTED_INTRINSICS)]
    off = np.abs(fit.lens - file) / fit.doubt
    out = []
    for i, camera in enumerate(fit.images.pixels.cameras):
        far = [j for j in range(len(FITTED_INTRINSICS)) if off[i, j] > MAX_LENS_SIGMAS]
        if far:
            named = ", ".join(
                f"{FITTED_INTRINSICS[j]} {fit.lens[i, j]:.6g} (file: {file[i, j]:.6g})" for j in far
            )
            out.append(
                f"{camera.source}: the pixels say that the lens of {camera.name} is "
                f"{off[i, far].max():.0f} times its doubt away from its file: {named}; is it the "
                "file of this camera?"
            )
    odd = describe_other_board_size(scale, ODD_SIZE)
    return [*out, odd] if odd else out


def list_outlier_pixel_notices(data: PixelData, rows: Array) -> list[str]:
    """Notices of pixels that were set aside, and of images most of whose pixels were."""
    if not len(rows):
        return []
    _, image, count = np.unique(data.image_of_pixels, return_inverse=True, return_counts=True)
    image = image.reshape(-1)
    lost = np.bincount(image[rows], minlength=len(count)) > MIN_WHOLE_IMAGE_FRACTION * count
    single = rows[~lost[image[rows]]]
    out = []
    if lost.any():
        first = [int(np.argmax(image == each)) for each in np.flatnonzero(lost)]
        named = [
            f"pose {data.labels[data.pose[row]]} of camera {data.cameras[data.camera[row]].name}"
            for row in first
        ]
        out.append(
            f"{data.source}: {len(first)} whole images are outliers, set aside: "
            f"{format_first_names(named, MAX_LISTED_IMAGES)}; "
            f"are the joint values those of the image?"
        )
    if len(single):
        named = [data.pixel_location(int(row)) for row in single]
        ending, are = ("s", "is") if len(named) == 1 else ("", "are")
        out.append(
            f"{data.source}: {len(named)} pixel{'' if ending else 's'} stand{ending} out and {are} "
            f"set aside: {format_first_names(named, MAX_LISTED_IMAGES)}"
        )
    return out
