"""Is a calibration still valid after a knock or a service?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import check_seed
from minimax_cal.fitting.accuracy import (
    MAX_INTERVAL_RATIO,
    Interval,
    bootstrap_rms_interval,
    exceedance_probability,
    predict_max_error_interval,
    summarise_point_errors,
)
from minimax_cal.fitting.arm_identity import check_same_arm, describe_computed_points, residual_rms
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import split_names
from minimax_cal.fitting.set_aside_points import accuracy_with_set_aside, set_aside_errors
from minimax_cal.measuring.faults import find_faults_by_distances
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling.cell import Cell
from minimax_cal.validation.monitoring.change_search import (
    MIN_OWN_MOTION,
    ChangeSearch,
    joint_name_of_parameter,
    search_changes,
    with_jointly_estimated_changes,
)
from minimax_cal.validation.monitoring.check_result import (
    ASKED_ZERO_SHIFT,
    CheckResult,
    InseparableZero,
    LimitVerdict,
)
from minimax_cal.validation.monitoring.monitored_arm import MonitoredArm
from minimax_cal.validation.monitoring.open_arm import match_flags_by_name, open_monitored_arm
from minimax_cal.validation.monitoring.placing import LinearPlacement
from minimax_cal.validation.monitoring.refit import build_refitted_calibration
from minimax_cal.validation.monitoring.session_pair import SessionPair
from minimax_cal.validation.tolerance import (
    LIMIT_KIND_NAMES,
    MAX_EXCEED_CHANCE,
    MIN_POSES_FOR_MAXIMUM,
    REFUSAL_REASONS,
    ToleranceLimit,
    parse_tolerance_limits,
)

KNOWN_CHOICES = ("frame", "targets")  # what may still be where it was
MIN_PLACING_POSES = 2  # poses that place an arm
MAX_POSE_DOUBLINGS = 6  # nobody measures more than 64 times as many poses
MIN_CONFIDENCE = 0.975  # one-sided: the 95 % interval lies on one side of what is required
CONFIDENCE_RANGE = (0.5, 0.9995)  # confidences that are reported
CONFIDENCE_BISECTIONS = 12
MIN_NOISIER_SIGMAS = 5.0  # standard deviations of a mean square that are worth a notice
MIN_SIGMA_GROWTH = 1.5  # so much wider sigmas are too


def check(
    fit: Fit | Path | str,
    data: Measurements | Path | str,
    tolerance: str,
    *,
    known: str | Sequence[str] = (),
    seed: int = 0,
    simulated: bool = False,
) -> CheckResult:
    """Whether a calibration is still valid, and what has moved, from a few new poses.

    Parameters
    ----------
    fit
        A calibration with its covariance, or its file.
    data
        New measurements.
    tolerance
        What is required of the error, in mm, as "rms 0.2, max 0.5".
    known
        What is where it was at the calibration: frame (the instrument), targets (the
        reflectors); reflectors on the foot, columns base1_x_mm ... of both, fix the frame
        too. All else is fitted again.
    seed
        Of samples behind the intervals.
    simulated
        The new points may be exact.

    Returns
    -------
    Health
        Whether it is valid, with its confidence, and what moved.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> mc.check("fit.json", "ten_poses.csv", "rms 0.2").valid
    """
    limits = parse_tolerance_limits(tolerance)
    if not limits:
        raise OptionError(f"tolerance {tolerance!r}: write it in mm as rms 0.2, max 0.5")
    known = tuple(split_names(known))
    for part in known:
        if part not in KNOWN_CHOICES:
            raise OptionError(f"known: {part!r} is none of {', '.join(KNOWN_CHOICES)}")
    check_seed(seed)
    fit, data = Fit.load(fit), read_measurements(data)
    robot = fit.cell.robot

    # What is open (frame, reflectors), beside what the calibration knows of the rest.
    watched, left_out = open_monitored_arm(fit, data, known)
    check_same_arm(robot, watched.data)

    # What moved: score tests of the parameters on the new poses [Rao 1948].
    found = search_changes(watched, match_flags_by_name(fit, watched, fit.identification.active))
    before, after = found.before, found.after

    # Errors as if nothing had moved, and with what moved corrected, against what is required.
    error, corrected = placed_point_errors(watched, before), placed_point_errors(watched, after)
    verdicts = tuple(
        judge_limit_by_errors(limit, error, watched.data, before.used, seed) for limit in limits
    )

    # No verdict can be that it is valid where the calibration itself is not, or where the points
    # were computed.
    noise = math.sqrt(3.0 * fit.uncertainty.noise.variance), "the calibration's noise"
    exact = replace(data, simulated=data.simulated or simulated)
    why = REFUSAL_REASONS.get(fit.status, "") or describe_computed_points(
        exact, residual_rms(error, before.used), noise, "the calibrated arm"
    )
    if why:
        sure = CONFIDENCE_RANGE[1]
        verdicts = tuple(replace(one, valid=False, confidence=sure, why=why) for one in verdicts)

    # The same with the points that were set aside.
    error, counted = inflate_errors_for_placed_coordinates(error, before.used), None
    if data.set_aside:
        cell = watched.cell
        now = Cell.from_parameters(
            robot, before.state, cell.target_names, cell.effects, cell.sessions
        )
        aside = set_aside_errors(now, watched.data)
        counted = accuracy_with_set_aside(
            error, group_repeated_poses(watched.data), aside, seed=seed
        )

    refitted = build_refitted_calibration(fit, watched, found)
    smallest_shifts, enough_poses, needed_poses = detectable_shifts(watched, found)
    return CheckResult(
        robot=robot.name,
        verdicts=verdicts,
        moved=with_jointly_estimated_changes(watched, after, found.named),
        hidden=tuple(find_inseparable_zeros(watched, found)),
        accuracy=summarise_point_errors(error),
        refitted=summarise_point_errors(
            inflate_errors_for_placed_coordinates(corrected, after.used)
        ),
        findable=smallest_shifts,
        sliding=frozenset(f"d{j + 1}" for j in np.flatnonzero(robot.prismatic)),
        enough=enough_poses,
        asked=needed_poses,
        noise=found.first.noise_ratio,
        poses=watched.data.poses,
        fit=replace(refitted, notices=(*refitted.notices, *left_out)),
        notices=(
            *data.notices,
            *(fault.text for fault in find_faults_by_distances(data)),
            *left_out,
            *warn_of_noise(found.first),
        ),
        set_aside=data.set_aside,
        with_them=counted,
    )


def find_inseparable_zeros(watched: MonitoredArm, found: ChangeSearch) -> Iterator[InseparableZero]:
    """Zero positions that no data of this kind separate from what is open, and what would."""
    names, rows, link_count = watched.names, found.before.rows, 5 * watched.cell.robot.joints
    base = watched.is_open & (np.arange(names.parameter_count) < link_count + 6)
    for zero in watched.zero_parameters:
        if zero in found.looked.column:
            continue
        column = np.array([zero])
        if base.any() and rows.independent_motion_fraction(column, base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors on the foot, or the old frame (known frame)"
            yield InseparableZero(names.all_names[zero], "the measurement frame", needs)
        elif rows.independent_motion_fraction(column, watched.is_open & ~base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors that were not touched (known targets)"
            yield InseparableZero(names.all_names[zero], "the tool", needs)
        else:
            yield InseparableZero(names.all_names[zero], "frame and tool", "poses that differ more")


class DetectableShifts(NamedTuple):
    """The smallest shift of each zero that is found; poses that are enough, and needed, or None."""

    smallest: dict[str, float]
    enough_pose_count: int | None
    needed_pose_count: int | None


def detectable_shifts(watched: MonitoredArm, found: ChangeSearch) -> DetectableShifts:
    """The smallest shift of each zero position that is found; poses that are enough, and needed."""
    tested, names = found.looked, watched.names.all_names
    zeros = tested.column[tested.zero]
    least = tested.detectable_changes(found.first)[tested.zero]
    smallest = {names[i]: float(size) for i, size in zip(zeros, least, strict=True)}
    joints = [int(joint_name_of_parameter(names[i])[1:]) - 1 for i in zeros]
    turning = ~watched.cell.robot.prismatic[joints]
    if not turning.any():
        return DetectableShifts(smallest, None, None)
    worst = float(np.max(least[turning]))
    needed = max(math.ceil(watched.data.poses * (worst / ASKED_ZERO_SHIFT) ** 2), MIN_PLACING_POSES)
    return DetectableShifts(smallest, (needed if worst <= ASKED_ZERO_SHIFT else None), needed)


def warn_of_noise(both: SessionPair) -> Iterator[str]:
    """Notices where the new poses are noisier than the calibration, or its model lacks much."""
    ratio, wider = both.noise_ratio, both.largest_sigma_factor()
    if ratio**2 > 1.0 + MIN_NOISIER_SIGMAS * math.sqrt(2.0 / both.variances.dof):
        yield (
            f"the new poses are {ratio:.2g} times as noisy as the calibration: the instrument is "
            "noisier now, or more changed than is named"
        )
    if wider > MIN_SIGMA_GROWTH:
        yield (
            f"the model lacks something: sigmas are up to {wider:.2g} times what noise alone would "
            "leave; a diagnosis says what"
        )


# ---- valid or not ------------------------------------------------------------------------------


def placed_point_errors(arm: MonitoredArm, placing: LinearPlacement) -> Array:
    """(m, k, 3) errors where base, targets and what moved are placed [m]."""
    state = placing.state
    model, _ = arm.fit_parameters_from(np.zeros(arm.names.parameter_count, dtype=bool), state)
    return model.point_errors(state) @ state.rotation.T


def inflate_errors_for_placed_coordinates(point_errors: Array, used_coordinates: float) -> Array:
    """Errors (m, k, 3) grown to n / (n - used) in the mean square: what placing took up, put back.

    used_coordinates: coordinates, as of `LinearPlacement`.
    """
    count = 3 * int(np.isfinite(point_errors[..., 0]).sum())
    return np.asarray(point_errors * math.sqrt(count / max(count - used_coordinates, 1.0)))


def judge_limit_by_errors(
    limit: ToleranceLimit,
    point_errors: Array,
    data: Measurements,
    used_coordinates: float,
    seed: int,
) -> LimitVerdict:
    """One requirement against errors (m, k, 3) that placing took up `used_coordinates` coordinates
    of.
    """
    grown, group = (
        inflate_errors_for_placed_coordinates(point_errors, used_coordinates),
        group_repeated_poses(data),
    )
    is_rms, required = limit.kind == "rms", 1e-3 * limit.size_mm
    kind = bootstrap_rms_interval if is_rms else predict_max_error_interval

    def interval(level: float, copies: int = 1) -> Interval:
        copied = np.add.outer(len(group) * np.arange(copies), group).ravel()
        errors = np.tile(grown, (copies, 1, 1))
        return kind(errors, copied, level, rng=np.random.default_rng(seed))

    found = summarise_point_errors(grown)
    value = found.rms_mm if is_rms else found.max_mm
    ends = interval(2.0 * MIN_CONFIDENCE - 1.0)
    poses, unsure = len(np.unique(group)), CONFIDENCE_RANGE[0]
    verdict = partial(
        LimitVerdict,
        limit.kind,
        limit.size_mm,
        value,
        (1e3 * ends.low, max(1e3 * ends.high, value)),
    )
    seen = (
        f"{LIMIT_KIND_NAMES[limit.kind]} {value:.3f} mm, at most {limit.size_mm:g} mm is required"
    )
    if math.isnan(ends.low):
        return verdict(None, unsure, f"{seen}, and {poses} poses are too few to say")
    if not is_rms and (most := summarise_point_errors(point_errors).max_mm) > limit.size_mm:
        return verdict(
            False,
            CONFIDENCE_RANGE[1],
            (
                f"{LIMIT_KIND_NAMES['max']} {most:.3f} mm was seen, "
                f"at most {limit.size_mm:g} mm is required"
            ),
        )
    if not is_rms and exceedance_probability(poses) > MAX_EXCEED_CHANCE:
        return verdict(
            None, unsure, f"{seen}, and a maximum needs at least {MIN_POSES_FOR_MAXIMUM} poses"
        )

    # The largest one-sided confidence at which the interval lies on one side of the limit.
    is_above, (sure, high) = value > limit.size_mm, CONFIDENCE_RANGE
    for _ in range(CONFIDENCE_BISECTIONS):
        middle = 0.5 * (sure + high)
        low_end, high_end = interval(2.0 * middle - 1.0)
        is_clear = low_end > required if is_above else high_end < required
        sure, high = (middle, high) if is_clear else (sure, middle)
    if sure >= MIN_CONFIDENCE:
        return verdict(not is_above, sure, seen)
    if not is_rms:  # which grows with the poses
        return verdict(None, sure, f"{seen}: more poses may decide")
    copied = partial(interval, 2.0 * MIN_CONFIDENCE - 1.0)
    needed = describe_poses_to_decide(copied, 1e-3 * value, required, poses)
    return verdict(None, sure, f"{seen}: {needed} poses like these decide")


def describe_poses_to_decide(
    interval: Callable[[int], Interval], rms: float, limit_size: float, pose_count: int
) -> str:
    """How many poses decide on which side of a limit an RMS lies, in words.

    Half of all sessions of so many are decided: the interval of an RMS as seen just excludes the
    limit.  The intervals are those of 1, 2, 4 ... copies of these poses, a power law between.
    interval: of so many copies.  rms: the RMS that was seen [m].  limit_size: the limit [m].
    pose_count: how many were seen.
    """
    side = int(rms < limit_size)
    wanted, width = abs(math.log(limit_size / rms)), math.inf
    for doubled in range(MAX_POSE_DOUBLINGS + 1):
        last = width
        end = float(
            np.clip(interval(2**doubled)[side] / rms, 1.0 / MAX_INTERVAL_RATIO, MAX_INTERVAL_RATIO)
        )
        width = abs(math.log(end))
        if width <= wanted:
            power = math.log(last / wanted) / math.log(last / width) if doubled else 1.0
            few = pose_count / (pose_count - 1.0)  # spread of copies, which are no new poses
            count = max(few * pose_count * 2.0 ** (doubled - 1.0 + power), pose_count + 1.0)
            return f"about {float(f'{count:.2g}'):.0f}"
    return f"more than {pose_count * 2**MAX_POSE_DOUBLINGS}"
