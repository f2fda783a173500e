"""What pixels determine: the fit, how sure it is, and what it leaves at the targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.pixels.drawing import Drawing, Scale, scale_of
from minimax_cal.fitting.pixels.fit import ROUNDS, PixelFit, PixelSquares, fit_pixels, right, softly
from minimax_cal.fitting.pixels.judge import Uncertainty, uncertainty_of
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.plausible import WHOLE_IMAGE, check_start
from minimax_cal.fitting.pixels.start import from_far, start_scene
from minimax_cal.fitting.pixels.worst import WorstPixels, fit_worst
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.instruments.camera import FLANGE, GROUND, INTRINSICS
from minimax_cal.instruments.images import Images
from minimax_cal.instruments.pixels import PixelData
from minimax_cal.measuring.grouping import groups, held_out
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import transform

CLEARLY = 0.2  # of the error: cameras that fit so much better elsewhere are fixed there


@dataclass(frozen=True, eq=False)
class Determined:
    """What pixels determine.  held: (m,) poses left out.  drawing, scale: of the least squares."""

    robot: Robot
    data: PixelData
    held: Array
    fit: PixelFit
    sure: Uncertainty
    drawing: Drawing
    scale: Scale | None
    worst: WorstPixels | None
    notices: tuple[str, ...]

    @property
    def train(self) -> PixelData:
        """The pixels that were fitted."""
        return self.data.some(~self.held[self.data.pose])


def determined(
    robot: Robot, data: PixelData, options: PixelOptions, progress: Progress = silent
) -> Determined:
    """The fit of pixels, and how sure it is."""
    held, said = held_out(data.at, options.holdout, options.seed)
    train = data.some(~held[data.pose])
    progress("start")
    fit = fitted_on(robot, train, options, progress)
    fit, worst, more = fit_worst(fit, options)
    progress("sigmas")
    _, group = np.unique(groups(data.at)[train.pose], return_inverse=True)
    sure = uncertainty_of(robot, fit, group.reshape(-1))
    length = np.arange(5 * robot.joints) < 2 * robot.joints  # known already where by_drawing
    drawing = Drawing.of(robot, fit, sure, ~(length & fit.by_drawing))
    scale = scale_of(robot, fit, sure)
    return Determined(robot, data, held, fit, sure, drawing, scale, worst, (*said, *more))


def fitted_on(robot: Robot, data: PixelData, options: PixelOptions, progress: Progress) -> PixelFit:
    """The fit with the cameras on what was given, or on what fits better.  Raises DataError."""
    places = [options.camera_on] if options.camera_on else [FLANGE, GROUND]
    both = [start_scene(robot, data, place == FLANGE) for place in places]
    both.sort(key=lambda one: one.miss(robot))
    miss = [one.miss(robot) for one in both]
    if miss[0] <= POOR_FIT * robot.reach():
        return fit_pixels(robot, both[0], options, progress)
    for started in both:
        check_start(robot, data, started)
    both = [one for one, each in zip(both, miss, strict=True) if CLEARLY * each <= miss[0]]
    begun = [from_far(robot, data, started) for started in both]
    fits = [fit_pixels(robot, started, options, progress) for started in begun]
    return min(fits, key=lambda fit: fit.noise_px)


def counting(robot: Robot, data: PixelData, held: Array, fit: PixelFit) -> tuple[Array, Array]:
    """(N,) True for pixels that judge a fit, (N,) for those that are set aside.  held: (m,)."""
    known, wrong = fit.known_of(data), np.zeros(data.count, dtype=bool)
    trained = ~held[data.pose]
    wrong[trained] = ~fit.images.counted
    later = np.flatnonzero(~trained & known)
    limit = np.linalg.norm(fit.problem.errors(fit.state)[:, fit.images.counted], axis=0)
    wrong[later] = standing_out(fit.everywhere(robot, data), fit.state, later, limit)
    return known & ~wrong, wrong


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
    image = pixels.pose * count + pixels.camera
    out = np.zeros(pixels.count, dtype=bool)
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


def metre_of(fit: PixelFit) -> float:
    """What a pixel is at a typical target [m]."""
    depth, images = fit.images.depth(*fit.problem.at(fit.nominal)), fit.images
    return float(np.median(depth / images.intrinsic[images.pixels.camera, 0]))


def placed(images: Images, own: Array, fit: PixelFit) -> dict[str, Any]:
    """For JSON: the cameras, the lenses, and the board or the targets."""
    turn, place = images.frames(own)
    poses = [pose_to_dict(transform(*each)) for each in zip(turn, place, strict=True)]
    cameras = {}
    for camera, lens, pose in zip(images.pixels.cameras, images.lens(own), poses, strict=False):
        fx, fy, cx, cy, *distortion = lens
        cameras[camera.name] = {
            "pose": pose,
            "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
            "distortion_coefficients": [*distortion, *camera.intrinsic[len(INTRINSICS) :]],
        }
    on, other = (FLANGE, "base") if images.on_flange else ("base", FLANGE)
    out = {"cameras_in": on, "targets_in": other, "cameras": cameras, "noise_px": fit.noise_px}
    if images.has_length:
        return {**out, "board": poses[-1]}
    spots = (1e3 * images.spots(own)).tolist()
    scale = "as drawn" if fit.by_drawing else "given"
    return {**out, "targets_mm": dict(zip(images.pixels.targets, spots, strict=True)),
            "scale": scale}  # fmt: skip
