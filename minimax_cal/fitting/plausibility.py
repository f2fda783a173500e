"""Slips of names, units and signs that show once base and targets are fitted."""

from __future__ import annotations

import numpy as np

from minimax_cal.fitting import start
from minimax_cal.fitting.start import BaseFit
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring import checks
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import Model, in_base, model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

FEW = 30  # poses that are enough to test a slip of units or signs
POOR_FIT = 5e-3  # errors above this share of the arm's reach are not what calibration is about


def check_sense(robot: Robot, data: Measurements) -> None:
    """Raise DataError for slips that show once base and targets are fitted: names, units, signs.

    All rows are looked at, those held out too: they judge the fit.
    """
    model = model_of(robot, data)
    frame = start.fit_base(model, robot.mdh)
    limit = POOR_FIT * robot.reach()
    if len(data.target_names) > 1:
        rows = misnamed(robot, data, model, frame)
        if len(rows):
            lines = ", ".join(str(data.line[row]) for row in rows[:8])
            more = f" and {len(rows) - 8} more" if len(rows) > 8 else ""
            raise DataError(
                f"{data.source}:{data.line[rows[0]]}: targets look swapped in {len(rows)} rows: "
                f"lines {lines}{more}; put their columns right or delete them"
            )
    if np.sqrt(frame.mean_square) <= limit:
        return
    trials = [("the measurement frame looks left-handed; reverse one of its axes", frame.mirrored)]
    few = np.linspace(0, data.poses - 1, min(data.poses, FEW)).astype(int)
    for text, mended in checks.suspicions(robot, data.take(few)):
        trials.append((text, start.fit_base(model_of(robot, mended), robot.mdh).mean_square))
    least_square = min(mean_square for _, mean_square in trials)
    # a mirrored arm is one with some joints reversed: of equals the simplest, named first, is meant
    text, mean_square = next(trial for trial in trials if trial[1] <= 2.0 * least_square)
    if np.sqrt(mean_square) <= 4.0 * limit and mean_square < 0.04 * frame.mean_square:
        raise DataError(
            f"{data.source}: {text} (the nominal robot then misses by "
            f"{1e3 * np.sqrt(mean_square):.3g} mm, not {1e3 * np.sqrt(frame.mean_square):.3g} mm)"
        )


def misnamed(robot: Robot, data: Measurements, model: Model, frame: BaseFit) -> Array:
    """Rows whose targets stand under each other's names.

    Swapped rows pull the frame that is to find them: rename, fit again, until nothing changes.
    """
    names = np.arange(len(data.target_names))
    given = np.repeat(names[None], data.poses, axis=0)
    order, fitted = given, frame
    for _ in range(10):
        better, _, _ = checks.best_orders(cross_errors(model, fitted.state))
        if np.array_equal(better, order):
            break
        order = better
        y = np.empty_like(data.y)
        np.put_along_axis(y, np.repeat(order[..., None], 3, axis=2), data.y, axis=1)
        fitted = start.fit_base(model_of(robot, data.with_y(y)), robot.mdh)
    good = np.sqrt(fitted.mean_square) <= 4.0 * POOR_FIT * robot.reach()
    return checks.swapped(cross_errors(model, fitted.state)) if good else np.zeros(0, dtype=int)


def cross_errors(model: Model, state: State) -> Array:
    """(k, k, m) distance of measured target i from predicted target j, NaN where not measured."""
    links = kinematics.chain(state.mdh, model.q, model.prismatic)
    predicted = kinematics.points(links, state.target_positions)
    measured = in_base(state, model.y)
    distance = np.linalg.norm(measured[:, None] - predicted[None], axis=-2)
    return np.where(model.seen[:, None], distance, np.nan)
