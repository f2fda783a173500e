"""Slips that no fit should be asked to explain, and what the reader of a result should know."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.fitting.data_slips import (
    MAX_CALIBRATION_ERROR_OF_REACH,
    check_plausible,
    describe_implausible_changes,
    raise_for_best_mend,
)
from minimax_cal.fitting.identification import ReasonKind
from minimax_cal.fitting.multi_instrument.instrument_fit import (
    InstrumentFit,
    build_start_state,
    build_training_stack,
    fit_instruments,
    select_parameters,
)
from minimax_cal.fitting.multi_instrument.instrument_identification import (
    identify_instrument_parameters,
)
from minimax_cal.fitting.multi_instrument.instrument_stack import (
    InstrumentBlock,
    InstrumentStack,
    build_own_state,
)
from minimax_cal.fitting.multi_instrument.options import (
    RelativeOptions,
    link_prior_sigmas,
    silent_progress,
)
from minimax_cal.fitting.multi_instrument.relative_result import MeasuredResult, RelativeCalibration
from minimax_cal.fitting.outcome import MAX_ROTATION_MISS
from minimax_cal.instruments.instrument import METRE_UNIT, RADIAN_UNIT, DataCorrection, Instrument
from minimax_cal.instruments.instrument_options import MAX_GIVEN_DEVIATION_SIGMAS
from minimax_cal.instruments.instrument_registry import is_user_registered
from minimax_cal.instruments.protocol import FlangeKinematics, FlangePoses
from minimax_cal.instruments.virtual_reflectors import DEFAULT_ROTATION_LEVER
from minimax_cal.measuring import measurement_checks
from minimax_cal.measuring.file_mistakes import (
    propose_column_corrections,
    propose_joint_corrections,
    propose_row_corrections,
    propose_unit_corrections,
)
from minimax_cal.modelling.parameters import ParameterNames, flatten_link_parameters
from minimax_cal.modelling.point_model import DEFAULT_TARGET_NAME
from minimax_cal.robots.robot import Robot


def check_instrument_slips(robot: Robot, data: Instrument, options: RelativeOptions) -> None:
    """Raise DataError or OptionError for slips that show where the arm as drawn is fitted."""
    measurement_checks.check_joints_move(data.at)
    if data.measurements_with_points.target_names:
        check_rotation_convention(robot, data, options)
        seen = (data.ready(robot, options) if data.options else data).measurements_with_points
        try:
            check_plausible(robot, seen)
        except DataError as wrong:  # the user's columns have other names
            text = str(wrong).replace("smr1_x_", data.first_column)
            if data.first_column != Instrument.first_column:  # `import` writes points alone
                text = COMMAND.sub("correct the file", text)
            raise DataError(text) from wrong
        return

    def fitted(one: Instrument) -> tuple[Any, FlangePoses, Array]:
        stack = build_training_stack(robot, {"": one}, options)
        x = build_start_state(robot, stack, select_parameters(stack, options)[0])
        block = stack.blocks[0]
        return block.instrument, *block.flange_and_own_values(x)

    data.check_given_values(fitted)
    some, size = data.thin_for_trials(), {METRE_UNIT: robot.reach(), RADIAN_UNIT: 1.0}
    good = MAX_CALIBRATION_ERROR_OF_REACH * size.get(
        data.unit, np.inf
    )  # of other units nobody knows what is poor
    given = mean_squares(*fitted(some))
    if np.sqrt(given[0]) <= good:
        data.check_nominal_fit(fitted, partial(max_nominal_errors, robot, options))
        return
    raise_for_best_mend(
        data.at.source,
        given,
        (some.propose_data_corrections(), list_joint_slips(robot, some), slips_of_rows(data)),
        lambda mended: mean_squares(*fitted(mended)),
        good,
        unit=data.unit,
    )


def check_rotation_convention(robot: Robot, data: Instrument, options: RelativeOptions) -> None:
    """Raise DataError where rotations are met as other columns hold them, and not as they stand.

    Rotations of another order or kind may leave the places that are measured beside them as small
    as they are.
    """
    if not any(True for _ in data.propose_data_corrections()):
        return

    def misses(one: Instrument) -> tuple[float, float]:
        ready, arm = (
            one.ready(robot, options),
            FlangeKinematics.from_robot(robot, one.at.q).compute_flange_poses(robot.mdh),
        )
        turns = ready.orientation_errors(arm, ready.starts(arm, np.zeros(0))[0])
        square = float((turns**2).mean()) if len(turns) else 0.0
        return square * DEFAULT_ROTATION_LEVER**2, square

    some = data.thin_for_trials()
    given = misses(some)
    if np.sqrt(given[1]) <= MAX_ROTATION_MISS:
        return
    raise_for_best_mend(
        data.at.source,
        given,
        (some.propose_data_corrections(),),
        misses,
        MAX_ROTATION_MISS * DEFAULT_ROTATION_LEVER,
        max_rms_ratio=1.0,
        comparison_text=(
            "the rotations of the drawn arm then miss by {:.3g} mm at 100 mm, not {:.3g} mm"
        ),
    )


def mean_squares(one: Instrument, arm: FlangePoses, own: Array) -> tuple[float, float]:
    """Mean square of the misses, and that over what it is to be seen by.

    The target's spread where an arm that hardly moves fits anything [m^2].
    """
    square = one.mean_square_error(arm, own)
    if not one.shrinks:
        return square, square
    place = arm.place(one.flange_points(own)[0])
    return square, square / max(float(place.var(axis=0).sum()), 1e-12)


def max_nominal_errors(
    robot: Robot, options: RelativeOptions, one: Instrument, own: Array
) -> Array:
    """(c,) by how much the drawn arm may miss each known sum: more where priors let it [m]."""
    block = InstrumentBlock.without_effects(robot, one)
    names = InstrumentStack.from_instruments(robot, [one], [""]).names
    sigma = link_prior_sigmas(names, options)
    free = np.pad(np.isfinite(sigma), (0, names.parameter_count - len(sigma)))
    x = build_own_state(robot.mdh, own)
    rows, limit = block.read_residual_rows(x), 4.0 * MAX_CALIBRATION_ERROR_OF_REACH * robot.reach()
    count = len(rows.short)
    if not (free.any() and count):
        return np.full(count, limit)
    slope = block.rows(x, free)[1][:, -count:] / np.sqrt(rows.heavy)
    return np.asarray(
        limit
        + MAX_GIVEN_DEVIATION_SIGMAS
        * np.linalg.norm(slope * sigma[free[: len(sigma)], None], axis=0)
    )


def list_joint_slips(robot: Robot, data: Instrument) -> Iterator[DataCorrection]:
    """Those of their units, columns, couplings and signs."""
    columns = ((text, mended) for text, _, mended in propose_column_corrections(robot, data.at))
    for text, mended in (
        *propose_unit_corrections(robot, data.at),
        *columns,
        *propose_joint_corrections(robot, data.at),
    ):
        if (mended.q != data.at.q).any():  # else of points, which are not measured here
            yield text, replace(data, at=mended)


def slips_of_rows(data: Instrument) -> Iterator[DataCorrection]:
    """What was measured beside the joints of other rows."""
    for text, _, joints, points in propose_row_corrections(data.poses):
        moved = data.take_rows(points)
        at = replace(moved.at, q=data.at.q[joints])
        yield f"the measurements {text}; correct the file", replace(moved, at=at).thin_for_trials()


# ---- remarks -------------------------------------------------------------------------------------


MIN_EXPLAINED_NOISE = 5e-6  # a fit that misses by less leaves nothing to explain [m]
MAX_SIGMA_TO_MEASURED_RATIO = (
    3.0  # times what was measured: positions that are told worse are weakly told
)
COMMAND = re.compile(r"minimax-cal import .*? -o mended\.csv")


def describe_extra_identified(result: RelativeCalibration) -> tuple[str, ...]:
    """What is told that one reflector would not tell."""
    names = ", ".join(result.beyond)
    what = "identified beyond what one reflector at the pose's origin tells"
    return (f"{what}: {names}",) if names else ()


def warn_of_missing_scale(fit: InstrumentFit) -> tuple[str, ...]:
    """What stands for the length standard that closures lack."""
    reasons = fit.identification.reasons
    kept = [name for name, why in reasons.items() if why.kind is ReasonKind.NO_SCALE]
    if not kept:
        return ()
    first = fit.stack.instruments[0]
    return (
        f"the scale is not identifiable from {first.kind}: {kept[0]} is kept as drawn, whatever "
        "its prior, and if that is wrong by a part in a thousand, so is every length; sigmas leave "
        "this out; " + first.scale[-1],
    )


def warn_of_rotation_units(fit: InstrumentFit) -> Iterator[str]:
    """That an instrument of the user's own reads rotations, and counts them as metres."""
    for i, one in enumerate(fit.stack.instruments):
        if is_user_registered(one) and one.unit == METRE_UNIT:
            rows = fit.stack.blocks[i].read_residual_rows(fit.stack.state_of_block(fit.state, i))
            if rows.by_rotation.any() and not rows.by_point.any():
                yield (
                    f"{one.kind}: its rows depend on rotations alone, and its unit is m: give its "
                    'class the unit of its rows, as unit = "rad"'
                )


def list_general_notices(result: MeasuredResult, data: Instrument, held: Array) -> tuple[str, ...]:
    """What the reader should know: nothing held out, measurements that stand out."""
    notices = []
    if not held.any():
        notices.append("no pose is held out: nothing here says how the fit does on new poses")
    elif not result.accuracy["holdout"].poses:
        notices.append("the held-out rows close with nothing: no held-out accuracy")
    distance = np.full((len(held), len(result.parts)), np.nan)
    distance[~held] = np.linalg.norm(result.errors["train"], axis=-1)
    distance[held] = np.linalg.norm(result.errors["holdout"], axis=-1)
    at = replace(data.at, target_names=result.parts)
    return (*notices, *measurement_checks.list_outlier_notices(at, distance, data.unit))


def warn_of_uncertain_positions(
    fit: InstrumentFit,
    result: RelativeCalibration,
    measured: Sequence[MeasuredResult],
    sigma: float,
) -> tuple[str, ...]:
    """A notice where positions are told far worse than what was measured.

    sigma: of a position, but for what is open and for what an arm does that no link holds [m].
    """
    of_lengths = [one for one in measured if one.units == (METRE_UNIT,)]
    rms_mm = min((one.accuracy["train"].rms_mm for one in of_lengths), default=np.nan)
    expected_mm = 1e3 * sigma
    more = [one.words.more for one in fit.stack.instruments]
    untold = [
        p.name
        for p in result.parameters
        if DEFAULT_TARGET_NAME in p.name and p.because is ReasonKind.NOT_TOLD
    ]
    if not all(more) or not (expected_mm > MAX_SIGMA_TO_MEASURED_RATIO * rms_mm or untold):
        return ()
    where = f" ({', '.join(untold)} not at all)" if untold else ""
    fits = f"what was measured fits to {rms_mm:.3g} mm, " if of_lengths else ""
    return (
        f"positions are poorly determined{where}: by the sigmas to {expected_mm:.3g} mm, "
        f"{fits}and model error makes positions worse still; "
        f"turn the flange more from pose to pose, and measure with {more[0]}",
    )


def warn_of_other_arm(
    result: RelativeCalibration, measured: Sequence[MeasuredResult]
) -> tuple[str, ...]:
    """Notices where the result is no calibration of this robot but of another one."""
    notices, reach = [], result.nominal.reach()
    for key, what in (("nominal_train", "the nominal robot"), ("train", "the best fit")):
        lengths = [one.accuracy[key].rms_mm for one in measured if one.units == (METRE_UNIT,)]
        miss_mm = max(lengths, default=0.0)
        if miss_mm > 1e3 * MAX_CALIBRATION_ERROR_OF_REACH * reach:
            notices.append(
                f"{what} misses by {miss_mm:.3g} mm: check that it is the robot of these "
                "measurements, with its joint signs, zero positions and units"
            )
    change = flatten_link_parameters(result.robot.mdh - result.nominal.mdh)
    if named := describe_implausible_changes(
        ParameterNames.for_robot(result.nominal, ()), change, reach
    ):
        notices.append(f"implausibly large changes: {named}; is the robot file the right one?")
    return tuple(notices)


def compare_with_wider_instrument(
    robot: Robot, fit: InstrumentFit, i: int, options: RelativeOptions
) -> tuple[str, str]:
    """A notice, and its mend, where more of an instrument would explain what the fit leaves."""
    one, noise = fit.stack.instruments[i], float(fit.noise[i])
    more = one.options_for_more_parameters()
    if not more or noise < MIN_EXPLAINED_NOISE:
        return "", ""
    try:
        wider = fit_instruments(
            robot, fit.training_data, replace(options, **dict[str, Any](more)), silent_progress
        )
    except DataError:  # too few numbers for so many unknowns
        return "", ""
    return one.describe_wider_fit(noise, float(wider.noise[i]))


def find_parameters_beyond_one_point(
    robot: Robot, fit: InstrumentFit, options: RelativeOptions
) -> tuple[str, ...]:
    """Parameters that a lone instrument tells, and one point of it would not."""
    one = fit.stack.instruments[0]
    point = one.single_point_instrument
    if point is None:
        return ()
    lone = InstrumentStack.from_instruments(robot, [point.ready(robot, options)], [""])
    own = one.single_point_unknowns(
        fit.stack.blocks[0].own_values(fit.stack.state_of_block(fit.state, 0))
    )
    x = lone.state(fit.state.mdh, [own])
    allowed, wanted = select_parameters(lone, options)
    alone = identify_instrument_parameters(
        robot, lone, lone.at_reference_poses(robot, x), x, allowed, wanted,
        known=np.zeros(lone.names.parameter_count, dtype=bool), resolution=options.resolution,
    )  # fmt: skip
    rows = lone.names.geometric_count + one.targets_at.start
    more = fit.identification.active[:rows] & ~alone.active[:rows]
    known = np.pad(alone.active[rows:], (0, len(one.lone_names) + rows - len(alone.active)))
    untold = (name for name, told in zip(one.lone_names, known, strict=True) if not told)
    return (*(lone.names.all_names[i] for i in np.flatnonzero(more)), *untold)
