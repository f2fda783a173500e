"""Diagnose the gap that geometry leaves: where it lies, what causes it, how far it shrinks."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from minimax_cal.diagnosing.causes import (
    Causes,
    beside_curves,
    beside_maps,
    causes_of,
    fault_findings,
    left_beside,
    merged,
    whole,
)
from minimax_cal.diagnosing.error_maps import error_maps
from minimax_cal.diagnosing.established import often
from minimax_cal.diagnosing.folds import beyond_of
from minimax_cal.diagnosing.foot import asked_foot, foot_notices, foot_tells
from minimax_cal.diagnosing.gap import (
    FAULTS,
    Judges,
    Ladder,
    climbed,
    closed,
    of_lines,
    valued,
    with_shares,
)
from minimax_cal.diagnosing.joint import Joint
from minimax_cal.diagnosing.result import Diagnosis, Finding, Step
from minimax_cal.diagnosing.scatter import are_wrong, unpulled, wrong_rows
from minimax_cal.diagnosing.set_aside import judged_with, sized, with_targets
from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.diagnosing.trial import session_notices
from minimax_cal.diagnosing.verdict import ABOVE_NOISE, down_to, explanation, known_noise
from minimax_cal.diagnosing.what_remains import remaining_of
from minimax_cal.diagnosing.where import where
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.checks import NO_ROWS, check_plausible, misplaced, put_right
from minimax_cal.fitting.crossed import MIN_HELD_POSES
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.floor import DISTANCES, Floor, floor_of, noise_at_most, with_instrument
from minimax_cal.fitting.judged import doubts
from minimax_cal.fitting.jump_sizes import fit_jump_sizes
from minimax_cal.fitting.options import Options, Progress, silent
from minimax_cal.fitting.outcome import FileEvidence, missed_rows
from minimax_cal.fitting.several.options import READ, RelativeOptions, check_no_others, with_others
from minimax_cal.fitting.solve import Solved, fit_cell
from minimax_cal.fitting.stations import stationed, unplaced
from minimax_cal.fitting.suspects import contradictions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.options import check_left_out, grouped, takes
from minimax_cal.ground.stages import name_rung, number_step
from minimax_cal.ground.threads import one_thread
from minimax_cal.ground.words import name_first
from minimax_cal.instruments.file import Given, InstrumentData, taken
from minimax_cal.instruments.images import Images
from minimax_cal.instruments.tracker import Points
from minimax_cal.measuring import checks
from minimax_cal.measuring.faults import find_faults, in_lines, mended, standing_out
from minimax_cal.measuring.faults.fault import Fault
from minimax_cal.measuring.faults.nests import RESEAT
from minimax_cal.measuring.faults.sessions import session_jumps
from minimax_cal.measuring.grouping import clusters, held_out, with_groups
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.effects.time import SESSION_JUMP, TARGET_SHIFT
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.robots.robot import Robot, RobotSource, load_robot

if TYPE_CHECKING:  # it is slow to import
    from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis

FAULTY, CAUSES, BUDGET = "faults of the data", "testing causes", "error budget"
PARTS, REMAINING = "regions held out", "remaining error"
STEPS = (FAULTY, CAUSES, BUDGET, PARTS, REMAINING)
NOT_ASKED = Beyond(reason="not asked for")
ROBUST = replace(SUM, trim=0.3)  # a fit that up to so many wrong points do not pull
sought = grouped("What is sought")


@dataclass(frozen=True)
class DiagnosisOptions:
    """What a diagnosis is to do.

    seed, holdout: of the poses kept out of the fit, and their share.
    holdout_by: a column (session, group ...) or region, whose poses are held out together.
    instrument: u95 of a coordinate as 10um+2.5um/m, where the data do not say.
    exclude: effects that are not to be considered.
    quick: leave no parts of the poses out in turn, so that there is no claim outside the measured
    poses.
    """

    seed: int = Options.seed
    holdout: float = Options.holdout
    holdout_by: str | None = None
    instrument: str | None = None
    exclude: Sequence[str] = sought(
        (),
        "Do not consider this effect; `minimax-cal effects` lists them.",
        metavar="EFFECT",
        flag="--without",
        many=tuple,
    )
    quick: bool = sought(
        False, "Hold out no parts of the poses in turn: no claim outside the measured region."
    )

    def step_of(self, progress: Progress, name: str) -> Progress:
        """Progress of one of STEPS."""
        steps = [step for step in STEPS if not (self.quick and step == PARTS)]
        return number_step(progress, steps.index(name) + 1, len(steps), name)


OF_OTHERS = ("offset", "known_distances", "lever", "noises", *Images.options)


@overload
def diagnose(
    robot: RobotSource,
    data: Measurements | Points,
    *,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent,
    **options: Any,
) -> Diagnosis: ...
@overload
def diagnose(
    robot: RobotSource,
    data: InstrumentData,
    *,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent,
    **options: Any,
) -> RelativeDiagnosis: ...
@overload
def diagnose(
    robot: RobotSource,
    data: Given | Sequence[Given],
    *,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent,
    **options: Any,
) -> Diagnosis | RelativeDiagnosis: ...
@takes(
    options=DiagnosisOptions, others=(RelativeOptions, OF_OTHERS), read={**READ, "exclude": list}
)
def diagnose(
    robot: Robot | str | Path,
    data: Given | Sequence[Given],
    *,
    options: DiagnosisOptions,
    others: RelativeOptions,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent,
) -> Diagnosis | RelativeDiagnosis:
    """Say what is still wrong with a calibrated robot, and why, as far as the data can tell.

    Parameters
    ----------
    robot, data
        Loaded, or a name or path; data also as a list of paths, the campaigns of one arm,
        each a session.  Lengths, closures, contacts and poses, alone or in a list, are diagnosed
        as `diagnose_relative` does.
    options
        See `DiagnosisOptions`.
    others
        Of other instruments: see `RelativeOptions`.
    jobs
        Processes that search parts of the poses, -1 for one a core.
    cluster
        Address of a Dask scheduler, as tcp://host:port, whose workers then do it.
    progress
        Called with a word on each stage.

    Returns
    -------
    Diagnosis | RelativeDiagnosis
        The causes and the error budget. Its lengths are in m, in mm where a name says so.  A
        `RelativeDiagnosis` where the data are not points of trackers alone.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.diagnose("irb2600", "poses.csv", exclude=["backlash"]).summary())
    """
    began = time.perf_counter()
    robot = load_robot(robot)
    given = taken(data)
    if not isinstance(given, Measurements):
        from minimax_cal.diagnosing.instruments import diagnosed

        chosen = with_others(given, replace(options, exclude=()), others)
        return diagnosed(robot, given, options.exclude, chosen, progress)
    check_no_others(given, others)
    check_left_out(options.exclude, EFFECTS)
    given = checks.check_joints(robot, given)
    checks.check_spread(robot, given)
    raw = with_groups(with_history(with_instrument(given, options.instrument)))
    held, notices = held_out(raw, options.holdout, options.seed, options.holdout_by)
    if not held.any():
        raise DataError(
            f"{given.source}: no pose is held out; a diagnosis needs some that no fit has seen: "
            "measure more poses, or hold out more (holdout)"
        )
    notices = (*notices, *few_judges(raw.take(held)), *unplaced(raw, ~held))
    raw = stationed(robot, raw, ~held)
    with one_thread():
        asked = Asked(robot, raw, held, options, jobs, cluster)
        return examined(asked, notices, progress, began)


def few_judges(held: Measurements) -> Iterator[str]:
    """That few poses judge.  held: those held out."""
    if len(np.unique(clusters(held))) < MIN_HELD_POSES:
        yield (
            f"only {held.poses} poses are held out: what is said of new poses rests on these; "
            "calibrate with the effects found judges every pose by a fit without it"
        )


@dataclass(frozen=True, eq=False)
class Asked:
    """What is to be diagnosed.  held: (m,) of the poses as given, True for those no fit may see."""

    robot: Robot
    data: Measurements
    held: Array
    options: DiagnosisOptions
    jobs: int = 1
    cluster: str = ""

    def train(self, data: Measurements) -> Measurements:
        """Of some of the rows those that fits may see."""
        return data.take(~np.isin(data.line, self.data.line[self.held]))


def examined(asked: Asked, notices: tuple[str, ...], progress: Progress, began: float) -> Diagnosis:
    """The diagnosis of checked measurements.  began: when the work did [s]."""
    robot, options = asked.robot, asked.options
    step_of = partial(options.step_of, progress)
    clean = cleaned(asked, step_of(FAULTY))
    train = asked.train(clean.data)
    judges = judges_of(asked, clean, train)
    fit = clean.fit or fit_cell(robot, train, SUM, progress)
    study = replace(studied(robot, train, fit), moments=clean.moments)
    workers = asked.jobs, asked.cluster
    study, causes = causes_of(study, clean.faults, options.exclude, step_of(CAUSES), *workers)
    causes, spoken, ladder = in_rungs(study, causes, step_of(BUDGET))
    beyond = NOT_ASKED if options.quick else beyond_of(study, causes, judges, step_of(PARTS))
    refused = math.nan
    if beyond.typical_mm > beyond.geometric_typical_mm:  # what does not extrapolate
        causes, spoken = (not_extending(one) for one in (causes, spoken))
        ladder, refused = replace(ladder, sure=0), beyond.typical_mm
        beyond = beyond_of(study, causes, judges, silent)
    kept = ladder.confirmed
    causes = replace(causes, left=left_beside(study, causes, kept.last.terms))
    last, late = judges.marked(kept.fits[0].cell, kept.last.cell)
    steps = steps_of(asked, study, last, spoken, ladder)
    tell_steps(steps, progress)
    count = len(steps) - len(ladder.taken) + ladder.sure
    step = steps[count - 1]
    judge = step.trusted if step.trusted.poses else step.train
    whole = floor_beneath(robot, clean.data, kept.last)
    floor = whole.beneath(judge.rms_mm)  # noise is part of what is left
    share, interval = closed(kept, last, floor, options.seed)
    effects = [*valued(spoken.effects, kept), *valued(spoken.effects, ladder)[ladder.sure :]]
    foot = tuple(foot_tells(kept.last, clean.data))
    effects = [*asked_foot(effects, foot)]
    findings = with_shares([*fault_findings(causes.faults), *effects], steps, floor.least)
    step_of(REMAINING)
    known = known_noise(kept.last, whole, clean.data, robot.repeatability)
    wrong = against(robot, floor, step)
    gone, counted = judged_with(asked.data, clean.data, clean.left, judges.held, kept.last.cell)
    told = explanation(findings, causes, known, study.fit.status, failed=bool(wrong))
    left = () if told["verdict"] == "not_repeatable" else causes.left  # it scatters, that is all
    error = kept.last.cell.error(clean.data)
    most = floor.value if told["structure_in"] == ABOVE_NOISE else math.inf
    rest, complete = remaining_of(left, judge.rms_mm, clean.data, error, most)
    more = ladder.last.cell if len(steps) > count else None
    return Diagnosis(
        **{**told, "meets_floor": down_to(known, complete)},
        robot=robot.name,
        ladder=tuple(steps[:count]),
        possible=steps[-1] if more else None,
        possible_cell=more,
        floor=floor,
        closed=share,
        closed_ci=interval,
        beyond=beyond,
        noise=float(np.sqrt(study.uneven * causes.choice.noise.variance)),  # of a mean coordinate
        where=where(study).to_dict(),
        notices=(
            *asked.data.notices,
            *notices,
            *notices_of(study, clean, kept, late, effects),
            *foot_notices(foot),
            *doubts(study.robot, study.fit, study.nominal.error(study.data)),
            *filter(None, [wrong]),
        ),
        provenance=Provenance.of(robot, asked.data, vars(options)),
        seconds=time.perf_counter() - began,
        data=study.geometric.placed(clean.data),
        held=~np.isin(clean.data.line, train.line),
        cells=tuple(fit.cell for fit in kept.fits),
        nominal=study.nominal,
        remaining=None if wrong else rest,
        tested=(known.remaining, known.highest),
        refused=refused,
        floor_known=complete,
        repeatable=known.is_repeatable,
        set_aside=gone,
        with_them=counted,
    )


def notices_of(
    study: Study, clean: Clean, ladder: Ladder, late: tuple[str, ...], effects: Sequence[Finding]
) -> Iterator[str]:
    """What the reader should know.

    late: outliers that the gap had hidden.  effects: with the values of the last fit.
    """
    yield from clean.remarks
    if not any(one.term.effect == SESSION_JUMP.name for one in effects):  # its size is the fit's
        yield from clean.jumps
    yield from filter(None, [study.scene.unused_torques])
    if late:
        yield f"outliers that no effect found explains: {name_first(late)}"
    every = ladder.last.cell.placed(clean.given)
    yield from contradictions(every, ladder.last.cell.error(every))
    yield from session_notices(study, effects)
    yield from study.fit.notices


def in_rungs(study: Study, causes: Causes, progress: Progress) -> tuple[Causes, Causes, Ladder]:
    """The causes, those found often enough to be spoken of, and the ladder, with maps of joints."""
    spoken, ladder = with_maps(study, causes, progress)
    if ladder.maps:
        progress("causes beside the error maps")
        other, wider = with_maps(study, beside_curves(study, causes, ladder.maps), progress)
        if wider.maps and no_worse(wider, ladder):
            spoken, ladder = other, wider
    return spoken if spoken.maps.terms else causes, spoken, ladder


def no_worse(one: Ladder, other: Ladder) -> bool:
    """Whether groups left out of the last fit are met no worse than by another's."""
    parts = one.last.spared(other.last.spared(other.parts))
    return one.last.cross_validated(parts) <= other.last.cross_validated(parts)


def with_maps(study: Study, causes: Causes, progress: Progress) -> tuple[Causes, Ladder]:
    """The causes found often enough to be spoken of, and the ladder.

    With the error maps, and fine waves, that joints have besides.
    """
    found = often(causes.effects)
    chosen = [term for finding in found for term in finding.terms]
    causes = replace(causes, effects=tuple(whole(f, chosen, study.scene) for f in found))
    ladder = laddered(study, causes)
    progress("error maps of joints")
    maps = error_maps(ladder.last, causes.exclude)
    if not maps.terms:
        return causes, ladder
    effects = merged(maps.findings([causes.effects[i] for i in ladder.taken], study.scene))
    causes = beside_maps(study, replace(causes, effects=tuple(effects), maps=maps), maps.terms)
    ladder = laddered(study, causes)
    texts = {term.text for term in ladder.last.terms}
    held = [term for term in maps.terms if term.text in texts]
    return (causes if len(held) == len(maps.terms) else beside_maps(study, causes, held)), ladder


def laddered(study: Study, causes: Causes) -> Ladder:
    """The ladder of all causes, those that are confirmed first."""
    effects, sure = causes.effects, [found.established for found in causes.effects]
    return climbed(study, [found.terms for found in effects], sure, guessed=causes.guessed)


def not_extending(causes: Causes) -> Causes:
    """The causes, none of them recommended: poses beyond those measured are met worse by them."""
    effects = (replace(f, extends=not f.established) for f in causes.effects)
    return replace(causes, effects=tuple(effects))


def floor_beneath(robot: Robot, data: Measurements, last: Joint) -> Floor:
    """What noise alone would leave beneath the last rung."""
    error = last.cell.error(data)
    most = noise_at_most(error, last.poses.left_free)
    return floor_of(data, error, robot.repeatability, most)


def steps_of(
    asked: Asked, study: Study, judges: Judges, causes: Causes, ladder: Ladder
) -> list[Step]:
    """The rungs, each judged: faults of the data first, by what they do to a fit."""
    steps = [judges.step("nominal", study.nominal)]
    spoilt = dict.fromkeys(f.effect for f in causes.faults if f.effect in FAULTS)
    first = ladder.fits[0].cell
    if spoilt:
        train = asked.train(asked.data)
        fit = fit_cell(asked.robot, train, SUM, silent)
        whole = replace(judges, train=train)
        steps = [
            whole.step("nominal", fit.nominal_cell(asked.robot, train)),
            whole.step("geometric", fit.cell(asked.robot, train)),
        ]
    steps.append(judges.step(f"without {' and '.join(spoilt)}" if spoilt else "geometric", first))
    for number, wider in zip(ladder.taken, ladder.fits[1:], strict=True):
        term = causes.effects[number].term
        steps.append(judges.step(term.step, wider.cell))
    return steps


def tell_steps(steps: Sequence[Step], progress: Progress) -> None:
    """Each step of the budget with its held-out error."""
    for step in steps:
        progress(name_rung(name_step(step.name), step.holdout.rms_mm))


def judges_of(asked: Asked, clean: Clean, train: Measurements) -> Judges:
    """Who judges: every held-out point as measured, those that stand out marked."""
    held = asked.data.take(asked.held)
    right = dict(zip(clean.given.line, clean.given.y, strict=True))
    held = held.with_y(np.array([right.get(line, held.y[i]) for i, line in enumerate(held.line)]))
    sound = of_lines(held.line, clean.data.line, clean.data.seen)
    return Judges(train, held, held.seen & ~sound, asked.options.holdout_by)


def against(robot: Robot, floor: Floor, last: Step) -> str:
    """Why the last rung contradicts the data; empty where it does not."""
    certain = floor.certain and floor.source != DISTANCES  # which do not hold what the arm does
    known = (floor.value, floor.source) if certain else None
    scores = {"training": (last.train, last.train), "held-out": (last.holdout, last.trusted)}
    return missed_rows(robot, FileEvidence(scores, floor=known))


# ---- data faults -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Clean:
    """Measurements with rows and points put right or left out.

    given: as measured, but for points that stood in each other's rows.  left: points that no fit
    counts, by lines of the file.  faults: their rows as lines
    of the file.  remarks: on them, for people.  fit: the geometric fit of the training poses, where
    it is that of the clean data.  moments: as `Study` has them.  jumps: what is said of these,
    where no effect says it.
    """

    data: Measurements
    given: Measurements
    left: tuple[Fault, ...]
    faults: tuple[Fault, ...]
    remarks: tuple[str, ...]
    fit: Solved | None
    moments: Array
    jumps: tuple[str, ...]


def cleaned(asked: Asked, progress: Progress) -> Clean:
    """The data without the faults that can be mended."""
    robot = asked.robot
    data, exchanged = in_order(robot, asked.data)
    found = find_faults(data)
    sound = mended(data, found)
    check_plausible(robot, sound)
    progress("geometry")

    def fitted(some: Measurements, options: Options = SUM) -> Cell:
        return fit_cell(robot, asked.train(some), options, silent).cell(robot, some)

    found = with_targets(found, data, fitted)
    sound = mended(data, found)
    fit = fit_cell(robot, asked.train(sound), SUM, progress)
    cell = fit.cell(robot, sound)
    found = tuple(sized(fault, cell, data) for fault in found)
    error = cell.error(sound)
    more = standing_out(cell.placed(sound), error)

    def robust() -> Array:
        return fitted(sound, ROBUST).error(sound)

    shifted = any(fault.effect == TARGET_SHIFT.name for fault in found)
    many = () if more or shifted else unpulled(error, robust, sound)
    wrong = wrong_rows(data, cell.error(data))
    points = (*in_lines(data, found, "outliers"), *in_lines(sound, more, "outliers"))
    faults = (
        *exchanged,
        *in_lines(data, found, "swapped_rows", RESEAT),
        *(one for one in points if are_wrong(one, wrong, data.line)),
        *in_lines(sound, many, "outliers"),
    )
    more = (*more, *many)
    sound = mended(sound, more)
    sound = sound.take(np.asarray(sound.seen.any(axis=1)))
    placed, held = cell.placed(sound), np.isin(sound.line, asked.data.line[asked.held])

    def fit_sizes(rows: Array) -> Array:
        return fit_jump_sizes(robot, placed, ~held, SUM, rows)

    jumped = session_jumps(placed, cell.error(sound), fit_sizes)
    told = (*found, *more)
    remarks = tuple(fault.text for fault in told if fault.effect != TARGET_SHIFT.name)
    rows = np.concatenate([NO_ROWS, *(fault.rows for fault in jumped)])
    moments = sound.columns["clock"][rows]
    left = tuple(in_lines(data, (*found, *more), "outliers", RESEAT))
    return Clean(
        sound, data, left, faults, remarks, None if more else fit, moments,
        tuple(fault.text for fault in jumped),
    )  # fmt: skip


def in_order(robot: Robot, data: Measurements) -> tuple[Measurements, tuple[Fault, ...]]:
    """The data with points that stand in each other's rows put back, and the fault if any did."""
    rows, source = misplaced(robot, data)
    if not len(rows):
        return data, ()
    text = f"{data.source}: rows hold each other's points: {data.list_rows(rows)}"
    fault = Fault("swapped_rows", "all", text, data.line[rows])
    return put_right(data, rows, source), (fault,)
