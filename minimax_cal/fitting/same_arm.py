"""Whether a result, or new measurements, can be of an arm at all."""

from __future__ import annotations

import numpy as np

from minimax_cal.fitting.checks import check_plausible
from minimax_cal.fitting.claims import GROSS
from minimax_cal.fitting.solve import LEAST_POSES
from minimax_cal.fitting.stations import stationed
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.joint_fit import refitted
from minimax_cal.modelling.parameters import Names, zero_positions
from minimax_cal.robots.robot import Robot

WILD_ANGLE = 0.05  # no joint of a whole robot is farther from its drawing [rad]
WILD_LENGTH = 0.02  # nor a length, of its reach
NAMED = 5  # implausible changes that are told one by one


def wild(names: Names, change: Array, reach: float) -> str:
    """Links that no whole arm changes so much, by name and how much; empty where there is none.

    change: (5n,) of the link parameters [m, rad].  reach: of the arm [m].
    """
    length = names.linear[: len(change)]
    far = np.flatnonzero(np.abs(change) > np.where(length, WILD_LENGTH * reach, WILD_ANGLE))
    return ", ".join(
        f"{names.all[i]} by {1e3 * change[i]:+.4g} {'mm' if length[i] else 'mrad'}"
        for i in far[:NAMED]
    )


def check_arm(robot: Robot, data: Measurements) -> None:
    """Raise DataError where new measurements cannot be of a calibrated arm.

    For the slips of `check_plausible`, and where they miss wherever base, targets and the zeros of
    the joints are: those may move, by a knock or a service.
    """
    if data.poses < LEAST_POSES:
        return
    data = stationed(robot, data, np.ones(data.poses, dtype=bool))
    given = check_plausible(robot, data)
    limit = GROSS * robot.reach()
    if np.sqrt(given.mean_square) <= limit:
        return
    free = np.zeros(Names(robot.joints, data.target_names).count, dtype=bool)
    free[5 * robot.joints :] = True
    free[zero_positions(robot.prismatic)] = True
    model, state = refitted(robot, data, given.state, free)
    miss = accuracy(model.error(state)).rms_mm
    if not miss <= 1e3 * limit:
        raise DataError(
            f"{data.source}: misses {robot.name} by {miss:.3g} mm wherever base, targets and the "
            "zeros of the joints are: check that the data are of the calibrated arm, with its "
            "units, joint signs and targets"
        )
