"""From files of detections to a calibrated robot, and whether to use it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.accuracy import HELD, accuracy
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.options import listed, qp_name
from minimax_cal.fitting.pixels.determined import Determined, counting, determined, metre_of, placed
from minimax_cal.fitting.pixels.drawing import Scale
from minimax_cal.fitting.pixels.fit import PixelFit, PixelSquares
from minimax_cal.fitting.pixels.judge import (
    Claim,
    Uncertainty,
    arms_apart,
    drawn_sigma,
    position_sigma,
)
from minimax_cal.fitting.pixels.options import PixelOptions, check_options
from minimax_cal.fitting.pixels.plausible import contradiction, file_notices, outlier_notices
from minimax_cal.fitting.several.fit import parameters_of
from minimax_cal.fitting.several.identify import Alone
from minimax_cal.fitting.several.kinds import by_key
from minimax_cal.fitting.several.pixel_result import PIXELS, PixelCalibration
from minimax_cal.fitting.several.result import InstrumentResult, Measured
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.options import takes
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.ground.threads import one_thread
from minimax_cal.instruments.camera import FLANGE, read_camera
from minimax_cal.instruments.pixels import PixelData, read_pixels
from minimax_cal.measuring.checks import arm_notices, check_joints
from minimax_cal.measuring.measurements import TOOL, SetAside
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers.status import Status


@takes(options=PixelOptions, read={"fix": listed, "free": listed})
def calibrate_pixels(
    robot: Robot | str | Path,
    pixels: Path | str,
    joints: Path | str,
    camera: Mapping[str, Path | str],
    board: Path | str | None = None,
    progress: Progress = silent,
    *,
    options: PixelOptions,
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
    options
        See `PixelOptions`.
    progress
        Called with a word on each stage.

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
    check_options(options)
    robot = load_robot(robot)
    cameras = [read_camera(name, path) for name, path in camera.items()]
    data = read_pixels(pixels, joints, cameras, board)
    data = replace(data, at=check_joints(robot, data.at))
    return fitted(robot, data, options, progress, began)


@one_thread()
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


def concluded(one: Determined, options: PixelOptions, began: float) -> PixelCalibration:
    """The result: whether to use the arm, and how good it is.  began: by `time.perf_counter`."""
    robot, data, train, held = one.robot, one.data, one.train, one.held
    fit, sure, scale = one.fit, one.sure, one.scale
    if options.drawn_prior:
        fit, sure = one.drawing.beside(fit, sure)
    counts, wrong = counting(robot, data, held, fit)
    errors, pixels, whole = left_by(fit, fit.everywhere(robot, data), held, counts, wrong)
    arm = robot.with_mdh(fit.state.mdh)
    claim = claimed(robot, arm, sure, one.drawing.share)
    reason, status = contradiction(robot, train, fit, scale, options), fit.found.status[0]
    told = () if reason else file_notices(train, fit, scale)
    if reason:
        status = Status.FAILED
    elif (
        fit.problem.active[: 5 * robot.joints].any()
        and not claim.is_better
        and status is not Status.FAILED
    ):
        status, reason = Status.NO_BETTER, kept_because(claim)
    numbers = {key: 2 * sum(accuracy(error).counts) for key, error in errors.items()}
    measured = Measured(
        kind=PIXELS, parts=data.parts, errors=errors, numbers=numbers, turns={},
        instrument=placed(fit.images, fit.state.effects, fit) | of_scale(scale),
    )  # fmt: skip
    at = replace(data.at, source=data.source, digest=data.digest)
    noise, aside = metre_of(fit) * fit.noise_px, np.flatnonzero(wrong)
    return PixelCalibration(
        **vars(measured),
        robot=robot if status is Status.NO_BETTER else arm,
        nominal=robot,
        status=status,
        iterations=int(fit.found.iterations[0]),
        seconds=time.perf_counter() - began,
        parameters=parameters_of(robot, replace(fit, covariance=sure.covariance)),
        instruments=(InstrumentResult.of(PIXELS, measured, at, held, noise, Alone(0, ())),),
        identification=fit.identification,
        position_sigma=claim.sigma,
        beyond=(),
        notices=(
            *data.notices, *arm_notices(robot, data.at), *one.notices, *notices_of(fit, held),
            *told, *outlier_notices(data, aside),
        ),
        provenance=Provenance.of(robot, at, options.settings()),
        calibrated=arm,
        pixels=pixels,
        claim=claim,
        set_aside=set_aside(data, aside),
        with_them=accuracy(whole) if len(aside) else None,
        reason=reason,
        objective=options.objective,
        qp=qp_name(options.qp) if one.worst else "",
        worst=one.worst,
    )  # fmt: skip


def left_by(
    fit: PixelFit, every: PixelSquares, held: Array, counts: Array, wrong: Array
) -> tuple[dict[str, Array], dict[str, tuple[float, float]], Array]:
    """Errors (parts, m, 3) by key [m], RMS and largest pixel by key [px], held out with all pixels.

    every: pixels of all poses.  counts, wrong: (N,) as `counting` has them.  held: (m,).
    """
    images, later = every.images, held[every.images.pixels.pose]
    arms = every.at(fit.nominal), every.at(fit.state)
    before, after = (images.table(*arm, counts) for arm in arms)
    drawn, found = (np.linalg.norm(images.off(*arm), axis=0) for arm in arms)
    pixels = {}
    for key, is_held in HELD.items():
        size = (drawn if key.startswith("nominal") else found)[counts & (later == is_held)]
        pixels[key] = (rms(size), float(size.max())) if size.size else (np.nan, np.nan)
    whole = images.table(*arms[1], counts | wrong)[:, held]
    return by_key(before, after, held), pixels, whole


def of_scale(scale: Scale | None) -> dict[str, Any]:
    """For JSON."""
    return {"lengths_over_drawn": {"share": scale.share, "sigma": scale.sigma}} if scale else {}


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


def notices_of(fit: PixelFit, held: Array) -> list[str]:
    """What the reader should know: the scale, the lenses, nothing held out."""
    out = []
    on = FLANGE if fit.images.on_flange else "ground"
    out.append(f"the cameras are taken as fixed to the {on}")
    if fit.by_drawing:
        out.append(
            "pixels alone have no length standard: the scale is that of the drawing's lengths, as "
            "well as drawn_within says; a board of known size gives it"
        )
    if fit.held:
        known = "their doubt counts in every sigma" if fit.lens_sigma.any() else "as known"
        out.append(f"the lenses are held as their files say, {known}")
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
