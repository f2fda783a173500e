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

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import DataError
from minimax_cal.core.option_fields import (
    check_excluded_effects_are_known,
    option_field_in_group,
    take_option_fields_as_keywords,
)
from minimax_cal.core.progress_stages import (
    announce_step_and_number_stages,
    build_finished_budget_step_stage,
)
from minimax_cal.core.threads import limit_blas_to_one_thread
from minimax_cal.diagnosing.budget_steps import (
    MENDED_FAULT_NAMES,
    BudgetSteps,
    JudgingPoses,
    explained_fraction,
    fill_error_fractions,
    fill_fitted_values,
)
from minimax_cal.diagnosing.cause_search import (
    FoundCauses,
    find_remaining_beside_terms,
    search_causes,
)
from minimax_cal.diagnosing.clean_data import CleanData, clean_measurements
from minimax_cal.diagnosing.diagnosis import BudgetStep, Diagnosis, Finding
from minimax_cal.diagnosing.error_budget import fit_error_budget
from minimax_cal.diagnosing.error_locations import locate_errors
from minimax_cal.diagnosing.extrapolation_test import compare_extrapolation
from minimax_cal.diagnosing.findings import build_fault_findings
from minimax_cal.diagnosing.foot_reflectors import (
    compare_laws_with_reflectors,
    describe_reflector_agreement,
    mark_contradicted_findings,
)
from minimax_cal.diagnosing.linear_trials import describe_session_changes
from minimax_cal.diagnosing.remaining_error import split_remaining_error
from minimax_cal.diagnosing.set_aside_points import accuracy_with_set_aside_points
from minimax_cal.diagnosing.study import (
    LEAST_SQUARES_OPTIONS,
    LinearisedGeometry,
    linearise_geometry,
)
from minimax_cal.diagnosing.verdict import (
    ABOVE_NOISE_TEXT,
    estimate_noise_limits,
    explain_verdict,
    is_down_to_complete_noise,
)
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.cross_validation import MIN_HELD_POSES
from minimax_cal.fitting.fit import Provenance
from minimax_cal.fitting.fit_judgement import warn_of_wrong_robot
from minimax_cal.fitting.multi_instrument.options import (
    RELATIVE_OPTION_READERS,
    RelativeOptions,
    check_no_instrument_options,
    merge_instrument_options,
)
from minimax_cal.fitting.noise_floor import (
    DISTANCES,
    NoiseFloor,
    estimate_noise_floor,
    noise_upper_bound_mm,
    with_u95_of_instrument,
)
from minimax_cal.fitting.options import Options, Progress, silent_progress
from minimax_cal.fitting.outcome import FileEvidence, missed_rows
from minimax_cal.fitting.outliers import find_contradicting_points
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.fitting.session_frames import place_sessions, warn_of_unplaced_sessions
from minimax_cal.instruments.camera_images import CameraImages
from minimax_cal.instruments.instrument_files import (
    InstrumentData,
    InstrumentInput,
    read_instruments_or_measurements,
)
from minimax_cal.instruments.tracker_points import TrackerPoints
from minimax_cal.measuring import measurement_checks
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import add_group_column, cluster_poses, select_holdout_rows
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.effect_names import format_budget_step
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.effects.time_effects import SESSION_JUMP
from minimax_cal.robots.robot import Robot, RobotSource, load_robot

if TYPE_CHECKING:  # it is slow to import
    from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis

DATA_FAULTS_STAGE, CAUSES_STAGE, BUDGET_STAGE = (
    "faults of the data",
    "testing causes",
    "error budget",
)
REGIONS_STAGE, REMAINING_STAGE = "regions held out", "remaining error"
DIAGNOSIS_STAGES = (DATA_FAULTS_STAGE, CAUSES_STAGE, BUDGET_STAGE, REGIONS_STAGE, REMAINING_STAGE)
NO_EXTRAPOLATION_TEST = RegionHoldout(reason="not asked for")
search_option = option_field_in_group("What is sought")


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
    exclude: Sequence[str] = search_option(
        (),
        "Do not consider this effect; `minimax-cal effects` lists them.",
        metavar="EFFECT",
        flag="--without",
        many=tuple,
    )
    quick: bool = search_option(
        False, "Hold out no parts of the poses in turn: no claim outside the measured region."
    )

    def number_stage(self, progress: Progress, stage_name: str) -> Progress:
        """Progress of one of STEPS."""
        steps = [step for step in DIAGNOSIS_STAGES if not (self.quick and step == REGIONS_STAGE)]
        return announce_step_and_number_stages(
            progress, steps.index(stage_name) + 1, len(steps), stage_name
        )


OTHER_INSTRUMENT_OPTIONS = ("offset", "known_distances", "lever", "noises", *CameraImages.options)


@overload
def diagnose(
    robot: RobotSource,
    data: Measurements | TrackerPoints,
    *,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent_progress,
    **options: Any,
) -> Diagnosis: ...
@overload
def diagnose(
    robot: RobotSource,
    data: InstrumentData,
    *,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent_progress,
    **options: Any,
) -> RelativeDiagnosis: ...
@overload
def diagnose(
    robot: RobotSource,
    data: InstrumentInput | Sequence[InstrumentInput],
    *,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent_progress,
    **options: Any,
) -> Diagnosis | RelativeDiagnosis: ...
@take_option_fields_as_keywords(
    options=DiagnosisOptions,
    others=(RelativeOptions, OTHER_INSTRUMENT_OPTIONS),
    readers_by_field={**RELATIVE_OPTION_READERS, "exclude": list},
)
def diagnose(
    robot: Robot | str | Path,
    data: InstrumentInput | Sequence[InstrumentInput],
    *,
    options: DiagnosisOptions,
    others: RelativeOptions,
    jobs: int = 1,
    cluster: str = "",
    progress: Progress = silent_progress,
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
    given = read_instruments_or_measurements(data)
    if not isinstance(given, Measurements):
        from minimax_cal.diagnosing.diagnose_instruments import diagnose_with_options

        chosen = merge_instrument_options(given, replace(options, exclude=()), others)
        return diagnose_with_options(robot, given, options.exclude, chosen, progress)
    check_no_instrument_options(given, others)
    check_excluded_effects_are_known(options.exclude, EFFECTS)
    given = measurement_checks.check_and_complete_joints(robot, given)
    measurement_checks.check_point_spread(robot, given)
    raw = add_group_column(add_history_columns(with_u95_of_instrument(given, options.instrument)))
    held, notices = select_holdout_rows(raw, options.holdout, options.seed, options.holdout_by)
    if not held.any():
        raise DataError(
            f"{given.source}: no pose is held out; a diagnosis needs some that no fit has seen: "
            "measure more poses, or hold out more (holdout)"
        )
    judges = raw.take(held)
    if len(np.unique(cluster_poses(judges))) < MIN_HELD_POSES:
        few = (
            f"only {judges.poses} poses are held out: what is said of new poses rests on these; "
            "calibrate with the effects found judges every pose by a fit without it"
        )
        notices = (*notices, few)
    notices = (*notices, *warn_of_unplaced_sessions(raw, ~held))
    raw = place_sessions(robot, raw, ~held)
    with limit_blas_to_one_thread():
        return diagnose_checked_measurements(
            robot, raw, held, options, notices, progress, began, (jobs, cluster)
        )


def diagnose_checked_measurements(
    robot: Robot,
    measurements: Measurements,
    holdout_mask: Array,
    options: DiagnosisOptions,
    notices: tuple[str, ...],
    progress: Progress,
    start_time: float,
    workers: tuple[int, str],
) -> Diagnosis:
    """The diagnosis of checked measurements.

    holdout_mask: (m,) True for poses that no fit may see.  start_time: when the work did [s].
    workers: processes, and the address of a Dask scheduler.
    """
    step_of, held_lines = partial(options.number_stage, progress), measurements.line[holdout_mask]
    clean = clean_measurements(robot, measurements, held_lines, step_of(DATA_FAULTS_STAGE))
    train = clean.data.take(~np.isin(clean.data.line, held_lines))
    judges = JudgingPoses.from_measurements(
        measurements.take(holdout_mask), clean.measured, clean.data, train, options.holdout_by
    )
    fit = clean.fit or fit_cell(robot, train, LEAST_SQUARES_OPTIONS, progress)
    study = replace(linearise_geometry(robot, train, fit), jump_times=clean.jump_times)

    # Causes, their budget, and how well these extrapolate: where worse than geometry, none of them
    # is recommended.
    study, causes = search_causes(
        study, clean.faults, options.exclude, step_of(CAUSES_STAGE), *workers
    )
    causes, spoken, ladder = fit_error_budget(study, causes, step_of(BUDGET_STAGE))
    beyond = (
        NO_EXTRAPOLATION_TEST
        if options.quick
        else compare_extrapolation(study, causes, judges, step_of(REGIONS_STAGE))
    )
    refused = math.nan
    if beyond.typical_mm > beyond.geometric_typical_mm:
        causes, spoken = (
            replace(one, effects=tuple(replace(f, extends=not f.established) for f in one.effects))
            for one in (causes, spoken)
        )
        ladder, refused = replace(ladder, confirmed_count=0), beyond.typical_mm
        beyond = compare_extrapolation(study, causes, judges, silent_progress)
    kept = ladder.confirmed_steps
    causes = replace(
        causes, remaining_components=find_remaining_beside_terms(study, causes, kept.last_fit.terms)
    )

    # Steps on held-out poses, and the noise beneath the last one that is recommended.
    last, late = judges.mark_outliers(kept.joint_fits[0].cell, kept.last_fit.cell)
    spoilt = None
    if any(f.effect in MENDED_FAULT_NAMES for f in causes.faults):
        spoilt = measurements.take(~np.isin(measurements.line, held_lines))
    steps = judge_budget_steps(study, last, spoken, ladder, spoilt)
    for one in steps:
        progress(build_finished_budget_step_stage(format_budget_step(one.name), one.holdout.rms_mm))
    count = len(steps) - len(ladder.taken_numbers) + ladder.confirmed_count
    step = steps[count - 1]
    judge = step.trusted if step.trusted.poses else step.train
    error = kept.last_fit.cell.error(clean.data)
    most = noise_upper_bound_mm(error, kept.last_fit.pose_linearisation.degrees_of_freedom)
    whole = estimate_noise_floor(clean.data, error, robot.repeatability, most)
    floor = whole.limited_by_error(judge.rms_mm)  # noise is part of what is left
    share, interval = explained_fraction(kept, last, floor, options.seed)
    effects = [
        *fill_fitted_values(spoken.effects, kept),
        *fill_fitted_values(spoken.effects, ladder)[ladder.confirmed_count :],
    ]
    foot = tuple(compare_laws_with_reflectors(kept.last_fit, clean.data))
    effects = [*mark_contradicted_findings(effects, foot)]
    findings = fill_error_fractions(
        [*build_fault_findings(causes.faults), *effects], steps, floor.lower_limit_mm
    )

    # The verdict, by all that is known of the noise.
    step_of(REMAINING_STAGE)
    known = estimate_noise_limits(kept.last_fit, whole, clean.data, robot.repeatability)
    wrong = describe_contradiction(robot, floor, step)
    gone, counted = accuracy_with_set_aside_points(
        measurements, clean.data, clean.left_out, judges.heldout_measurements, kept.last_fit.cell
    )
    told = explain_verdict(findings, causes, known, study.fit.status, is_contradicted=bool(wrong))
    left = (
        () if told["verdict"] == "not_repeatable" else causes.remaining_components
    )  # it scatters, that is all
    most = floor.value if told["structure_in"] == ABOVE_NOISE_TEXT else math.inf
    rest, complete = split_remaining_error(left, judge.rms_mm, clean.data, error, most)
    more = ladder.last_fit.cell if len(steps) > count else None
    return Diagnosis(
        **{**told, "meets_floor": is_down_to_complete_noise(known, complete)},
        robot=robot.name,
        ladder=tuple(steps[:count]),
        possible=steps[-1] if more else None,
        possible_cell=more,
        floor=floor,
        closed=share,
        closed_ci=interval,
        beyond=beyond,
        noise=float(
            np.sqrt(study.variance_anisotropy * causes.selection.noise.variance)
        ),  # of a mean coordinate
        where=locate_errors(study).to_dict(),
        notices=(
            *measurements.notices,
            *notices,
            *list_notices(study, clean, kept, late, effects),
            *describe_reflector_agreement(foot),
            *warn_of_wrong_robot(study.robot, study.fit, study.nominal_cell.error(study.data)),
            *filter(None, [wrong]),
        ),
        provenance=Provenance.from_run(robot, measurements, vars(options)),
        seconds=time.perf_counter() - start_time,
        data=study.geometric_cell.align_to_first_session(clean.data),
        held=~np.isin(clean.data.line, train.line),
        cells=tuple(fit.cell for fit in kept.joint_fits),
        nominal=study.nominal_cell,
        remaining=None if wrong else rest,
        tested=(known.lowest_error_mm, known.highest_noise_mm),
        refused=refused,
        floor_known=complete,
        repeatable=known.is_repeatable,
        set_aside=gone,
        with_them=counted,
    )


def list_notices(
    study: LinearisedGeometry,
    clean_data: CleanData,
    budget: BudgetSteps,
    late_outliers: tuple[str, ...],
    effects: Sequence[Finding],
) -> Iterator[str]:
    """What the reader should know.

    late_outliers: outliers that the gap had hidden.  effects: with the values of the last fit.
    """
    yield from clean_data.remarks
    if not any(one.term.effect == SESSION_JUMP.name for one in effects):  # its size is the fit's
        yield from clean_data.jump_texts
    yield from filter(None, [study.scene.unused_torques_notice])
    if late_outliers:
        yield f"outliers that no effect found explains: {format_first_names(late_outliers)}"
    every = budget.last_fit.cell.align_to_first_session(clean_data.measured)
    yield from find_contradicting_points(every, budget.last_fit.cell.error(every))
    yield from describe_session_changes(study, effects)
    yield from study.fit.notices


def judge_budget_steps(
    study: LinearisedGeometry,
    judging_poses: JudgingPoses,
    causes: FoundCauses,
    budget: BudgetSteps,
    faulty_training_poses: Measurements | None,
) -> list[BudgetStep]:
    """The steps of the budget, each judged: faults of the data first, by what they do to a fit.

    faulty_training_poses: training poses as measured, where they hold faults that were mended.
    """
    robot, geometric = study.robot, "geometric"
    steps = [judging_poses.judge_cell("nominal", study.nominal_cell)]
    if faulty_training_poses:
        fit, whole = (
            fit_cell(robot, faulty_training_poses, LEAST_SQUARES_OPTIONS, silent_progress),
            replace(judging_poses, training_measurements=faulty_training_poses),
        )
        steps = [
            whole.judge_cell("nominal", fit.nominal_cell(robot, faulty_training_poses)),
            whole.judge_cell("geometric", fit.cell(robot, faulty_training_poses)),
        ]
        faults = dict.fromkeys(f.effect for f in causes.faults if f.effect in MENDED_FAULT_NAMES)
        geometric = f"without {' and '.join(faults)}"
    names = (
        geometric,
        *(causes.effects[number].term.budget_step_name for number in budget.taken_numbers),
    )
    cells = zip(names, budget.joint_fits, strict=True)
    return [*steps, *(judging_poses.judge_cell(name, fit.cell) for name, fit in cells)]


def describe_contradiction(robot: Robot, floor: NoiseFloor, last_step: BudgetStep) -> str:
    """Why the last rung contradicts the data; empty where it does not."""
    certain = floor.is_certain and floor.source != DISTANCES  # which do not hold what the arm does
    known = (floor.value, floor.source) if certain else None
    scores = {
        "training": (last_step.train, last_step.train),
        "held-out": (last_step.holdout, last_step.trusted),
    }
    return missed_rows(robot, FileEvidence(scores, floor=known))
