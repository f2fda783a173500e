"""Slips of the data that show once base and targets are fitted: names, units, signs, rows."""

from __future__ import annotations

import numpy as np
import scipy

from minimax_cal.fitting.start import BaseFit, fit_base
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.checks import best_orders, suspicions, swapped
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import Model, in_base, model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kernels.choice import work
from minimax_cal.robots.robot import Robot

FEW = 30  # poses that are enough to test a slip of units or signs
POOR_FIT = 5e-3  # errors above this share of the arm's reach are not what calibration is about
EXPLAINED = 0.04  # of the mean square: a slip that leaves no more is the cause
ROUNDS = 5
APART = 8.0  # times the typical miss, and this share of the reach: no error of the arm
LEAST = 0.02
CLOSE = 3.0  # times the typical miss: where a row belongs
NO_ROWS: Array = np.zeros(0, dtype=int)


def fitted(robot: Robot, data: Measurements) -> BaseFit:
    """Base and targets that fit the robot as drawn best."""
    return fit_base(model_of(robot, data), robot.mdh)


def measured_and_predicted(model: Model, state: State) -> tuple[Array, Array]:
    """Points of the targets in the base, (k, 3, m) each [m]."""
    links = kinematics.chain(state.mdh, model.q, model.prismatic)
    return in_base(state, model.y), kinematics.points(links, state.target_positions)


def check_plausible(robot: Robot, data: Measurements) -> BaseFit:
    """The fit of base and targets; DataError for slips that show then: names, units, signs.

    All rows are looked at, those held out too: they judge the fit.
    """
    if not (robot.mdh[:, :2].any() or robot.prismatic.any()):
        raise DataError(
            f"{data.source}: {robot.name} has no lengths: every a and d of its joints is 0; "
            "check the robot file"
        )
    given = fitted(robot, data)
    check_names(robot, data, given)
    limit = POOR_FIT * robot.reach()
    if np.sqrt(given.mean_square) <= limit:
        return given
    mirrored = "the measurement frame looks left-handed; reverse one of its axes"
    few = data.take(np.linspace(0, data.poses - 1, min(data.poses, FEW)).astype(int))
    shown = fitted(robot, few) if few.poses < data.poses else given  # of the same rows as trials
    trials = [(mirrored, shown.mirrored)]
    with work(brief=False):
        for text, mended in suspicions(robot, few):
            left = fitted(robot, mended).mean_square
            if left < EXPLAINED * spread(mended):  # points drawn together are near any arm
                trials.append((text, left))
    least_square = min(mean_square for _, mean_square in trials)
    # a mirrored arm is one with some joints reversed: of equals the simplest, named first, is meant
    text, mean_square = next(trial for trial in trials if trial[1] <= 2.0 * least_square)
    if np.sqrt(mean_square) <= 4.0 * limit and mean_square < EXPLAINED * shown.mean_square:
        raise DataError(
            f"{data.source}: {text} (the nominal robot then misses by "
            f"{1e3 * np.sqrt(mean_square):.3g} mm, not {1e3 * np.sqrt(shown.mean_square):.3g} mm)"
        )
    return given


def spread(data: Measurements) -> float:
    """Mean square of the points about their middle, the most of all targets [m^2]."""
    return float(np.nanvar(data.y, axis=0).sum(axis=-1).max())


def check_names(robot: Robot, data: Measurements, given: BaseFit) -> None:
    """Raise DataError where targets stand under each other's names.  given: see `fitted`."""
    rows = misnamed(robot, data, given) if len(data.target_names) > 1 else NO_ROWS
    if len(rows):
        lines = ", ".join(str(data.line[row]) for row in rows[:8])
        more = f" and {len(rows) - 8} more" if len(rows) > 8 else ""
        raise DataError(
            f"{data.source}:{data.line[rows[0]]}: targets look swapped in {len(rows)} rows: "
            f"lines {lines}{more}; put their columns right or delete them"
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
    for _ in range(ROUNDS):
        state = fitted(robot, data.take(good)).state
        measured, predicted = measured_and_predicted(model, state)
        squares = (np.where(model.seen[:, None], measured - predicted, 0.0) ** 2).sum(axis=(0, 1))
        miss = np.sqrt(squares / np.maximum(model.seen.sum(axis=0), 1))
        typical = float(np.median(miss[good]))
        limit = max(APART * typical, LEAST * robot.reach())
        if not (miss > limit).any() and good.all():
            break
        kept = miss < max(CLOSE * float(np.median(miss)), limit)
        if (kept == good).all() or kept.sum() < max(10, data.poses // 2):
            break
        good = kept
    bad = np.flatnonzero(miss > max(APART * float(np.median(miss)), LEAST * robot.reach()))
    if not len(bad) or len(bad) > data.poses // 5:
        return NO_ROWS, NO_ROWS
    off = measured[:, :, None, bad] - predicted[:, :, bad, None]  # of points b at pose a
    both = model.seen[:, None, bad] & model.seen[:, bad, None]
    distance = np.sqrt((off**2).sum(axis=1) * both).sum(axis=0) / np.maximum(both.sum(axis=0), 1)
    pose, points = scipy.optimize.linear_sum_assignment(distance)
    fits = distance[pose, points] < max(CLOSE * typical, LEAST * robot.reach() / 4.0)
    return bad, bad[np.where(fits, points, pose)]


def exchanged(robot: Robot, data: Measurements) -> Array:
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
