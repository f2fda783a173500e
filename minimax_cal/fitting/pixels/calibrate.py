"""From files of detections to a calibrated robot, and whether to use it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.option_fields import take_option_fields_as_keywords
from minimax_cal.core.progress_stages import Progress, silent_progress
from minimax_cal.core.threads import limit_blas_to_one_thread
from minimax_cal.fitting.accuracy import split_errors_by_key, summarise_point_errors
from minimax_cal.fitting.accuracy_claims import nominal_link_sigmas
from minimax_cal.fitting.multi_instrument.instrument_fit import minimise_worst_rows
from minimax_cal.fitting.multi_instrument.instrument_stack import InstrumentBlock, InstrumentStack
from minimax_cal.fitting.multi_instrument.options import RELATIVE_OPTION_READERS, SUM
from minimax_cal.fitting.multi_instrument.relative_calibration import (
    RelativeTask,
    build_relative_result,
    measure_instrument_errors,
    rms_and_largest,
)
from minimax_cal.fitting.multi_instrument.relative_result import PixelCalibration, PositionClaim
from minimax_cal.fitting.multi_instrument.worst_rows import WorstPixels
from minimax_cal.fitting.outcome import FitEvidence, judge
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.image_instrument import (
    FittedImages,
    as_image_instrument,
    fit_with_camera_mount,
)
from minimax_cal.fitting.pixels.options import (
    PIXEL_OPTION_NAMES,
    WORST_CAMERA,
    PixelOptions,
    check_pixel_options,
)
from minimax_cal.fitting.pixels.pixel_slips import (
    describe_pixel_objection,
    list_file_notices,
    list_outlier_pixel_notices,
)
from minimax_cal.fitting.pixels.pixel_uncertainty import (
    NominalLinks,
    PixelUncertainty,
    calibrated_position_sigma,
    estimate_pixel_uncertainty,
    fit_length_scale,
    nominal_position_sigma,
    rms_difference_of_arms,
)
from minimax_cal.instruments.camera_model import CAMERA_ON_FLANGE, read_camera_file
from minimax_cal.instruments.pixel_data import PixelData, read_pixel_data
from minimax_cal.measuring.measurement_checks import check_and_complete_joints, list_robot_notices
from minimax_cal.measuring.measurements import SET_ASIDE_BY_TOOL, SetAsidePoint
from minimax_cal.measuring.pose_groups import group_repeated_poses, select_holdout_rows
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers.status import Status

MAX_ROUNDING_PX = 1e-6  # an error below is rounding: pixels that were computed, not seen [px]


@take_option_fields_as_keywords(
    options=(PixelOptions, PIXEL_OPTION_NAMES), readers_by_field=RELATIVE_OPTION_READERS
)
def calibrate_pixels(
    robot: Robot | str | Path,
    pixels: Path | str,
    joints: Path | str,
    camera: Mapping[str, Path | str],
    board: Path | str | None = None,
    progress: Progress = silent_progress,
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
    check_pixel_options(options)
    robot = load_robot(robot)
    cameras = [read_camera_file(name, path) for name, path in camera.items()]
    data = read_pixel_data(pixels, joints, cameras, board)
    data = replace(data, at=check_and_complete_joints(robot, data.at))
    return calibrate_pixel_data(robot, data, options, progress, began)


@limit_blas_to_one_thread()
def calibrate_pixel_data(
    robot: Robot,
    data: PixelData,
    options: PixelOptions,
    progress: Progress = silent_progress,
    start_time: float | None = None,
) -> PixelCalibration:
    """As `calibrate_pixels`, of measurements that are read."""
    start_time = time.perf_counter() if start_time is None else start_time
    return conclude_pixel_calibration(
        fit_and_estimate_uncertainty(robot, data, options, progress), options, start_time
    )


@dataclass(frozen=True, eq=False)
class PixelDetermination:
    """What pixels determine.  held: (m,) poses left out."""

    robot: Robot
    data: PixelData
    held: Array
    fit: PixelFit
    sure: PixelUncertainty
    notices: tuple[str, ...]


def fit_and_estimate_uncertainty(
    robot: Robot, data: PixelData, options: PixelOptions, progress: Progress = silent_progress
) -> PixelDetermination:
    """The fit of pixels, and how sure it is."""
    held, said = select_holdout_rows(data.at, options.holdout, options.seed)
    train = data.take_pixels(~held[data.pose])
    progress("start")
    fit = minimise_worst_pixels(fit_with_camera_mount(robot, train, options, progress), options)
    progress("sigmas")
    _, group = np.unique(group_repeated_poses(data.at)[train.pose], return_inverse=True)
    return PixelDetermination(
        robot, data, held, fit, estimate_pixel_uncertainty(robot, fit, group.reshape(-1)), said
    )


def minimise_worst_pixels(fit: PixelFit, options: PixelOptions) -> PixelFit:
    """The minimax from a fit of the sum, where the objective asks for one.

    f_i is the mean square of the pixels of one target in one camera, or of one camera.
    """
    if options.objective == SUM or fit.least_squares.status[0] is Status.FAILED:
        return fit
    data = fit.images.pixels
    of, names = data.part_of_pixels, data.part_names
    if options.objective == WORST_CAMERA:
        of, names = data.camera, tuple(camera.name for camera in data.cameras)
    of = np.where(fit.images.counted_pixel_mask, of, -1)
    rows = np.concatenate([of, of, np.full(fit.images.lens_row_count, -2)])
    fit, share = minimise_worst_rows(fit, rows, names, 2, options.qp, MAX_ROUNDING_PX, WorstPixels)
    return replace(fit, share=share[: data.pixel_count])


def conclude_pixel_calibration(
    determination: PixelDetermination, options: PixelOptions, start_time: float
) -> PixelCalibration:
    """The result: whether to use the arm, and how good it is.  start_time: by
    `time.perf_counter`.
    """
    robot, data, held, fit, sure = (
        determination.robot,
        determination.data,
        determination.held,
        determination.fit,
        determination.sure,
    )
    among = np.arange(5 * robot.joints) >= 2 * robot.joints * fit.by_drawing  # lengths are in it
    scale, drawing = (
        fit_length_scale(robot, fit, sure),
        NominalLinks.from_fit(robot, fit, sure, among),
    )
    if options.drawn_prior:
        fit, sure = drawing.with_nominal_prior(fit, sure)
    images = FittedImages.from_fit(robot, fit)
    stack = InstrumentStack.from_instruments(robot, [images], [images.kind])
    found = replace(fit, problem=replace(fit.problem, stack=stack), covariance=sure.covariance,
                    noise=images.metre * fit.noise)  # fmt: skip
    plain = as_image_instrument(data)
    asked, every = (
        RelativeTask(robot, [plain], options, [(held, determination.notices)]),
        images.copy_choices_to(plain),
    )
    counts, wrong = every.split_counted_pixels(held)
    arms = [
        InstrumentBlock.without_effects(robot, every).flange_and_own_values(x)
        for x in (fit.nominal, fit.state)
    ]
    before, after = (np.linalg.norm(every.pixel_errors(*arm), axis=0)[counts] for arm in arms)
    measured = measure_instrument_errors(robot, found, 0, plain, held)
    scaled = {"lengths_over_drawn": {"share": scale.share, "sigma": scale.sigma}} if scale else {}
    measured = replace(
        measured,
        numbers={key: 2 * sum(each.counts) for key, each in measured.accuracy.items()},
        instrument={**measured.instrument, **scaled},
    )
    arm = robot.with_mdh(fit.state.mdh)
    claim = build_position_claim(robot, arm, sure, drawing.variance_fraction)
    links = slice(5 * robot.joints)
    fits_links = fit.problem.active[links].any()
    evidence = FitEvidence(
        robot,
        fit.state.mdh,
        fit.problem.active[links],
        (),
        sigma=np.sqrt(np.maximum(np.diag(sure.covariance)[links], 0.0)),
        drawn=nominal_link_sigmas(robot),
        position_sigma=claim.sigma,
        drawn_sigma=claim.drawn,
        allow_large_changes=options.allow_large_changes,
        objection=describe_pixel_objection(robot, fit, scale),
        worse=claim.why_kept() if fits_links and not claim.is_better else "",
    )
    ended = judge(evidence, fit.least_squares.status[0])
    told = () if ended.status is Status.FAILED else list_file_notices(fit, scale)
    aside = np.flatnonzero(wrong)
    return build_relative_result(
        asked,
        found,
        [measured],
        start_time,
        PixelCalibration,
        robot=robot if ended.status.keeps_drawn else arm,
        status=ended.status,
        position_sigma=claim.sigma,
        notices=(
            *data.notices,
            *list_robot_notices(robot, data.at),
            *determination.notices,
            *fit.notices,
            *list_pixel_notices(fit, held),
            *told,
            *list_outlier_pixel_notices(data, aside),
        ),
        calibrated=arm,
        pixels=rms_and_largest(split_errors_by_key(before, after, held[data.pose][counts])),
        claim=claim,
        set_aside=list_set_aside_pixels(data, aside),
        with_them=summarise_point_errors(
            every.target_errors_by_part(*arms[1], counts | wrong)[held]
        )
        if len(aside)
        else None,
        reason=ended.reason,
    )


def build_position_claim(
    robot: Robot, arm: Robot, uncertainty: PixelUncertainty, share: float
) -> PositionClaim:
    """What is known of the drawn and the calibrated arm.  share: as in `NominalLinks`."""
    shown = nominal_position_sigma(robot, uncertainty.lack, share) if share else 0.0
    drawn = nominal_position_sigma(robot, uncertainty.lack)
    return PositionClaim(
        calibrated_position_sigma(arm, uncertainty),
        drawn,
        rms_difference_of_arms(robot, arm),
        shown,
    )


def list_pixel_notices(fit: PixelFit, is_held: Array) -> list[str]:
    """What the reader should know: the scale, the lenses, nothing held out."""
    out = []
    on = CAMERA_ON_FLANGE if fit.images.on_flange else "ground"
    out.append(f"the cameras are taken as fixed to the {on}")
    if fit.by_drawing:
        out.append(
            "pixels alone have no length standard: the scale is that of the drawing's lengths, as "
            "well as drawn_within says; a board of known size gives it"
        )
    if fit.held:
        known = "their doubt counts in every sigma" if fit.lens_sigma.any() else "as known"
        out.append(f"the lenses are held as their files say, {known}")
    if not is_held.any():
        out.append("no pose is held out: nothing here says how the fit does on new poses")
    return out


def list_set_aside_pixels(data: PixelData, rows: Array) -> tuple[SetAsidePoint, ...]:
    """The pixels that took no part."""
    return tuple(
        SetAsidePoint(
            row=int(data.line[row]),
            pose=int(data.pose[row]) + 1,
            target=data.targets[data.target[row]],
            why="the pixel is an outlier",
            by=SET_ASIDE_BY_TOOL,
        )
        for row in rows
    )
