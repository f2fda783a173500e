"""Slips of lengths and closures that no fit should be asked to explain: units, signs, offsets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.fitting.checks import EXPLAINED, MAX_TRIAL_POSES, POOR_FIT
from minimax_cal.fitting.checks import check_plausible as of_points
from minimax_cal.fitting.claims import MAX_MISS_OF_REACH
from minimax_cal.fitting.identify import plenty_of_poses
from minimax_cal.fitting.instruments.data import SPHERE, RelativeData
from minimax_cal.fitting.instruments.fit import (
    InstrumentFit,
    Train,
    allowed_of,
    fit_instruments,
    stack_of,
    start_of,
)
from minimax_cal.fitting.instruments.options import (
    RelativeOptions,
    known_text,
    sigmas_of,
    silent,
)
from minimax_cal.fitting.instruments.poses import lever_of, poses_as_targets
from minimax_cal.fitting.instruments.probe import Contacts
from minimax_cal.fitting.instruments.result import Measured
from minimax_cal.fitting.instruments.rows import Block, places
from minimax_cal.fitting.instruments.sockets import Closures
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.measuring.slips import of_couplings, of_signs, of_units
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

BETTER = 0.25  # of the mean square: what explains so much is worth a look
LEAST = 5e-3  # a fit that misses by less leaves nothing to explain [mm]
BETTER_RADIUS = 4.0  # times the mean square of a sphere whose radius is free
FAR = 4.0  # sigmas of a prior that an arm may be off
RESIZED = 0.25  # of what the arm sweeps: a fit that changes it by more is of no arm


def check_plausible(robot: Robot, data: RelativeData, options: RelativeOptions) -> None:
    """Raise CalibrationError for slips that show where the arm as drawn is fitted.

    All rows are looked at, those held out too: they judge the fit.
    """
    if data.kind == "pixels":  # their own fit looks for slips
        return
    if data.kind in ("points", "poses"):
        check_in_space(robot, data, options)
        return
    data = data.take(some(data))
    block, x = started(robot, data, options)
    if isinstance(block, Contacts):
        check_radii(robot, data, options, block, x)
    given, limit = block.mean_square(x), POOR_FIT * robot.reach()
    if np.sqrt(given) <= limit:
        if isinstance(block, Closures):
            check_known(robot, data, options, block, x)
        return
    whole = size(block, x)
    trials = []
    for text, mended in slips(robot, data):
        one, at = started(robot, mended, options)
        square = one.mean_square(at)
        trials.append((square / size(one, at), square, text))
        if mended.length is not data.length and np.sqrt(square) <= limit:
            break  # a unit that fits leaves nothing to ask of joints
    least = min(share for share, _, _ in trials)
    share, square, text = next(trial for trial in trials if trial[0] <= 2.0 * least)
    if np.sqrt(square) <= 4.0 * limit and share < EXPLAINED * given / whole:
        raise DataError(
            f"{data.at.source}: {text} (the nominal robot then misses by "
            f"{1e3 * np.sqrt(square):.3g} mm, not {1e3 * np.sqrt(given):.3g} mm)"
        )


def check_in_space(robot: Robot, data: RelativeData, options: RelativeOptions) -> None:
    """Raise DataError for slips of points, or of whole poses by their reflectors."""
    if data.kind == "points":
        of_points(robot, data.at)
        return
    try:
        of_points(robot, poses_as_targets(data, lever_of(data, options.lever)[0]))
    except DataError as wrong:  # the user's columns have other names
        raise DataError(str(wrong).replace("smr1_x_", "flange_x_")) from wrong


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


def started(robot: Robot, data: RelativeData, options: RelativeOptions) -> tuple[Block, State]:
    """The measurements, and what fits the arm as drawn best."""
    stack = stack_of(robot, [Train("", data)], options)
    allowed, _ = allowed_of(stack, options)
    return stack.blocks[0], start_of(robot, stack, allowed)


def size(block: Block, x: State) -> float:
    """What a mean square of closures is to be seen by: an arm that hardly moves closes anything."""
    if not isinstance(block, Closures | Contacts):
        return 1.0
    return max(float(places(block.model, x).var(axis=-1).sum()), 1e-12)


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
    robot: Robot, data: RelativeData, options: RelativeOptions, closures: Closures, x: State
) -> None:
    """Raise OptionError for a known distance that no arm like the drawn one can have."""
    centre = closures.barycentres(places(closures.model, x)).T
    limits = farthest(robot, options, closures, x)
    for known, (a, b), limit in zip(closures.known, closures.pairs, limits, strict=True):
        drawn, told = float(np.linalg.norm(centre[a] - centre[b])), known[2]
        if abs(drawn - told) <= limit:
            continue
        metres = "; metres? give millimetres" if abs(drawn - 1e3 * told) <= limit else ""
        raise OptionError(
            f"{known_text(known)}: by the arm as drawn these sockets of {data.at.source} are "
            f"{1e3 * drawn:.4g} mm apart{metres or '; check the labels and the length'}"
        )


def check_radii(
    robot: Robot, data: RelativeData, options: RelativeOptions, contacts: Contacts, x: State
) -> None:
    """Raise DataError for a given radius that no arm like the drawn one can have found."""
    if not (np.isfinite(data.ball_radius) and any(s.kind == SPHERE for s in data.surfaces)):
        return
    free = tuple(replace(s, size=np.nan) if s.kind == SPHERE else s for s in data.surfaces)
    block, at = started(robot, replace(data, surfaces=free), options)
    one, other = contacts.mean_square(x), block.mean_square(at)
    found = block.placed(at, at)["surfaces"]
    for surface in data.surfaces:
        size_mm = found[surface.label].get("radius_mm", 0.0)
        off = abs(size_mm - 1e3 * surface.size) if surface.kind == SPHERE else 0.0
        if one > BETTER_RADIUS * other and off > FAR * 1e3 * np.sqrt(other):
            raise DataError(
                f"{data.at.source}: column radius_mm: by the arm as drawn surface "
                f"{surface.label!r} has a radius of {size_mm:.4g} mm, not "
                f"{1e3 * surface.size:.4g} mm; check radius_mm, ball_radius_mm and their units"
            )


def farthest(robot: Robot, options: RelativeOptions, closures: Closures, x: State) -> list[float]:
    """By how much the drawn arm may miss each known distance: more where priors let it [m]."""
    sigma = sigmas_of(closures.model.names, options)
    free = np.pad(np.isfinite(sigma), (0, closures.model.names.count - len(sigma)))
    limit = 4.0 * POOR_FIT * robot.reach()
    if not (free.any() and len(closures.pairs)):
        return [limit] * len(closures.pairs)
    _, jacobian = closures.rows(x, free)
    slope = jacobian[:, -len(closures.pairs) :] / np.sqrt(closures.weights[-1])
    spread = np.linalg.norm(slope * sigma[np.isfinite(sigma)][:, None], axis=0)
    return [limit + FAR * float(one) for one in spread]


WHICH = {
    "distances": "which length is which wire's",
    "closures": "the labels of the sockets",
    "contacts": "the labels of the surfaces, and radii",
}


def contradiction(
    robot: Robot,
    every: Sequence[RelativeData],
    fit: InstrumentFit,
    measured: Sequence[Measured],
    offset: str,
) -> str:
    """Why the fit is no calibration of this arm; '' where it is one.

    offset: what the lengths say of offsets that were not fitted, see `offset_told`.
    """
    limit_mm = 1e3 * MAX_MISS_OF_REACH * robot.reach()
    which = " and ".join(dict.fromkeys(WHICH.get(d.kind, "the order of the rows") for d in every))
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
    nominal, calibrated, _ = measured[0].before_and_after()
    if offset and calibrated.rms_mm > nominal.rms_mm:
        return "the fit is worse than the arm as drawn: fit the wires' zeros with offset="
    return ""


def swept(robot: Robot, fit: InstrumentFit, state: State) -> float:
    """Spread of the first file's targets over the joints' range [m]."""
    block = fit.stack.blocks[0]
    plenty = plenty_of_poses(robot, block.model)
    links = kinematics.chain(state.mdh, plenty.q, plenty.prismatic)
    spots = block.arm_state(fit.stack.part(state, 0)).target_positions
    place = kinematics.points(links, spots).mean(axis=0)
    return float(np.sqrt(place.var(axis=-1).sum()))


def offset_told(robot: Robot, fit: InstrumentFit, options: RelativeOptions) -> str:
    """A notice where an offset of each wire explains what the fit leaves; '' where not."""
    kinds = [block.kind for block in fit.stack.blocks]
    if "distances" not in kinds or options.offset:
        return ""
    at = kinds.index("distances")
    if 1e3 * fit.noise[at] < LEAST:
        return ""
    try:
        more = fit_instruments(robot, fit.trains, replace(options, offset=True), silent)
    except DataError:  # too few lengths for so many unknowns
        return ""
    if more.noise[at] ** 2 > BETTER * fit.noise[at] ** 2:
        return ""
    return (
        f"with an offset of each wire the lengths fit to {1e3 * more.noise[at]:.3g} mm, without to "
        f"{1e3 * fit.noise[at]:.3g} mm: the wires' zeros look off; fit them with offset="
    )
