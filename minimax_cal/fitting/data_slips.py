"""Slips of the data that show once base and targets are fitted: names, units, signs, rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import DataError
from minimax_cal.core.units import display_unit_of_change
from minimax_cal.fitting.coaxial_axes import merge_coaxial_zero_changes
from minimax_cal.fitting.common_scale import (
    MIN_SCALE_ERROR,
    estimate_point_scale,
    fit_state_with_links,
)
from minimax_cal.measuring.file_mistakes import (
    JOINT_ROUNDING_STEPS,
    MAX_TRIAL_POSES,
    TRIED_ROW_SHIFTS,
    describe_coarse_rounding,
    describe_row_shift,
    find_stale_rows,
    format_leave_out_command,
    format_mend_command,
    propose_file_corrections,
    with_points_from_rows_ahead,
)
from minimax_cal.measuring.measurement_checks import (
    check_joints_move,
    find_best_target_orders,
    find_swapped_rows,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.global_start import BaseFit, fit_base_and_targets
from minimax_cal.modelling.parameters import (
    ParameterNames,
    ParameterValues,
    flatten_link_parameters,
)
from minimax_cal.modelling.point_model import PointModel, build_point_model, points_in_base_axes
from minimax_cal.robots import kinematics
from minimax_cal.robots.kernels.kernel_choice import use_numpy_kernels_for_brief_work
from minimax_cal.robots.robot import Robot

MAX_PLAUSIBLE_ANGLE_CHANGE = 0.05  # no joint of a whole robot is farther from its drawing [rad]
MAX_PLAUSIBLE_LENGTH_CHANGE_OF_REACH = 0.02  # nor a length, of its reach
MAX_LENGTH_CHANGE_OF_REACH = (
    0.05  # of the reach: with an identified length so far off it is another arm
)
MAX_TWIST_CHANGE, MAX_ZERO_CHANGE = (
    math.radians(5.0),
    math.radians(30.0),
)  # alpha, beta; theta, as well
MAX_NAMED_CHANGES = 5  # changes that are told one by one
MAX_CALIBRATION_ERROR_OF_REACH = (
    5e-3  # errors above this share of the arm's reach are not what calibration is about
)
MAX_REMAINING_OF_MENDED_SQUARE = 0.04  # of the mean square: a slip that leaves no more is the cause
MAX_STRAY_ROUNDS = 5
MAX_MEETING_AXES = 3  # joints of an arm whose axes all meet, as a wrist's; of more it has lengths
MIN_STRAY_RATIO = 8.0  # times the typical miss, and this share of the reach: no error of the arm
MIN_STRAY_OF_REACH = 0.02
MAX_HOME_RATIO = 3.0  # times the typical miss: where a row belongs
MIN_BASE_ROWS = 8  # rows that place a base well enough to judge others
MIN_ROWS_BEFORE_BREAK = 10  # rows at the start that may be right before a break
MIN_ROWS_FROM_END = 3  # rows at either end that no break is looked for in
MIN_CLIPPED_JOINT_ROWS = 3  # rows at the end of a joint's values that are no chance
MAX_SCALE_ERROR = 0.05  # a larger one is another unit, or another arm
MIN_SCALE_GAIN = 50.0  # twice the log likelihood that a common factor must gain, as elsewhere
MIN_MOVING_JOINTS = 5  # joints whose links have ways enough to differ from a common factor
NO_ROW_INDICES: Array = np.zeros(0, dtype=int)
T = TypeVar("T")


def fit_base_to_nominal(robot: Robot, data: Measurements) -> BaseFit:
    """Base and targets that fit the robot as drawn best."""
    return fit_base_and_targets(build_point_model(robot, data), robot.mdh)


def target_points_in_base(model: PointModel, state: ParameterValues) -> tuple[Array, Array]:
    """Points of the targets in the base, (k, 3, m) each [m]."""
    links = kinematics.compute_link_frames(state.mdh, model.q, model.prismatic)
    return points_in_base_axes(state, model.y), kinematics.targets_in_base(
        links, state.target_positions
    )


def raise_for_best_mend(
    source: str,
    nominal_squares: tuple[float, float],
    trial_tables: Iterable[Iterable[tuple[str, T]]],
    fit_mended: Callable[[T], tuple[float, float]],
    good_rms: float,
    max_rms_ratio: float = 4.0,
    max_remaining_fraction: float = MAX_REMAINING_OF_MENDED_SQUARE,
    max_equal_ratio: float = 2.0,
    comparison_text: str = "the nominal robot then misses by {:.3g} {unit}, not {:.3g} {unit}",
    unit: str = "m",
) -> None:
    """Raise DataError for the mend with which the drawn arm fits far better, of equals the first.

    nominal_squares: mean square of the misses [m^2], and as it is compared.  trial_tables: what to
    say, and what `fit_mended`, which returns such a pair, takes: the data mended.  A table is tried
    where none before it fits to `good_rms` [m], an RMS.  max_rms_ratio: times that, which may be
    left.  max_remaining_fraction: of the mean square. max_equal_ratio: factor between equals, as a
    mirrored arm and one with some joints reversed are. unit: of the misses, in place of m.
    """
    trials: list[tuple[float, float, str]] = []
    for table in trial_tables:
        trials += [(*fit_mended(mended), text) for text, mended in table]
        if any(np.sqrt(square) <= good_rms for square, _, _ in trials):
            break
    least = min(compared for _, compared, _ in trials)
    square, compared, text = next(trial for trial in trials if trial[1] <= max_equal_ratio * least)
    if (
        np.sqrt(square) <= max_rms_ratio * good_rms
        and compared < max_remaining_fraction * nominal_squares[1]
    ):
        scale, name = display_unit_of_change(unit)
        misses = scale * np.sqrt([square, nominal_squares[0]])
        raise DataError(f"{source}: {text} ({comparison_text.format(*misses, unit=name)})")


def check_plausible(robot: Robot, data: Measurements) -> BaseFit:
    """The fit of base and targets; DataError for slips that show then: names, units, signs, rows.

    All rows are looked at, those held out too: they judge the fit.
    """
    has_lengths = robot.mdh[:, :2].any() or robot.prismatic.any()
    if robot.joints > MAX_MEETING_AXES and not has_lengths:
        raise DataError(
            f"{data.source}: {robot.name} has no lengths: every a and d of its joints is 0; "
            "check the robot file"
        )
    check_joints_move(data)
    check_stale_rows(robot, data)
    given = fit_base_to_nominal(robot, data)
    rows = find_misnamed_rows(robot, data, given) if len(data.target_names) > 1 else NO_ROW_INDICES
    if len(rows):
        raise DataError(
            f"{data.source}:{data.line[rows[0]]}: targets look swapped in {len(rows)} rows: "
            f"{data.format_row_names(rows)}; put their columns right or delete them"
        )
    limit = MAX_CALIBRATION_ERROR_OF_REACH * robot.reach()
    check_common_scale(robot, data, given)
    if np.sqrt(given.mean_square) <= limit:
        return given
    check_shifted_rows(robot, data)
    shown = fit_base_to_nominal(
        robot, thin_to_trial_poses(data)
    ).mean_square  # of the same rows as trials

    def tried(mended: tuple[Robot, Measurements]) -> tuple[float, float]:
        few = thin_to_trial_poses(mended[1])
        left = fit_base_to_nominal(mended[0], few).mean_square
        spread = float(np.nanvar(few.y, axis=0).sum(axis=-1).max())
        near = (
            left >= MAX_REMAINING_OF_MENDED_SQUARE * spread
        )  # points drawn together are near any arm
        return left, np.inf if near else left

    with use_numpy_kernels_for_brief_work(brief=False):
        raise_for_best_mend(
            data.source, (shown, shown), [propose_file_corrections(robot, data)], tried, limit
        )
    check_clipped_joints(robot, data)
    return given


def thin_to_trial_poses(data: Measurements) -> Measurements:
    """At most `MAX_TRIAL_POSES` rows, spread evenly."""
    if data.poses <= MAX_TRIAL_POSES:
        return data
    return data.take(np.linspace(0, data.poses - 1, MAX_TRIAL_POSES).astype(int))


def check_stale_rows(robot: Robot, data: Measurements) -> None:
    """Raise DataError where points are those of the row before, though the arm moved."""
    rows = find_stale_rows(robot, data)
    if len(rows):
        line = int(data.line[rows[0]])
        raise DataError(
            f"{data.origin_of_line(line).point_location(line)}: the "
            f"points are those of the row before to the last "
            f"digit, though the joints moved, in {len(rows)} row{'s' * (len(rows) > 1)}: stale "
            f"readings; measure again, or {format_leave_out_command(data, rows)}"
        )


def check_common_scale(robot: Robot, data: Measurements, base_fit: BaseFit) -> None:
    """Raise DataError where a common factor on all points, and no error of links, fits the arm."""
    moving = np.count_nonzero(np.ptp(data.q, axis=0) > 0.0)
    if moving < MIN_MOVING_JOINTS or len({row.tobytes() for row in data.q}) < MIN_BASE_ROWS:
        return
    if np.sqrt(base_fit.mean_square) > MAX_SCALE_ERROR * robot.reach():
        return
    found = estimate_point_scale(robot, data, base_fit.state)
    if found.gain >= MIN_SCALE_GAIN:  # of errors far larger than usual, links may tell it better
        found = estimate_point_scale(robot, data, fit_state_with_links(robot, data, base_fit.state))
    if found.gain >= MIN_SCALE_GAIN and MIN_SCALE_ERROR < abs(found.factor - 1.0) < MAX_SCALE_ERROR:
        raise DataError(
            f"{data.source}: all points lie {found.factor:.5g} times as far apart as {robot.name} "
            "is drawn, as no error of links does: check the instrument's scale, units and "
            "temperature compensation; to correct the points: "
            f"{format_mend_command(data, f'scale={1.0 / found.factor:.6g}')}"
        )


def misses(robot: Robot, data: Measurements, state: ParameterValues) -> Array:
    """(m,) how far the points of each row lie from where a base and targets have them [m]."""
    model = build_point_model(robot, data)
    measured, predicted = target_points_in_base(model, state)
    squares = (np.where(model.measured_mask[:, None], measured - predicted, 0.0) ** 2).sum(
        axis=(0, 1)
    )
    return np.asarray(np.sqrt(squares / np.maximum(model.measured_mask.sum(axis=0), 1)))


def check_shifted_rows(robot: Robot, data: Measurements) -> None:
    """Raise DataError where, from some row on, points stand beside the joints of another row.

    A beam break, or a line too many: one end of the file fits the drawn arm, and the other does
    with its points moved.
    """
    if data.poses < 3 * MIN_BASE_ROWS:
        return
    limit = 4.0 * MAX_CALIBRATION_ERROR_OF_REACH * robot.reach()
    count = min(data.poses // 3, MAX_TRIAL_POSES)
    rows = np.arange(data.poses)
    for end in (rows[:count], rows[:MIN_ROWS_BEFORE_BREAK], rows[-count:]):
        state = fit_base_to_nominal(robot, data.take(end)).state
        own = misses(robot, data, state)
        if np.sqrt(np.mean(own[end] ** 2)) > limit:
            continue
        cost, by, at = min(
            find_best_break(robot, data, state, own, by, is_shifted_before=end[0] > 0)
            for by in TRIED_ROW_SHIFTS
        )
        beyond = own[: at + 1] if end[0] > 0 else own[at:]
        if np.median(beyond) <= limit:  # some points are off, not all of these rows
            continue
        if np.sqrt(cost / data.poses) <= limit and cost < MAX_REMAINING_OF_MENDED_SQUARE * float(
            (own**2).sum()
        ):
            way = "up to" if end[0] > 0 else "from"
            line = data.line[at]
            to = f"..{line}" if end[0] > 0 else f"{line}.."
            raise DataError(
                f"{data.source}:{line}: {way} about this line the points of each pose "
                f"{describe_row_shift(by)}: a row was lost, or is too many; complete it, or "
                + format_mend_command(data, f"shift={by}@{to}")
            )


def find_best_break(
    robot: Robot,
    data: Measurements,
    state: ParameterValues,
    own: Array,
    shift: int,
    *,
    is_shifted_before: bool,
) -> tuple[float, int, int]:
    """Least sum of squares if points are moved from some row on (is_shifted_before: up to it); by,
    and that row.

    As many rows as they are moved by do not count: their points may be lost.

    own: (m,) misses of the rows as they are.
    """
    moved = np.zeros(data.poses)
    moved[slice(None, -shift) if shift > 0 else slice(-shift, None)] = misses(
        robot, with_points_from_rows_ahead(data, shift), state
    )
    one, other = (moved, own) if is_shifted_before else (own, moved)
    gap = abs(shift)  # rows at the break whose own points are lost
    sums = np.concatenate([[0.0], np.cumsum(one**2)])
    after = np.concatenate([np.cumsum(other[::-1] ** 2)[::-1], [0.0]])
    sums += np.concatenate([after[gap:], np.zeros(gap)])
    inner = slice(MIN_ROWS_FROM_END, data.poses - MIN_ROWS_FROM_END)
    at = MIN_ROWS_FROM_END + int(np.argmin(sums[inner]))
    return float(sums[at]), shift, at - is_shifted_before


def check_clipped_joints(robot: Robot, data: Measurements) -> None:
    """Raise DataError where rows at the end of a joint's values miss, and they alone."""
    limit = MAX_CALIBRATION_ERROR_OF_REACH * robot.reach()
    for joint in range(data.q.shape[1]):
        values = data.q[:, joint]
        ends = [
            end
            for end in (values.min(), values.max())
            if (values == end).sum() >= MIN_CLIPPED_JOINT_ROWS
        ]
        at_end = np.isin(values, ends)
        if not ends or at_end.all() or (~at_end).sum() < MIN_BASE_ROWS:
            continue
        rest = fit_base_to_nominal(robot, data.take(~at_end))
        away = misses(robot, data.take(at_end), rest.state)
        if np.sqrt(rest.mean_square) <= limit and np.median(away) > MAX_HOME_RATIO * limit:
            worst = ", ".join(f"{end:.6g}" for end in ends)
            unit = "m" if robot.prismatic[joint] else "rad"
            raise DataError(
                f"{data.source}: joint {joint + 1} looks clipped at {worst} {unit}: the "
                f"{at_end.sum()} rows there miss by {1e3 * np.median(away):.3g} mm, the others by "
                f"{1e3 * np.sqrt(rest.mean_square):.3g} mm; export the joints unclipped, or "
                f"{format_leave_out_command(data, np.flatnonzero(at_end))}"
            )


def warn_of_coarse_joints(robot: Robot, data: Measurements, base_fit: BaseFit) -> str:
    """A notice where joint values have so few digits that rounding could cost what is missing."""
    name = describe_coarse_rounding(robot, data)
    cost = JOINT_ROUNDING_STEPS[name] * robot.reach() / np.sqrt(12.0) if name else np.inf
    if np.sqrt(base_fit.mean_square) < 0.5 * cost:
        return ""
    return (
        f"{data.source}: joint values are {name}: if they were rounded and not commanded so, no "
        f"fit gets much below {1e3 * cost:.2g} mm; export them with all their digits"
    )


def find_misnamed_rows(robot: Robot, data: Measurements, base_fit: BaseFit) -> Array:
    """Rows whose targets stand under each other's names.

    Swapped rows pull the frame that is to find them: rename, fit again, until nothing changes.
    """
    model, renamed = build_point_model(robot, data), base_fit
    order = np.tile(np.arange(len(data.target_names)), (data.poses, 1))
    for _ in range(10):
        better, least, own = find_best_target_orders(target_cross_distances(model, renamed.state))
        if np.array_equal(better, order):
            break
        order = better
        y = np.empty_like(data.y)
        np.put_along_axis(y, np.repeat(order[..., None], 3, axis=2), data.y, axis=1)
        renamed = fit_base_to_nominal(robot, data.with_y(y))
    else:
        _, least, own = find_best_target_orders(target_cross_distances(model, renamed.state))
    good = np.sqrt(renamed.mean_square) <= 4.0 * MAX_CALIBRATION_ERROR_OF_REACH * robot.reach()
    return find_swapped_rows(least, own) if good else NO_ROW_INDICES


def target_cross_distances(model: PointModel, state: ParameterValues) -> Array:
    """(k, k, m) distance of measured target i from predicted target j, NaN where not measured."""
    measured, predicted = target_points_in_base(model, state)
    distance = np.linalg.norm(measured[:, None] - predicted[None], axis=-2)
    return np.where(model.measured_mask[:, None], distance, np.nan)


def match_misplaced_rows(robot: Robot, data: Measurements) -> tuple[Array, Array]:
    """Rows whose points belong to other poses: (b,) rows, and (b,) the row whose points are theirs.

    Found by where the arm would have been.  A row whose points belong nowhere has itself there.
    """
    model, good = build_point_model(robot, data), np.ones(data.poses, dtype=bool)
    for _ in range(MAX_STRAY_ROUNDS):
        state = fit_base_to_nominal(robot, data.take(good)).state
        miss = misses(robot, data, state)
        typical = float(np.median(miss[good]))
        limit = max(MIN_STRAY_RATIO * typical, MIN_STRAY_OF_REACH * robot.reach())
        if not (miss > limit).any() and good.all():
            break
        kept = miss < max(MAX_HOME_RATIO * float(np.median(miss)), limit)
        if (kept == good).all() or kept.sum() < max(10, data.poses // 2):
            break
        good = kept
    bad = np.flatnonzero(
        miss > max(MIN_STRAY_RATIO * float(np.median(miss)), MIN_STRAY_OF_REACH * robot.reach())
    )
    if not len(bad) or len(bad) > data.poses // 5:
        return NO_ROW_INDICES, NO_ROW_INDICES
    measured, predicted = target_points_in_base(model, state)
    off = measured[:, :, None, bad] - predicted[:, :, bad, None]  # of points b at pose a
    both = model.measured_mask[:, None, bad] & model.measured_mask[:, bad, None]
    distance = np.sqrt((off**2).sum(axis=1) * both).sum(axis=0) / np.maximum(both.sum(axis=0), 1)
    pose, points = scipy.optimize.linear_sum_assignment(distance)
    fits = distance[pose, points] < max(
        MAX_HOME_RATIO * typical, MIN_STRAY_OF_REACH * robot.reach() / 4.0
    )
    return bad, bad[np.where(fits, points, pose)]


def find_exchanged_rows(robot: Robot, data: Measurements) -> Array:
    """(b,) rows whose points belong to other rows: their lines were exchanged."""
    rows, source = match_misplaced_rows(robot, data)
    return np.asarray(rows[rows != source])


def correct_misplaced_rows(data: Measurements, rows: Array, source_rows: Array) -> Measurements:
    """Points put where they belong; rows that belong nowhere are left out."""
    y = data.y.copy()
    y[rows] = data.y[source_rows]
    kept = np.ones(data.poses, dtype=bool)
    kept[rows[rows == source_rows]] = False
    return data.with_y(y).take(kept)


def describe_implausible_changes(
    parameter_names: ParameterNames, link_changes: Array, reach: float
) -> str:
    """Links that no whole arm changes so much, by name and how much; empty where there is none.

    link_changes: (5n,) of the link parameters [m, rad].  reach: of the arm [m].
    """
    length = parameter_names.linear_mask[: len(link_changes)]
    far = np.flatnonzero(
        np.abs(link_changes)
        > np.where(length, MAX_PLAUSIBLE_LENGTH_CHANGE_OF_REACH * reach, MAX_PLAUSIBLE_ANGLE_CHANGE)
    )
    return ", ".join(
        (
            f"{parameter_names.all_names[i]} by {1e3 * link_changes[i]:+.4g}"
            f" {'mm' if length[i] else 'mrad'}"
        )
        for i in far[:MAX_NAMED_CHANGES]
    )


def describe_other_arm(robot: Robot, mdh: Array, is_identified: Array) -> str:
    """Why a result is of another arm than the one drawn, by its links; empty where it is not.

    mdh: (n, 5) calibrated.  is_identified: (5n,) True for link parameters that were identified.
    What moves all points as the base or the tool does (d and theta of the first joint, the last
    link) may be anywhere.
    """
    kinds = np.arange(5 * robot.joints).reshape(5, -1)  # a, d, theta, alpha, beta of each joint
    counts = is_identified.copy()
    counts[[kinds[1, 0], kinds[2, 0], *kinds[:, -1]]] = False
    change = merge_coaxial_zero_changes(robot, flatten_link_parameters(mdh - robot.mdh))
    change[2 * robot.joints :] = np.angle(np.exp(1j * change[2 * robot.joints :]))
    zero = kinds[2]
    most = np.full(len(change), MAX_TWIST_CHANGE)
    most[: 2 * robot.joints], most[zero] = (
        MAX_LENGTH_CHANGE_OF_REACH * robot.reach(),
        MAX_ZERO_CHANGE,
    )
    far = np.flatnonzero(counts & (np.abs(change) > most))
    if robot.rough or not len(far):
        return ""
    far = far[np.argsort(-np.abs(change[far]) / most[far])]
    names, lengths = ParameterNames.for_robot(robot, ()).all_names, 2 * robot.joints
    named = [
        f"{names[i]} by {1e3 * change[i]:+.3g} mm" if i < lengths
        else f"{names[i]} by {math.degrees(change[i]):+.3g} degrees"
        for i in far
    ]  # fmt: skip
    return (
        f"the measured arm is not the one that {robot.name} draws: "
        f"{format_first_names(named, MAX_NAMED_CHANGES)} "
        f"(at most {1e3 * MAX_LENGTH_CHANGE_OF_REACH * robot.reach():.3g}"
        f" mm, 5 % of the reach; 5 degrees of "
        "alpha and beta, 30 of theta): check the robot file, joint signs and units; where the "
        "drawing is rough, give allow_large_changes=True"
    )
