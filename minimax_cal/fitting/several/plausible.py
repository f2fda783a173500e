"""Slips that no fit should be asked to explain, and what the reader of a result should know."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT, check_mends, check_plausible, wild
from minimax_cal.fitting.identify import Because
from minimax_cal.fitting.outcome import MAX_ROTATION_MISS
from minimax_cal.fitting.several.fit import (
    InstrumentFit,
    allowed_of,
    fit_instruments,
    stack_of,
    start_of,
)
from minimax_cal.fitting.several.identify import identified
from minimax_cal.fitting.several.options import RelativeOptions, sigmas_of, silent
from minimax_cal.fitting.several.result import Measured, RelativeCalibration
from minimax_cal.fitting.several.stack import Block, Stack, own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import METRE, RADIAN, Instrument, Slip
from minimax_cal.instruments.options import FAR
from minimax_cal.instruments.protocol import Arm, FlangePoses
from minimax_cal.instruments.reflectors import LEVER
from minimax_cal.instruments.table import is_registered
from minimax_cal.measuring import checks
from minimax_cal.measuring.slips import of_columns, of_joints, of_rows, of_units
from minimax_cal.modelling.model import TARGET
from minimax_cal.modelling.parameters import Names, links_of
from minimax_cal.robots.robot import Robot


def check_slips(robot: Robot, data: Instrument, options: RelativeOptions) -> None:
    """Raise DataError or OptionError for slips that show where the arm as drawn is fitted."""
    checks.check_span(data.at)
    if data.seen.target_names:
        check_rotations(robot, data, options)
        seen = (data.ready(robot, options) if data.options else data).seen
        try:
            check_plausible(robot, seen)
        except DataError as wrong:  # the user's columns have other names
            text = str(wrong).replace("smr1_x_", data.first_column)
            if data.first_column != Instrument.first_column:  # `import` writes points alone
                text = COMMAND.sub("correct the file", text)
            raise DataError(text) from wrong
        return

    def fitted(one: Instrument) -> tuple[Any, FlangePoses, Array]:
        stack = stack_of(robot, {"": one}, options)
        x = start_of(robot, stack, allowed_of(stack, options)[0])
        block = stack.blocks[0]
        return block.instrument, *block.at(x)

    data.check_given(fitted)
    some, size = data.tried(), {METRE: robot.reach(), RADIAN: 1.0}
    good = POOR_FIT * size.get(data.unit, np.inf)  # of other units nobody knows what is poor
    given = measured(*fitted(some))
    if np.sqrt(given[0]) <= good:
        data.check_start(fitted, partial(farthest, robot, options))
        return
    check_mends(
        data.at.source,
        given,
        (some.slips(), slips_of_joints(robot, some), slips_of_rows(data)),
        lambda mended: measured(*fitted(mended)),
        good,
        unit=data.unit,
    )


def check_rotations(robot: Robot, data: Instrument, options: RelativeOptions) -> None:
    """Raise DataError where rotations are met as other columns hold them, and not as they stand.

    Rotations of another order or kind may leave the places that are measured beside them as small
    as they are.
    """
    if not any(True for _ in data.slips()):
        return

    def misses(one: Instrument) -> tuple[float, float]:
        ready, arm = one.ready(robot, options), Arm.of(robot, one.at.q).at(robot.mdh)
        turns = ready.turns(arm, ready.starts(arm, np.zeros(0))[0])
        square = float((turns**2).mean()) if len(turns) else 0.0
        return square * LEVER**2, square

    some = data.tried()
    given = misses(some)
    if np.sqrt(given[1]) <= MAX_ROTATION_MISS:
        return
    check_mends(
        data.at.source, given, (some.slips(),), misses, MAX_ROTATION_MISS * LEVER, limit=1.0,
        said="the rotations of the drawn arm then miss by {:.3g} mm at 100 mm, not {:.3g} mm",
    )  # fmt: skip


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
    """Those of their units, columns, couplings and signs."""
    columns = ((text, mended) for text, _, mended in of_columns(robot, data.at))
    for text, mended in (*of_units(robot, data.at), *columns, *of_joints(robot, data.at)):
        if (mended.q != data.at.q).any():  # else of points, which are not measured here
            yield text, replace(data, at=mended)


def slips_of_rows(data: Instrument) -> Iterator[Slip]:
    """What was measured beside the joints of other rows."""
    for text, _, joints, points in of_rows(data.poses):
        moved = data.take(points)
        at = replace(moved.at, q=data.at.q[joints])
        yield f"the measurements {text}; correct the file", replace(moved, at=at).tried()


# ---- remarks -------------------------------------------------------------------------------------


LEAST = 5e-6  # a fit that misses by less leaves nothing to explain [m]
WEAK = 3.0  # times what was measured: positions that are told worse are weakly told
COMMAND = re.compile(r"minimax-cal import .*? -o mended\.csv")


def of_beyond(result: RelativeCalibration) -> tuple[str, ...]:
    """What is told that one reflector would not tell."""
    names = ", ".join(result.beyond)
    what = "identified beyond what one reflector at the pose's origin tells"
    return (f"{what}: {names}",) if names else ()


def of_scale(fit: InstrumentFit) -> tuple[str, ...]:
    """What stands for the length standard that closures lack."""
    reasons = fit.identification.reasons
    kept = [name for name, why in reasons.items() if why.kind is Because.NO_SCALE]
    if not kept:
        return ()
    first = fit.stack.instruments[0]
    return (
        f"the scale is not identifiable from {first.kind}: {kept[0]} is kept as drawn, whatever "
        "its prior, and if that is wrong by a part in a thousand, so is every length; sigmas leave "
        "this out; " + first.scale[-1],
    )


def of_lone_rotations(fit: InstrumentFit) -> Iterator[str]:
    """That an instrument of the user's own reads rotations, and counts them as metres."""
    for i, one in enumerate(fit.stack.instruments):
        if is_registered(one) and one.unit == METRE:
            rows = fit.stack.blocks[i].read(fit.stack.part(fit.state, i))
            if rows.by_rotation.any() and not rows.by_point.any():
                yield (
                    f"{one.kind}: its rows depend on rotations alone, and its unit is m: give its "
                    'class the unit of its rows, as unit = "rad"'
                )


def general(result: Measured, data: Instrument, held: Array) -> tuple[str, ...]:
    """What the reader should know: nothing held out, measurements that stand out."""
    notices = []
    if not held.any():
        notices.append("no pose is held out: nothing here says how the fit does on new poses")
    elif not result.accuracy["holdout"].poses:
        notices.append("the held-out rows close with nothing: no held-out accuracy")
    distance = np.full((len(held), len(result.parts)), np.nan)
    distance[~held] = np.linalg.norm(result.errors["train"], axis=-1)
    distance[held] = np.linalg.norm(result.errors["holdout"], axis=-1)
    at = replace(data.at, target_names=result.parts)
    return (*notices, *checks.outliers(at, distance, data.unit))


def weak(
    fit: InstrumentFit, result: RelativeCalibration, measured: Sequence[Measured], sigma: float
) -> tuple[str, ...]:
    """A notice where positions are told far worse than what was measured.

    sigma: of a position, but for what is open and for what an arm does that no link holds [m].
    """
    of_lengths = [one for one in measured if one.units == (METRE,)]
    rms_mm = min((one.accuracy["train"].rms_mm for one in of_lengths), default=np.nan)
    expected_mm = 1e3 * sigma
    more = [one.words.more for one in fit.stack.instruments]
    untold = [
        p.name for p in result.parameters if TARGET in p.name and p.because is Because.NOT_TOLD
    ]
    if not all(more) or not (expected_mm > WEAK * rms_mm or untold):
        return ()
    where = f" ({', '.join(untold)} not at all)" if untold else ""
    fits = f"what was measured fits to {rms_mm:.3g} mm, " if of_lengths else ""
    return (
        f"positions are poorly determined{where}: by the sigmas to {expected_mm:.3g} mm, "
        f"{fits}and model error makes positions worse still; "
        f"turn the flange more from pose to pose, and measure with {more[0]}",
    )


def unlikely(result: RelativeCalibration, measured: Sequence[Measured]) -> tuple[str, ...]:
    """Notices where the result is no calibration of this robot but of another one."""
    notices, reach = [], result.nominal.reach()
    for key, what in (("nominal_train", "the nominal robot"), ("train", "the best fit")):
        lengths = [one.accuracy[key].rms_mm for one in measured if one.units == (METRE,)]
        miss_mm = max(lengths, default=0.0)
        if miss_mm > 1e3 * POOR_FIT * reach:
            notices.append(
                f"{what} misses by {miss_mm:.3g} mm: check that it is the robot of these "
                "measurements, with its joint signs, zero positions and units"
            )
    change = links_of(result.robot.mdh - result.nominal.mdh)
    if named := wild(Names.of(result.nominal, ()), change, reach):
        notices.append(f"implausibly large changes: {named}; is the robot file the right one?")
    return tuple(notices)


def unfitted(robot: Robot, fit: InstrumentFit, i: int, options: RelativeOptions) -> tuple[str, str]:
    """A notice, and its mend, where more of an instrument would explain what the fit leaves."""
    one, noise = fit.stack.instruments[i], float(fit.noise[i])
    more = one.wider()
    if not more or noise < LEAST:
        return "", ""
    try:
        wider = fit_instruments(robot, fit.trains, replace(options, **dict[str, Any](more)), silent)
    except DataError:  # too few numbers for so many unknowns
        return "", ""
    return one.told_wider(noise, float(wider.noise[i]))


def beyond(robot: Robot, fit: InstrumentFit, options: RelativeOptions) -> tuple[str, ...]:
    """Parameters that a lone instrument tells, and one point of it would not."""
    one = fit.stack.instruments[0]
    point = one.lone
    if point is None:
        return ()
    lone = Stack.of(robot, [point.ready(robot, options)], [""])
    own = one.lone_values(fit.stack.blocks[0].own(fit.stack.part(fit.state, 0)))
    x = lone.state(fit.state.mdh, [own])
    allowed, wanted = allowed_of(lone, options)
    alone = identified(
        robot, lone, lone.reference(robot, x), x, allowed, wanted,
        known=np.zeros(lone.names.count, dtype=bool), resolution=options.resolution,
    )  # fmt: skip
    rows = lone.names.geometric + one.targets_at.start
    more = fit.identification.active[:rows] & ~alone.active[:rows]
    known = np.pad(alone.active[rows:], (0, len(one.lone_names) + rows - len(alone.active)))
    untold = (name for name, told in zip(one.lone_names, known, strict=True) if not told)
    return (*(lone.names.all[i] for i in np.flatnonzero(more)), *untold)
