"""How far a jump of the base moves the points, fitted beside the arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import rows_in_visit_order
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.effects.time_effects import SESSION_JUMP, rigid_base_motions
from minimax_cal.modelling.global_start import NO_BASE_ROTATION
from minimax_cal.robots.robot import Robot


def fit_jump_sizes(
    robot: Robot,
    data: Measurements,
    is_training: Array,
    options: Options,
    start_rows: Array,
    base_rotation: Array = NO_BASE_ROTATION,
) -> Array:
    """Sizes (j,) of jumps that start at some rows, as effects of a fit [m].

    Residuals show a jump too small: arm and base without it take a part.  is_training: (m,) True
    for rows of the fit.  start_rows: (j,) as `faults.sessions.jumps` has them.  base_rotation: as
    of `fit_cell`. A size is the RMS motion of all points; NaN where so few poses determine no jump.
    """
    clock = data.columns.get("clock", np.zeros(0)).astype(float)
    if len(np.unique(clock)) < 2:  # of no known order: that of the rows, as jumps are found
        clock = np.empty(data.poses)
        clock[rows_in_visit_order(data)] = np.linspace(0.0, 1.0, data.poses)
        data = replace(data, columns={**data.columns, "clock": clock})
    terms = [Term(SESSION_JUMP.name, "frame", {"since": float(clock[row])}) for row in start_rows]
    asked = replace(options, objective="sum", effects=(*options.effects, *terms))
    try:
        cell = fit_cell(robot, data.take(is_training), asked, silent_progress, base_rotation).cell(
            robot, data
        )
    except DataError:
        return np.full(len(start_rows), np.nan)
    motion = rigid_base_motions(cell.pose_arm(data))
    values = {
        term.choice["since"]: value
        for term, value in cell.effects.terms_with_values
        if term in terms
    }
    moved = [
        np.tensordot(values[float(clock[row])], motion, 1) for row in start_rows
    ]  # (k, 3, m) each
    return np.array([np.sqrt((one**2).sum(axis=1).mean()) for one in moved])
