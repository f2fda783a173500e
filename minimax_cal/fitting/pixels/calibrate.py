"""From files of detections to a calibrated robot, and whether to use it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.fit import Parameter, Provenance, link_by_link
from minimax_cal.fitting.identify import RESOLUTION
from minimax_cal.fitting.instruments.options import Progress, silent
from minimax_cal.fitting.options import QpSolver, listed, qp_name
from minimax_cal.fitting.pixels.camera import FLANGE, GROUND, INTRINSICS, read_camera
from minimax_cal.fitting.pixels.data import PixelData, read_pixels
from minimax_cal.fitting.pixels.drawing import Drawing, Scale, scale_of
from minimax_cal.fitting.pixels.fit import (
    PixelFit,
    fit_pixels,
    right,
)
from minimax_cal.fitting.pixels.judge import Claim, arms_apart, drawn_sigma, position_sigma
from minimax_cal.fitting.pixels.model import PixelModel, Scene, units_of
from minimax_cal.fitting.pixels.options import SUM, PixelOptions, check_options
from minimax_cal.fitting.pixels.plausible import (
    check_start,
    contradiction,
    file_notices,
    outlier_notices,
)
from minimax_cal.fitting.pixels.result import PIXELS, PixelCalibration
from minimax_cal.fitting.pixels.start import from_far, start_scene
from minimax_cal.fitting.pixels.uncertainty import Uncertainty, uncertainty_of
from minimax_cal.fitting.pixels.worst import WorstPixels, fit_worst
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.measuring.aside import TOOL, SetAside
from minimax_cal.measuring.checks import check_joints, limit_notices
from minimax_cal.measuring.grouping import groups, held_out
from minimax_cal.modelling.cell import pose_to_dict
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.transforms import transform
from minimax_cal.solvers.status import Status

CLEARLY = 0.2  # of the error: cameras that fit so much better elsewhere are fixed there
HELD = {"nominal": True, "holdout": True, "train": False, "nominal_train": False}


def calibrate_pixels(
    robot: Robot | str | Path,
    pixels: Path | str,
    joints: Path | str,
    camera: Mapping[str, Path | str],
    board: Path | str | None = None,
    progress: Progress = silent,
    *,
    objective: str = SUM,
    qp: QpSolver = PixelOptions.qp,
    camera_on: str = "",
    fix_camera: bool = False,
    camera_prior: str = "",
    drawn_prior: bool = False,
    holdout: float = 0.2,
    seed: int = 0,
    fix: str | Sequence[str] = (),
    free: str | Sequence[str] = (),
    resolution: float = RESOLUTION,
    allow_large_changes: bool = False,
) -> PixelCalibration:
    """Calibrate a robot from what cameras saw.

    Parameters
    ----------
    robot
        Loaded, or a name or path.
    pixels
        detections.csv (pose, camera, target, u_px, v_px).
    joints
        Joint values by pose.
    camera
        Files of K and D by the cameras' names (OpenCV or ROS, YAML).
    board
        Places of the targets (target, x_mm, y_mm, z_mm); without it they are fitted, and
        the drawing alone tells the scale.
    progress
        Called with a word on each stage.
    objective
        sum, minimax (the worst target) or camera (the worst camera).
    qp
        Backend of the minimax QPs.
    camera_on
        flange or ground; what fits better unless given.
    fix_camera
        Hold the lenses as their files say.
    camera_prior
        How well these know them, as ``f 0.1%, c 2px``.
    drawn_prior
        Take the drawing as a prior, as well as the robot's `drawn_within` says or better.
    holdout
        Share of the poses kept out of the fit.
    seed
        Of that choice.
    fix, free
        Names or patterns as ``beta*``.
    resolution
        Relative singular value that counts as not measured.
    allow_large_changes
        Accept an arm that is another than the one drawn.

    Returns
    -------
    PixelCalibration
        The calibration; its `status` is no_better where the drawing is known better than
        these pixels tell the arm.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> fit = mc.calibrate_pixels("ur5", "detections.csv", "joints.csv", {"cam": "camera.yaml"})
    """
    began = time.perf_counter()
    options = PixelOptions(
        objective=objective,
        qp=qp,
        camera_on=camera_on,
        fix_camera=fix_camera,
        camera_prior=camera_prior,
        drawn_prior=drawn_prior,
        holdout=holdout,
        seed=seed,
        fix=listed(fix),
        free=listed(free),
        resolution=resolution,
        allow_large_changes=allow_large_changes,
    )
    check_options(options)
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    cameras = [read_camera(name, path) for name, path in camera.items()]
    data = read_pixels(pixels, joints, cameras, board)
    data = replace(data, at=check_joints(robot, data.at))
    return fitted(robot, data, options, progress, began)


def fitted(
    robot: Robot,
    data: PixelData,
    options: PixelOptions,
    progress: Progress = silent,
    began: float | None = None,
) -> PixelCalibration:
    """As `calibrate_pixels`, of measurements that are read."""
    began = time.perf_counter() if began is None else began
    return concluded(determined(robot, data, options, progress), options, began)


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


def concluded(one: Determined, options: PixelOptions, began: float) -> PixelCalibration:
    """The result: whether to use the arm, and how good it is.  began: by `time.perf_counter`."""
    robot, data, train, held = one.robot, one.data, one.train, one.held
    fit, sure, scale = one.fit, one.sure, one.scale
    if options.drawn_prior:
        fit, sure = one.drawing.beside(fit, sure)
    seen = judged_pixels(robot, data, held, fit)
    arm = robot.with_mdh(fit.scene.mdh[0])
    claim = claimed(robot, arm, sure, one.drawing.share)
    reason, status = contradiction(robot, train, fit, scale, options), fit.found.status[0]
    told = () if reason else file_notices(train, fit, scale)
    if reason:
        status = Status.FAILED
    elif not claim.is_better and status is not Status.FAILED:
        status, reason = Status.NO_BETTER, kept_because(claim)
    return PixelCalibration(
        kind=PIXELS,
        robot=robot if status is Status.NO_BETTER else arm,
        nominal=robot,
        parts=data.parts,
        status=status,
        iterations=int(fit.found.iterations[0]),
        seconds=time.perf_counter() - began,
        parameters=parameters_of(robot, fit, sure.covariance),
        errors=seen.errors,
        numbers={key: 2 * sum(accuracy(error).counts) for key, error in seen.errors.items()},
        turns={},
        instrument=placed(data, fit, scale),
        identification=fit.identification,
        position_sigma=claim.sigma,
        beyond=(),
        notices=(
            *data.notices, *limit_notices(robot, data.at), *one.notices, *notices_of(fit, held),
            *told, *outlier_notices(data, seen.aside),
        ),
        provenance=Provenance.of(
            robot, replace(data.at, source=data.source, digest=data.digest), options.settings()
        ),
        calibrated=arm,
        pixels=seen.pixels,
        claim=claim,
        set_aside=set_aside(data, seen.aside),
        with_them=accuracy(seen.whole) if len(seen.aside) else None,
        reason=reason,
        objective=options.objective,
        qp=qp_name(options.qp) if one.worst else "",
        worst=one.worst,
    )  # fmt: skip


def claimed(robot: Robot, arm: Robot, sure: Uncertainty, share: float) -> Claim:
    """What is known of the drawn and the calibrated arm.  share: as in `Drawing`."""
    shown = drawn_sigma(robot, sure.lack, share) if share else 0.0
    drawn = drawn_sigma(robot, sure.lack)
    return Claim(position_sigma(arm, sure), drawn, arms_apart(robot, arm), shown)


def kept_because(claim: Claim) -> str:
    """Why the drawn arm is kept."""
    mm = claim.texts()
    why = (
        f"the calibrated arm, known to {mm['sigma']}, differs from the drawn one by "
        f"{mm['change']}, which shows the drawing to be off by {mm['shown']}: too little to be sure"
    )
    if claim.sigma >= claim.drawn:
        why = (
            f"the drawing is known better ({mm['drawn']}) than these pixels tell the arm "
            f"({mm['sigma']})"
        )
    return (
        f"{why}: the drawn arm is kept; take more images, nearer and more tilted, or say how well "
        "the drawing is known (drawn_within)"
    )


def fitted_on(robot: Robot, data: PixelData, options: PixelOptions, progress: Progress) -> PixelFit:
    """The fit with the cameras on what was given, or on what fits better.  Raises DataError."""
    places = [options.camera_on] if options.camera_on else [FLANGE, GROUND]
    both = [start_scene(robot, data, place == FLANGE) for place in places]
    both.sort(key=lambda one: one.miss(robot, data))
    miss = [one.miss(robot, data) for one in both]
    if miss[0] <= POOR_FIT * robot.reach():
        return fit_pixels(robot, data, both[0], options, progress)
    both = [one for one, each in zip(both, miss, strict=True) if CLEARLY * each <= miss[0]]
    for started in both:
        check_start(robot, data, started)
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
    error = model.errors(fit.scene)
    trained = ~held[data.pose]
    wrong[trained] = fit.model.weight == 0.0
    later = ~trained & counts
    limit = np.linalg.norm(fit.model.errors(fit.scene)[:, fit.model.weight > 0.0], axis=0)
    wrong[later] = right_beside(error[:, later], limit) == 0.0
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


def right_beside(error: Array, size: Array) -> Array:
    """(N,) 0 where errors (2, N) stand out from those of sizes (t,) that the fit has seen [px]."""
    seen = np.stack([size, np.zeros_like(size)])
    both = np.concatenate([seen, error], axis=1)
    weight = np.concatenate([np.ones(len(size)), np.zeros(error.shape[1])])
    return right(both, weight)[len(size) :]


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


def parameters_of(robot: Robot, fit: PixelFit, covariance: Array) -> tuple[Parameter, ...]:
    """Every parameter, link by link; then cameras, targets and lenses."""
    names, base = fit.model.names, np.zeros(6)

    def told(x: Scene) -> Array:
        mdh = robot.notation.told(x.mdh[0], robot.prismatic)
        return np.concatenate([mdh.T.reshape(-1), base, x.values()])

    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    every = link_by_link(
        names, units_of(names), told(fit.nominal), told(fit.scene), sigma, fit.identification
    )
    return tuple(p for p in every if not p.name.startswith("base_"))


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


def notices_of(fit: PixelFit, held: Array) -> list[str]:
    """What the reader should know: the scale, the lenses, nothing held out."""
    out = []
    on = FLANGE if fit.model.on_flange else "ground"
    out.append(f"the cameras are taken as fixed to the {on}")
    if fit.by_drawing:
        out.append(
            "pixels alone have no length standard: the scale is that of the drawing's lengths, as "
            "well as drawn_within says; a board of known size gives it"
        )
    if fit.held:
        out.append("the lenses are held as their files say; their doubt counts in every sigma")
    if not held.any():
        out.append("no pose is held out: nothing here says how the fit does on new poses")
    return out


def set_aside(data: PixelData, rows: Array) -> tuple[SetAside, ...]:
    """The pixels that took no part."""
    return tuple(
        SetAside(
            row=int(data.line[row]),
            pose=int(data.pose[row]) + 1,
            target=data.targets[data.target[row]],
            why="the pixel is an outlier",
            by=TOOL,
        )
        for row in rows
    )
