"""Diagnose what the fit of several instruments leaves: the laws of the arm, in the rows of all."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from minimax_cal.diagnosing.causes import Causes, judge_causes
from minimax_cal.diagnosing.established import select_frequent
from minimax_cal.diagnosing.findings import with_complete_law
from minimax_cal.diagnosing.gap import motions as motions_of
from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis, RelativeStep
from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.verdict import Known, explanation
from minimax_cal.diagnosing.what_remains import NOTHING, left_over, motions
from minimax_cal.evidence.limits import HELPS, MAX_JOINT_JITTER, MINOR
from minimax_cal.evidence.remains import Remains
from minimax_cal.evidence.selection import select
from minimax_cal.fitting.robust import SQUARE
from minimax_cal.fitting.several.fit import InstrumentFit, remaining
from minimax_cal.fitting.several.kinds import Asked, asked_of, result_of
from minimax_cal.fitting.several.laws import is_shared
from minimax_cal.fitting.several.linear import rows_of_all, scene_of_all
from minimax_cal.fitting.several.options import READ, Progress, RelativeOptions, silent
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.options import check_left_out, takes
from minimax_cal.ground.threads import one_thread
from minimax_cal.instruments.file import Given
from minimax_cal.instruments.instrument import METRE
from minimax_cal.modelling.dictionary import arm_library
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.status import Status

ELSEWHERE = "the measurements of one instrument alone: minimax-cal diagnose"
CLOCKS = "a temperature; the times of several files have no common zero"
NOT_KNOWN = Known(np.nan, 0.0, np.nan, np.nan)


@takes(chosen=RelativeOptions, read=READ)
def diagnose_relative(
    robot: Robot | str | Path,
    data: Given | Sequence[Given],
    *,
    exclude: Sequence[str] = (),
    chosen: RelativeOptions,
    progress: Progress = silent,
) -> RelativeDiagnosis:
    """Say what geometry leaves of one or several instruments' measurements, and why.

    Every instrument counts by its noise.  Effects that all of them share are looked for: those of
    the arm and of its foot.

    Parameters
    ----------
    robot, data
        As `relative` takes them.
    exclude
        Effects that are not to be considered.
    chosen
        See `RelativeOptions`.
    progress
        Called with a word on each stage.

    Returns
    -------
    RelativeDiagnosis
        The verdict, and the calibration with the effects found.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.diagnose_relative("irb2600", ["tracker.csv", "sockets.csv"]).headline())
    """
    return diagnosed(robot, data, exclude, chosen, progress)


def diagnosed(
    robot: Robot | str | Path,
    data: Given | Sequence[Given],
    exclude: Sequence[str],
    chosen: RelativeOptions,
    progress: Progress,
) -> RelativeDiagnosis:
    """`diagnose_relative`, which calls this, with its options in one."""
    began = time.perf_counter()
    check_left_out(exclude, EFFECTS)
    if chosen.effects:
        raise OptionError("effects: a diagnosis looks for them; leave them out")
    if chosen.loss != SQUARE:
        raise OptionError(f"loss={chosen.loss} is not for a diagnosis yet: leave it out")
    asked = asked_of(robot, data, chosen, sought=True)
    if not all(held.any() for held, _ in asked.splits):
        raise DataError(
            "a diagnosis needs held-out rows in every file: measure more, or hold out more "
            "(holdout)"
        )
    with one_thread():
        fit = asked.fit(progress)
        progress("testing causes")
        scene, causes = search_causes(asked, fit, tuple(exclude))
        progress("error budget")
        ladder = budget_of(asked, fit, select_frequent(causes.effects))
        effects = with_shares(scene, ladder)
        last = ladder.calibrations[-1]
        known, file, unit = known_noise(scene, ladder.fits[-1])
        failed = last.status is Status.FAILED or ladder.calibrations[0].status is Status.FAILED
        steps = [RelativeStep.of("nominal", ladder.calibrations[0], nominal=True)]
        names = ["geometric", *(found.term.step for found in ladder.findings)]
        steps += [RelativeStep.of(n, c) for n, c in zip(names, ladder.calibrations, strict=True)]
        return RelativeDiagnosis(
            **explanation(effects, causes, known, last.status, failed=failed),
            calibration=last,
            steps=tuple(steps),
            floor_file=file,
            floor=(known.remaining, known.highest),
            floor_unit=unit,
            seconds=time.perf_counter() - began,
        )


# ---- the search --------------------------------------------------------------------------------


def search_causes(
    asked: Asked, fit: InstrumentFit, exclude: tuple[str, ...]
) -> tuple[Scene, Causes]:
    """What explains the errors that geometry leaves.

    The instruments are weighed once more by the noises beside the effects: what geometry leaves of
    the rough and of the fine alike counts too much as noise.
    """
    lacking = dict(not_testable(asked.robot, fit))
    left_out = (*exclude, *lacking)
    scene = scene_of_all(asked.robot, fit)
    rows = rows_of_all(scene, fit)
    choice = select(arm_library(scene, rows, left_out))
    if choice.found and len(fit.trains) > 1:
        bent = asked.beside([one.term for one in choice.chosen]).fit(silent)
        stack = replace(fit.stack, precision=bent.stack.precision)
        rows = rows_of_all(scene, replace(fit, problem=replace(fit.problem, stack=stack)))
        choice = select(arm_library(scene, rows, left_out), first=choice.found)
    left: tuple[Remains, ...] = (NOTHING,)
    if choice.noise.variance >= rows.exact**2:
        left = left_over(scene, rows, choice.doubted, motions(choice))
    untestable = (*choice.library.untestable, *lacking.items())
    return scene, judge_causes(
        scene, Causes((), left_out, choice, (), left, untestable), rows.group
    )


def not_testable(robot: Robot, fit: InstrumentFit) -> Iterator[tuple[str, str]]:
    """Effects that these instruments together cannot test, and what they lack."""
    scenes = fit.stack.scenes(robot, fit.state)
    for name, effect in EFFECTS.items():
        if effect.is_map:
            continue
        if not is_shared(name):
            yield name, ELSEWHERE
        elif missing := next(filter(None, (effect.needs(scene) for scene in scenes)), ""):
            yield name, missing
        elif len(scenes) > 1 and any(Term(name, place, choice).ends_with_session
                                     for place in effect.places(scenes[0])
                                     for choice in effect.choices(scenes[0], place)):  # fmt: skip
            yield name, CLOCKS


# ---- what the effects are worth ----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Budget:
    """Geometry, then with each effect that helps at held-out poses.

    missed: of each step, RMS of the held-out errors, each file's by its noise.
    """

    fits: list[InstrumentFit]
    calibrations: list[RelativeCalibration]
    findings: list[Finding]
    missed: list[float]


def budget_of(asked: Asked, fit: InstrumentFit, effects: Sequence[Finding]) -> Budget:
    """The steps of the error budget.  effects: found often enough, the weightiest first."""
    chosen = [term for found in effects for term in found.terms]
    scene = scene_of_all(asked.robot, fit)
    waiting = [with_complete_law(found, chosen, scene) for found in effects]
    every = [term for found in waiting for term in found.terms]
    began = time.perf_counter()
    full = asked.beside(every).fit(silent) if waiting else fit
    spent, noise = time.perf_counter() - began, full.noise
    first = result_of(asked, fit, time.perf_counter())
    out = Budget([fit], [first], [], [missed(first, fit, noise)])
    for found in waiting:
        terms = [term for one in (*out.findings, found) for term in one.terms]
        wider = asked.beside(terms)
        began = time.perf_counter() - (spent if terms == every else 0.0)
        bent = full if terms == every else wider.fit(silent)
        result = result_of(wider, bent, began)
        error = missed(result, bent, noise)
        if error**2 < (1.0 - HELPS) * out.missed[-1] ** 2:
            out.fits.append(bent)
            out.calibrations.append(result)
            out.findings.append(found)
            out.missed.append(error)
    return out


def missed(result: RelativeCalibration, fit: InstrumentFit, noise: Array) -> float:
    """RMS of the held-out errors, each file's relative to its noise (b,) [m]."""
    rough = noise / [one.row_noise for one in fit.stack.instruments]
    square = [
        np.nansum((one.errors["holdout"] / r) ** 2)
        for one, r in zip(result.instruments, rough, strict=True)
    ]
    return float(np.sqrt(sum(square) / sum(one.numbers["holdout"] for one in result.instruments)))


def with_shares(scene: Scene, ladder: Budget) -> list[Finding]:
    """The findings with their values in the last fit and what each takes off, largest first."""
    last, scenes = ladder.fits[-1], ladder.fits[0].stack.scenes(scene.robot, ladder.fits[0].state)
    first = last.stack.lawless
    values = last.stack.values(last.state)
    sigma = np.sqrt(np.maximum(np.diag(last.covariance)[first:], 0.0))
    squares, at, out = np.square(ladder.missed), 0, []
    for i, found in enumerate(ladder.findings):
        own = slice(at, at + len(found.names))
        at = own.stop
        before, after = (c.accuracy["holdout"].rms_mm for c in ladder.calibrations[i : i + 2])
        share = float((squares[i] - squares[i + 1]) / squares[0])
        out.append(
            replace(
                found,
                values=tuple(values[own].tolist()),
                sigmas=tuple(sigma[own].tolist()),
                motion=tuple(
                    map(max, zip(*(motions_of(one, found) for one in scenes), strict=False))
                ),
                before=before,
                after=after,
                share=share,
                minor=share < MINOR,
            )
        )
    return sorted(out, key=lambda found: -found.share)


def known_noise(scene: Scene, fit: InstrumentFit) -> tuple[Known, str, str]:
    """What is known of the noise beneath the last step, of the file that exceeds it most.

    Known is the noise of files that the user gave; sound joints add to it.  In
    the unit of the file's rows [SI].  And the file's name and unit.
    """
    stack = fit.stack
    cost, spare = remaining(fit.problem, fit.state)
    looks = rows_of_all(scene, fit.stiff or fit).looks
    worst, file, units = NOT_KNOWN, "", METRE
    for i, (one, look) in enumerate(zip(stack.instruments, looks, strict=True)):
        if not np.isfinite(stack.given[i]):
            continue
        arm = look.of(scene.jacobian[..., look.poses])
        own = (arm**2).sum(axis=0).mean() / (fit.stiff or fit).stack.precision[i]
        unit = 1.0 / one.row_noise
        low = float(np.sqrt(cost[i] / chdtri(spare[i], 0.05)))
        most = float(np.sqrt(stack.given[i] + MAX_JOINT_JITTER**2 * own))
        if not worst.remaining / worst.highest > low / most:
            worst = replace(worst, remaining=unit * low, highest=unit * most)
            file, units = stack.labels[i], one.unit
    return worst, file, units
