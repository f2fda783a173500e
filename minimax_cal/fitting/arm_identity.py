"""Whether a result, or new measurements, can be of an arm at all, and of any that was measured."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.data_slips import check_plausible
from minimax_cal.fitting.geometry_fit import MIN_TARGET_POSES
from minimax_cal.fitting.noise_floor import U95_SIGMAS, declared_noise_mm
from minimax_cal.fitting.outcome import MAX_MISS_OF_REACH
from minimax_cal.fitting.session_frames import place_sessions
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects_in_model import fit_geometry_nearby
from minimax_cal.modelling.parameters import ParameterNames, joint_zero_indices
from minimax_cal.robots.robot import Robot

MAX_NOISE_TO_ERROR_RATIO = (
    20.0  # errors of less than this part of the noise are none of an instrument
)
# Where nothing is declared: laser trackers, the most exact instruments of these distances, promise
# 15 um of a coordinate (u95).  A twentieth, 0.7 um in space, is above what three decimals of a
# millimetre leave by rounding (0.5 um) and far below the repeatability of any arm (5 um).
MIN_TRACKER_U95 = 15e-6


def check_same_arm(robot: Robot, data: Measurements) -> None:
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
    free = np.zeros(ParameterNames.for_robot(robot, data.target_names).parameter_count, dtype=bool)
    free[5 * robot.joints :] = True
    free[joint_zero_indices(robot.prismatic)] = True
    model, state = fit_geometry_nearby(robot, data, given.state, free)
    miss = summarise_point_errors(model.point_errors(state)).rms_mm
    if not miss <= 1e3 * limit:
        raise DataError(
            f"{data.source}: misses {robot.name} by {miss:.3g} mm wherever base, targets and the "
            "zeros of the joints are: check that the data are of the calibrated arm, with its "
            "units, joint signs and targets"
        )


def smallest_possible_noise(data: Measurements, repeatability: float) -> tuple[float, str]:
    """RMS distance of noise that is declared, or the least that any instrument has [m]; in words.

    repeatability: of the arm by ISO 9283, NaN unknown [m].
    """
    parts = declared_noise_mm(data, repeatability)
    if parts is None:
        return math.sqrt(3.0) * MIN_TRACKER_U95 / U95_SIGMAS, "the least noise of any tracker"
    return 1e-3 * math.hypot(*np.nan_to_num(parts)), "the declared noise"


def residual_rms(point_errors: Array, parameter_count: float = 0.0) -> float:
    """RMS distance of errors (m, k, 3), NaN unknown, with what parameters took put back [m].

    parameter_count: coordinates that the parameters took up.
    """
    count = 3.0 * np.count_nonzero(np.isfinite(point_errors[..., 0]))
    return (
        math.sqrt(3.0 * float(np.nansum(point_errors**2)) / max(count - parameter_count, 1.0))
        if count
        else np.inf
    )


def describe_computed_points(
    data: Measurements, residual_rms: float, noise: tuple[float, str], arm_name: str
) -> str:
    """Why points were computed, not measured; empty where they may have been measured.

    residual_rms: RMS distance from an arm [m].  noise: as of `smallest_possible_noise`.  arm_name:
    which, in words.
    """
    if data.simulated or not residual_rms < noise[0] / MAX_NOISE_TO_ERROR_RATIO:
        return ""
    return (
        f"{data.source}: these points were computed, not measured: {arm_name} misses them by "
        f"{1e3 * residual_rms:.2g} mm, less than a twentieth "
        f"of {noise[1]} ({1e3 * noise[0]:.3g} mm); "
        "give the points of the instrument, not those of the controller, or simulated=True for a "
        "simulation"
    )
