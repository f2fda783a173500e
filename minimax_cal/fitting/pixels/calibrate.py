"""From files of detections to a calibrated robot, and whether to use it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from minimax_cal.fitting.accuracy import accuracy, by_key
from minimax_cal.fitting.claims import drawn_sigmas
from minimax_cal.fitting.outcome import FitEvidence, judge
from minimax_cal.fitting.pixels.beside import FittedImages, as_instrument, fitted_on
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.judge import (
    Drawing,
    Uncertainty,
    arms_apart,
    drawn_sigma,
    position_sigma,
    scale_of,
    uncertainty_of,
)
from minimax_cal.fitting.pixels.options import FIELDS, WORST_CAMERA, PixelOptions, check_options
from minimax_cal.fitting.pixels.plausible import file_notices, objection, outlier_notices
from minimax_cal.fitting.several.fit import at_worst
from minimax_cal.fitting.several.kinds import Asked, assembled, extremes, measured_by
from minimax_cal.fitting.several.options import READ, SUM
from minimax_cal.fitting.several.result import Claim, PixelCalibration
from minimax_cal.fitting.several.stack import Block, Stack
from minimax_cal.fitting.several.worst import WorstPixels
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.options import takes
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.ground.threads import one_thread
from minimax_cal.instruments.camera import FLANGE, read_camera
from minimax_cal.instruments.pixels import PixelData, read_pixels
from minimax_cal.measuring.checks import arm_notices, check_joints
from minimax_cal.measuring.grouping import groups, held_out
from minimax_cal.measuring.measurements import TOOL, SetAside
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers.status import Status

MAX_ROUNDING = 1e-6  # an error below is rounding: pixels that were computed, not seen [px]


@takes(options=(PixelOptions, FIELDS), read=READ)
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


@dataclass(frozen=True, eq=False)
class Determined:
    """What pixels determine.  held: (m,) poses left out."""

    robot: Robot
    data: PixelData
    held: Array
    fit: PixelFit
    sure: Uncertainty
    notices: tuple[str, ...]


def determined(
    robot: Robot, data: PixelData, options: PixelOptions, progress: Progress = silent
) -> Determined:
    """The fit of pixels, and how sure it is."""
    held, said = held_out(data.at, options.holdout, options.seed)
    train = data.some(~held[data.pose])
    progress("start")
    fit = of_worst(fitted_on(robot, train, options, progress), options)
    progress("sigmas")
    _, group = np.unique(groups(data.at)[train.pose], return_inverse=True)
    return Determined(robot, data, held, fit, uncertainty_of(robot, fit, group.reshape(-1)), said)


def of_worst(fit: PixelFit, options: PixelOptions) -> PixelFit:
    """The minimax from a fit of the sum, where the objective asks for one.

    f_i is the mean square of the pixels of one target in one camera, or of one camera.
    """
    if options.objective == SUM or fit.found.status[0] is Status.FAILED:
        return fit
    data = fit.images.pixels
    of, names = data.part, data.parts
    if options.objective == WORST_CAMERA:
        of, names = data.camera, tuple(camera.name for camera in data.cameras)
    of = np.where(fit.images.counted, of, -1)
    rows = np.concatenate([of, of, np.full(fit.images.lens_rows, -2)])
    fit, share = at_worst(fit, rows, names, 2, options.qp, MAX_ROUNDING, WorstPixels)
    return replace(fit, share=share[: data.count])


def concluded(one: Determined, options: PixelOptions, began: float) -> PixelCalibration:
    """The result: whether to use the arm, and how good it is.  began: by `time.perf_counter`."""
    robot, data, held, fit, sure = one.robot, one.data, one.held, one.fit, one.sure
    among = np.arange(5 * robot.joints) >= 2 * robot.joints * fit.by_drawing  # lengths are in it
    scale, drawing = scale_of(robot, fit, sure), Drawing.of(robot, fit, sure, among)
    if options.drawn_prior:
        fit, sure = drawing.beside(fit, sure)
    images = FittedImages.of(robot, fit)
    stack = Stack.of(robot, [images], [images.kind])
    found = replace(fit, problem=replace(fit.problem, stack=stack), covariance=sure.covariance,
                    noise=images.metre * fit.noise)  # fmt: skip
    plain = as_instrument(data)
    asked, every = Asked(robot, [plain], options, [(held, one.notices)]), images.at_rows_of(plain)
    counts, wrong = every.counting(held)
    arms = [Block.of(robot, every).at(x) for x in (fit.nominal, fit.state)]
    before, after = (np.linalg.norm(every.off(*arm), axis=0)[counts] for arm in arms)
    measured = measured_by(robot, found, 0, plain, held)
    scaled = {"lengths_over_drawn": {"share": scale.share, "sigma": scale.sigma}} if scale else {}
    measured = replace(
        measured,
        numbers={key: 2 * sum(each.counts) for key, each in measured.accuracy.items()},
        instrument={**measured.instrument, **scaled},
    )
    arm = robot.with_mdh(fit.state.mdh)
    claim = claimed(robot, arm, sure, drawing.share)
    links = slice(5 * robot.joints)
    fits_links = fit.problem.active[links].any()
    evidence = FitEvidence(
        robot,
        fit.state.mdh,
        fit.problem.active[links],
        (),
        sigma=np.sqrt(np.maximum(np.diag(sure.covariance)[links], 0.0)),
        drawn=drawn_sigmas(robot),
        position_sigma=claim.sigma,
        drawn_sigma=claim.drawn,
        allow_large_changes=options.allow_large_changes,
        objection=objection(robot, fit, scale),
        worse=claim.why_kept() if fits_links and not claim.is_better else "",
    )
    ended = judge(evidence, fit.found.status[0])
    told = () if ended.status is Status.FAILED else file_notices(fit, scale)
    aside = np.flatnonzero(wrong)
    return assembled(
        asked, found, [measured], began, PixelCalibration,
        robot=robot if ended.status.keeps_drawn else arm,
        status=ended.status,
        position_sigma=claim.sigma,
        notices=(
            *data.notices, *arm_notices(robot, data.at), *one.notices, *fit.notices,
            *notices_of(fit, held), *told, *outlier_notices(data, aside),
        ),
        calibrated=arm,
        pixels=extremes(by_key(before, after, held[data.pose][counts])),
        claim=claim,
        set_aside=set_aside(data, aside),
        with_them=accuracy(every.table(*arms[1], counts | wrong)[held]) if len(aside) else None,
        reason=ended.reason,
    )  # fmt: skip


def claimed(robot: Robot, arm: Robot, sure: Uncertainty, share: float) -> Claim:
    """What is known of the drawn and the calibrated arm.  share: as in `Drawing`."""
    shown = drawn_sigma(robot, sure.lack, share) if share else 0.0
    drawn = drawn_sigma(robot, sure.lack)
    return Claim(position_sigma(arm, sure), drawn, arms_apart(robot, arm), shown)


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
