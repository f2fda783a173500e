"""The gap between a simulator's model and logs of the arm: measured, named, closed, measured."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from minimax_cal.dynamics.diagnose import diagnose_motion
from minimax_cal.dynamics.given import MotionKnown, Payload, read_logs, runs_of
from minimax_cal.dynamics.logs.table import CURRENT, NOTHING, Run
from minimax_cal.dynamics.result import MotionDiagnosis, MotionEffect, load_motion
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable
from minimax_cal.ground.options import takes
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.ground.threads import one_thread
from minimax_cal.robots.mjcf import mujoco
from minimax_cal.robots.urdf import MODELS
from minimax_cal.simulators.motion import drives
from minimax_cal.simulators.motion.correct import STAYS, Bench, asked_of, correct, mean_log
from minimax_cal.simulators.motion.fit import PRIOR, PRIOR_ASSUMED, Study
from minimax_cal.simulators.motion.judge import OWN_SERVOS, Judge
from minimax_cal.simulators.motion.numbers import Opened, calibrated, open_model
from minimax_cal.simulators.result import MotionGap, MotionRung


@takes(known=MotionKnown)
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
    progress: Progress = silent,
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
        check_writable(write, MODELS)
    mujoco()
    if actuators and actuators[0] not in ("isaac", "json"):
        raise OptionError(f"actuators={actuators[0]!r}: give isaac or json, and a file")
    for file in (actuators and actuators[1], randomize):
        if file is not None:
            check_writable(file)
    progress("reading the model and the logs")
    runs = read_logs(model, logs)
    opened = open_model(model, runs[0].joints if runs else 0, tip)
    runs = runs_of(model, opened.chain.robot, runs, commands=driven)
    with one_thread():
        commanded = driven and all(run.command is not None for run in runs)
        judge = Judge.of(opened, runs, known, fast=commanded)
        if commanded:
            whole = open_model(model, runs[0].joints, tip, freed=False)
            if drives.damped_by_joints(judge, whole):
                opened, judge = whole, judge.of_model(whole)
        judge = judge.driving(opened, gains) if driven else judge
        first, notices = [judge.rung("as given", opened.chain)], tuple[str, ...]()
        if fit is not None:
            opened, notices = calibrated(opened, Fit.load(fit))
            judge = judge.of_model(opened)
            first.append(judge.rung("calibrated geometry", opened.chain))
        if judge.held.unit == NOTHING:
            progress("fitting the drives to their commands")
            made = drives.by_positions(judge, opened, plain=plain)
        else:
            found = told_or_found(judge, opened, diagnosis, known.payload, progress)
            judge = replace(judge, arm=replace(judge.arm, fastest=found.arm.fastest,
                                               soft=found.arm.soft))  # fmt: skip
            bench = bench_of(judge, opened, found, plain=plain)
            made = by_torques(bench, found, progress)
    nothing = False
    if judge.commanded:  # the joint error has to fall, joint by joint and in all
        rungs = (*first, *made.rungs)
        start, end = (np.array(rungs[k].tracking_rms_mrad) for k in (0, -1))
        falls = np.linalg.norm(end) < np.linalg.norm(start)
        nothing = not (falls and mean_log(end) < mean_log(start) - STAYS)
    path = None if write is None or nothing else Path(write)
    if path is not None:
        made.opened.write(path)
    if actuators is not None and not nothing:
        drives.write_actuators(actuators[1], actuators[0], made.opened.chain, made.served)
    if randomize is not None and not nothing:
        count = len(judge.learning_runs)
        drives.write_ranges(randomize, made.fitted, made.served, opened.chain.names, count)
    told = (text for run in runs for text in run.notices)
    said = (*told, *notices, *made.notices, *(made.lost if path else ()))
    return MotionGap(
        model=str(model),
        robot=opened.chain.robot.name,
        unit=judge.held.unit,
        rungs=tuple(first[:1] if nothing else (*first, *made.rungs)),
        effects=() if nothing else made.effects,
        elements=() if nothing else made.elements,
        left_out=made.left_out,
        drives=judge.drives,
        held_out=judge.held.names,
        notices=tuple(dict.fromkeys(said)),
        written="" if path is None else str(path),
        seconds=time.perf_counter() - began,
    )


def by_torques(bench: Bench, found: MotionDiagnosis, progress: Progress) -> drives.Answer:
    """By torques, and by commands where they were logged."""
    judge, opened = bench.judge, bench.opened
    served: drives.Served | None = None
    effects, rungs = tuple[MotionEffect, ...](), tuple[MotionRung, ...]()

    # Drives that logged commands show, a step for each kind of effect, rated beside all elements.
    if judge.drives == OWN_SERVOS and opened.has_correctable_servos():
        progress("fitting the drives to their commands")
        served = drives.serve(judge, opened, plain=bench.plain)
    if served and served.changes:
        driven = bench_of(judge, served.apply_to(opened), found, plain=bench.plain)
        beside = driven.candidate(asked_of(found, bench)).opened
        served = served.without_idle(judge, beside)
        effects = served.rate_effects(judge, beside)
        off = judge.torque(opened.chain)
        rungs = tuple(judge.rung(name, one.chain, missed=off)
                      for name, one in served.apply_by_steps(effects, opened))  # fmt: skip
        bench = bench_of(judge, served.apply_to(opened), found, plain=bench.plain)

    # Elements of the body, from torques.
    made = correct(bench, found, progress)
    notices, filtered = made.notices, bench.opened.chain.find_filtered_servos()
    if judge.drives == OWN_SERVOS and filtered:
        text = f"the servos of {filtered} filter their commands: gains and delay stay as they are"
        notices = (*notices, text)
    changes = {"rungs": (*rungs, *made.rungs), "notices": notices,
               "lost": (*made.lost, *drives.lost_late(effects))}  # fmt: skip
    return drives.Answer(**vars(made) | changes, served=served, effects=effects)


def told_or_found(
    judge: Judge,
    opened: Opened,
    given: MotionDiagnosis | Path | str | None,
    payload: Payload | None,
    progress: Progress,
) -> MotionDiagnosis:
    """The diagnosis that is given, or a new one whose search sees no run that judges.

    Raises OptionError for one of another arm or unit.
    """
    if given is None:
        gain = judge.arm.gain.tolist() if judge.held.unit == CURRENT else None
        ratio = judge.arm.ratio.tolist() if np.isfinite(judge.arm.ratio).any() else None
        return diagnose_motion(
            judge.arm.robot,
            [*judge.learning_runs, *judge.runs],
            holdout_run=judge.held.names,
            payload=payload,
            drive_gain=gain,
            ratio=ratio,
            progress=progress,
        )
    found = load_motion(given)
    if found.unit != judge.held.unit or found.arm.robot.joints != opened.chain.robot.joints:
        raise OptionError("diagnosis: is of another arm or another unit; leave it, to make one")
    return found


def bench_of(judge: Judge, opened: Opened, found: MotionDiagnosis, *, plain: bool) -> Bench:
    """Where corrections of a model are fitted and judged.  plain: as of `Bench`."""
    assumed = opened.given.assumed or opened.chain.has_assumed_masses
    study = Study.of(opened.chain, judge.arm, judge.learning, found.models[-1].terms,
                     opened.chain.find_largest_inertias(),
                     PRIOR_ASSUMED if assumed else PRIOR)  # fmt: skip
    return Bench(judge, opened, study, plain)
