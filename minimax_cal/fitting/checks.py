"""Slips of the data that show once base and targets are fitted: names, units, signs, rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np
import scipy

from minimax_cal.fitting.coaxial import change_of_coaxial_zeros
from minimax_cal.fitting.common_scale import LEAST_SHARE, scale_of, with_links
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.units import for_people
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.checks import best_orders, check_span, swapped
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.slips import (
    DIGITS,
    MAX_TRIAL_POSES,
    SHIFTS,
    beside,
    digits_of,
    left_out_by,
    mend_by,
    slips,
    stale_rows,
    with_points_moved,
)
from minimax_cal.modelling.model import Model, in_base, model_of
from minimax_cal.modelling.parameters import Names, State, links_of
from minimax_cal.modelling.start import BaseFit, fit_base
from minimax_cal.robots import kinematics
from minimax_cal.robots.kernels.choice import work
from minimax_cal.robots.robot import Robot

WILD_ANGLE = 0.05  # no joint of a whole robot is farther from its drawing [rad]
WILD_LENGTH = 0.02  # nor a length, of its reach
LARGE_LENGTH = 0.05  # of the reach: with an identified length so far off it is another arm
LARGE_TWIST, LARGE_ZERO = math.radians(5.0), math.radians(30.0)  # alpha, beta; theta, as well
MAX_NAMED = 5  # changes that are told one by one
POOR_FIT = 5e-3  # errors above this share of the arm's reach are not what calibration is about
EXPLAINED = 0.04  # of the mean square: a slip that leaves no more is the cause
MAX_ROUNDS = 5
MAX_MEETING_AXES = 3  # joints of an arm whose axes all meet, as a wrist's; of more it has lengths
MIN_STRAY_RATIO = 8.0  # times the typical miss, and this share of the reach: no error of the arm
MIN_STRAY_OF_REACH = 0.02
MAX_HOME_RATIO = 3.0  # times the typical miss: where a row belongs
LEAST_HEAD = 8  # rows that place a base well enough to judge others
LEAST_PLACED = 10  # rows at the start that may be right before a break
CLOSE_BY = 3  # rows at either end that no break is looked for in
FEW_CLIPPED = 3  # rows at the end of a joint's values that are no chance
MOST_SCALE = 0.05  # a larger one is another unit, or another arm
MIN_SCALE_GAIN = 50.0  # twice the log likelihood that a common factor must gain, as elsewhere
LEAST_MOVING = 5  # joints whose links have ways enough to differ from a common factor
NO_ROWS: Array = np.zeros(0, dtype=int)
T = TypeVar("T")


def fitted(robot: Robot, data: Measurements) -> BaseFit:
    """Base and targets that fit the robot as drawn best."""
    return fit_base(model_of(robot, data), robot.mdh)


def measured_and_predicted(model: Model, state: State) -> tuple[Array, Array]:
    """Points of the targets in the base, (k, 3, m) each [m]."""
    links = kinematics.chain(state.mdh, model.q, model.prismatic)
    return in_base(state, model.y), kinematics.points(links, state.target_positions)


def check_mends(
    source: str,
    given: tuple[float, float],
    tables: Iterable[Iterable[tuple[str, T]]],
    fit: Callable[[T], tuple[float, float]],
    good: float,
    limit: float = 4.0,
    share: float = EXPLAINED,
    alike: float = 2.0,
    said: str = "the nominal robot then misses by {:.3g} {unit}, not {:.3g} {unit}",
    unit: str = "m",
) -> None:
    """Raise DataError for the mend with which the drawn arm fits far better, of equals the first.

    given: mean square of the misses [m^2], and as it is compared.  tables: what to say, and what
    `fit`, which returns such a pair, takes: the data mended.  A table is tried where none before it
    fits to `good` [m], an RMS.  limit: times that, which may be left.  share: of the mean square.
    alike: factor between equals, as a mirrored arm and one with some joints reversed are.
    unit: of the misses, in place of m.
    """
    trials: list[tuple[float, float, str]] = []
    for table in tables:
        trials += [(*fit(mended), text) for text, mended in table]
        if any(np.sqrt(square) <= good for square, _, _ in trials):
            break
    least = min(compared for _, compared, _ in trials)
    square, compared, text = next(trial for trial in trials if trial[1] <= alike * least)
    if np.sqrt(square) <= limit * good and compared < share * given[1]:
        scale, name = for_people(unit)
        misses = scale * np.sqrt([square, given[0]])
        raise DataError(f"{source}: {text} ({said.format(*misses, unit=name)})")


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
    check_span(data)
    check_fresh(robot, data)
    given = fitted(robot, data)
    rows = misnamed(robot, data, given) if len(data.target_names) > 1 else NO_ROWS
    if len(rows):
        raise DataError(
            f"{data.source}:{data.line[rows[0]]}: targets look swapped in {len(rows)} rows: "
            f"{data.list_rows(rows)}; put their columns right or delete them"
        )
    limit = POOR_FIT * robot.reach()
    check_scale(robot, data, given)
    if np.sqrt(given.mean_square) <= limit:
        return given
    check_broken(robot, data)
    shown = fitted(robot, few_of(data)).mean_square  # of the same rows as trials

    def tried(mended: tuple[Robot, Measurements]) -> tuple[float, float]:
        few = few_of(mended[1])
        left = fitted(mended[0], few).mean_square
        spread = float(np.nanvar(few.y, axis=0).sum(axis=-1).max())
        near = left >= EXPLAINED * spread  # points drawn together are near any arm
        return left, np.inf if near else left

    with work(brief=False):
        check_mends(data.source, (shown, shown), [slips(robot, data)], tried, limit)
    check_clipped(robot, data)
    return given


def few_of(data: Measurements) -> Measurements:
    """At most `MAX_TRIAL_POSES` rows, spread evenly."""
    if data.poses <= MAX_TRIAL_POSES:
        return data
    return data.take(np.linspace(0, data.poses - 1, MAX_TRIAL_POSES).astype(int))


def check_fresh(robot: Robot, data: Measurements) -> None:
    """Raise DataError where points are those of the row before, though the arm moved."""
    rows = stale_rows(robot, data)
    if len(rows):
        line = int(data.line[rows[0]])
        raise DataError(
            f"{data.origin(line).place(line)}: the points are those of the row before to the last "
            f"digit, though the joints moved, in {len(rows)} row{'s' * (len(rows) > 1)}: stale "
            f"readings; measure again, or {left_out_by(data, rows)}"
        )


def check_scale(robot: Robot, data: Measurements, given: BaseFit) -> None:
    """Raise DataError where a common factor on all points, and no error of links, fits the arm."""
    moving = np.count_nonzero(np.ptp(data.q, axis=0) > 0.0)
    if moving < LEAST_MOVING or len({row.tobytes() for row in data.q}) < LEAST_HEAD:
        return
    if np.sqrt(given.mean_square) > MOST_SCALE * robot.reach():
        return
    found = scale_of(robot, data, given.state)
    if found.gain >= MIN_SCALE_GAIN:  # of errors far larger than usual, links may tell it better
        found = scale_of(robot, data, with_links(robot, data, given.state))
    if found.gain >= MIN_SCALE_GAIN and LEAST_SHARE < abs(found.factor - 1.0) < MOST_SCALE:
        raise DataError(
            f"{data.source}: all points lie {found.factor:.5g} times as far apart as {robot.name} "
            "is drawn, as no error of links does: check the instrument's scale, units and "
            "temperature compensation; to correct the points: "
            f"{mend_by(data, f'scale={1.0 / found.factor:.6g}')}"
        )


def misses(robot: Robot, data: Measurements, state: State) -> Array:
    """(m,) how far the points of each row lie from where a base and targets have them [m]."""
    model = model_of(robot, data)
    measured, predicted = measured_and_predicted(model, state)
    squares = (np.where(model.seen[:, None], measured - predicted, 0.0) ** 2).sum(axis=(0, 1))
    return np.asarray(np.sqrt(squares / np.maximum(model.seen.sum(axis=0), 1)))


def check_broken(robot: Robot, data: Measurements) -> None:
    """Raise DataError where, from some row on, points stand beside the joints of another row.

    A beam break, or a line too many: one end of the file fits the drawn arm, and the other does
    with its points moved.
    """
    if data.poses < 3 * LEAST_HEAD:
        return
    limit = 4.0 * POOR_FIT * robot.reach()
    count = min(data.poses // 3, MAX_TRIAL_POSES)
    rows = np.arange(data.poses)
    for end in (rows[:count], rows[:LEAST_PLACED], rows[-count:]):
        state = fitted(robot, data.take(end)).state
        own = misses(robot, data, state)
        if np.sqrt(np.mean(own[end] ** 2)) > limit:
            continue
        cost, by, at = min(broken_at(robot, data, state, own, by, last=end[0] > 0) for by in SHIFTS)
        beyond = own[: at + 1] if end[0] > 0 else own[at:]
        if np.median(beyond) <= limit:  # some points are off, not all of these rows
            continue
        if np.sqrt(cost / data.poses) <= limit and cost < EXPLAINED * float((own**2).sum()):
            way = "up to" if end[0] > 0 else "from"
            line = data.line[at]
            to = f"..{line}" if end[0] > 0 else f"{line}.."
            raise DataError(
                f"{data.source}:{line}: {way} about this line the points of each pose "
                f"{beside(by)}: a row was lost, or is too many; complete it, or "
                + mend_by(data, f"shift={by}@{to}")
            )


def broken_at(
    robot: Robot, data: Measurements, state: State, own: Array, by: int, *, last: bool
) -> tuple[float, int, int]:
    """Least sum of squares if points are moved from some row on (last: up to it); by, and that row.

    As many rows as they are moved by do not count: their points may be lost.

    own: (m,) misses of the rows as they are.
    """
    moved = np.zeros(data.poses)
    moved[slice(None, -by) if by > 0 else slice(-by, None)] = misses(
        robot, with_points_moved(data, by), state
    )
    one, other = (moved, own) if last else (own, moved)
    gap = abs(by)  # rows at the break whose own points are lost
    sums = np.concatenate([[0.0], np.cumsum(one**2)])
    after = np.concatenate([np.cumsum(other[::-1] ** 2)[::-1], [0.0]])
    sums += np.concatenate([after[gap:], np.zeros(gap)])
    inner = slice(CLOSE_BY, data.poses - CLOSE_BY)
    at = CLOSE_BY + int(np.argmin(sums[inner]))
    return float(sums[at]), by, at - last


def check_clipped(robot: Robot, data: Measurements) -> None:
    """Raise DataError where rows at the end of a joint's values miss, and they alone."""
    limit = POOR_FIT * robot.reach()
    for joint in range(data.q.shape[1]):
        values = data.q[:, joint]
        ends = [end for end in (values.min(), values.max()) if (values == end).sum() >= FEW_CLIPPED]
        at_end = np.isin(values, ends)
        if not ends or at_end.all() or (~at_end).sum() < LEAST_HEAD:
            continue
        rest = fitted(robot, data.take(~at_end))
        away = misses(robot, data.take(at_end), rest.state)
        if np.sqrt(rest.mean_square) <= limit and np.median(away) > MAX_HOME_RATIO * limit:
            worst = ", ".join(f"{end:.6g}" for end in ends)
            unit = "m" if robot.prismatic[joint] else "rad"
            raise DataError(
                f"{data.source}: joint {joint + 1} looks clipped at {worst} {unit}: the "
                f"{at_end.sum()} rows there miss by {1e3 * np.median(away):.3g} mm, the others by "
                f"{1e3 * np.sqrt(rest.mean_square):.3g} mm; export the joints unclipped, or "
                f"{left_out_by(data, np.flatnonzero(at_end))}"
            )


def coarse_joints(robot: Robot, data: Measurements, given: BaseFit) -> str:
    """A notice where joint values have so few digits that rounding could cost what is missing."""
    name = digits_of(robot, data)
    cost = DIGITS[name] * robot.reach() / np.sqrt(12.0) if name else np.inf
    if np.sqrt(given.mean_square) < 0.5 * cost:
        return ""
    return (
        f"{data.source}: joint values are {name}: if they were rounded and not commanded so, no "
        f"fit gets much below {1e3 * cost:.2g} mm; export them with all their digits"
    )


def misnamed(robot: Robot, data: Measurements, given: BaseFit) -> Array:
    """Rows whose targets stand under each other's names.

    Swapped rows pull the frame that is to find them: rename, fit again, until nothing changes.
    """
    model, renamed = model_of(robot, data), given
    order = np.tile(np.arange(len(data.target_names)), (data.poses, 1))
    for _ in range(10):
        better, least, own = best_orders(cross_errors(model, renamed.state))
        if np.array_equal(better, order):
            break
        order = better
        y = np.empty_like(data.y)
        np.put_along_axis(y, np.repeat(order[..., None], 3, axis=2), data.y, axis=1)
        renamed = fitted(robot, data.with_y(y))
    else:
        _, least, own = best_orders(cross_errors(model, renamed.state))
    good = np.sqrt(renamed.mean_square) <= 4.0 * POOR_FIT * robot.reach()
    return swapped(least, own) if good else NO_ROWS


def cross_errors(model: Model, state: State) -> Array:
    """(k, k, m) distance of measured target i from predicted target j, NaN where not measured."""
    measured, predicted = measured_and_predicted(model, state)
    distance = np.linalg.norm(measured[:, None] - predicted[None], axis=-2)
    return np.where(model.seen[:, None], distance, np.nan)


def misplaced(robot: Robot, data: Measurements) -> tuple[Array, Array]:
    """Rows whose points belong to other poses: (b,) rows, and (b,) the row whose points are theirs.

    Found by where the arm would have been.  A row whose points belong nowhere has itself there.
    """
    model, good = model_of(robot, data), np.ones(data.poses, dtype=bool)
    for _ in range(MAX_ROUNDS):
        state = fitted(robot, data.take(good)).state
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
        return NO_ROWS, NO_ROWS
    measured, predicted = measured_and_predicted(model, state)
    off = measured[:, :, None, bad] - predicted[:, :, bad, None]  # of points b at pose a
    both = model.seen[:, None, bad] & model.seen[:, bad, None]
    distance = np.sqrt((off**2).sum(axis=1) * both).sum(axis=0) / np.maximum(both.sum(axis=0), 1)
    pose, points = scipy.optimize.linear_sum_assignment(distance)
    fits = distance[pose, points] < max(
        MAX_HOME_RATIO * typical, MIN_STRAY_OF_REACH * robot.reach() / 4.0
    )
    return bad, bad[np.where(fits, points, pose)]


def find_exchanged_rows(robot: Robot, data: Measurements) -> Array:
    """(b,) rows whose points belong to other rows: their lines were exchanged."""
    rows, source = misplaced(robot, data)
    return np.asarray(rows[rows != source])


def put_right(data: Measurements, rows: Array, source: Array) -> Measurements:
    """Points put where they belong; rows that belong nowhere are left out."""
    y = data.y.copy()
    y[rows] = data.y[source]
    kept = np.ones(data.poses, dtype=bool)
    kept[rows[rows == source]] = False
    return data.with_y(y).take(kept)


def wild(names: Names, change: Array, reach: float) -> str:
    """Links that no whole arm changes so much, by name and how much; empty where there is none.

    change: (5n,) of the link parameters [m, rad].  reach: of the arm [m].
    """
    length = names.linear[: len(change)]
    far = np.flatnonzero(np.abs(change) > np.where(length, WILD_LENGTH * reach, WILD_ANGLE))
    return ", ".join(
        f"{names.all[i]} by {1e3 * change[i]:+.4g} {'mm' if length[i] else 'mrad'}"
        for i in far[:MAX_NAMED]
    )


def too_changed(robot: Robot, mdh: Array, active: Array) -> str:
    """Why a result is of another arm than the one drawn, by its links; empty where it is not.

    mdh: (n, 5) calibrated.  active: (5n,) True for link parameters that were identified.  What
    moves all points as the base or the tool does (d and theta of the first joint, the last link)
    may be anywhere.
    """
    kinds = np.arange(5 * robot.joints).reshape(5, -1)  # a, d, theta, alpha, beta of each joint
    counts = active.copy()
    counts[[kinds[1, 0], kinds[2, 0], *kinds[:, -1]]] = False
    change = change_of_coaxial_zeros(robot, links_of(mdh - robot.mdh))
    change[2 * robot.joints :] = np.angle(np.exp(1j * change[2 * robot.joints :]))
    zero = kinds[2]
    most = np.full(len(change), LARGE_TWIST)
    most[: 2 * robot.joints], most[zero] = LARGE_LENGTH * robot.reach(), LARGE_ZERO
    far = np.flatnonzero(counts & (np.abs(change) > most))
    if robot.rough or not len(far):
        return ""
    far = far[np.argsort(-np.abs(change[far]) / most[far])]
    names, lengths = Names.of(robot, ()).all, 2 * robot.joints
    named = [
        f"{names[i]} by {1e3 * change[i]:+.3g} mm" if i < lengths
        else f"{names[i]} by {math.degrees(change[i]):+.3g} degrees"
        for i in far
    ]  # fmt: skip
    return (
        f"the measured arm is not the one that {robot.name} draws: {name_first(named, MAX_NAMED)} "
        f"(at most {1e3 * LARGE_LENGTH * robot.reach():.3g} mm, 5 % of the reach; 5 degrees of "
        "alpha and beta, 30 of theta): check the robot file, joint signs and units; where the "
        "drawing is rough, give allow_large_changes=True"
    )
