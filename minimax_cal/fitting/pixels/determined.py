"""What pixels determine: the fit, how sure it is, and what it leaves at the targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from minimax_cal.fitting.accuracy import HELD
from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.pixels.camera import FLANGE, GROUND, INTRINSICS
from minimax_cal.fitting.pixels.data import PixelData
from minimax_cal.fitting.pixels.drawing import Drawing, Scale, scale_of
from minimax_cal.fitting.pixels.fit import ROUNDS, PixelFit, fit_pixels, right, softly
from minimax_cal.fitting.pixels.judge import Uncertainty, uncertainty_of
from minimax_cal.fitting.pixels.model import PixelModel, Scene
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.plausible import WHOLE_IMAGE, check_start
from minimax_cal.fitting.pixels.start import from_far, start_scene
from minimax_cal.fitting.pixels.worst import WorstPixels, fit_worst
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.measuring.grouping import groups, held_out
from minimax_cal.modelling.cell import pose_to_dict
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
    fit, worst, more = fit_worst(train, fit, options)
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
    both.sort(key=lambda one: one.miss(robot, data))
    miss = [one.miss(robot, data) for one in both]
    if miss[0] <= POOR_FIT * robot.reach():
        return fit_pixels(robot, data, both[0], options, progress)
    for started in both:
        check_start(robot, data, started)
    both = [one for one, each in zip(both, miss, strict=True) if CLEARLY * each <= miss[0]]
    begun = [from_far(robot, data, started) for started in both]
    fits = [fit_pixels(robot, data, started, options, progress) for started in begun]
    return min(fits, key=lambda fit: fit.noise)


@dataclass(frozen=True, eq=False)
class JudgedPixels:
    """Errors at the targets, of all pixels.

    errors: (parts, m, 3) by key, NaN where not measured or
    set aside [m].  pixels: RMS and largest by key [px].  aside: (a,) rows set aside.  whole: of the
    held-out poses, with them.
    """

    errors: dict[str, Array]
    pixels: dict[str, tuple[float, float]]
    aside: Array
    whole: Array


def judged_pixels(robot: Robot, data: PixelData, held: Array, fit: PixelFit) -> JudgedPixels:
    """Errors of the drawn and the calibrated arm.  held: (m,)."""
    model = PixelModel.of(robot, data, fit.model.on_flange)
    known = np.ones(len(data.targets), dtype=bool)
    if not len(data.board):
        known = np.isin(np.arange(len(data.targets)), fit.model.target)
    counts = known[data.target]
    wrong = np.zeros(data.count, dtype=bool)
    trained = ~held[data.pose]
    wrong[trained] = fit.model.weight == 0.0
    later = np.flatnonzero(~trained & counts)
    limit = np.linalg.norm(fit.model.errors(fit.scene)[:, fit.model.weight > 0.0], axis=0)
    wrong[later] = standing_out(model, fit.scene, later, limit)
    tables = {
        name: table_of(model, data, scene, counts) for name, scene in
        (("drawn", fit.nominal), ("calibrated", fit.scene))
    }  # fmt: skip
    errors, pixels, whole = {}, {}, np.zeros(0)
    rows = data.part
    for key, is_held in HELD.items():
        metres, image = tables["drawn" if key.startswith("nominal") else "calibrated"]
        part = metres[:, held == is_held]
        if key == "holdout":
            whole = part.copy()
        metres = metres.copy()
        metres[rows[wrong], data.pose[wrong]] = np.nan
        errors[key] = metres[:, held == is_held]
        size = np.linalg.norm(image, axis=0)[counts & ~wrong & (held[data.pose] == is_held)]
        pixels[key] = (
            (float(np.sqrt((size**2).mean())), float(size.max())) if size.size else (np.nan,) * 2
        )
    return JudgedPixels(errors, pixels, np.flatnonzero(wrong), whole)


def standing_out(model: PixelModel, x: Scene, rows: Array, size: Array) -> Array:
    """Which rows (r,) stand out in their own image, each taken with the camera where it fits best.

    What the arm misses moves an image as a whole: no fit may set aside what judges it.  Where most
    of an image stands out, none of it does.  size: (t,) of the errors that the fit has seen [px].
    """
    camera = np.arange(model.names.count) - model.names.geometric
    error, slope = model.rows(x, (camera >= 0) & (camera < 6 * len(model.intrinsic)))
    image = model.pose * len(model.intrinsic) + model.camera
    out = np.zeros(model.pose.shape, dtype=bool)
    for each in np.unique(image[rows]):
        mine = rows[image[rows] == each]
        first = 6 * int(model.camera[mine[0]])
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


def table_of(model: PixelModel, data: PixelData, x: Scene, counts: Array) -> tuple[Array, Array]:
    """Errors at the targets (parts, m, 3) [m], NaN where not measured, and in the image (2, N)."""
    error, depth = model.errors(x), model.seen(x).point[2]
    focal = x.lens[0][data.camera, :2].T
    out = np.full((len(data.parts), data.at.poses, 3), np.nan)
    rows = data.part
    at = np.flatnonzero(counts)
    flat = (error * np.abs(depth) / focal)[:, at].T
    out[rows[at], data.pose[at]] = np.concatenate([flat, np.zeros((len(at), 1))], axis=1)
    return out, error


def metre_of(fit: PixelFit) -> float:
    """What a pixel is at a typical target [m]."""
    depth = fit.model.seen(fit.nominal).point[2]
    return float(np.median(depth / fit.model.intrinsic[fit.model.camera, 0]))


def placed(data: PixelData, fit: PixelFit, scale: Scale | None) -> dict[str, Any]:
    """For JSON: the cameras, the lenses, and the board or the targets."""
    x = fit.scene
    cameras = {}
    for i, camera in enumerate(data.cameras):
        fx, fy, cx, cy, *distortion = x.lens[0, i]
        cameras[camera.name] = {
            "pose": pose_to_dict(transform(x.turn[0, i], x.place[0, i])),
            "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
            "distortion_coefficients": [*distortion, *camera.intrinsic[len(INTRINSICS) :]],
        }
    on, other = (FLANGE, "base") if fit.model.on_flange else ("base", FLANGE)
    out: dict[str, Any] = {"cameras_in": on, "targets_in": other, "cameras": cameras}
    out["noise_px"] = fit.noise
    if len(data.board):
        out["board"] = pose_to_dict(transform(x.board_turn[0], x.board_place[0]))
    else:
        out["targets_mm"] = dict(zip(data.targets, (1e3 * x.points[0]).tolist(), strict=True))
        out["scale"] = "as drawn" if fit.by_drawing else "given"
    if scale is not None:
        out["lengths_over_drawn"] = {"share": scale.share, "sigma": scale.sigma}
    return out
