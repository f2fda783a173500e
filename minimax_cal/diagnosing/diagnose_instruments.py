"""Diagnose what the fit of several instruments leaves: the laws of the arm, in the rows of all."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.option_fields import (
    check_excluded_effects_are_known,
    take_option_fields_as_keywords,
)
from minimax_cal.core.threads import limit_blas_to_one_thread
from minimax_cal.diagnosing.budget_steps import max_motion_per_unit as motions_of
from minimax_cal.diagnosing.cause_search import FoundCauses, judge_causes
from minimax_cal.diagnosing.confirmation import select_frequent
from minimax_cal.diagnosing.diagnosis import Finding
from minimax_cal.diagnosing.findings import with_complete_law
from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis, RelativeStep
from minimax_cal.diagnosing.remaining_error import (
    NO_REMAINING_COMPONENT,
    find_remaining_component,
    list_effect_motions,
)
from minimax_cal.diagnosing.verdict import NoiseLimits, explain_verdict
from minimax_cal.fitting.multi_instrument.instrument_fit import (
    InstrumentFit,
    residual_squares_and_freedom,
)
from minimax_cal.fitting.multi_instrument.laws import is_arm_effect
from minimax_cal.fitting.multi_instrument.linear_rows import (
    build_common_arm_state,
    build_instrument_rows,
)
from minimax_cal.fitting.multi_instrument.options import (
    RELATIVE_OPTION_READERS,
    Progress,
    RelativeOptions,
    silent_progress,
)
from minimax_cal.fitting.multi_instrument.relative_calibration import (
    RelativeTask,
    judge_instrument_fit,
    prepare_relative_task,
)
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.fitting.robust_fit import SQUARE_LOSS
from minimax_cal.instruments.instrument import METRE_UNIT
from minimax_cal.instruments.instrument_files import InstrumentInput
from minimax_cal.modelling.arm_laws import build_library_of_testable_arm_laws
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.forward_selection import select_effects_by_evidence
from minimax_cal.selection.remaining_structure import RemainingComponent
from minimax_cal.selection.thresholds import (
    MIN_RELATIVE_HELDOUT_GAIN,
    MINOR_EFFECT_SQUARE_FRACTION,
    SOUND_JOINT_JITTER_RAD,
)
from minimax_cal.solvers.status import Status

SINGLE_INSTRUMENT_NEEDED = "the measurements of one instrument alone: minimax-cal diagnose"
COMMON_CLOCK_NEEDED = "a temperature; the times of several files have no common zero"
UNKNOWN_NOISE = NoiseLimits(np.nan, 0.0, np.nan, np.nan)


@take_option_fields_as_keywords(chosen=RelativeOptions, readers_by_field=RELATIVE_OPTION_READERS)
def diagnose_relative(
    robot: Robot | str | Path,
    data: InstrumentInput | Sequence[InstrumentInput],
    *,
    exclude: Sequence[str] = (),
    chosen: RelativeOptions,
    progress: Progress = silent_progress,
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
    return diagnose_with_options(robot, data, exclude, chosen, progress)


def diagnose_with_options(
    robot: Robot | str | Path,
    data: InstrumentInput | Sequence[InstrumentInput],
    excluded_effects: Sequence[str],
    options: RelativeOptions,
    progress: Progress,
) -> RelativeDiagnosis:
    """`diagnose_relative`, which calls this, with its options in one."""
    began = time.perf_counter()
    check_excluded_effects_are_known(excluded_effects, EFFECTS)
    if options.effects:
        raise OptionError("effects: a diagnosis looks for them; leave them out")
    if options.loss != SQUARE_LOSS:
        raise OptionError(f"loss={options.loss} is not for a diagnosis yet: leave it out")
    asked = prepare_relative_task(robot, data, options, with_effect_search=True)
    if not all(held.any() for held, _ in asked.splits):
        raise DataError(
            "a diagnosis needs held-out rows in every file: measure more, or hold out more "
            "(holdout)"
        )
    with limit_blas_to_one_thread():
        fit = asked.fit_training_data(progress)
        progress("testing causes")
        scene, causes = search_shared_causes(asked, fit, tuple(excluded_effects))
        progress("error budget")
        ladder = fit_instrument_budget(asked, fit, select_frequent(causes.effects))
        effects = fill_instrument_fractions(scene, ladder)
        last = ladder.calibrations[-1]
        known, file, unit = estimate_instrument_noise(scene, ladder.fits[-1])
        failed = last.status is Status.FAILED or ladder.calibrations[0].status is Status.FAILED
        steps = [RelativeStep.from_calibration("nominal", ladder.calibrations[0], nominal=True)]
        names = ["geometric", *(found.term.budget_step_name for found in ladder.findings)]
        steps += [
            RelativeStep.from_calibration(n, c)
            for n, c in zip(names, ladder.calibrations, strict=True)
        ]
        return RelativeDiagnosis(
            **explain_verdict(effects, causes, known, last.status, is_contradicted=failed),
            calibration=last,
            steps=tuple(steps),
            floor_file=file,
            floor=(known.lowest_error_mm, known.highest_noise_mm),
            floor_unit=unit,
            seconds=time.perf_counter() - began,
        )


# ---- the search --------------------------------------------------------------------------------


def search_shared_causes(
    request: RelativeTask, fit: InstrumentFit, excluded_effects: tuple[str, ...]
) -> tuple[PosedArm, FoundCauses]:
    """What explains the errors that geometry leaves.

    The instruments are weighed once more by the noises beside the effects: what geometry leaves of
    the rough and of the fine alike counts too much as noise.
    """
    lacking = dict(list_untestable_effects(request.robot, fit))
    left_out = (*excluded_effects, *lacking)
    scene = build_common_arm_state(request.robot, fit)
    rows = build_instrument_rows(scene, fit)
    choice = select_effects_by_evidence(build_library_of_testable_arm_laws(scene, rows, left_out))
    if choice.candidate_fits and len(fit.training_data) > 1:
        bent = request.with_effects([one.term for one in choice.candidates]).fit_training_data(
            silent_progress
        )
        stack = replace(fit.stack, precision=bent.stack.precision)
        rows = build_instrument_rows(scene, replace(fit, problem=replace(fit.problem, stack=stack)))
        choice = select_effects_by_evidence(
            build_library_of_testable_arm_laws(scene, rows, left_out),
            previous_fits=choice.candidate_fits,
        )
    left: tuple[RemainingComponent, ...] = (NO_REMAINING_COMPONENT,)
    if choice.noise.variance >= rows.rounding_noise**2:
        left = find_remaining_component(
            scene, rows, choice.effect_and_variation_columns, list_effect_motions(choice)
        )
    untestable = (*choice.library.untestable, *lacking.items())
    return scene, judge_causes(
        scene, FoundCauses((), left_out, choice, (), left, untestable), rows.row_groups
    )


def list_untestable_effects(robot: Robot, fit: InstrumentFit) -> Iterator[tuple[str, str]]:
    """Effects that these instruments together cannot test, and what they lack."""
    scenes = fit.stack.arm_states(robot, fit.state)
    for name, effect in EFFECTS.items():
        if effect.is_map:
            continue
        if not is_arm_effect(name):
            yield name, SINGLE_INSTRUMENT_NEEDED
        elif missing := next(filter(None, (effect.needs(scene) for scene in scenes)), ""):
            yield name, missing
        elif len(scenes) > 1 and any(Term(name, place, choice).ends_with_session
                                     for place in effect.places(scenes[0])
                                     for choice in effect.choices(scenes[0], place)):  # fmt: skip
            yield name, COMMON_CLOCK_NEEDED


# ---- what the effects are worth ----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class InstrumentBudget:
    """Geometry, then with each effect that helps at held-out poses.

    heldout_rms: of each step, RMS of the held-out errors, each file's by its noise.
    """

    fits: list[InstrumentFit]
    calibrations: list[RelativeCalibration]
    findings: list[Finding]
    heldout_rms: list[float]


def fit_instrument_budget(
    request: RelativeTask, fit: InstrumentFit, effects: Sequence[Finding]
) -> InstrumentBudget:
    """The steps of the error budget.  effects: found often enough, the weightiest first."""
    chosen = [term for found in effects for term in found.terms]
    scene = build_common_arm_state(request.robot, fit)
    waiting = [with_complete_law(found, chosen, scene) for found in effects]
    every = [term for found in waiting for term in found.terms]
    began = time.perf_counter()
    full = request.with_effects(every).fit_training_data(silent_progress) if waiting else fit
    spent, noise = time.perf_counter() - began, full.noise
    first = judge_instrument_fit(request, fit, time.perf_counter())
    out = InstrumentBudget([fit], [first], [], [relative_heldout_rms(first, fit, noise)])
    for found in waiting:
        terms = [term for one in (*out.findings, found) for term in one.terms]
        wider = request.with_effects(terms)
        began = time.perf_counter() - (spent if terms == every else 0.0)
        bent = full if terms == every else wider.fit_training_data(silent_progress)
        result = judge_instrument_fit(wider, bent, began)
        error = relative_heldout_rms(result, bent, noise)
        if error**2 < (1.0 - MIN_RELATIVE_HELDOUT_GAIN) * out.heldout_rms[-1] ** 2:
            out.fits.append(bent)
            out.calibrations.append(result)
            out.findings.append(found)
            out.heldout_rms.append(error)
    return out


def relative_heldout_rms(result: RelativeCalibration, fit: InstrumentFit, noise: Array) -> float:
    """RMS of the held-out errors, each file's relative to its noise (b,) [m]."""
    rough = noise / [one.row_noise for one in fit.stack.instruments]
    square = [
        np.nansum((one.errors["holdout"] / r) ** 2)
        for one, r in zip(result.instruments, rough, strict=True)
    ]
    return float(np.sqrt(sum(square) / sum(one.numbers["holdout"] for one in result.instruments)))


def fill_instrument_fractions(scene: PosedArm, budget: InstrumentBudget) -> list[Finding]:
    """The findings with their values in the last fit and what each takes off, largest first."""
    last, scenes = (
        budget.fits[-1],
        budget.fits[0].stack.arm_states(scene.robot, budget.fits[0].state),
    )
    first = last.stack.parameter_count_without_laws
    values = last.stack.law_values(last.state)
    sigma = np.sqrt(np.maximum(np.diag(last.covariance)[first:], 0.0))
    squares, at, out = np.square(budget.heldout_rms), 0, []
    for i, found in enumerate(budget.findings):
        own = slice(at, at + len(found.names))
        at = own.stop
        before, after = (c.accuracy["holdout"].rms_mm for c in budget.calibrations[i : i + 2])
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
                minor=share < MINOR_EFFECT_SQUARE_FRACTION,
            )
        )
    return sorted(out, key=lambda found: -found.share)


def estimate_instrument_noise(scene: PosedArm, fit: InstrumentFit) -> tuple[NoiseLimits, str, str]:
    """What is known of the noise beneath the last step, of the file that exceeds it most.

    Known is the noise of files that the user gave; sound joints add to it.  In
    the unit of the file's rows [SI].  And the file's name and unit.
    """
    stack = fit.stack
    cost, spare = residual_squares_and_freedom(fit.problem, fit.state)
    looks = build_instrument_rows(scene, fit.geometric_fit or fit).looks
    worst, file, units = UNKNOWN_NOISE, "", METRE_UNIT
    for i, (one, look) in enumerate(zip(stack.instruments, looks, strict=True)):
        if not np.isfinite(stack.given[i]):
            continue
        arm = look.rows_from_fields(scene.jacobian[..., look.poses])
        own = (arm**2).sum(axis=0).mean() / (fit.geometric_fit or fit).stack.precision[i]
        unit = 1.0 / one.row_noise
        low = float(np.sqrt(cost[i] / chdtri(spare[i], 0.05)))
        most = float(np.sqrt(stack.given[i] + SOUND_JOINT_JITTER_RAD**2 * own))
        if not worst.lowest_error_mm / worst.highest_noise_mm > low / most:
            worst = replace(worst, lowest_error_mm=unit * low, highest_noise_mm=unit * most)
            file, units = stack.labels[i], one.unit
    return worst, file, units
