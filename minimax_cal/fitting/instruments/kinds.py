"""From a file of lengths, closures or poses to a calibrated robot."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.identify import RESOLUTION
from minimax_cal.fitting.instruments import fit, plausible, poses, remarks
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.file import read_relative
from minimax_cal.fitting.instruments.identify import position_sigma
from minimax_cal.fitting.instruments.options import (
    Known,
    Progress,
    RelativeOptions,
    check_options,
    silent,
)
from minimax_cal.fitting.instruments.result import RelativeCalibration
from minimax_cal.fitting.instruments.split import held_out
from minimax_cal.fitting.options import listed, sigmas_of
from minimax_cal.measuring.checks import check_joints, limit_notices
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.solvers.least_squares import AUTO
from minimax_cal.solvers.status import Status


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
    priors: Mapping[str, float | str] | None = None,
    method: str = AUTO,
    resolution: float = RESOLUTION,
) -> RelativeCalibration:
    """Calibrate a robot from lengths, closures or poses.

    Parameters
    ----------
    robot, data
        Loaded, or a name or path.
    progress
        Called with a word on each stage.
    holdout
        Share kept out of the fit.
    seed
        Of that choice.
    fix, free
        Names or patterns as ``beta*``.
    offset
        Of lengths, fit a constant one of each wire.
    known_distances
        Of closures, sockets A, B and the distance of their centres [m].
    lever
        Of poses, what a radian counts as [m]; the file's own unless given.
    priors
        Sigma of a parameter's deviation from nominal, by name [m, rad], or a text as 5mm.
    method
        Of the least squares.
    resolution
        Relative singular value that counts as not measured.

    Returns
    -------
    RelativeCalibration
        The calibration; how the numbers ended is in its `status`.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
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
        priors=sigmas_of(priors or {}),
        method=method,
        resolution=resolution,
    )
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    data = data if isinstance(data, RelativeData) else read_relative(data)
    check_options(data, chosen)
    data = replace(data, at=check_joints(robot, data.at))
    begin = from_poses if data.kind == "poses" else from_instrument
    return begin(robot, data, chosen, progress)


def from_instrument(
    robot: Robot, data: RelativeData, options: RelativeOptions, progress: Progress
) -> RelativeCalibration:
    """Calibrate from lengths or closures."""
    began = time.perf_counter()
    plausible.check_plausible(robot, data, options)
    held, notices = held_out(data, options)
    train = data.take(~held)
    fitted = fit.fit_instrument(robot, train, options, progress)
    arm = fitted.instrument.model
    covariance = fitted.covariance[: arm.names.count, : arm.names.count]
    result = RelativeCalibration(
        kind=data.kind,
        robot=robot.with_mdh(fitted.state.mdh),
        nominal=robot,
        parts=data.wires or ("visits",),
        status=fitted.found.status[0],
        iterations=int(fitted.found.iterations[0]),
        seconds=time.perf_counter() - began,
        parameters=fit.parameters_of(robot, fitted, offset=options.offset),
        errors=fit.errors_of(robot, fitted, data, held),
        numbers=fit.count_numbers(data, held),
        turns={},
        instrument=fit.placed(fitted, train, options),
        identification=fitted.identification,
        position_sigma=position_sigma(robot, arm, fitted.state, covariance),
        beyond=(),
        notices=(*data.at.notices, *limit_notices(robot, data.at), *notices),
        provenance=Provenance.of(robot, data.at, options.settings()),
    )
    said = (*remarks.of_scale(fitted), *remarks.of_offsets(fitted, result.parameters, options))
    offset = plausible.offset_told(robot, train, options, fitted)
    wrong = plausible.contradiction(robot, data, fitted, result, offset)
    said += (*remarks.weak(result), *remarks.unlikely(result), *filter(None, (offset, wrong)))
    return replace(
        result,
        status=Status.FAILED if wrong else result.status,
        notices=(*result.notices, *said, *remarks.general(result, data, held)),
    )


def from_poses(
    robot: Robot, data: RelativeData, options: RelativeOptions, progress: Progress
) -> RelativeCalibration:
    """Calibrate from whole poses: `calibrate` on virtual reflectors, told as poses."""
    began = time.perf_counter()
    lever, whence = poses.lever_of(data, options.lever)
    fitted = poses.fit_poses(robot, data, lever, options, progress)
    calibration = fitted.fit
    errors, turns = poses.errors_of(fitted, data)
    beyond = poses.beyond_one(fitted, robot, options)
    result = RelativeCalibration(
        kind=data.kind,
        robot=calibration.robot,
        nominal=robot,
        parts=("position",),
        status=calibration.status,
        iterations=calibration.iterations,
        seconds=time.perf_counter() - began,
        parameters=poses.pose_parameters(fitted),
        errors=errors,
        numbers={key: 6 * error.shape[1] for key, error in errors.items()},
        turns=turns,
        instrument=poses.pose_place(fitted, lever),
        identification=calibration.identification,
        position_sigma=position_sigma(robot, fitted.model, fitted.state, fitted.covariance),
        beyond=beyond,
        notices=poses.notices_of(fitted),
        provenance=Provenance.of(robot, data.at, {**options.settings(), "lever": lever}),
    )
    said = (
        f"a radian counts as {1e3 * lever:.4g} mm ({whence})",
        f"identified beyond what one reflector at the pose's origin tells: {', '.join(beyond)}",
        *remarks.general(result, data, calibration.held),
    )
    return replace(result, notices=(*result.notices, *said))
