"""How far a jump of the base moves the points, fitted beside the arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.history import visits
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects.time import SESSION_JUMP, rigid
from minimax_cal.modelling.start import EVERYWHERE
from minimax_cal.robots.robot import Robot


def fit_jump_sizes(
    robot: Robot,
    data: Measurements,
    train: Array,
    options: Options,
    rows: Array,
    near: Array = EVERYWHERE,
) -> Array:
    """Sizes (j,) of jumps that start at some rows, as effects of a fit [m].

    Residuals show a jump too small: arm and base without it take a part.  train: (m,) True for
    rows of the fit.  rows: (j,) as `faults.sessions.jumps` has them.  near: as of `fit_cell`.
    A size is the RMS motion of all points; NaN where so few poses determine no jump.
    """
    clock = data.columns.get("clock", np.zeros(0)).astype(float)
    if len(np.unique(clock)) < 2:  # of no known order: that of the rows, as jumps are found
        clock = np.empty(data.poses)
        clock[visits(data)] = np.linspace(0.0, 1.0, data.poses)
        data = replace(data, columns={**data.columns, "clock": clock})
    terms = [Term(SESSION_JUMP.name, "frame", {"since": float(clock[row])}) for row in rows]
    asked = replace(options, objective="sum", effects=(*options.effects, *terms))
    try:
        cell = fit_cell(robot, data.take(train), asked, silent, near).cell(robot, data)
    except DataError:
        return np.full(len(rows), np.nan)
    motion = rigid(cell.scene(data))
    values = {term.choice["since"]: value for term, value in cell.effects.pairs if term in terms}
    moved = [np.tensordot(values[float(clock[row])], motion, 1) for row in rows]  # (k, 3, m) each
    return np.array([np.sqrt((one**2).sum(axis=1).mean()) for one in moved])
