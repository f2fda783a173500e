"""The gap between a simulator's model and logs of the arm: measured, named, closed, measured."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import check_output_path
from minimax_cal.core.option_fields import take_option_fields_as_keywords
from minimax_cal.core.progress_stages import Progress, silent_progress
from minimax_cal.core.threads import limit_blas_to_one_thread
from minimax_cal.dynamics.diagnose import diagnose_motion
from minimax_cal.dynamics.known_inputs import (
    MotionKnown,
    Payload,
    read_checked_runs,
    read_runs_of_robot,
)
from minimax_cal.dynamics.logs.log_table import CURRENT_UNIT, NO_TORQUE_UNIT, Run
from minimax_cal.dynamics.result import MotionDiagnosis, MotionEffect, load_motion
from minimax_cal.fitting.fit import Fit
from minimax_cal.robots.mjcf_import import import_mujoco
from minimax_cal.robots.urdf_robot import MJCF_SUFFIXES
from minimax_cal.simulators.motion import drives
from minimax_cal.simulators.motion.correct import (
    MIN_LOG_ERROR_FALL,
    CandidateModels,
    correct_elements,
    mean_logarithm,
    select_elements,
)
from minimax_cal.simulators.motion.fit import ASSUMED_BODY_PRIOR_SIGMA, BODY_PRIOR_SIGMA, FitData
from minimax_cal.simulators.motion.judge import OWN_SERVOS_TEXT, MotionJudge
from minimax_cal.simulators.motion.model_parameters import (
    OpenedModel,
    apply_calibration,
    open_model,
)
from minimax_cal.simulators.result import MotionGap, MotionGapStep


@take_option_fields_as_keywords(known=MotionKnown)
def motion_gap(
    model: Path | str,
    logs: Sequence[Run | str | Path] | str | Path,
    *,
    fit: Fit | Path | str | None = None,
    diagnosis: MotionDiagnosis | Path | str | None = None,
    write: Path | str | None = None,
    tip: str = "",
    known: MotionKnown,
    gains: tuple[Sequence[float], Sequence[float]] | None = None,
    plain: bool = False,
    actuators: tuple[str, Path | str] | None = None,
    randomize: Path | str | None = None,
    driven: bool = True,
    progress: Progress = silent_progress,
) -> MotionGap:
    """Say how a simulated arm moves beside the real one, and correct what makes the difference.

    Parameters
    ----------
    model
        An MJCF, or a robot file or URDF, of which a new MJCF is made.
    logs
        Files or runs; each is a trajectory.
    fit
        A static calibration of the same arm, which goes into the same file.
    diagnosis
        Of the motion, where it is known already.
    write
        Where the corrected model goes.
    tip
        Last body of the arm, where the model has several.
    known
        See `MotionKnown`.
    gains
        Stiffness [N m/rad] and damper [N m s/rad] of the drives, of all joints or of each.
    plain
        Whether the file is fitted without what other simulators leave out of it: damping and
        stiffness of higher powers, and delay.
    actuators
        `isaac` or `json`, and where the actuators of the corrected model go.
    randomize
        Where mean, covariance and spread between runs of what was fitted go (JSON).
    driven
        Whether drives move the arm along the held-out runs as well.
    progress
        Called with a word on each stage.

    Returns
    -------
    MotionGap

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.motion_gap("arm.xml", ["run1.csv", "run2.csv"], write="corrected.xml").summary())
    """
    began = time.perf_counter()
    if write is not None:
        check_output_path(write, MJCF_SUFFIXES)
    import_mujoco()
    if actuators and actuators[0] not in ("isaac", "json"):
        raise OptionError(f"actuators={actuators[0]!r}: give isaac or json, and a file")
    for file in (actuators and actuators[1], randomize):
        if file is not None:
            check_output_path(file)
    progress("reading the model and the logs")
    runs = read_runs_of_robot(model, logs)
    opened = open_model(model, runs[0].joints if runs else 0, tip)
    runs = read_checked_runs(model, opened.chain.robot, runs, allow_commands_only=driven)
    with limit_blas_to_one_thread():
        commanded = driven and all(run.command is not None for run in runs)
        judge = MotionJudge.from_runs(opened, runs, known, judge_by_fastest=commanded)
        if commanded:
            whole = open_model(model, runs[0].joints, tip, with_free_joints=False)
            if drives.are_logs_without_joint_dampers(judge, whole):
                opened, judge = whole, judge.for_model(whole)
        judge = judge.with_drives(opened, gains) if driven else judge
        first, notices = [judge.measure_step("as given", opened.chain)], tuple[str, ...]()
        if fit is not None:
            opened, notices = apply_calibration(opened, Fit.load(fit))
            judge = judge.for_model(opened)
            first.append(judge.measure_step("calibrated geometry", opened.chain))
        if judge.held_out_logs.unit == NO_TORQUE_UNIT:
            progress("fitting the drives to their commands")
            made = drives.correct_by_positions(judge, opened, portable=plain)
        else:
            found = load_or_make_diagnosis(judge, opened, diagnosis, known.payload, progress)
            judge = replace(judge, arm=replace(judge.arm, fastest=found.arm.fastest,
                                               soft=found.arm.soft))  # fmt: skip
            bench = build_candidate_models(judge, opened, found, portable=plain)
            made = correct_by_torques(bench, found, progress)
    nothing = False
    if judge.is_driven_by_commands:  # the joint error has to fall, joint by joint and in all
        rungs = (*first, *made.rungs)
        start, end = (np.array(rungs[k].tracking_rms_mrad) for k in (0, -1))
        falls = np.linalg.norm(end) < np.linalg.norm(start)
        nothing = not (falls and mean_logarithm(end) < mean_logarithm(start) - MIN_LOG_ERROR_FALL)
    path = None if write is None or nothing else Path(write)
    if path is not None:
        made.opened.write(path)
    if actuators is not None and not nothing:
        drives.write_actuators(actuators[1], actuators[0], made.opened.chain, made.served)
    if randomize is not None and not nothing:
        count = len(judge.learning_runs)
        drives.write_ranges(
            randomize, made.candidate_and_data, made.served, opened.chain.joint_names, count
        )
    told = (text for run in runs for text in run.notices)
    said = (*told, *notices, *made.notices, *(made.portability_notices if path else ()))
    return MotionGap(
        model=str(model),
        robot=opened.chain.robot.name,
        unit=judge.held_out_logs.unit,
        rungs=tuple(first[:1] if nothing else (*first, *made.rungs)),
        effects=() if nothing else made.effects,
        elements=() if nothing else made.elements,
        left_out=made.left_out,
        drives=judge.drive_text,
        held_out=judge.held_out_logs.names,
        notices=tuple(dict.fromkeys(said)),
        written="" if path is None else str(path),
        seconds=time.perf_counter() - began,
    )


def correct_by_torques(
    candidates: CandidateModels, diagnosis: MotionDiagnosis, progress: Progress
) -> drives.CorrectedDrivesModel:
    """By torques, and by commands where they were logged."""
    judge, opened = candidates.judge, candidates.opened
    served: drives.FittedDrives | None = None
    effects, rungs = tuple[MotionEffect, ...](), tuple[MotionGapStep, ...]()

    # Drives that logged commands show, a step for each kind of effect, rated beside all elements.
    if judge.drive_text == OWN_SERVOS_TEXT and opened.has_correctable_servos():
        progress("fitting the drives to their commands")
        served = drives.fit_drives(judge, opened, portable=candidates.portable)
    if served and served.has_changes:
        driven = build_candidate_models(
            judge, served.apply_to(opened), diagnosis, portable=candidates.portable
        )
        beside = driven.fit_candidate(select_elements(diagnosis, candidates)).opened
        served = served.without_idle(judge, beside)
        effects = served.rate_effects(judge, beside)
        off = judge.measure_torque_error(opened.chain)
        rungs = tuple(judge.measure_step(name, one.chain, torque_errors=off)
                      for name, one in served.apply_by_steps(effects, opened))  # fmt: skip
        candidates = build_candidate_models(
            judge, served.apply_to(opened), diagnosis, portable=candidates.portable
        )

    # Elements of the body, from torques.
    made = correct_elements(candidates, diagnosis, progress)
    notices, filtered = made.notices, candidates.opened.chain.name_joints_with_filtered_commands()
    if judge.drive_text == OWN_SERVOS_TEXT and filtered:
        text = f"the servos of {filtered} filter their commands: gains and delay stay as they are"
        notices = (*notices, text)
    changes = {
        "rungs": (*rungs, *made.rungs),
        "notices": notices,
        "portability_notices": (*made.portability_notices, *drives.list_delay_notices(effects)),
    }
    return drives.CorrectedDrivesModel(**vars(made) | changes, served=served, effects=effects)


def load_or_make_diagnosis(
    judge: MotionJudge,
    opened: OpenedModel,
    diagnosis: MotionDiagnosis | Path | str | None,
    payload: Payload | None,
    progress: Progress,
) -> MotionDiagnosis:
    """The diagnosis that is given, or a new one whose search sees no run that judges.

    Raises OptionError for one of another arm or unit.
    """
    if diagnosis is None:
        gain = judge.arm.gain.tolist() if judge.held_out_logs.unit == CURRENT_UNIT else None
        ratio = judge.arm.ratio.tolist() if np.isfinite(judge.arm.ratio).any() else None
        return diagnose_motion(
            judge.arm.robot,
            [*judge.learning_runs, *judge.held_out_runs],
            holdout_run=judge.held_out_logs.names,
            payload=payload,
            drive_gain=gain,
            ratio=ratio,
            progress=progress,
        )
    found = load_motion(diagnosis)
    if (
        found.unit != judge.held_out_logs.unit
        or found.arm.robot.joints != opened.chain.robot.joints
    ):
        raise OptionError("diagnosis: is of another arm or another unit; leave it, to make one")
    return found


def build_candidate_models(
    judge: MotionJudge, opened: OpenedModel, diagnosis: MotionDiagnosis, *, portable: bool
) -> CandidateModels:
    """Where corrections of a model are fitted and judged.  portable: as of `CandidateModels`."""
    assumed = opened.given.assumed or opened.chain.has_assumed_masses
    study = FitData.of(opened.chain, judge.arm, judge.learning_logs, diagnosis.models[-1].terms,
                     opened.chain.largest_inertias_over_workspace(),
                     ASSUMED_BODY_PRIOR_SIGMA if assumed else BODY_PRIOR_SIGMA)  # fmt: skip
    return CandidateModels(judge, opened, study, portable)
