"""From a file of lengths, closures or poses to a calibrated robot."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.identify import RESOLUTION
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.file import read_relative
from minimax_cal.fitting.instruments.fit import (
    count_numbers,
    errors_at,
    fit_instrument,
    parameters_of,
    placed,
)
from minimax_cal.fitting.instruments.identify import position_sigma
from minimax_cal.fitting.instruments.options import (
    Known,
    Progress,
    RelativeOptions,
    check_options,
    silent,
    wishes,
)
from minimax_cal.fitting.instruments.poses import (
    beyond_one,
    lever_of,
    pose_errors,
    pose_fit,
    pose_parameters,
    pose_place,
    poses_as_targets,
    spots_of,
    tool_of,
)
from minimax_cal.fitting.instruments.remarks import (
    offset_notices,
    remarks,
    scale_notices,
    unlikely,
    weak,
)
from minimax_cal.fitting.instruments.result import RelativeCalibration
from minimax_cal.fitting.instruments.split import split_rows, split_sockets
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring import checks
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.robots.robot import Robot, load_robot


def relative(
    robot: Robot | str | Path,
    data: RelativeData | str | Path,
    progress: Progress = silent,
    *,
    holdout: float = 0.2,
    seed: int = 0,
    fix: str | Sequence[str] = (),
    free: str | Sequence[str] = (),
    offset: bool = False,
    known_distances: Sequence[Known] = (),
    lever: float | None = None,
    method: str = "snllm",
    resolution: float = RESOLUTION,
) -> RelativeCalibration:
    """Calibrate a robot from lengths, closures or poses.

    robot, data: loaded, or a name or path.  progress: called with a word on each stage.  holdout:
    share kept out of the fit.  seed: of that choice.  fix, free: names or patterns as ``beta*``.
    offset: of lengths, fit a constant one of each wire.  known_distances: of closures, sockets A, B
    and the distance of their centres [m].  lever: of poses, what a radian counts as [m]; the
    file's own unless given.  method: of the least squares.  resolution: relative singular value
    that counts as not measured.  Raises CalibrationError for wrong input; how the numbers ended is
    in the result's `status`.

    >>> print(mc.relative("irb2600", "wires.csv", holdout=0.1).headline())
    """
    chosen = RelativeOptions(
        holdout=holdout,
        seed=seed,
        fix=listed(fix),
        free=listed(free),
        offset=offset,
        known_distances=known_distances,
        lever=lever,
        method=method,
        resolution=resolution,
    )
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    data = data if isinstance(data, RelativeData) else read_relative(data)
    check_options(data, chosen)
    checks.check_joints(robot, data.at)
    begin = from_poses if data.kind == "poses" else from_instrument
    return begin(robot, data, chosen, progress)


def listed(names: str | Sequence[str]) -> Sequence[str]:
    """Names one by one, also where they are a text with commas."""
    if isinstance(names, str):
        return tuple(filter(None, names.replace(" ", "").split(",")))
    return names


def from_instrument(
    robot: Robot, data: RelativeData, options: RelativeOptions, progress: Progress
) -> RelativeCalibration:
    """Calibrate from lengths or closures."""
    began = time.perf_counter()
    needed = tuple(label for known in options.known_distances for label in known[:2])
    if data.kind == "closures":
        held, notices = split_sockets(data, options.holdout, options.seed, needed)
    else:
        held, notices = split_rows(data, options.holdout, options.seed)
    train = data.take(~held)
    fit = fit_instrument(robot, train, options, progress)
    before, before_held = errors_at(robot, fit, fit.nominal, data, held)
    after, after_held = errors_at(robot, fit, fit.state, data, held)
    errors = dict(nominal=before_held, train=after, holdout=after_held, nominal_train=before)
    trained, left = count_numbers(data, held)
    numbers = {"nominal": left, "holdout": left, "train": trained, "nominal_train": trained}
    parts = data.wires or ("visits",)
    parameters = parameters_of(robot, fit, offset=options.offset)
    arm = fit.instrument.model
    covariance = fit.covariance[: arm.names.count, : arm.names.count]
    result = RelativeCalibration(
        kind=data.kind,
        robot=robot.with_mdh(fit.state.mdh),
        nominal=robot,
        parts=parts,
        status=fit.found.status[0],
        iterations=int(fit.found.iterations[0]),
        seconds=time.perf_counter() - began,
        parameters=parameters,
        accuracy={key: accuracy(error) for key, error in errors.items()},
        errors=errors,
        numbers=numbers,
        turns={},
        instrument=placed(fit, train, options),
        identification=fit.identification,
        position_sigma=position_sigma(robot, arm, fit.state, covariance),
        beyond=(),
        notices=(*data.at.notices, *checks.limit_notices(robot, data.at), *notices),
        provenance=Provenance.of(robot, data.at, options.settings()),
    )
    said = (*scale_notices(fit), *offset_notices(fit, parameters, options))
    said += (*weak(result), *unlikely(result))
    return replace(result, notices=(*result.notices, *said, *remarks(result, data, held)))


def from_poses(
    robot: Robot, data: RelativeData, options: RelativeOptions, progress: Progress
) -> RelativeCalibration:
    """Calibrate from whole poses: `calibrate` on virtual reflectors, told as poses."""
    began = time.perf_counter()
    lever, whence = lever_of(data, options.lever)
    spots, targets = spots_of(lever), poses_as_targets(data, lever)
    try:
        fit = calibrate(
            robot,
            targets,
            objective="sum",
            progress=progress,
            holdout=options.holdout,
            seed=options.seed,
            fix=options.fix,
            free=options.free,
            method=options.method,
            resolution=options.resolution,
        )
    except DataError as wrong:  # the user's columns have other names
        raise DataError(str(wrong).replace("smr1_x_", "flange_x_")) from wrong
    held = fit.held
    found = pose_fit(fit, targets.take(~held), spots)
    nominal_tool = tool_of(fit.before, spots)
    errors, turns = {}, {}
    for key, cell, tool, rows in (
        ("nominal", fit.before, nominal_tool, held),
        ("train", fit.cell, found.tool, ~held),
        ("holdout", fit.cell, found.tool, held),
        ("nominal_train", fit.before, nominal_tool, ~held),
    ):
        error, angle = pose_errors(cell, tool, data.take(rows))
        errors[key] = error[None]
        turns[key] = spread_of(angle)
    allowed, _ = wishes(found.model.names, options)
    beyond = beyond_one(found, robot, targets.take(~held), allowed)
    again = ("points that stand out", "no pose is held out")  # said below, of poses
    told = [notice for notice in fit.notices if not any(words in notice for words in again)]
    result = RelativeCalibration(
        kind=data.kind,
        robot=fit.robot,
        nominal=robot,
        parts=("position",),
        status=fit.status,
        iterations=fit.iterations,
        seconds=time.perf_counter() - began,
        parameters=pose_parameters(found, nominal_tool, spots),
        accuracy={key: accuracy(error) for key, error in errors.items()},
        errors=errors,
        numbers={key: 6 * error.shape[1] for key, error in errors.items()},
        turns=turns,
        instrument=pose_place(fit.cell, found.tool, lever),
        identification=fit.identification,
        position_sigma=position_sigma(robot, found.model, found.state, found.covariance),
        beyond=beyond,
        notices=tuple(told),
        provenance=Provenance.of(robot, data.at, {**options.settings(), "lever": lever}),
    )
    said = (
        f"a radian counts as {1e3 * lever:.4g} mm ({whence})",
        f"identified beyond what one reflector at the pose's origin tells: {', '.join(beyond)}",
    )
    return replace(result, notices=(*told, *said, *remarks(result, data, held)))


def spread_of(angle: Array) -> tuple[float, float]:
    """RMS and largest of angles [rad]; NaN without any."""
    if not len(angle):
        return np.nan, np.nan
    return float(np.sqrt(np.mean(angle**2))), float(angle.max())
