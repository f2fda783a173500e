"""Is a calibration still valid after a knock or a service?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from minimax_cal.fitting.accuracy import (
    FARTHEST,
    Interval,
    accuracy,
    chance_of_larger,
    max_interval,
    rms_interval,
)
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import listed
from minimax_cal.fitting.same_arm import check_arm, computed, residual
from minimax_cal.fitting.set_aside import errors_of, with_them
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import check_seed
from minimax_cal.judging.tolerance import (
    KINDS,
    MAX_EXCEED_CHANCE,
    MIN_POSES,
    REFUSED,
    Limit,
    limits_of,
)
from minimax_cal.judging.watching.both import Both
from minimax_cal.judging.watching.moved import MIN_OWN_MOTION, Search, joint_of, search, sized
from minimax_cal.judging.watching.opening import match_names, open_parameters
from minimax_cal.judging.watching.placing import Placing
from minimax_cal.judging.watching.refit import refit
from minimax_cal.judging.watching.result import SHIFT, Health, Hidden, Verdict
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.faults import distance_faults
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell

KNOWN = ("frame", "targets")  # what may still be where it was
MIN_PLACING_POSES = 2  # poses that place an arm
MAX_POSE_DOUBLINGS = 6  # nobody measures more than 64 times as many poses
MIN_CONFIDENCE = 0.975  # one-sided: the 95 % interval lies on one side of what is required
CONFIDENCE_RANGE = (0.5, 0.9995)  # confidences that are reported
CONFIDENCE_BISECTIONS = 12
MIN_NOISIER_SIGMAS = 5.0  # standard deviations of a mean square that are worth a notice
MIN_WIDER = 1.5  # so much wider sigmas are too


def check(
    fit: Fit | Path | str,
    data: Measurements | Path | str,
    tolerance: str,
    *,
    known: str | Sequence[str] = (),
    seed: int = 0,
    simulated: bool = False,
) -> Health:
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
    limits = limits_of(tolerance)
    if not limits:
        raise OptionError(f"tolerance {tolerance!r}: write it in mm as rms 0.2, max 0.5")
    known = tuple(listed(known))
    for part in known:
        if part not in KNOWN:
            raise OptionError(f"known: {part!r} is none of {', '.join(KNOWN)}")
    check_seed(seed)
    fit, data = Fit.load(fit), read_measurements(data)
    robot = fit.cell.robot

    # What is open (frame, reflectors), beside what the calibration knows of the rest.
    watched, left_out = open_parameters(fit, data, known)
    check_arm(robot, watched.data)

    # What moved: score tests of the parameters on the new poses [Rao 1948].
    found = search(watched, match_names(fit, watched, fit.identification.active))
    before, after = found.before, found.after

    # Errors as if nothing had moved, and with what moved corrected, against what is required.
    error, corrected = placed_errors(watched, before), placed_errors(watched, after)
    verdicts = tuple(judge_limit(limit, error, watched.data, before.used, seed) for limit in limits)

    # No verdict can be that it is valid where the calibration itself is not, or where the points
    # were computed.
    noise = math.sqrt(3.0 * fit.uncertainty.noise.variance), "the calibration's noise"
    exact = replace(data, simulated=data.simulated or simulated)
    why = REFUSED.get(fit.status, "") or computed(
        exact, residual(error, before.used), noise, "the calibrated arm"
    )
    if why:
        sure = CONFIDENCE_RANGE[1]
        verdicts = tuple(replace(one, valid=False, confidence=sure, why=why) for one in verdicts)

    # The same with the points that were set aside.
    error, counted = with_spent_freedom(error, before.used), None
    if data.set_aside:
        cell = watched.cell
        now = Cell.of(robot, before.state, cell.target_names, cell.effects, cell.sessions)
        aside = errors_of(now, watched.data)
        counted = with_them(error, groups(watched.data), aside, seed=seed)

    refitted = refit(fit, watched, found)
    smallest_shifts, enough_poses, needed_poses = detectable_shifts(watched, found)
    return Health(
        robot=robot.name,
        verdicts=verdicts,
        moved=sized(watched, after, found.named),
        hidden=tuple(find_inseparable_zeros(watched, found)),
        accuracy=accuracy(error),
        refitted=accuracy(with_spent_freedom(corrected, after.used)),
        findable=smallest_shifts,
        sliding=frozenset(f"d{j + 1}" for j in np.flatnonzero(robot.prismatic)),
        enough=enough_poses,
        asked=needed_poses,
        noise=found.first.noise_ratio,
        poses=watched.data.poses,
        fit=replace(refitted, notices=(*refitted.notices, *left_out)),
        notices=(
            *data.notices,
            *(fault.text for fault in distance_faults(data)),
            *left_out,
            *warn_of_noise(found.first),
        ),
        set_aside=data.set_aside,
        with_them=counted,
    )


def find_inseparable_zeros(watched: Watched, found: Search) -> Iterator[Hidden]:
    """Zero positions that no data of this kind separate from what is open, and what would."""
    names, rows, link_count = watched.names, found.before.rows, 5 * watched.cell.robot.joints
    base = watched.open & (np.arange(names.count) < link_count + 6)
    for zero in watched.zeros:
        if zero in found.looked.column:
            continue
        column = np.array([zero])
        if base.any() and rows.share(column, base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors on the foot, or the old frame (known frame)"
            yield Hidden(names.all[zero], "the measurement frame", needs)
        elif rows.share(column, watched.open & ~base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors that were not touched (known targets)"
            yield Hidden(names.all[zero], "the tool", needs)
        else:
            yield Hidden(names.all[zero], "frame and tool", "poses that differ more")


def detectable_shifts(
    watched: Watched, found: Search
) -> tuple[dict[str, float], int | None, int | None]:
    """The smallest shift of each zero position that is found; poses that are enough, and needed."""
    tested, names = found.looked, watched.names.all
    zeros = tested.column[tested.zero]
    least = tested.least(found.first)[tested.zero]
    smallest = {names[i]: float(size) for i, size in zip(zeros, least, strict=True)}
    joints = [int(joint_of(names[i])[1:]) - 1 for i in zeros]
    turning = ~watched.cell.robot.prismatic[joints]
    if not turning.any():
        return smallest, None, None
    worst = float(np.max(least[turning]))
    needed = max(math.ceil(watched.data.poses * (worst / SHIFT) ** 2), MIN_PLACING_POSES)
    return smallest, (needed if worst <= SHIFT else None), needed


def warn_of_noise(both: Both) -> Iterator[str]:
    """Notices where the new poses are noisier than the calibration, or its model lacks much."""
    ratio, wider = both.noise_ratio, both.widest()
    if ratio**2 > 1.0 + MIN_NOISIER_SIGMAS * math.sqrt(2.0 / both.variances.dof):
        yield (
            f"the new poses are {ratio:.2g} times as noisy as the calibration: the instrument is "
            "noisier now, or more changed than is named"
        )
    if wider > MIN_WIDER:
        yield (
            f"the model lacks something: sigmas are up to {wider:.2g} times what noise alone would "
            "leave; a diagnosis says what"
        )


# ---- valid or not ------------------------------------------------------------------------------


def placed_errors(watched: Watched, placed: Placing) -> Array:
    """(m, k, 3) errors where base, targets and what moved are placed [m]."""
    state = placed.state
    model, _ = watched.fitted(np.zeros(watched.names.count, dtype=bool), state)
    return model.error(state) @ state.rotation.T


def with_spent_freedom(error: Array, used: float) -> Array:
    """Errors (m, k, 3) grown to n / (n - used) in the mean square: what placing took up, put back.

    used: coordinates, as of `Placing`.
    """
    count = 3 * int(np.isfinite(error[..., 0]).sum())
    return np.asarray(error * math.sqrt(count / max(count - used, 1.0)))


def judge_limit(limit: Limit, error: Array, data: Measurements, used: float, seed: int) -> Verdict:
    """One requirement against errors (m, k, 3) that placing took up `used` coordinates of."""
    grown, group = with_spent_freedom(error, used), groups(data)
    is_rms, required = limit.kind == "rms", 1e-3 * limit.size_mm
    kind = rms_interval if is_rms else max_interval

    def interval(level: float, copies: int = 1) -> Interval:
        copied = np.add.outer(len(group) * np.arange(copies), group).ravel()
        errors = np.tile(grown, (copies, 1, 1))
        return kind(errors, copied, level, rng=np.random.default_rng(seed))

    found = accuracy(grown)
    value = found.rms_mm if is_rms else found.max_mm
    ends = interval(2.0 * MIN_CONFIDENCE - 1.0)
    poses, unsure = len(np.unique(group)), CONFIDENCE_RANGE[0]
    verdict = partial(
        Verdict, limit.kind, limit.size_mm, value, (1e3 * ends.low, max(1e3 * ends.high, value))
    )
    seen = f"{KINDS[limit.kind]} {value:.3f} mm, at most {limit.size_mm:g} mm is required"
    if math.isnan(ends.low):
        return verdict(None, unsure, f"{seen}, and {poses} poses are too few to say")
    if not is_rms and (most := accuracy(error).max_mm) > limit.size_mm:
        return verdict(
            False, CONFIDENCE_RANGE[1],
            f"{KINDS['max']} {most:.3f} mm was seen, at most {limit.size_mm:g} mm is required",
        )  # fmt: skip
    if not is_rms and chance_of_larger(poses) > MAX_EXCEED_CHANCE:
        return verdict(None, unsure, f"{seen}, and a maximum needs at least {MIN_POSES} poses")

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
    needed = poses_to_decide(copied, 1e-3 * value, required, poses)
    return verdict(None, sure, f"{seen}: {needed} poses like these decide")


def poses_to_decide(
    interval: Callable[[int], Interval], value: float, size: float, poses: int
) -> str:
    """How many poses decide on which side of a limit an RMS lies, in words.

    Half of all sessions of so many are decided: the interval of an RMS as seen just excludes the
    limit.  The intervals are those of 1, 2, 4 ... copies of these poses, a power law between.
    interval: of so many copies.  value: the RMS that was seen [m].  size: the limit [m].  poses:
    how many were seen.
    """
    side = int(value < size)
    wanted, width = abs(math.log(size / value)), math.inf
    for doubled in range(MAX_POSE_DOUBLINGS + 1):
        last = width
        end = float(np.clip(interval(2**doubled)[side] / value, 1.0 / FARTHEST, FARTHEST))
        width = abs(math.log(end))
        if width <= wanted:
            power = math.log(last / wanted) / math.log(last / width) if doubled else 1.0
            few = poses / (poses - 1.0)  # spread of copies, which are no new poses
            count = max(few * poses * 2.0 ** (doubled - 1.0 + power), poses + 1.0)
            return f"about {float(f'{count:.2g}'):.0f}"
    return f"more than {poses * 2**MAX_POSE_DOUBLINGS}"
