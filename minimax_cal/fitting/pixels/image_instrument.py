"""Pixels as one instrument of a fit: what they are to it, a fit of their own says first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.progress_stages import Progress, silent_progress
from minimax_cal.fitting.data_slips import MAX_CALIBRATION_ERROR_OF_REACH
from minimax_cal.fitting.outcome import MAX_MISS_OF_REACH
from minimax_cal.fitting.pixels.fit import (
    MAX_OUTLIER_ROUNDS,
    PixelFit,
    PixelSquares,
    cauchy_weights,
    fit_pixels,
    inlier_weights,
)
from minimax_cal.fitting.pixels.options import PixelOptions, check_pixel_options
from minimax_cal.fitting.pixels.pixel_slips import (
    MAX_SET_ASIDE_FRACTION,
    MIN_WHOLE_IMAGE_FRACTION,
    check_pixel_slips,
    list_outlier_pixel_notices,
)
from minimax_cal.fitting.pixels.pixel_start import start_from_far, start_scene
from minimax_cal.instruments.camera_images import CameraImages
from minimax_cal.instruments.camera_model import (
    CAMERA_ON_FLANGE,
    CAMERA_ON_GROUND,
    FITTED_INTRINSICS,
    read_camera_file,
)
from minimax_cal.instruments.instrument import NOT_READY, check_instrument_data
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.instruments.pixel_data import PixelData, read_pixel_data
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.measuring.measurement_checks import check_joints_move
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform

MIN_CAMERA_MOUNT_GAIN = (
    0.2  # of the error: cameras that fit so much better elsewhere are fixed there
)


@dataclass(frozen=True, eq=False)
class FittedImages(CameraImages):
    """robot: as drawn.  fit: of training images, by themselves."""

    robot: Robot = NOT_READY
    fit: PixelFit = NOT_READY

    chosen = (*CameraImages.chosen, "robot", "fit")

    @staticmethod
    def from_fit(robot: Robot, fit: PixelFit) -> FittedImages:
        """What a fit of the images alone says of them; a pixel counts as at a typical target."""
        images = fit.images
        depth = images.target_depths(*fit.problem.flange_and_own_parameters(fit.nominal))
        metre = float(np.median(depth / images.intrinsic[images.pixels.camera, 0]))
        return replace(
            FittedImages(**vars(images)), robot=robot, fit=fit, metre=metre,
            doubt=fit.lens_sigma, noise=fit.noise_px, lens_held=fit.held,
        )  # fmt: skip

    def ready(self, robot: Robot, options: InstrumentOptions) -> FittedImages:
        """Fitted by itself, as it then weighs.  Raises DataError."""
        chosen = {name: getattr(options, name) for name in self.options}
        own = PixelOptions(holdout=0.0, **chosen)
        check_pixel_options(own)
        return FittedImages.from_fit(
            robot, fit_with_camera_mount(robot, self.pixel_data_at_poses, own, silent_progress)
        )

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> Sequence[Array]:
        """Of the fit of the pixels to the arm as drawn."""
        return [self.fit.nominal.effects]

    def split_counted_pixels(self, held: Array) -> tuple[Array, Array]:
        """(N,) True for pixels that judge the fit, (N,) for those that are set aside.  held: (m,).

        Of all images, where `fit` is of those that are not held.
        """
        fit, data = self.fit, self.pixel_data_at_poses
        seen = np.isin(np.arange(len(data.targets)), fit.images.pixels.target)
        known, wrong = (seen | self.has_length)[data.target], np.zeros(data.pixel_count, dtype=bool)
        trained = ~held[data.pose]
        wrong[trained] = ~fit.images.counted_pixel_mask
        later = np.flatnonzero(~trained & known)
        limit = np.linalg.norm(
            fit.problem.errors(fit.state)[:, fit.images.counted_pixel_mask], axis=0
        )
        alike = replace(
            self, pixels=data, weight=np.ones(data.pixel_count), doubt=self.doubt[:0], metre=1.0
        )
        problem = PixelSquares.from_images(self.robot, alike)
        far = MAX_MISS_OF_REACH * self.robot.reach()
        astray = find_misassigned_images(
            problem.images, *problem.flange_and_own_parameters(fit.state), later, far
        )
        wrong[later] = astray | find_outlier_pixels(problem, fit.state, later, limit)
        return known & ~wrong, wrong

    def list_remarks(self, parameters: Sequence[Any], noise: float) -> tuple[str, ...]:
        """Which of its pixels do not count."""
        return tuple(
            list_outlier_pixel_notices(
                self.pixel_data_at_poses, np.flatnonzero(~self.counted_pixel_mask)
            )
        )

    def part_errors(self, arm: FlangePoses, unknowns: Array, holdout_mask: Array) -> Array:
        """At the targets, of all images; wrong pixels are left out."""
        return self.target_errors_by_part(arm, unknowns, self.split_counted_pixels(holdout_mask)[0])

    def fitted_values_to_dict(
        self, arm: FlangePoses, unknowns: Array, nominal_unknowns: Array
    ) -> dict[str, Any]:
        """For JSON: the cameras, the lenses, and the board or the targets."""
        turn, place = self.camera_and_board_frames(unknowns)
        poses = [pose_to_dict(build_transform(*each)) for each in zip(turn, place, strict=True)]
        cameras = {}
        for camera, lens, pose in zip(
            self.pixels.cameras, self.lens_parameters(unknowns), poses, strict=False
        ):
            fx, fy, cx, cy, *distortion = lens
            cameras[camera.name] = {
                "pose": pose,
                "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
                "distortion_coefficients": [
                    *distortion,
                    *camera.intrinsic[len(FITTED_INTRINSICS) :],
                ],
            }
        on, other = (CAMERA_ON_FLANGE, "base") if self.on_flange else ("base", CAMERA_ON_FLANGE)
        noise = self.fit.noise_px
        out = {"cameras_in": on, "targets_in": other, "cameras": cameras, "noise_px": noise}
        if self.has_length:
            return {**out, "board": poses[-1]}
        spots = (1e3 * self.target_positions(unknowns)).tolist()
        scale = "as drawn" if self.fit.by_drawing else "given"
        return {**out, "targets_mm": dict(zip(self.pixels.targets, spots, strict=True)),
                "scale": scale}  # fmt: skip


def fit_with_camera_mount(
    robot: Robot, data: PixelData, options: PixelOptions, progress: Progress
) -> PixelFit:
    """The fit with the cameras on what was given, or on what fits better.  Raises DataError."""
    check_joints_move(data.at)
    places = [options.camera_on] if options.camera_on else [CAMERA_ON_FLANGE, CAMERA_ON_GROUND]
    both = [start_scene(robot, data, place == CAMERA_ON_FLANGE) for place in places]
    both.sort(key=lambda one: one.median_target_error(robot))
    miss = [one.median_target_error(robot) for one in both]
    if miss[0] <= MAX_CALIBRATION_ERROR_OF_REACH * robot.reach():
        check_pixel_slips(robot, data, both[0])
        return fit_pixels(robot, both[0], options, progress)
    for started in both:
        check_pixel_slips(robot, data, started)
    both = [
        one for one, each in zip(both, miss, strict=True) if MIN_CAMERA_MOUNT_GAIN * each <= miss[0]
    ]
    begun = [start_from_far(robot, data, started) for started in both]
    fits = [fit_pixels(robot, started, options, progress) for started in begun]
    return min(fits, key=lambda fit: fit.noise_px)


def find_misassigned_images(
    images: CameraImages, arm: FlangePoses, own: Array, rows: Array, max_distance: float
) -> Array:
    """Which rows (r,) are of images most of which lie farther off than any arm does; none where
    many images do.  max_distance: at the target [m].
    """
    size = np.linalg.norm(images.errors_at_targets(arm, own), axis=0)[rows]
    image = np.unique(images.pixels.image_of_pixels[rows], return_inverse=True)[1].reshape(-1)
    astray = np.bincount(image, size > max_distance) > MIN_WHOLE_IMAGE_FRACTION * np.bincount(image)
    return np.asarray(
        astray[image] & (astray.mean() <= MAX_SET_ASIDE_FRACTION if len(astray) else False)
    )


def find_outlier_pixels(
    problem: PixelSquares, x: ParameterValues, rows: Array, size: Array
) -> Array:
    """Which rows (r,) stand out in their own image, each taken with the camera where it fits best.

    What the arm misses moves an image as a whole: no fit may set aside what judges it.  Where most
    of an image stands out, none of it does.  size: (t,) of the errors that the fit has seen [px].
    """
    pixels, number = problem.images.pixels, np.arange(problem.names.parameter_count)
    count = len(pixels.cameras)
    camera = number - problem.names.geometric_count
    error, slope = problem.rows(x, (camera >= 0) & (camera < 6 * count))
    error, slope = error.reshape(2, -1), slope.reshape(6 * count, 2, -1)
    image, out = pixels.image_of_pixels, np.zeros(pixels.pixel_count, dtype=bool)
    for each in np.unique(image[rows]):
        mine = rows[image[rows] == each]
        first = 6 * int(pixels.camera[mine[0]])
        by = slope[first : first + 6][..., mine].reshape(6, -1).T
        left = error[:, mine]
        for _ in range(MAX_OUTLIER_ROUNDS):
            root = np.tile(np.sqrt(cauchy_weights(left)), 2)
            moved = np.linalg.lstsq(root[:, None] * by, root * error[:, mine].reshape(-1))[0]
            left = error[:, mine] - (by @ moved).reshape(2, -1)
        both = np.concatenate([np.stack([size, np.zeros_like(size)]), left], axis=1)
        weight = np.append(np.ones(len(size)), np.zeros(len(mine)))
        off = inlier_weights(both, weight)[len(size) :] == 0.0
        out[mine] = off & (off.mean() <= MIN_WHOLE_IMAGE_FRACTION)
    return out[rows]


def read_detections(
    detections: Path | str,
    joints: Path | str,
    camera: Mapping[str, Path | str],
    board: Path | str | None = None,
) -> FittedImages:
    """What cameras saw, for `relative`.  Files as `calibrate_pixels` takes them."""
    cameras = [read_camera_file(name, path) for name, path in camera.items()]
    return as_image_instrument(read_pixel_data(detections, joints, cameras, board))


def as_image_instrument(data: PixelData) -> FittedImages:
    """Pixels as one instrument of several."""
    at = replace(data.at, source=data.source, digest=data.digest, notices=data.notices)
    return check_instrument_data(FittedImages(at, data))
