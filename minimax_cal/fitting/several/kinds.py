"""From files of lengths, closures, poses and points to a calibrated robot."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from minimax_cal.fitting.accuracy import HELD, by_key
from minimax_cal.fitting.claims import (
    NO_MOTION,
    drawn_sigmas,
    lacking,
    position_sigma,
    positions_by,
)
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.improvement import improvement_of_files, no_better
from minimax_cal.fitting.options import qp_name
from minimax_cal.fitting.outcome import FileEvidence, FitEvidence, judge
from minimax_cal.fitting.several import fit, plausible
from minimax_cal.fitting.several.agreement import (
    find_contradictions,
    find_moved_bases,
    find_other_order,
    find_other_scale,
)
from minimax_cal.fitting.several.fit import InstrumentFit
from minimax_cal.fitting.several.identify import Alone
from minimax_cal.fitting.several.lack import with_lack
from minimax_cal.fitting.several.options import (
    READ,
    Progress,
    RelativeOptions,
    check_given,
    check_noises,
    check_options,
    silent,
)
from minimax_cal.fitting.several.result import (
    SEVERAL,
    InstrumentResult,
    Measured,
    RelativeCalibration,
)
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.options import takes
from minimax_cal.ground.threads import one_thread
from minimax_cal.instruments.check import check_instrument
from minimax_cal.instruments.file import Given, as_instrument
from minimax_cal.instruments.instrument import METRE, RADIAN, Instrument, checked
from minimax_cal.instruments.table import is_registered
from minimax_cal.measuring.campaigns import session_names
from minimax_cal.measuring.checks import arm_notices, check_joints
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.history import Clock, with_history
from minimax_cal.measuring.stations import Sessions
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.joint_fit import fitted
from minimax_cal.modelling.model import TARGET
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot, load_robot

R = TypeVar("R", bound=RelativeCalibration)
PARTS = {"train": "training", "holdout": "held-out"}  # of the poses, by the keys of accuracy


@takes(options=RelativeOptions, read=READ)
def relative(
    robot: Robot | str | Path,
    data: Given | Sequence[Given],
    progress: Progress = silent,
    *,
    options: RelativeOptions,
) -> RelativeCalibration:
    """Calibrate a robot from lengths, closures or poses, or from several files together.

    Several files share the arm; each has unknowns and a noise of its own, by its own residuals.
    One of them may be measurements of a tracker.

    Parameters
    ----------
    robot, data
        Loaded, or a name or path; several data in a list.
    options
        See `RelativeOptions`.
    progress
        Called with a word on each stage.

    Returns
    -------
    RelativeCalibration
        The calibration; how the numbers ended is in its `status`.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.relative("irb2600", "wires.csv", holdout=0.1).headline())
    """
    return relative_with(robot, data, options, progress)


@one_thread()
def relative_with(
    robot: Robot | str | Path,
    data: Given | Sequence[Given],
    options: RelativeOptions,
    progress: Progress,
) -> RelativeCalibration:
    """`relative`, which calls this, with its options in one."""
    asked = asked_of(robot, data, options)
    began = time.perf_counter()
    return result_of(asked, asked.fit(progress), began)


@dataclass(frozen=True, eq=False)
class Asked:
    """What is to be calibrated, checked.

    every: the measurements of each instrument.  splits: of each, (m,) True where held out, and what
    the reader should know of that.
    """

    robot: Robot
    every: Sequence[Instrument]
    options: RelativeOptions
    splits: Sequence[tuple[Array, tuple[str, ...]]]

    @cached_property
    def trains(self) -> dict[str, Instrument]:
        """What fits may see, by what the file is called."""
        named = zip(labels_of(self.every), self.every, self.splits, strict=True)
        return {label: data.take(~held) for label, data, (held, _) in named}

    def fit(self, progress: Progress) -> InstrumentFit:
        """The fit of the training measurements."""
        found = fit.fit_instruments(self.robot, self.trains, self.options, progress)
        progress("sigmas")
        return with_lack(self.robot, found)

    def beside(self, effects: Sequence[Term]) -> Asked:
        """The same with effects."""
        return replace(self, options=replace(self.options, effects=tuple(effects)))


def asked_of(
    robot: Robot | str | Path,
    data: Given | Sequence[Given],
    options: RelativeOptions,
    *,
    sought: bool = False,
) -> Asked:
    """Data loaded, checked, and split into training and held-out poses.

    sought: whether effects are looked for.  Raises CalibrationError.
    """
    # Each file by its instrument, those that look at the arm first.
    robot = load_robot(robot)
    given = [data] if isinstance(data, Given) else list(data)
    every = sorted(map(as_instrument, given), key=lambda data: not data.on_arm)
    check_given(every, bends=sought or bool(options.effects))
    check_options(every, options)

    # All joints of the arm, and the way to each pose.
    every = [replace(each, at=with_history(check_joints(robot, each.at))) for each in every]
    check_noises(labels_of(every), every, options)

    # Instruments of the user's own keep the protocol; slips show where the drawn arm is fitted.
    for each in filter(is_registered, every):
        check_instrument(checked(each), robot, options)
    for each in every:
        plausible.check_slips(robot, each, options)
    return Asked(robot, every, options, [each.held_back(options) for each in every])


def labels_of(every: Sequence[Instrument]) -> list[str]:
    """What files are called: by their stems; data from arrays by their kind."""
    files = [Path(data.at.source) for data in every if data.at.digest]
    names = iter(session_names(files) if files else ())
    out: list[str] = []
    for data in every:
        name = next(names) if data.at.digest else data.kind
        alike = [each for each in out if each.rstrip("0123456789") == name]
        out.append(f"{name}{len(alike) + 1}" if name in out else name)
    return out


def result_of(asked: Asked, found: InstrumentFit, began: float) -> RelativeCalibration:
    """The result of a fit, judged at all poses.  began: when the work did [s]."""
    robot, every, options, splits = asked.robot, asked.every, asked.options, asked.splits

    # Errors of each file, as drawn and calibrated; how well positions of the arm are known.
    measured = [
        measured_by(robot, found, i, data, held)
        for i, (data, (held, _)) in enumerate(zip(every, splits, strict=True))
    ]
    left_open, sigma = open_positions(robot, found), sigma_of_positions(robot, found)
    result = assembled(
        asked, found, measured, began, RelativeCalibration,
        position_sigma=np.nan if left_open else sigma,
        positions_open=left_open,
        beyond=plausible.beyond(robot, found, options) if len(measured) == 1 else (),
        cell=cell_of(robot, found) if found.stiff else None,
    )  # fmt: skip

    # The outcome: with it, what of an instrument was not fitted and the residuals show.
    unfitted = [plausible.unfitted(robot, found, i, options) for i in range(len(every))]
    evidence = evidence_of(asked, found, measured, sigma, [mend for _, mend in unfitted])
    outcome = judge(evidence, result.status)

    # What the reader should know.
    instruments = enumerate(found.stack.instruments)
    notices = [
        *result.notices,
        *(remark for i, one in instruments
          for remark in one.remarks(fit.own_parameters(robot, found, i), found.noise[i])),
        *plausible.of_beyond(result),
        *plausible.of_scale(found),
        *plausible.of_lone_rotations(found),
        *plausible.weak(
            found, result, measured, sigma_of_positions(robot, found, with_lack=False)
        ),
        *plausible.unlikely(result, measured),
        *evidence.doubts,
        *filter(None, (*(notice for notice, _ in unfitted), outcome.reason)),
    ]  # fmt: skip
    for data, (held, _), each in zip(every, splits, measured, strict=True):
        notices += plausible.general(each, data, held)
    return replace(
        result,
        robot=robot if outcome.status.keeps_drawn else result.robot,
        calibrated=result.robot,
        status=outcome.status,
        reason=outcome.reason,
        contradictions=evidence.contradictions,
        notices=tuple(dict.fromkeys(notices)),
    )


def evidence_of(
    asked: Asked,
    found: InstrumentFit,
    measured: Sequence[Measured],
    sigma: float,
    mends: Sequence[str],
) -> FitEvidence:
    """What the outcome is judged by.

    sigma: of a position, but for what is open [m].  mends: of what was not fitted of each file and
    the residuals show, empty where nothing is.
    """
    robot, every, geometry = asked.robot, asked.every, found.stiff or found
    links, stack = slice(5 * robot.joints), found.stack
    active = geometry.identification.active[links]

    # Errors of each file; one that more of an instrument would explain is an objection where the
    # fit is worse than the drawn arm.
    files, objection = [], ""
    for data, one, mend in zip(every, measured, mends, strict=True):
        scores = {what: one.accuracy[key] for key, what in PARTS.items()}
        rotations = {what: one.turns[key][0] for key, what in PARTS.items() if key in one.turns}
        if one.units == (RADIAN,):
            rotations = {what: score.rms_error for what, score in scores.items()}
        drawn_scores = {}
        if data.unit == METRE:
            drawn_scores = {key: one.accuracy[key] for key in ("nominal_train", "nominal")}
        files.append(
            FileEvidence(
                {what: (score, score) for what, score in scores.items()},
                source=data.at.source if len(every) > 1 else "",
                check=data.words.check,
                rotations=rotations,
                drawn=drawn_scores,
            )
        )
        drawn, calibrated, _ = one.before_and_after()
        if mend and not objection and calibrated.rms_error > drawn.rms_error:
            objection = f"the fit is worse than the arm as drawn: {mend}"

    # Is the calibrated arm better on held-out rows?  By paired comparison, files by their noises.
    better = None
    if active.any() or stack.laws.names:
        better = improvement_of_files(
            [one.errors["nominal"] for one in measured],
            [one.errors["holdout"] for one in measured],
            [groups(data.at)[held] for data, (held, _) in zip(every, asked.splits, strict=True)],
            [s / one.row_noise for s, one in zip(found.noise, stack.instruments, strict=True)],
        )

    # Do files contradict each other?  How well does the drawing know the adopted links?
    drawn_sigma = drawn_sigmas(robot, asked.options.priors)
    other_scale, scale_doubt = find_other_scale(robot, geometry, drawn_sigma)
    return FitEvidence(
        robot,
        geometry.state.mdh,
        active,
        files,
        sigma=np.sqrt(np.maximum(np.diag(geometry.covariance)[links], 0.0)),
        drawn=drawn_sigma,
        position_sigma=sigma,
        drawn_sigma=drawn_sigma_of_positions(robot, geometry, drawn_sigma),
        allow_large_changes=asked.options.allow_large_changes,
        objection=objection,
        contradictions=find_other_order(robot, geometry)
        or find_contradictions(robot, geometry)
        or find_moved_bases(geometry)
        or other_scale,
        doubts=(scale_doubt,) if scale_doubt else (),
        worse=no_better(better) if better and not better.is_better else "",
    )


def assembled(
    asked: Asked,
    found: InstrumentFit,
    measured: Sequence[Measured],
    began: float,
    kind: type[R],
    **more: Any,
) -> R:
    """A kind of result of what was measured, before it is judged.  more: fields of its own."""
    robot, every, splits, options = asked.robot, asked.every, asked.splits, asked.options
    whole = measured[0] if len(every) == 1 else together(found.stack.parts, measured)
    notices = [
        said
        for data, (_, notes) in zip(every, splits, strict=True)
        for said in (*data.at.notices, *arm_notices(robot, data.at), *notes)
    ] + [*found.notices]
    sources = ", ".join(data.at.source for data in every)
    source = replace(every[0].at, source=sources, digest=" ".join(d.at.digest for d in every))
    geometry = found.stiff or found
    settings = options.settings()
    for one in reversed(found.stack.instruments):  # the first one's stand
        settings |= one.choices
    own: dict[str, Any] = dict(vars(whole)) | dict(
        robot=robot.with_mdh(geometry.state.mdh),
        nominal=robot,
        status=found.found.status[0],
        iterations=int(found.found.iterations[0]),
        seconds=time.perf_counter() - began,
        parameters=fit.parameters_of(robot, found),
        identification=found.identification,
        beyond=(),
        notices=tuple(dict.fromkeys(notices)),
        provenance=Provenance.of(robot, source, settings),
        instruments=instruments_of(found, every, splits, measured),
        objective=options.objective,
        qp=qp_name(options.qp) if found.worst else "",
        worst=found.worst,
    )
    return kind(**{**own, **more})


def measured_by(
    robot: Robot, found: InstrumentFit, i: int, data: Instrument, held: Array
) -> Measured:
    """The errors of an instrument, as drawn and calibrated.  held: (m,)."""
    stack, seen = found.stack, []
    for x in found.state_of(i):
        block = stack.blocks[i].at_rows_of(robot, data, stack.laws, x)
        seen.append((block.instrument, *block.at(x)))
    nominal, calibrated = (one.errors(arm, own, held) for one, arm, own in seen)
    turned = [one.turns(arm, own) for one, arm, own in seen]
    turns = by_key(turned[0], turned[1], held) if turned[0].size else {}
    train, drawn, own = stack.instruments[i], seen[0][2], seen[1][2]
    counts = data.count(held)
    return Measured(
        kind=data.kind,
        parts=train.parts,
        errors=by_key(nominal, calibrated, held),
        numbers={key: counts[is_held] for key, is_held in HELD.items()},
        turns=extremes(turns),
        instrument=train.placed(stack.blocks[i].flange(x), own, drawn),
        units=(data.unit,),
    )  # fmt: skip


def extremes(sizes: Mapping[str, Array]) -> dict[str, tuple[float, float]]:
    """RMS and largest, by the same keys."""
    return {key: (rms(s), float(s.max()) if s.size else np.nan) for key, s in sizes.items()}


def together(parts: tuple[str, ...], measured: Sequence[Measured]) -> Measured:
    """The errors of all files, one beside the other."""
    errors = {}
    for key in HELD:
        every = [each.errors[key] for each in measured]
        ends = np.cumsum([[0, 0], *(part.shape[:2] for part in every)], axis=0)
        errors[key] = np.full((*ends[-1], 3), np.nan)
        for part, (pose, row) in zip(every, ends, strict=False):
            errors[key][pose : pose + part.shape[0], row : row + part.shape[1]] = part
    return Measured(
        kind=SEVERAL,
        parts=parts,
        errors=errors,
        numbers={key: sum(each.numbers[key] for each in measured) for key in HELD},
        turns={},
        instrument={},
        units=tuple(dict.fromkeys(unit for each in measured for unit in each.units)),
    )


def cell_of(robot: Robot, found: InstrumentFit) -> Cell:
    """The arm with its effects in its own base, and amid the first file's targets one of its own.

    Where these are is all that the laws know of them.
    """
    stack = found.stack
    scene = stack.scenes(robot, found.state)[0]
    effects = fitted(stack.laws.terms, scene, stack.values(found.state))
    amid = scene.target_positions.mean(axis=0, keepdims=True)
    sessions = Sessions({}, Clock.of(next(iter(found.trains.values())).at))
    return Cell(scene.robot, np.eye(4), (TARGET,), amid, effects, sessions)


def instruments_of(
    found: InstrumentFit,
    every: Sequence[Instrument],
    splits: Sequence[tuple[Array, tuple[str, ...]]],
    measured: Sequence[Measured],
) -> tuple[InstrumentResult, ...]:
    """Each file's own figures."""
    names, fitted = found.stack.labels, found.stack.instruments
    alone = found.alone or (Alone(0, ()),)
    noise = [float(s) / one.row_noise for s, one in zip(found.noise, fitted, strict=True)]
    told = zip(names, measured, every, splits, noise, alone, strict=True)
    return tuple(
        InstrumentResult.of(name, seen, data.at, held, sigma, own)
        for name, seen, data, (held, _), sigma, own in told
    )


def sigma_of_positions(robot: Robot, found: InstrumentFit, *, with_lack: bool = True) -> float:
    """`positions.position_sigma`, of the target of the first file.

    with_lack: of fit; without it, what noise alone leaves.
    """
    stack, spots = found.stack, targets_of(found, found.state)
    (place, column), values = places_of(found), stack.values(found.state)
    count = 5 * robot.joints + 6 + 3 * len(spots) + len(values)
    covariance = np.full((count, count), np.nan)
    covariance[np.ix_(column, column)] = found.covariance[np.ix_(place, place)]
    if found.lack is None:
        return position_sigma(robot, found.state.mdh, spots, covariance, stack.laws, values)
    moved, moment = np.zeros((count, found.lack.moved.shape[1])), found.lack.moment
    moved[column] = found.lack.moved[place]
    alone = covariance - moved @ moment @ moved.T
    lack = (moved, moment) if with_lack else ()
    return position_sigma(robot, found.state.mdh, spots, alone, stack.laws, values, *lack)


def drawn_sigma_of_positions(robot: Robot, found: InstrumentFit, within: Array) -> float:
    """The same of the drawn arm, by the links that were adopted.  within: (5n,) sigmas [m].

    The drawn arm bends as the calibrated one does, and no link of it takes a part of that.
    """
    spots, links = targets_of(found, found.nominal), 5 * robot.joints
    count = links + 6 + 3 * len(spots)
    covariance, adopted = np.full((count, count), np.nan), found.identification.active[:links]
    covariance[:links, :links] = np.where(np.outer(adopted, adopted), np.diag(within**2), np.nan)
    moment = found.lack.moment if found.lack else NO_MOTION
    still = np.zeros((count, len(moment)))
    return position_sigma(robot, robot.mdh, spots, covariance, moved=still, moment=moment)


def targets_of(found: InstrumentFit, x: State) -> Array:
    """(k, 3) targets of the first file on the flange, none where it has none there [m]."""
    block = found.stack.blocks[0]
    spots = block.instrument.targets(block.own(found.stack.part(x, 0)))
    return spots if block.instrument.on_arm else spots[:0]


def places_of(found: InstrumentFit) -> tuple[Array, Array]:
    """Where what moves the target of the first file stands among all, and in `positions_by`."""
    stack, spots = found.stack, targets_of(found, found.state)
    every = np.arange(stack.names.count)
    own = stack.own(0)[stack.instruments[0].targets_at]
    first, laws = 5 * stack.names.joints + 6, every[stack.lawless :]
    place = np.concatenate([every[:first], own, laws])
    last = first + 3 * len(spots) + laws - stack.lawless
    return place, np.concatenate([every[: first + len(own)], last])


def open_positions(robot: Robot, found: InstrumentFit) -> tuple[str, ...]:
    """Parameters that positions over the joints' range depend on and the measurements do not tell.

    Asked of the arm as drawn, where what is redundant is so exactly.  Not those that were fixed.
    """
    fit = found.stiff or found
    (place, column), stack, known = places_of(fit), fit.stack, fit.identification
    names = [stack.names.all[i] for i in place]
    asked = known.asked(names) & stack.movable[place]
    jacobian = positions_by(robot, fit.nominal.mdh, targets_of(fit, fit.nominal))[:, column]
    left = lacking(jacobian, known.active[place], asked)
    return tuple(name for name, is_open in zip(names, left, strict=True) if is_open)
