"""Slips that no fit should be asked to explain, and fits that are no calibration of their arm."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import EXPLAINED, POOR_FIT, check_plausible
from minimax_cal.fitting.claims import MAX_MISS_OF_REACH
from minimax_cal.fitting.several.fit import (
    InstrumentFit,
    Train,
    allowed_of,
    stack_of,
    start_of,
)
from minimax_cal.fitting.several.options import FAR, RelativeOptions, sigmas_of
from minimax_cal.fitting.several.result import Measured
from minimax_cal.fitting.several.stack import Block, Stack, own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import PLENTY, Instrument, Slip, anywhere
from minimax_cal.instruments.protocol import Arm, FlangePoses
from minimax_cal.measuring.slips import of_couplings, of_signs, of_units
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot

RESIZED = 0.25  # of what the arm sweeps: a fit that changes it by more is of no arm


def check_slips(robot: Robot, data: Instrument, options: RelativeOptions) -> None:
    """Raise DataError or OptionError for slips that show where the arm as drawn is fitted."""
    if data.seen.target_names:
        check_points(robot, data.ready(robot, options) if data.options else data)
        return

    def fitted(one: Instrument) -> tuple[Any, FlangePoses, Array]:
        stack = stack_of(robot, [Train("", one)], options)
        x = start_of(robot, stack, allowed_of(stack, options)[0])
        block = stack.blocks[0]
        return block.instrument, block.flange(x), block.own(x)

    data.check_given(fitted)
    some = data.tried()
    one, arm, own = fitted(some)
    given, limit = one.mean_square(arm, own), POOR_FIT * robot.reach()
    if np.sqrt(given) <= limit:
        data.check_start(fitted, lambda ready, own: farthest(robot, options, ready, own))
        return

    def tried(slips: Iterable[Slip]) -> list[tuple[float, float, str]]:
        out = []
        for text, mended in slips:
            square, size = measured(*fitted(mended))
            out.append((square / size, square, text))
        return out

    trials = tried(some.slips())
    if all(np.sqrt(square) > limit for _, square, _ in trials):
        trials += tried(slips_of_joints(robot, some))
    least = min(share for share, _, _ in trials)
    share, square, text = next(trial for trial in trials if trial[0] <= 2.0 * least)
    if np.sqrt(square) <= 4.0 * limit and share < EXPLAINED * given / measured(one, arm, own)[1]:
        raise DataError(
            f"{data.at.source}: {text} (the nominal robot then misses by "
            f"{1e3 * np.sqrt(square):.3g} mm, not {1e3 * np.sqrt(given):.3g} mm)"
        )


def measured(one: Instrument, arm: FlangePoses, own: Array) -> tuple[float, float]:
    """Mean square of the misses, and by what it is to be seen.

    The target's spread where an arm that hardly moves fits anything [m^2].
    """
    place = arm.place(one.targets(own)[0]) if one.shrinks else np.zeros((1, 3))
    size = max(float(place.var(axis=0).sum()), 1e-12) if one.shrinks else 1.0
    return one.mean_square(arm, own), size


def check_points(robot: Robot, data: Instrument) -> None:
    """Raise DataError for slips, by points in space."""
    try:
        check_plausible(robot, data.seen)
    except DataError as wrong:  # the user's columns have other names
        raise DataError(str(wrong).replace("smr1_x_", data.first_column)) from wrong


def farthest(robot: Robot, options: RelativeOptions, one: Instrument, own: Array) -> Array:
    """(c,) by how much the drawn arm may miss each known sum: more where priors let it [m]."""
    block = Block.of(robot, one)
    names = Stack.of(robot, [one], [""]).names
    sigma = sigmas_of(names, options)
    free = np.pad(np.isfinite(sigma), (0, names.count - len(sigma)))
    x = own_state(robot.mdh, own)
    rows, limit = block.read(x), 4.0 * POOR_FIT * robot.reach()
    count = len(rows.short)
    if not (free.any() and count):
        return np.full(count, limit)
    slope = block.rows(x, free)[1][:, -count:] / np.sqrt(rows.heavy)
    return np.asarray(limit + FAR * np.linalg.norm(slope * sigma[free[: len(sigma)], None], axis=0))


def slips_of_joints(robot: Robot, data: Instrument) -> Iterator[Slip]:
    """Those of their units, couplings and signs."""
    given = robot, data.at
    for text, mended in (*of_units(*given), *of_couplings(*given), *of_signs(*given)):
        if mended.q is not data.at.q:  # else of points, which are not measured here
            yield text, replace(data, at=mended)


def contradiction(
    robot: Robot,
    every: Sequence[Instrument],
    fit: InstrumentFit,
    measured: Sequence[Measured],
    mends: Sequence[str],
) -> str:
    """Why the fit is no calibration of this arm; '' where it is one.

    mends: of what was not fitted of each and the residuals show, '' where nothing is.
    """
    limit_mm = 1e3 * MAX_MISS_OF_REACH * robot.reach()
    which = " and ".join(dict.fromkeys(d.words.check for d in every))
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
    """Spread of the first instrument's targets over the joints' range [m]."""
    x, block = fit.stack.part(state, 0), fit.stack.blocks[0]
    arm = Arm.of(robot, anywhere(robot, PLENTY).q).at(state.mdh)
    place = arm.place(block.instrument.targets(block.own(x))).mean(axis=1)
    return float(np.sqrt(place.var(axis=0).sum()))
