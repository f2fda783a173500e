"""Slips that no fit should be asked to explain, and fits that are no calibration of their arm."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import EXPLAINED, POOR_FIT
from minimax_cal.fitting.claims import MAX_MISS_OF_REACH
from minimax_cal.fitting.identify import plenty_of_poses
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.fit import (
    InstrumentFit,
    Train,
    allowed_of,
    stack_of,
    start_of,
)
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.fitting.instruments.result import Measured
from minimax_cal.fitting.instruments.table import instrument_of
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.slips import of_couplings, of_signs, of_units
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

RESIZED = 0.25  # of what the arm sweeps: a fit that changes it by more is of no arm
Slip = tuple[str, RelativeData]  # what to say, and the data with the slip mended


def started(robot: Robot, data: RelativeData, options: RelativeOptions) -> tuple[Any, State]:
    """The measurements, and what fits the arm as drawn best."""
    stack = stack_of(robot, [Train("", data)], options)
    allowed, _ = allowed_of(stack, options)
    return stack.blocks[0], start_of(robot, stack, allowed)


def check_slips(
    robot: Robot,
    data: RelativeData,
    options: RelativeOptions,
    own: Iterable[Slip] = (),
) -> tuple[Any, State] | None:
    """The arm as drawn, `started`; None where it is far off.  Raises DataError for a slip.

    own: slips of the instrument, besides those of joints, of which nothing is asked where one of
    these fits.
    """
    block, x = started(robot, data, options)
    given, limit = block.mean_square(x), POOR_FIT * robot.reach()
    if np.sqrt(given) <= limit:
        return block, x

    def tried(slips: Iterable[Slip]) -> list[tuple[float, float, str]]:
        found = [(text, *started(robot, mended, options)) for text, mended in slips]
        squares = [(one.mean_square(at), one.size(at), text) for text, one, at in found]
        return [(square / size, square, text) for square, size, text in squares]

    trials = tried(own)
    if all(np.sqrt(square) > limit for _, square, _ in trials):
        trials += tried(slips_of_joints(robot, data))
    least = min(share for share, _, _ in trials)
    share, square, text = next(trial for trial in trials if trial[0] <= 2.0 * least)
    if np.sqrt(square) <= 4.0 * limit and share < EXPLAINED * given / block.size(x):
        raise DataError(
            f"{data.at.source}: {text} (the nominal robot then misses by "
            f"{1e3 * np.sqrt(square):.3g} mm, not {1e3 * np.sqrt(given):.3g} mm)"
        )
    return None


def slips_of_joints(robot: Robot, data: RelativeData) -> Iterator[Slip]:
    """Those of their units, couplings and signs."""
    given = robot, data.at
    for text, mended in (*of_units(*given), *of_couplings(*given), *of_signs(*given)):
        if mended.q is not data.at.q:  # else of points, which are not measured here
            yield text, replace(data, at=mended)


def contradiction(
    robot: Robot,
    every: Sequence[RelativeData],
    fit: InstrumentFit,
    measured: Sequence[Measured],
    mends: Sequence[str],
) -> str:
    """Why the fit is no calibration of this arm; '' where it is one.

    mends: of what was not fitted of each and the residuals show, '' where nothing is.
    """
    limit_mm = 1e3 * MAX_MISS_OF_REACH * robot.reach()
    which = " and ".join(dict.fromkeys(instrument_of(d).words.check for d in every))
    for data, one in zip(every, measured, strict=True):
        of_file = f" of {data.at.source}" if len(every) > 1 else ""
        for key, what in (("train", "training"), ("holdout", "held-out")):
            miss_mm = one.accuracy[key].rms_mm
            if miss_mm > limit_mm:
                return (
                    f"the fit misses the {what} rows{of_file} by {miss_mm:.3g} mm, more than "
                    f"{100 * MAX_MISS_OF_REACH:g} % "
                    "of the arm's reach: it is no calibration of this arm; check the robot file, "
                    f"joint signs, units and {which}"
                )
    before, after = (swept(robot, fit, x) for x in (fit.nominal, fit.state))
    if abs(after - before) > RESIZED * before:
        return (
            f"the fit makes an arm that sweeps {before:.3g} m one that sweeps {after:.3g} m: it is "
            f"no calibration of this arm; check the robot file, joint signs, units and {which}"
        )
    for mend, one in zip(mends, measured, strict=True):
        nominal, calibrated, _ = one.before_and_after()
        if mend and calibrated.rms_mm > nominal.rms_mm:
            return f"the fit is worse than the arm as drawn: {mend}"
    return ""


def swept(robot: Robot, fit: InstrumentFit, state: State) -> float:
    """Spread of the first file's targets over the joints' range [m]."""
    block = fit.stack.blocks[0]
    plenty = plenty_of_poses(robot, block.model)
    links = kinematics.chain(state.mdh, plenty.q, plenty.prismatic)
    spots = block.arm_state(fit.stack.part(state, 0)).target_positions
    place = kinematics.points(links, spots).mean(axis=0)
    return float(np.sqrt(place.var(axis=-1).sum()))
