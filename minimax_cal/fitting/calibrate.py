"""Calibrate a robot: from measurements to parameters with their uncertainty and honest accuracy."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, CalibrationWarning
from minimax_cal.core.option_fields import take_option_fields_as_keywords
from minimax_cal.core.threads import limit_blas_to_one_thread
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.data_slips import check_plausible, warn_of_coarse_joints
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.fit_judgement import DataSplit, judge_fit
from minimax_cal.fitting.geometry_fit import MIN_TARGET_POSES
from minimax_cal.fitting.multi_instrument.options import (
    RELATIVE_OPTION_READERS,
    RelativeOptions,
    check_no_instrument_options,
    list_other_instrument_options,
    merge_instrument_options,
)
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.fitting.noise_floor import with_u95_of_instrument
from minimax_cal.fitting.options import (
    Loss,
    Objective,
    Options,
    Progress,
    QpChoice,
    check_options,
    parse_objective_target,
    select_usable_qp_backend,
    silent_progress,
)
from minimax_cal.fitting.session_frames import place_sessions, warn_of_unplaced_sessions
from minimax_cal.instruments import instrument_files
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.instrument_files import (
    InstrumentData,
    JointsAndPoints,
    PointData,
    read_instruments_or_measurements,
)
from minimax_cal.measuring import measurement_checks
from minimax_cal.measuring.faults import find_faults_by_distances
from minimax_cal.measuring.faults.point_faults import find_misdeclared_noise
from minimax_cal.measuring.faults.session_faults import locate_frame_jumps as find_jumps
from minimax_cal.measuring.measurements import SET_ASIDE_BY_TOOL, Measurements, measurements
from minimax_cal.measuring.pose_groups import (
    add_group_column,
    describe_mislabelled_pose,
    group_repeated_poses,
    split_train_and_holdout,
)
from minimax_cal.measuring.session_frames import convert_to_first_frame
from minimax_cal.measuring.set_aside_points import set_points_aside
from minimax_cal.measuring.visit_history import add_history_columns, list_backward_time_notices
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects.time_effects import SESSION_JUMP
from minimax_cal.modelling.global_start import NO_BASE_ROTATION
from minimax_cal.robots.robot import Robot, RobotSource, load_robot

JUMP_WITHOUT_TIME_TEXTS = (SESSION_JUMP.name, f"{SESSION_JUMP.name}:frame")  # without its moment
CalibrationData = (
    instrument_files.InstrumentInput | Sequence[instrument_files.InstrumentInput] | JointsAndPoints
)


@overload
def calibrate(
    robot: RobotSource,
    data: PointData,
    objective: Objective = "minimax",
    qp: QpChoice = "daqp",
    *,
    loss: Loss = "square",
    progress: Progress = silent_progress,
    **options: Any,
) -> Fit: ...
@overload
def calibrate(
    robot: RobotSource,
    data: InstrumentData,
    objective: Objective = "minimax",
    qp: QpChoice = "daqp",
    *,
    loss: Loss = "square",
    progress: Progress = silent_progress,
    **options: Any,
) -> RelativeCalibration: ...
@overload
def calibrate(
    robot: RobotSource,
    data: CalibrationData,
    objective: Objective = "minimax",
    qp: QpChoice = "daqp",
    *,
    loss: Loss = "square",
    progress: Progress = silent_progress,
    **options: Any,
) -> Fit | RelativeCalibration: ...
@take_option_fields_as_keywords(
    "objective",
    "qp",
    options=Options,
    others=(RelativeOptions, list_other_instrument_options(Options)),
    readers_by_field=RELATIVE_OPTION_READERS,
)
def calibrate(
    robot: Robot | str | Path,
    data: CalibrationData,
    *,
    options: Options,
    others: RelativeOptions,
    progress: Progress = silent_progress,
) -> Fit | RelativeCalibration:
    """Calibrate a robot from measurements of any instruments.

    Parameters
    ----------
    robot, data
        Loaded, or a name or path; data also as joints (m, n) and points (m, 3) or (m, k,
        3), or a list of paths: the campaigns of one arm, each a session.  Lengths, closures,
        contacts and poses, alone or in a list, are calibrated as `relative` does.
    options
        See `Options`.
    others
        Of other instruments: see `RelativeOptions`.
    progress
        Called with a word on each stage.

    Returns
    -------
    Fit | RelativeCalibration
        The calibration; how the numbers ended is in its `status`.  A `RelativeCalibration`
        where the data are not points of trackers alone: of files their columns decide.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.calibrate("irb2600", "poses.csv", objective="sum", holdout=0.3).summary())
    """
    given: Measurements | list[Instrument]
    if isinstance(data, tuple) and data and isinstance(data[0], np.ndarray | list | tuple):
        given = measurements(*(np.asarray(part, dtype=float) for part in data))
    else:
        given = read_instruments_or_measurements(data)  # type: ignore[arg-type]
    if isinstance(given, Measurements):
        check_no_instrument_options(given, others)
        return calibrate_tracker_points(robot, given, options, progress)
    from minimax_cal.fitting.multi_instrument.relative_calibration import (
        calibrate_instruments,
    )  # slow to import

    asked = merge_instrument_options(given, options, others)
    return calibrate_instruments(robot, given, asked, progress)


@limit_blas_to_one_thread()
def calibrate_tracker_points(
    robot: Robot | str | Path, data: Measurements, options: Options, progress: Progress
) -> Fit:
    """`calibrate` of points of trackers, with its options in one."""
    began = time.perf_counter()
    robot = load_robot(robot)
    data = check_input(robot, data, options)
    parts = split_data(robot, data, options)
    progress("start")
    options = with_jump_time(robot, parts, options, progress)
    solved = fit_cell(robot, parts.train, options, progress, parts.near)
    judged = judge_fit(robot, options, parts, solved, began)
    for alarm in judged.alarms:
        warnings.warn(alarm, CalibrationWarning, stacklevel=5)
    return judged.fit


def refit_with_options(fit: Fit, progress: Progress = silent_progress, **changes: object) -> Fit:
    """A fit of the same poses, split as they were, with some options changed.

    changes: fields of `Options`.  Raises CalibrationError.
    """
    options = replace(fit.options, **changes)  # type: ignore[arg-type]
    return fit_held_split(fit.nominal.robot, fit.data, fit.held, options, progress)


def fit_held_split(
    robot: Robot,
    data: Measurements,
    is_held: Array,
    options: Options,
    progress: Progress = silent_progress,
) -> Fit:
    """A fit of poses that are split already, as a result holds them.

    is_held: (m,) True where held out.  Raises CalibrationError.
    """
    began = time.perf_counter()
    data = check_input(robot, data, options)
    parts = DataSplit(data, data.take(~is_held), data.take(is_held), data.notices)
    solved = fit_cell(robot, parts.train, options, progress)
    return judge_fit(robot, options, parts, solved, began).fit


def check_input(robot: Robot, data: Measurements, options: Options) -> Measurements:
    """The data with all joints of the arm.

    Raises CalibrationError, before any work, for options and data that cannot be.
    """
    parse_objective_target(options.objective, data)
    check_options(options)
    if isinstance(options.qp, str):
        select_usable_qp_backend(options.qp)
    data = measurement_checks.check_and_complete_joints(robot, data)
    measurement_checks.check_point_spread(robot, data)
    return data


def split_data(robot: Robot, data: Measurements, options: Options) -> DataSplit:
    """Training and held-out poses in one frame, and what the data's faults say.

    Raises DataError for slips of the data: names, units, signs, rows.
    """
    # What a pose has of others, while all are there: its predecessor, repeats of it.
    if options.effects:
        data = add_history_columns(data)
    data = add_group_column(with_u95_of_instrument(data, options.instrument))
    data = replace(data, simulated=data.simulated or options.simulated)

    # Poses that belong together are held out together.
    train, held, split_notices = split_train_and_holdout(
        data, options.holdout, options.seed, options.holdout_by
    )
    in_train = np.isin(data.line, train.line)

    # The points of all sessions in the frame of the first, which training poses alone determine.
    split_notices = (*split_notices, *warn_of_unplaced_sessions(data, in_train))
    data = place_sessions(robot, data, in_train)
    train, held = (
        convert_to_first_frame(train, data.frames),
        convert_to_first_frame(held, data.frames),
    )

    # Faults that show without a fit: of joints, clocks and names, distances, noise.
    doubts = (
        *measurement_checks.list_robot_notices(robot, data),
        *list_backward_time_notices(data),
        describe_mislabelled_pose(data),
    )
    faults = tuple(
        fault.text for fault in (*find_faults_by_distances(data), *find_misdeclared_noise(data))
    )
    notices = (*data.notices, *filter(None, doubts), *faults, *split_notices)

    # Targets that hardly any training pose shows are left out.
    few = train.seen.sum(axis=0) < MIN_TARGET_POSES
    if few.any() and not few.all():
        names = ", ".join(np.array(data.target_names)[few])
        why = f"fewer than {MIN_TARGET_POSES} poses"
        notices += (f"left out: {names}, measured at {why.replace('poses', 'training poses')}",)
        data = set_points_aside(
            data, data.seen & few, f"the fit has {why} with this target", SET_ASIDE_BY_TOOL
        )
        data, train, held = (part.keep(~few) for part in (data, train, held))
        parse_objective_target(options.objective, data)

    # Slips that show once base and targets are fitted; that base is where the fit begins.
    near = NO_BASE_ROTATION
    if len(np.unique(group_repeated_poses(train))) >= MIN_TARGET_POSES:
        base = check_plausible(robot, data)
        near = base.state.rotation
        notices += tuple(filter(None, [warn_of_coarse_joints(robot, data, base)]))
    return DataSplit(data, train, held, notices, near)


def with_jump_time(robot: Robot, parts: DataSplit, options: Options, progress: Progress) -> Options:
    """The options with the moment of a jump that was asked for without one.

    That of the largest in the errors of the geometry, on all poses: held-out ones between the last
    training pose before it and the first one after could not be placed otherwise.
    """
    if not any(text in JUMP_WITHOUT_TIME_TEXTS for text in options.effects):
        return options
    geometric = replace(options, effects=(), objective="sum")
    cell = fit_cell(robot, parts.train, geometric, progress).cell(robot, parts.data)
    rows, sizes = find_jumps(cell.align_to_first_session(parts.data), cell.error(parts.data))
    if not len(rows):
        return options
    since = float(parts.data.columns["clock"][rows[np.argmax(sizes)]])
    jump = Term(SESSION_JUMP.name, "frame", {"since": since})
    return replace(
        options, effects=[jump if e in JUMP_WITHOUT_TIME_TEXTS else e for e in options.effects]
    )


# ---- many at once --------------------------------------------------------------------------------


SingleCampaignData = Measurements | str | Path | tuple[ArrayLike, ArrayLike]


def calibrate_many(
    robots: Robot | str | Path | Sequence[Robot | str | Path],
    data: Sequence[SingleCampaignData],
    *,
    jobs: int = -1,
    cluster: str = "",
    **options: Any,
) -> tuple[Fit | CalibrationError, ...]:
    """Calibrate from many sets of measurements.

    Parameters
    ----------
    robots
        One for all, or one for each set.
    data
        As `calibrate` takes each.
    jobs
        Processes, -1 for one a core, 1 for this one alone.
    cluster
        Address of a Dask scheduler, as tcp://host:port, whose workers then do it.
    options
        Of `calibrate`, for all.

    Returns
    -------
    tuple[Fit | CalibrationError, ...]
        A fit for each set in its order, or the error that says why there is none.

    Raises
    ------
    OptionError
        For wrong input.

    Examples
    --------
    >>> fits = mc.calibrate_many("irb120", ["monday.csv", "friday.csv"], objective="sum")
    """
    return run_for_many_arms(calibrate, robots, data, jobs, cluster, options)


def run_for_many_arms(
    verb: Callable[..., Any],
    robots: Robot | str | Path | Sequence[Robot | str | Path],
    data: Sequence[SingleCampaignData],
    jobs: int,
    cluster: str,
    options: dict[str, Any],
) -> tuple[Any, ...]:
    """What a verb makes of each robot and its data, or the error that says why it makes nothing."""
    from minimax_cal.core.parallel import run_in_parallel  # slow to import

    arms = [robots] * len(data) if isinstance(robots, Robot | str | Path) else list(robots)
    if len(arms) != len(data):
        raise CalibrationError(f"{len(arms)} robots for {len(data)} data sets; give one for each")
    known: dict[str, Robot] = {}
    for arm in arms:
        if not isinstance(arm, Robot) and str(arm) not in known:
            known[str(arm)] = load_robot(arm)
    loaded = [arm if isinstance(arm, Robot) else known[str(arm)] for arm in arms]
    calls = [(verb, arm, sheet, options) for arm, sheet in zip(loaded, data, strict=True)]
    found = dict(
        run_in_parallel(
            run_or_return_error,
            calls,
            [verb.__module__],
            process_count=jobs,
            scheduler_address=cluster,
        )
    )
    return tuple(found[number] for number in range(len(calls)))


def run_or_return_error(
    verb: Callable[..., Any], robot: Robot, data: SingleCampaignData, options: dict[str, Any]
) -> Any:
    """What a verb makes of one, or the error that says why it makes nothing."""
    try:
        return verb(robot, data, **options)
    except CalibrationError as error:
        return error
