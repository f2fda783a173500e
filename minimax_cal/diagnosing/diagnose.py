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

from minimax_cal.diagnosing.causes import Causes, remaining_beside_terms, search_causes
from minimax_cal.diagnosing.clean_data import CleanData, clean_measurements
from minimax_cal.diagnosing.error_budget import fit_error_budget
from minimax_cal.diagnosing.findings import describe_faults
from minimax_cal.diagnosing.folds import beyond_of
from minimax_cal.diagnosing.foot import asked_foot, foot_notices, foot_tells
from minimax_cal.diagnosing.gap import FAULTS, Judges, Ladder, closed, valued, with_shares
from minimax_cal.diagnosing.result import Diagnosis, Finding, Step
from minimax_cal.diagnosing.set_aside import judged_with
from minimax_cal.diagnosing.study import SUM, Study, studied
from minimax_cal.diagnosing.trial import session_notices
from minimax_cal.diagnosing.verdict import ABOVE_NOISE, down_to, explanation, known_noise
from minimax_cal.diagnosing.what_remains import remaining_of
from minimax_cal.diagnosing.where import where
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.crossed import MIN_HELD_POSES
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.floor import DISTANCES, Floor, floor_of, noise_at_most, with_instrument
from minimax_cal.fitting.judged import warn_of_wrong_robot
from minimax_cal.fitting.options import Options, Progress, silent
from minimax_cal.fitting.outcome import FileEvidence, missed_rows
from minimax_cal.fitting.several.options import READ, RelativeOptions, check_no_others, with_others
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.fitting.stations import place_sessions, warn_of_unplaced_sessions
from minimax_cal.fitting.suspects import find_contradicting_points
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
from minimax_cal.measuring.grouping import clusters, held_out, with_groups
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.effects.time import SESSION_JUMP
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.robots.robot import Robot, RobotSource, load_robot

if TYPE_CHECKING:  # it is slow to import
    from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis

FAULTY, CAUSES, BUDGET = "faults of the data", "testing causes", "error budget"
PARTS, REMAINING = "regions held out", "remaining error"
STEPS = (FAULTY, CAUSES, BUDGET, PARTS, REMAINING)
NOT_ASKED = Beyond(reason="not asked for")
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
    judges = raw.take(held)
    if len(np.unique(clusters(judges))) < MIN_HELD_POSES:
        few = (
            f"only {judges.poses} poses are held out: what is said of new poses rests on these; "
            "calibrate with the effects found judges every pose by a fit without it"
        )
        notices = (*notices, few)
    notices = (*notices, *warn_of_unplaced_sessions(raw, ~held))
    raw = place_sessions(robot, raw, ~held)
    with one_thread():
        return examine(robot, raw, held, options, notices, progress, began, (jobs, cluster))


def examine(
    robot: Robot,
    given: Measurements,
    held: Array,
    options: DiagnosisOptions,
    notices: tuple[str, ...],
    progress: Progress,
    began: float,
    workers: tuple[int, str],
) -> Diagnosis:
    """The diagnosis of checked measurements.

    held: (m,) True for poses that no fit may see.  began: when the work did [s].  workers:
    processes, and the address of a Dask scheduler.
    """
    step_of, held_lines = partial(options.step_of, progress), given.line[held]
    clean = clean_measurements(robot, given, held_lines, step_of(FAULTY))
    train = clean.data.take(~np.isin(clean.data.line, held_lines))
    judges = Judges.of(given.take(held), clean.measured, clean.data, train, options.holdout_by)
    fit = clean.fit or fit_cell(robot, train, SUM, progress)
    study = replace(studied(robot, train, fit), moments=clean.jump_times)

    # Causes, their budget, and how well these extrapolate: where worse than geometry, none of them
    # is recommended.
    study, causes = search_causes(study, clean.faults, options.exclude, step_of(CAUSES), *workers)
    causes, spoken, ladder = fit_error_budget(study, causes, step_of(BUDGET))
    beyond = NOT_ASKED if options.quick else beyond_of(study, causes, judges, step_of(PARTS))
    refused = math.nan
    if beyond.typical_mm > beyond.geometric_typical_mm:
        causes, spoken = (
            replace(one, effects=tuple(replace(f, extends=not f.established) for f in one.effects))
            for one in (causes, spoken)
        )
        ladder, refused = replace(ladder, sure=0), beyond.typical_mm
        beyond = beyond_of(study, causes, judges, silent)
    kept = ladder.confirmed
    causes = replace(causes, left=remaining_beside_terms(study, causes, kept.last.terms))

    # Steps on held-out poses, and the noise beneath the last one that is recommended.
    last, late = judges.marked(kept.fits[0].cell, kept.last.cell)
    spoilt = None
    if any(f.effect in FAULTS for f in causes.faults):
        spoilt = given.take(~np.isin(given.line, held_lines))
    steps = judge_steps(study, last, spoken, ladder, spoilt)
    for one in steps:
        progress(name_rung(name_step(one.name), one.holdout.rms_mm))
    count = len(steps) - len(ladder.taken) + ladder.sure
    step = steps[count - 1]
    judge = step.trusted if step.trusted.poses else step.train
    error = kept.last.cell.error(clean.data)
    most = noise_at_most(error, kept.last.poses.left_free)
    whole = floor_of(clean.data, error, robot.repeatability, most)
    floor = whole.beneath(judge.rms_mm)  # noise is part of what is left
    share, interval = closed(kept, last, floor, options.seed)
    effects = [*valued(spoken.effects, kept), *valued(spoken.effects, ladder)[ladder.sure :]]
    foot = tuple(foot_tells(kept.last, clean.data))
    effects = [*asked_foot(effects, foot)]
    findings = with_shares([*describe_faults(causes.faults), *effects], steps, floor.least)

    # The verdict, by all that is known of the noise.
    step_of(REMAINING)
    known = known_noise(kept.last, whole, clean.data, robot.repeatability)
    wrong = explain_contradiction(robot, floor, step)
    gone, counted = judged_with(given, clean.data, clean.left_out, judges.held, kept.last.cell)
    told = explanation(findings, causes, known, study.fit.status, failed=bool(wrong))
    left = () if told["verdict"] == "not_repeatable" else causes.left  # it scatters, that is all
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
            *given.notices,
            *notices,
            *notices_of(study, clean, kept, late, effects),
            *foot_notices(foot),
            *warn_of_wrong_robot(study.robot, study.fit, study.nominal.error(study.data)),
            *filter(None, [wrong]),
        ),
        provenance=Provenance.of(robot, given, vars(options)),
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
    study: Study,
    clean: CleanData,
    ladder: Ladder,
    late: tuple[str, ...],
    effects: Sequence[Finding],
) -> Iterator[str]:
    """What the reader should know.

    late: outliers that the gap had hidden.  effects: with the values of the last fit.
    """
    yield from clean.remarks
    if not any(one.term.effect == SESSION_JUMP.name for one in effects):  # its size is the fit's
        yield from clean.jump_texts
    yield from filter(None, [study.scene.unused_torques])
    if late:
        yield f"outliers that no effect found explains: {name_first(late)}"
    every = ladder.last.cell.placed(clean.measured)
    yield from find_contradicting_points(every, ladder.last.cell.error(every))
    yield from session_notices(study, effects)
    yield from study.fit.notices


def judge_steps(
    study: Study, judges: Judges, causes: Causes, ladder: Ladder, spoilt: Measurements | None
) -> list[Step]:
    """The steps of the budget, each judged: faults of the data first, by what they do to a fit.

    spoilt: training poses as measured, where they hold faults that were mended.
    """
    robot, geometric = study.robot, "geometric"
    steps = [judges.step("nominal", study.nominal)]
    if spoilt:
        fit, whole = fit_cell(robot, spoilt, SUM, silent), replace(judges, train=spoilt)
        steps = [
            whole.step("nominal", fit.nominal_cell(robot, spoilt)),
            whole.step("geometric", fit.cell(robot, spoilt)),
        ]
        faults = dict.fromkeys(f.effect for f in causes.faults if f.effect in FAULTS)
        geometric = f"without {' and '.join(faults)}"
    names = (geometric, *(causes.effects[number].term.step for number in ladder.taken))
    cells = zip(names, ladder.fits, strict=True)
    return [*steps, *(judges.step(name, fit.cell) for name, fit in cells)]


def explain_contradiction(robot: Robot, floor: Floor, last: Step) -> str:
    """Why the last rung contradicts the data; empty where it does not."""
    certain = floor.certain and floor.source != DISTANCES  # which do not hold what the arm does
    known = (floor.value, floor.source) if certain else None
    scores = {"training": (last.train, last.train), "held-out": (last.holdout, last.trusted)}
    return missed_rows(robot, FileEvidence(scores, floor=known))
