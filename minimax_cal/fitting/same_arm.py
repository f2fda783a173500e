"""Whether a result, or new measurements, can be of an arm at all, and of any that was measured."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.fitting.accuracy import accuracy
from minimax_cal.fitting.checks import check_plausible
from minimax_cal.fitting.floor import SIGMAS, declared
from minimax_cal.fitting.geometry_fit import MIN_TARGET_POSES
from minimax_cal.fitting.outcome import MAX_MISS_OF_REACH
from minimax_cal.fitting.stations import place_sessions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.joint_fit import refitted
from minimax_cal.modelling.parameters import Names, zero_positions
from minimax_cal.robots.robot import Robot

FRACTION = 20.0  # errors of less than this part of the noise are none of an instrument
# Where nothing is declared: laser trackers, the most exact instruments of these distances, promise
# 15 um of a coordinate (u95).  A twentieth, 0.7 um in space, is above what three decimals of a
# millimetre leave by rounding (0.5 um) and far below the repeatability of any arm (5 um).
LEAST_U95 = 15e-6


def check_arm(robot: Robot, data: Measurements) -> None:
    """Raise DataError where new measurements cannot be of a calibrated arm.

    For the slips of `check_plausible`, and where they miss wherever base, targets and the zeros of
    the joints are: those may move, by a knock or a service.
    """
    if data.poses < MIN_TARGET_POSES:
        return
    data = place_sessions(robot, data, np.ones(data.poses, dtype=bool))
    given = check_plausible(robot, data)
    limit = MAX_MISS_OF_REACH * robot.reach()
    if np.sqrt(given.mean_square) <= limit:
        return
    free = np.zeros(Names.of(robot, data.target_names).count, dtype=bool)
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


def least_noise(data: Measurements, repeatability: float) -> tuple[float, str]:
    """RMS distance of noise that is declared, or the least that any instrument has [m]; in words.

    repeatability: of the arm by ISO 9283, NaN unknown [m].
    """
    parts = declared(data, repeatability)
    if parts is None:
        return math.sqrt(3.0) * LEAST_U95 / SIGMAS, "the least noise of any tracker"
    return 1e-3 * math.hypot(*np.nan_to_num(parts)), "the declared noise"


def residual(error: Array, paid: float = 0.0) -> float:
    """RMS distance of errors (m, k, 3), NaN unknown, with what parameters took put back [m].

    paid: coordinates that the parameters took up.
    """
    count = 3.0 * np.count_nonzero(np.isfinite(error[..., 0]))
    return math.sqrt(3.0 * float(np.nansum(error**2)) / max(count - paid, 1.0)) if count else np.inf


def computed(data: Measurements, size: float, noise: tuple[float, str], arm: str) -> str:
    """Why points were computed, not measured; empty where they may have been measured.

    size: RMS distance from an arm [m].  noise: as of `least_noise`.  arm: which, in words.
    """
    if data.simulated or not size < noise[0] / FRACTION:
        return ""
    return (
        f"{data.source}: these points were computed, not measured: {arm} misses them by "
        f"{1e3 * size:.2g} mm, less than a twentieth of {noise[1]} ({1e3 * noise[0]:.3g} mm); "
        "give the points of the instrument, not those of the controller, or simulated=True for a "
        "simulation"
    )
