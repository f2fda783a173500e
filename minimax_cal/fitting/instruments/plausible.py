"""Slips of lengths and closures that no fit should be asked to explain: units, signs, offsets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from minimax_cal.fitting.checks import EXPLAINED, MAX_TRIAL_POSES, POOR_FIT
from minimax_cal.fitting.claims import MAX_MISS_OF_REACH
from minimax_cal.fitting.identify import plenty_of_poses
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.fit import (
    InstrumentFit,
    allowed_of,
    fit_instrument,
    instrument_of,
    start_of,
)
from minimax_cal.fitting.instruments.options import (
    RelativeOptions,
    known_text,
    sigmas_of,
    silent,
)
from minimax_cal.fitting.instruments.result import RelativeCalibration
from minimax_cal.fitting.instruments.rows import Closures, Instrument, places
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.measuring.slips import of_couplings, of_signs, of_units
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot

BETTER = 0.25  # of the mean square: what explains so much is worth a look
LEAST = 5e-3  # a fit that misses by less leaves nothing to explain [mm]
FAR = 4.0  # sigmas of a prior that an arm may be off
RESIZED = 0.25  # of what the arm sweeps: a fit that changes it by more is of no arm


def check_plausible(robot: Robot, data: RelativeData, options: RelativeOptions) -> None:
    """Raise CalibrationError for slips that show where the arm as drawn is fitted.

    All rows are looked at, those held out too: they judge the fit.
    """
    data = data.take(some(data))
    instrument, state = started(robot, data, options)
    given, limit = mean_square(instrument, state), POOR_FIT * robot.reach()
    if np.sqrt(given) <= limit:
        check_known(robot, data, options, instrument, state)
        return
    whole = size(instrument, state)
    trials = []
    for text, mended in slips(robot, data):
        at = started(robot, mended, options)
        trials.append((mean_square(*at) / size(*at), mean_square(*at), text))
        if mended.length is not data.length and np.sqrt(trials[-1][1]) <= limit:
            break  # a unit that fits leaves nothing to ask of joints
    least = min(share for share, _, _ in trials)
    share, square, text = next(trial for trial in trials if trial[0] <= 2.0 * least)
    if np.sqrt(square) <= 4.0 * limit and share < EXPLAINED * given / whole:
        raise DataError(
            f"{data.at.source}: {text} (the nominal robot then misses by "
            f"{1e3 * np.sqrt(square):.3g} mm, not {1e3 * np.sqrt(given):.3g} mm)"
        )


def some(data: RelativeData) -> Array:
    """(m,) True for rows enough to find a slip: all closures, `MAX_TRIAL_POSES` of each wire."""
    if data.kind != "distances":
        return np.ones(data.poses, dtype=bool)
    chosen = np.zeros(data.poses, dtype=bool)
    for length in data.length.T:
        seen = np.flatnonzero(np.isfinite(length))
        chosen[seen[np.linspace(0, len(seen) - 1, min(len(seen), MAX_TRIAL_POSES)).astype(int)]] = (
            True
        )
    return chosen


def started(robot: Robot, data: RelativeData, options: RelativeOptions) -> tuple[Instrument, State]:
    """The measurements, and what fits the arm as drawn best."""
    instrument = instrument_of(robot, data, options)
    allowed, _ = allowed_of(robot, instrument, options)
    return instrument, start_of(robot, instrument, data.at.q, allowed)


def mean_square(instrument: Instrument, state: State) -> float:
    """Of the misses of lengths, or of visits about their socket [m^2]."""
    if isinstance(instrument, Closures):
        off = instrument.centred(places(instrument.model, state))
        return float((off**2).sum(axis=0).mean())
    return float(np.nanmean(instrument.errors(state) ** 2))


def size(instrument: Instrument, state: State) -> float:
    """What a mean square of closures is to be seen by: an arm that hardly moves closes anything."""
    if not isinstance(instrument, Closures):
        return 1.0
    place = places(instrument.model, state)
    return max(float(place.var(axis=-1).sum()), 1e-12)


def slips(robot: Robot, data: RelativeData) -> Iterator[tuple[str, RelativeData]]:
    """Slips worth testing: what to say, and the data with the slip mended."""
    if data.kind == "distances":
        yield (
            "the lengths look like millimetres given as metres: name the columns wire1_mm, ...",
            replace(data, length=1e-3 * data.length),
        )
        yield (
            "the lengths look like metres given as millimetres: name the columns wire1_m, ...",
            replace(data, length=1e3 * data.length),
        )
    given = robot, data.at
    for text, mended in (*of_units(*given), *of_couplings(*given), *of_signs(*given)):
        if mended.q is not data.at.q:  # else of points, which are not measured here
            yield text, replace(data, at=mended)


def check_known(
    robot: Robot,
    data: RelativeData,
    options: RelativeOptions,
    instrument: Instrument,
    state: State,
) -> None:
    """Raise OptionError for a known distance that no arm like the drawn one can have."""
    if not isinstance(instrument, Closures):
        return
    centre = instrument.barycentres(places(instrument.model, state)).T
    limits = farthest(robot, options, instrument, state)
    pairs = zip(options.known_distances, instrument.pairs, limits, strict=True)
    for known, (a, b), limit in pairs:
        drawn, told = float(np.linalg.norm(centre[a] - centre[b])), known[2]
        if abs(drawn - told) <= limit:
            continue
        metres = "; metres? give millimetres" if abs(drawn - 1e3 * told) <= limit else ""
        raise OptionError(
            f"{known_text(known)}: by the arm as drawn these sockets of {data.at.source} are "
            f"{1e3 * drawn:.4g} mm apart{metres or '; check the labels and the length'}"
        )


def farthest(
    robot: Robot, options: RelativeOptions, closures: Closures, state: State
) -> list[float]:
    """By how much the drawn arm may miss each known distance: more where priors let it [m]."""
    sigma = sigmas_of(closures.names, options)
    free = np.pad(np.isfinite(sigma), (0, closures.names.count - len(sigma)))
    limit = 4.0 * POOR_FIT * robot.reach()
    if not (free.any() and len(closures.pairs)):
        return [limit] * len(closures.pairs)
    _, jacobian = closures.rows(state, free)
    slope = jacobian[:, -len(closures.pairs) :] / np.sqrt(closures.weights[-1])
    spread = np.linalg.norm(slope * sigma[np.isfinite(sigma)][:, None], axis=0)
    return [limit + FAR * float(one) for one in spread]


def contradiction(
    robot: Robot, data: RelativeData, fit: InstrumentFit, result: RelativeCalibration, offset: str
) -> str:
    """Why the fit is no calibration of this arm; '' where it is one.

    offset: what the lengths say of offsets that were not fitted, see `offset_told`.
    """
    closing, limit_mm = data.kind == "closures", 1e3 * MAX_MISS_OF_REACH * robot.reach()
    which = "the labels of the sockets" if closing else "which length is which wire's"
    for key, what in (("train", "training"), ("holdout", "held-out")):
        miss_mm = result.accuracy[key].rms_mm
        if miss_mm > limit_mm:
            return (
                f"the fit misses the {what} rows by {miss_mm:.3g} mm, more than "
                f"{100 * MAX_MISS_OF_REACH:g} % "
                "of the arm's reach: it is no calibration of this arm; check the robot file, joint "
                f"signs, units and {which}"
            )
    before, after = (swept(robot, fit.instrument, x) for x in (fit.nominal, fit.state))
    if abs(after - before) > RESIZED * before:
        return (
            f"the fit makes an arm that sweeps {before:.3g} m one that sweeps {after:.3g} m: it is "
            f"no calibration of this arm; check the robot file, joint signs, units and {which}"
        )
    nominal, calibrated, _ = result.before_and_after()
    if offset and calibrated.rms_mm > nominal.rms_mm:
        return "the fit is worse than the arm as drawn: fit the wires' zeros with offset="
    return ""


def swept(robot: Robot, instrument: Instrument, state: State) -> float:
    """Spread of the target over the joints' range [m]."""
    place = places(plenty_of_poses(robot, instrument.model), state)
    return float(np.sqrt(place.var(axis=-1).sum()))


def offset_told(
    robot: Robot, train: RelativeData, options: RelativeOptions, fit: InstrumentFit
) -> str:
    """A notice where an offset of each wire explains what the fit leaves; '' where not."""
    if train.kind != "distances" or options.offset or spread_mm(fit) < LEAST:
        return ""
    try:
        more = fit_instrument(robot, train, replace(options, offset=True), silent)
    except DataError:  # too few lengths for so many unknowns
        return ""
    if spread_mm(more) ** 2 > BETTER * spread_mm(fit) ** 2:
        return ""
    return (
        f"with an offset of each wire the lengths fit to {spread_mm(more):.3g} mm, without to "
        f"{spread_mm(fit):.3g} mm: the wires' zeros look off; fit them with offset="
    )


def spread_mm(fit: InstrumentFit) -> float:
    """What a fit leaves of a length, by its spare numbers."""
    dof = max(fit.numbers - int(fit.identification.active.sum()), 1)
    return 1e3 * float(np.sqrt(fit.found.cost[0] / dof))
