"""Pixels as one instrument of a fit: what they are to it, a fit of their own says first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.outcome import MAX_MISS_OF_REACH
from minimax_cal.fitting.pixels.fit import ROUNDS, PixelFit, PixelSquares, fit_pixels, right, softly
from minimax_cal.fitting.pixels.options import PixelOptions, check_options
from minimax_cal.fitting.pixels.plausible import (
    MOST_ASIDE,
    WHOLE_IMAGE,
    check_start,
    outlier_notices,
)
from minimax_cal.fitting.pixels.start import from_far, start_scene
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.instruments.camera import FLANGE, GROUND, INTRINSICS, read_camera
from minimax_cal.instruments.images import Images
from minimax_cal.instruments.instrument import UNREADY, checked
from minimax_cal.instruments.options import InstrumentOptions
from minimax_cal.instruments.pixels import PixelData, read_pixels
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.measuring.checks import check_span
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import transform

CLEARLY = 0.2  # of the error: cameras that fit so much better elsewhere are fixed there


@dataclass(frozen=True, eq=False)
class FittedImages(Images):
    """robot: as drawn.  fit: of training images, by themselves."""

    robot: Robot = UNREADY
    fit: PixelFit = UNREADY

    chosen = (*Images.chosen, "robot", "fit")

    @staticmethod
    def of(robot: Robot, fit: PixelFit) -> FittedImages:
        """What a fit of the images alone says of them; a pixel counts as at a typical target."""
        images = fit.images
        depth = images.depth(*fit.problem.at(fit.nominal))
        metre = float(np.median(depth / images.intrinsic[images.pixels.camera, 0]))
        return replace(
            FittedImages(**vars(images)), robot=robot, fit=fit, metre=metre,
            doubt=fit.lens_sigma, noise=fit.noise_px, lens_held=fit.held,
        )  # fmt: skip

    def ready(self, robot: Robot, options: InstrumentOptions) -> FittedImages:
        """Fitted by itself, as it then weighs.  Raises DataError."""
        chosen = {name: getattr(options, name) for name in self.options}
        own = PixelOptions(holdout=0.0, **chosen)
        check_options(own)
        return FittedImages.of(robot, fitted_on(robot, self.images, own, silent))

    def starts(self, arm: FlangePoses, free: Array) -> Sequence[Array]:
        """Of the fit of the pixels to the arm as drawn."""
        return [self.fit.nominal.effects]

    def counting(self, held: Array) -> tuple[Array, Array]:
        """(N,) True for pixels that judge the fit, (N,) for those that are set aside.  held: (m,).

        Of all images, where `fit` is of those that are not held.
        """
        fit, data = self.fit, self.images
        seen = np.isin(np.arange(len(data.targets)), fit.images.pixels.target)
        known, wrong = (seen | self.has_length)[data.target], np.zeros(data.count, dtype=bool)
        trained = ~held[data.pose]
        wrong[trained] = ~fit.images.counted
        later = np.flatnonzero(~trained & known)
        limit = np.linalg.norm(fit.problem.errors(fit.state)[:, fit.images.counted], axis=0)
        alike = replace(
            self, pixels=data, weight=np.ones(data.count), doubt=self.doubt[:0], metre=1.0
        )
        problem = PixelSquares.of(self.robot, alike)
        far = MAX_MISS_OF_REACH * self.robot.reach()
        astray = of_other_poses(problem.images, *problem.at(fit.state), later, far)
        wrong[later] = astray | standing_out(problem, fit.state, later, limit)
        return known & ~wrong, wrong

    def remarks(self, parameters: Sequence[Any], noise: float) -> tuple[str, ...]:
        """Which of its pixels do not count."""
        return tuple(outlier_notices(self.images, np.flatnonzero(~self.counted)))

    def errors(self, arm: FlangePoses, own: Array, held: Array) -> Array:
        """At the targets, of all images; wrong pixels are left out."""
        return self.table(arm, own, self.counting(held)[0])

    def placed(self, arm: FlangePoses, own: Array, drawn: Array) -> dict[str, Any]:
        """For JSON: the cameras, the lenses, and the board or the targets."""
        turn, place = self.frames(own)
        poses = [pose_to_dict(transform(*each)) for each in zip(turn, place, strict=True)]
        cameras = {}
        for camera, lens, pose in zip(self.pixels.cameras, self.lens(own), poses, strict=False):
            fx, fy, cx, cy, *distortion = lens
            cameras[camera.name] = {
                "pose": pose,
                "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
                "distortion_coefficients": [*distortion, *camera.intrinsic[len(INTRINSICS) :]],
            }
        on, other = (FLANGE, "base") if self.on_flange else ("base", FLANGE)
        noise = self.fit.noise_px
        out = {"cameras_in": on, "targets_in": other, "cameras": cameras, "noise_px": noise}
        if self.has_length:
            return {**out, "board": poses[-1]}
        spots = (1e3 * self.spots(own)).tolist()
        scale = "as drawn" if self.fit.by_drawing else "given"
        return {**out, "targets_mm": dict(zip(self.pixels.targets, spots, strict=True)),
                "scale": scale}  # fmt: skip


def fitted_on(robot: Robot, data: PixelData, options: PixelOptions, progress: Progress) -> PixelFit:
    """The fit with the cameras on what was given, or on what fits better.  Raises DataError."""
    check_span(data.at)
    places = [options.camera_on] if options.camera_on else [FLANGE, GROUND]
    both = [start_scene(robot, data, place == FLANGE) for place in places]
    both.sort(key=lambda one: one.miss(robot))
    miss = [one.miss(robot) for one in both]
    if miss[0] <= POOR_FIT * robot.reach():
        check_start(robot, data, both[0])
        return fit_pixels(robot, both[0], options, progress)
    for started in both:
        check_start(robot, data, started)
    both = [one for one, each in zip(both, miss, strict=True) if CLEARLY * each <= miss[0]]
    begun = [from_far(robot, data, started) for started in both]
    fits = [fit_pixels(robot, started, options, progress) for started in begun]
    return min(fits, key=lambda fit: fit.noise_px)


def of_other_poses(images: Images, arm: FlangePoses, own: Array, rows: Array, far: float) -> Array:
    """Which rows (r,) are of images most of which lie farther off than any arm does; none where
    many images do.  far: at the target [m].
    """
    size = np.linalg.norm(images.at_targets(arm, own), axis=0)[rows]
    image = np.unique(images.pixels.image[rows], return_inverse=True)[1].reshape(-1)
    astray = np.bincount(image, size > far) > WHOLE_IMAGE * np.bincount(image)
    return np.asarray(astray[image] & (astray.mean() <= MOST_ASIDE if len(astray) else False))


def standing_out(problem: PixelSquares, x: State, rows: Array, size: Array) -> Array:
    """Which rows (r,) stand out in their own image, each taken with the camera where it fits best.

    What the arm misses moves an image as a whole: no fit may set aside what judges it.  Where most
    of an image stands out, none of it does.  size: (t,) of the errors that the fit has seen [px].
    """
    pixels, number = problem.images.pixels, np.arange(problem.names.count)
    count = len(pixels.cameras)
    camera = number - problem.names.geometric
    error, slope = problem.rows(x, (camera >= 0) & (camera < 6 * count))
    error, slope = error.reshape(2, -1), slope.reshape(6 * count, 2, -1)
    image, out = pixels.image, np.zeros(pixels.count, dtype=bool)
    for each in np.unique(image[rows]):
        mine = rows[image[rows] == each]
        first = 6 * int(pixels.camera[mine[0]])
        by = slope[first : first + 6][..., mine].reshape(6, -1).T
        left = error[:, mine]
        for _ in range(ROUNDS):
            root = np.tile(np.sqrt(softly(left)), 2)
            moved = np.linalg.lstsq(root[:, None] * by, root * error[:, mine].reshape(-1))[0]
            left = error[:, mine] - (by @ moved).reshape(2, -1)
        both = np.concatenate([np.stack([size, np.zeros_like(size)]), left], axis=1)
        weight = np.append(np.ones(len(size)), np.zeros(len(mine)))
        off = right(both, weight)[len(size) :] == 0.0
        out[mine] = off & (off.mean() <= WHOLE_IMAGE)
    return out[rows]


def detected(
    detections: Path | str,
    joints: Path | str,
    camera: Mapping[str, Path | str],
    board: Path | str | None = None,
) -> FittedImages:
    """What cameras saw, for `relative`.  Files as `calibrate_pixels` takes them."""
    cameras = [read_camera(name, path) for name, path in camera.items()]
    return as_instrument(read_pixels(detections, joints, cameras, board))


def as_instrument(data: PixelData) -> FittedImages:
    """Pixels as one instrument of several."""
    at = replace(data.at, source=data.source, digest=data.digest, notices=data.notices)
    return checked(FittedImages(at, data))
