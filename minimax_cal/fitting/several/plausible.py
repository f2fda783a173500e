"""Slips that no fit should be asked to explain, and fits that are no calibration of their arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT, check_mends, check_plausible
from minimax_cal.fitting.claims import MAX_MISS_OF_REACH
from minimax_cal.fitting.several.fit import (
    InstrumentFit,
    Train,
    allowed_of,
    stack_of,
    start_of,
)
from minimax_cal.fitting.several.options import RelativeOptions, sigmas_of
from minimax_cal.fitting.several.result import Measured
from minimax_cal.fitting.several.stack import Block, Stack, own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import PLENTY, Instrument, Slip, anywhere
from minimax_cal.instruments.options import FAR
from minimax_cal.instruments.protocol import Arm, FlangePoses
from minimax_cal.measuring.slips import of_joints, of_units
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot

RESIZED = 0.25  # of what the arm sweeps: a fit that changes it by more is of no arm


def check_slips(robot: Robot, data: Instrument, options: RelativeOptions) -> None:
    """Raise DataError or OptionError for slips that show where the arm as drawn is fitted."""
    if data.seen.target_names:
        seen = (data.ready(robot, options) if data.options else data).seen
        try:
            check_plausible(robot, seen)
        except DataError as wrong:  # the user's columns have other names
            raise DataError(str(wrong).replace("smr1_x_", data.first_column)) from wrong
        return

    def fitted(one: Instrument) -> tuple[Any, FlangePoses, Array]:
        stack = stack_of(robot, [Train("", one)], options)
        x = start_of(robot, stack, allowed_of(stack, options)[0])
        block = stack.blocks[0]
        return block.instrument, block.flange(x), block.own(x)

    data.check_given(fitted)
    some, good = data.tried(), POOR_FIT * robot.reach()
    given = measured(*fitted(some))
    if np.sqrt(given[0]) <= good:
        data.check_start(fitted, partial(farthest, robot, options))
        return
    check_mends(
        data.at.source,
        given,
        (some.slips(), slips_of_joints(robot, some)),
        lambda mended: measured(*fitted(mended)),
        good,
    )


def measured(one: Instrument, arm: FlangePoses, own: Array) -> tuple[float, float]:
    """Mean square of the misses, and that over what it is to be seen by.

    The target's spread where an arm that hardly moves fits anything [m^2].
    """
    square = one.mean_square(arm, own)
    if not one.shrinks:
        return square, square
    place = arm.place(one.targets(own)[0])
    return square, square / max(float(place.var(axis=0).sum()), 1e-12)


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
    for text, mended in (*of_units(robot, data.at), *of_joints(robot, data.at)):
        if (mended.q != data.at.q).any():  # else of points, which are not measured here
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
