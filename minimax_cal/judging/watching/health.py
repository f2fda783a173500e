"""Is a calibration still valid after a knock or a service?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.accuracy import (
    FARTHEST,
    Accuracy,
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
from minimax_cal.judging.watching.moved import MIN_OWN_MOTION, Search, joint_of, search, sized
from minimax_cal.judging.watching.opening import in_names, watched_of
from minimax_cal.judging.watching.placing import Placing
from minimax_cal.judging.watching.refit import refit
from minimax_cal.judging.watching.result import SHIFT, Health, Hidden, Verdict
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.faults import distance_faults
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.modelling.cell import Cell

PLACE_AN_ARM = 2  # poses that place an arm
DOUBLINGS = 6  # of the poses: nobody measures more than 64 times as many


def hidden(watched: Watched, found: Search) -> Iterator[Hidden]:
    """Zero positions that nobody could tell from what is open, and what would tell them."""
    names, n = watched.names, watched.cell.robot.joints
    lost = [i for i in watched.zeros if i not in found.looked.column]
    place = np.arange(names.count)
    base = watched.open & (place < 5 * n + 6)
    for i in lost:
        alone = np.array([i])
        if base.any() and found.before.rows.share(alone, base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors on the foot, or the old frame (known frame)"
            yield Hidden(names.all[i], "the measurement frame", needs)
        elif found.before.rows.share(alone, watched.open & ~base)[0] <= MIN_OWN_MOTION:
            needs = "reflectors that were not touched (known targets)"
            yield Hidden(names.all[i], "the tool", needs)
        else:
            yield Hidden(names.all[i], "frame and tool", "poses that differ more")


def prospects(watched: Watched, found: Search) -> tuple[dict[str, float], int | None, int | None]:
    """The smallest shift of each zero position that is found; poses that are enough, and needed."""
    rows, looked = found.first, found.looked
    zero = looked.column[looked.zero]
    if not len(zero):
        return {}, None, None
    least = looked.least(rows)[looked.zero]
    names = watched.names.all
    findable = {names[i]: float(size) for i, size in zip(zero, least, strict=True)}
    turning = ~watched.cell.robot.prismatic[[int(joint_of(names[i])[1:]) - 1 for i in zero]]
    if not turning.any():
        return findable, None, None
    worst = float(np.max(least[turning]))
    wanted = max(math.ceil(watched.data.poses * (worst / SHIFT) ** 2), PLACE_AN_ARM)
    return findable, (wanted if worst <= SHIFT else None), wanted


def to_decide(interval: Callable[[int], Interval], value: float, size: float, poses: int) -> str:
    """How many poses decide on which side of a limit an RMS lies, in words.

    Half of all sessions of so many are decided: the interval of an RMS as seen just excludes the
    limit.  The intervals are those of 1, 2, 4 ... copies of these poses, a power law between.
    interval: of so many copies.  value: the RMS that was seen [m].  size: the limit [m].  poses:
    how many were seen.
    """
    side = int(value < size)
    wanted, width = abs(math.log(size / value)), math.inf
    for doubled in range(DOUBLINGS + 1):
        last = width
        end = float(np.clip(interval(2**doubled)[side] / value, 1.0 / FARTHEST, FARTHEST))
        width = abs(math.log(end))
        if width <= wanted:
            power = math.log(last / wanted) / math.log(last / width) if doubled else 1.0
            few = poses / (poses - 1.0)  # spread of copies, which are no new poses
            count = max(few * poses * 2.0 ** (doubled - 1.0 + power), poses + 1.0)
            return f"about {float(f'{count:.2g}'):.0f}"
    return f"more than {poses * 2**DOUBLINGS}"


# ---- how it does ---------------------------------------------------------------------------------


KNOWN = ("frame", "targets")  # what may still be where it was
MIN_CONFIDENCE = 0.975  # one-sided: the 95 % interval lies on one side of what is required
CONFIDENCE_RANGE = (0.5, 0.9995)  # confidences that are told
MIN_NOISIER_SIGMAS = 5.0  # standard deviations of a mean square that are worth a word
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
    limits, known = required(tolerance), checked_known(known)
    check_seed(seed)
    fit = Fit.load(fit)
    data = read_measurements(data)
    watched, said = watched_of(fit, data, known)
    check_arm(fit.cell.robot, watched.data)
    links = in_names(fit, watched, fit.identification.active)
    found = search(watched, links)
    error, after_it = (left(watched, placed) for placed in (found.before, found.after))
    used = found.before.used
    verdicts = tuple(verdict(limit, error, watched.data, used, seed) for limit in limits)
    exact = replace(data, simulated=data.simulated or simulated)
    if why := refused(fit, exact, residual(error, used)):
        verdicts = tuple(
            replace(one, valid=False, confidence=CONFIDENCE_RANGE[1], why=why) for one in verdicts
        )
    after = refit(fit, watched, found)
    spread, enough, asked = prospects(watched, found)
    return Health(
        robot=fit.cell.robot.name,
        verdicts=verdicts,
        moved=sized(watched, found.after, found.named),
        hidden=tuple(hidden(watched, found)),
        accuracy=accuracy(grown(error, found.before.used)),
        refitted=accuracy(grown(after_it, found.after.used)),
        findable=spread,
        sliding=frozenset(f"d{j + 1}" for j in np.flatnonzero(fit.cell.robot.prismatic)),
        enough=enough,
        asked=asked,
        noise=found.first.noise_ratio,
        poses=watched.data.poses,
        fit=replace(after, notices=(*after.notices, *said)),
        notices=(
            *data.notices,
            *(fault.text for fault in distance_faults(data)),
            *said,
            *remarks(watched, found),
        ),
        set_aside=data.set_aside,
        with_them=counting_all(watched, found.before, seed) if data.set_aside else None,
    )


def required(tolerance: str) -> tuple[Limit, ...]:
    """What is required.  Raises OptionError."""
    limits = limits_of(tolerance)
    if not limits:
        raise OptionError(f"tolerance {tolerance!r}: write it in mm as rms 0.2, max 0.5")
    return limits


def checked_known(known: str | Sequence[str]) -> tuple[str, ...]:
    """What is where it was.  Raises OptionError."""
    for part in listed(known):
        if part not in KNOWN:
            raise OptionError(f"known: {part!r} is none of {', '.join(KNOWN)}")
    return tuple(listed(known))


def refused(fit: Fit, data: Measurements, missed: float) -> str:
    """Why no verdict can be that the calibration is valid; empty where one can.

    missed: `residual` of the new points [m].
    """
    noise = math.sqrt(3.0 * fit.uncertainty.noise.variance), "the calibration's noise"
    return REFUSED.get(fit.status, "") or computed(data, missed, noise, "the calibrated arm")


# ---- valid or not ------------------------------------------------------------------------------


def left(watched: Watched, placed: Placing) -> Array:
    """(m, k, 3) errors as placed [m]."""
    state = placed.state
    model, _ = watched.fitted(np.zeros(watched.names.count, dtype=bool), state)
    return model.error(state) @ state.rotation.T


def counting_all(watched: Watched, placed: Placing, seed: int) -> Accuracy:
    """The accuracy as placed, where the points that were set aside count too."""
    cell, error = watched.cell, grown(left(watched, placed), placed.used)
    now = Cell.of(cell.robot, placed.state, cell.target_names, cell.effects, cell.sessions)
    return with_them(error, groups(watched.data), errors_of(now, watched.data), seed=seed)


def grown(error: Array, used: float) -> Array:
    """Errors (m, k, 3) with what placing took off them put back; used: as of `Placing`."""
    count = 3 * int(np.isfinite(error[..., 0]).sum())
    return np.asarray(error * math.sqrt(count / max(count - used, 1.0)))


def verdict(limit: Limit, error: Array, data: Measurements, used: float, seed: int) -> Verdict:
    """One requirement against errors (m, k, 3) that placing took up `used` coordinates of."""
    larger = grown(error, used)
    group, rms = groups(data), limit.kind == "rms"
    kind = rms_interval if rms else max_interval

    def interval(level: float, copies: int = 1) -> Interval:
        each = np.add.outer(len(group) * np.arange(copies), group).ravel()
        error = np.tile(larger, (copies, 1, 1))
        return kind(error, each, level, rng=np.random.default_rng(seed))

    found = accuracy(larger)
    value = found.rms_mm if rms else found.max_mm
    ends = interval(2.0 * MIN_CONFIDENCE - 1.0)
    span = 1e3 * ends.low, max(1e3 * ends.high, value)
    poses = len(np.unique(group))
    told = partial(Verdict, limit.kind, limit.size_mm, value, span)
    seen = f"{KINDS[limit.kind]} {value:.3f} mm, at most {limit.size_mm:g} mm is required"
    if math.isnan(ends.low):
        return told(None, CONFIDENCE_RANGE[0], f"{seen}, and {poses} poses are too few to say")
    if not rms and (most := accuracy(error).max_mm) > limit.size_mm:
        return told(
            False, CONFIDENCE_RANGE[1],
            f"{KINDS['max']} {most:.3f} mm was seen, at most {limit.size_mm:g} mm is required",
        )  # fmt: skip
    if not rms and chance_of_larger(poses) > MAX_EXCEED_CHANCE:
        said = f"{seen}, and a maximum needs at least {MIN_POSES} poses"
        return told(None, CONFIDENCE_RANGE[0], said)
    sure = confidence(interval, 1e-3 * limit.size_mm, above=value > limit.size_mm)
    if sure >= MIN_CONFIDENCE:
        return told(value <= limit.size_mm, sure, seen)
    if not rms:  # which grows with the poses
        return told(None, sure, f"{seen}: more poses may decide")
    copied = partial(interval, 2.0 * MIN_CONFIDENCE - 1.0)
    many = to_decide(copied, 1e-3 * value, 1e-3 * limit.size_mm, poses)
    return told(None, sure, f"{seen}: {many} poses like these decide")


def confidence(interval: Any, size: float, *, above: bool) -> float:
    """The largest one-sided confidence at which an interval lies on one side of a size."""
    low, high = CONFIDENCE_RANGE
    for _ in range(12):
        middle = 0.5 * (low + high)
        ends = interval(2.0 * middle - 1.0)
        holds = ends.low > size if above else ends.high < size
        low, high = (middle, high) if holds else (low, middle)
    return low


def remarks(watched: Watched, found: Search) -> Iterator[str]:
    """What the reader should know."""
    ratio, dof = found.first.noise_ratio, found.first.variances.dof
    if ratio**2 > 1.0 + MIN_NOISIER_SIGMAS * math.sqrt(2.0 / dof):
        yield (
            f"the new poses are {ratio:.2g} times as noisy as the calibration: the instrument is "
            "noisier now, or more changed than is named"
        )
    wider = found.first.widest()
    if wider > MIN_WIDER:
        yield (
            f"the model lacks something: sigmas are up to {wider:.2g} times what noise alone would "
            "leave; a diagnosis says what"
        )
