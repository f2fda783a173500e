"""Diagnose torques along trajectories: what the model lacks, and what each effect is worth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from minimax_cal.core.arrays import Array
from minimax_cal.core.option_fields import (
    check_excluded_effects_are_known,
    take_option_fields_as_keywords,
)
from minimax_cal.core.progress_stages import Progress, silent_progress
from minimax_cal.core.threads import limit_blas_to_one_thread
from minimax_cal.dynamics.cross_validation import CrossValidation
from minimax_cal.dynamics.known_inputs import (
    MAX_PLAUSIBLE_TORQUE_SCALE,
    MIN_PLAUSIBLE_TORQUE_SCALE,
    MotionKnown,
)
from minimax_cal.dynamics.laws import (
    ANGLE_TORQUE_FAMILY,
    FRICTION_CURVE_FAMILY,
    TORQUE_LAWS,
    USUAL_FRICTION_EFFECTS,
    TorqueTerm,
    list_testable_terms,
)
from minimax_cal.dynamics.logs.log_table import Run
from minimax_cal.dynamics.mass_tests import (
    LinkChange,
    compare_masses_with_nominal,
    find_payloads_by_run,
)
from minimax_cal.dynamics.residual_structure import Unexplained, find_unexplained_torques
from minimax_cal.dynamics.result import (
    MotionAlternative,
    MotionDiagnosis,
    MotionEffect,
    MotionVerdict,
    UntestableMotionEffect,
)
from minimax_cal.dynamics.torque_regression import (
    RIGID_BODY_GROUP,
    USUAL_FRICTION_GROUP,
    FittedBody,
    TorqueColumns,
    TorqueDictionary,
    TorqueRegression,
)
from minimax_cal.dynamics.torque_rows import ArmMotion, MotionLogs, TorqueArm
from minimax_cal.measuring.faults.data_fault import FaultAmount
from minimax_cal.robots.gravity_torques import known_link_mass_mask
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.candidate_library import CandidateLibrary
from minimax_cal.selection.forward_selection import EffectSelection, select_effects_by_evidence
from minimax_cal.selection.stability_selection import (
    SubsampleSelections,
    build_half_masks,
    find_alternatives,
    select_on_subsamples,
)
from minimax_cal.selection.thresholds import FALSE_NAME_PROBABILITY, MINOR_EFFECT_SQUARE_FRACTION

MIN_TOTAL_DURATION = 25.0  # of trajectories: in less, laws stand in for each other
MIN_PEAK_SPEED = 0.25  # that some joint must reach [rad/s, m/s]: slower, most laws are invisible
MAX_UNEXPLAINED_SQUARE_SHARE = (
    0.28  # of the remaining error's square at a joint, 15 % of its RMS: more has no name
)
SELECTION_FOLD_SHARE = (
    0.2  # about this share of the trajectories is left out in turn to judge a law
)
RANDOM_HALVING_COUNT = 2  # of the groups, in whose halves names are sought again
MIN_REPEAT_SHARE = 0.75  # of the halves in which a confirmed name is found
MAX_GAIN_ERROR = 0.3  # of a drive: what is off by more has another unit or sign
MIN_DELAY = 1e-4  # delays below it move no row [s]
ZERO_DELAY = FaultAmount("time", 0.0, "s", 0.0)


@take_option_fields_as_keywords(known=MotionKnown)
def diagnose_motion(
    robot: Robot | str | Path,
    logs: Sequence[Run | str | Path] | str | Path,
    *,
    known: MotionKnown,
    exclude: Sequence[str] = (),
    progress: Progress = silent_progress,
) -> MotionDiagnosis:
    """Say why the torques of a robot along trajectories are not those of its model.

    Parameters
    ----------
    robot
        Loaded, or a name or path; masses, inertias and drive gains of its file are used.
    logs
        Files or runs; each is a trajectory.
    known
        See `MotionKnown`.
    exclude
        Effects that are not to be considered.
    progress
        Called with a word on each stage.

    Returns
    -------
    MotionDiagnosis

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.diagnose_motion("arm.urdf", ["run1.csv", "run2.csv"]).summary())
    """
    began = time.perf_counter()
    check_excluded_effects_are_known(exclude, TORQUE_LAWS)
    progress("reading logs")
    inputs = known.read_inputs(robot, logs)
    with limit_blas_to_one_thread():
        found = diagnose_torques(inputs.arm, inputs.logs, inputs.fold_by_row, exclude, progress)
    seconds = time.perf_counter() - began
    return replace(found, notices=(*inputs.notices, *found.notices), seconds=seconds)


def diagnose_torques(
    arm: TorqueArm,
    logs: MotionLogs,
    fold_by_row: Array,
    excluded_effects: Sequence[str],
    progress: Progress,
) -> MotionDiagnosis:
    """Causes of what a rigid body leaves of the torques, judged on rows that their fit did not see.

    fold_by_row: (R,) in which a row is left out, negative for rows that are always fitted; the
    search sees these alone where there are some.  excluded_effects: effects that are not
    considered.
    """
    rows = fold_by_row < 0 if (fold_by_row < 0).any() else fold_by_row >= 0
    learning, logged_torque = np.unique(logs.run_index[rows]).tolist(), logs.row_torques

    # Forward selection of laws by evidence; again with whatever changes the rows or all columns.
    progress("searching for causes")
    search = search_torque_laws(arm, logs.select_runs(learning), excluded_effects)
    soft = search.columns.fit_sign_change_speeds(search.terms)
    if np.any(soft > arm.soft):
        arm = replace(arm, soft=soft)
        progress("searching again with softer friction")
        search = search_torque_laws(arm, logs.select_runs(learning), excluded_effects)
    if wrong_units := search.describe_wrong_torque_units():
        arm = replace(arm, gain=np.zeros(0))
        progress("searching again with masses of each joint")
        search = search_torque_laws(arm, logs.select_runs(learning), excluded_effects)
    delay = search.find_torque_delay()
    if delay.value:
        logs = logs.with_torque_delay_removed(delay.value)
        progress("searching again without the delay")
        search = search_torque_laws(arm, logs.select_runs(learning), excluded_effects)

    # Backward elimination by cross-validation over the runs that the search saw.
    progress("judging causes on trajectories left out")
    normal = TorqueRegression.build_with_estimated_whitening(search.columns, search.terms)
    fold = search.logs.split_rows_into_folds(SELECTION_FOLD_SHARE)
    validation = CrossValidation.build(normal, search.columns.torques_to_explain, fold)
    search = search.with_terms_only(validation.select_laws_that_help())

    # Generalised least squares of all runs, and without each fold.
    columns = search.columns
    if len(learning) < len(logs.names):
        columns = search.linearisation_body.build_torque_columns(ArmMotion.build(arm, logs))
    normal = TorqueRegression.build_with_estimated_whitening(columns, search.terms)
    undelayed = columns.torques_to_explain + (logged_torque - logs.row_torques).T
    validation = CrossValidation.build(normal, undelayed, fold_by_row)

    # Stability selection, test of the masses as given, structure of the residuals.
    masks = build_half_masks(search.selection.library.problem.row_groups, RANDOM_HALVING_COUNT)
    repeats = select_on_subsamples(
        search.selection, masks, false_name_probability=FALSE_NAME_PROBABILITY
    )
    masses = compare_masses_with_nominal(normal)
    left = tuple(find_unexplained_torques(normal, validation.values))
    if any(
        one.share > MAX_UNEXPLAINED_SQUARE_SHARE for one in left
    ):  # what makes the masses look wrong, perhaps
        masses = replace(masses, link_change=None)

    effects = build_motion_effects(search, validation, repeats, delay, masses.link_change)
    too_little = search.describe_lacking_motion()
    return MotionDiagnosis(
        arm=arm,
        unit=logs.unit,
        verdict=find_verdict(effects, left, too_little),
        effects=effects,
        budget=validation.list_heldout_rms_by_step(delay.value),
        unexplained=left,
        not_testable=search.list_untestable_effects(),
        too_little=too_little,
        models=validation.fit_models_of_budget_steps(search.linearisation_body, delay.value),
        runs=logs.names,
        held_out=validation.describe_held_out_rows(),
        held_run=validation.build_held_out_run(),
        curves=tuple(validation.compute_friction_curves()),
        notices=(*wrong_units, *masses.describe_masses(arm, logs.unit)),
        seconds=0.0,
    )


@dataclass(frozen=True, eq=False)
class TorqueLawSearch:
    """The laws that trajectories call for.

    columns: of the rows that were searched.  linearisation_body: body and friction that the laws
    were computed with.  untested_laws: effect, place and what is needed of laws that were not
    tried.
    """

    columns: TorqueColumns
    linearisation_body: FittedBody
    selection: EffectSelection
    untested_laws: tuple[tuple[str, str, str], ...]

    @property
    def logs(self) -> MotionLogs:
        """Whose rows were searched."""
        return self.columns.scene.logs

    @property
    def terms(self) -> tuple[TorqueTerm, ...]:
        """The laws."""
        return tuple(one.candidate.term for one in self.selection.candidate_fits)

    def with_terms_only(self, terms: Sequence[TorqueTerm]) -> TorqueLawSearch:
        """With some of its laws."""
        found = tuple(one for one in self.selection.candidate_fits if one.candidate.term in terms)
        return replace(self, selection=replace(self.selection, candidate_fits=found))

    def describe_lacking_motion(self) -> tuple[str, ...]:
        """Why the motion is too little to name a cause."""
        peak, out = float(np.abs(self.logs.motion.qd).max()), []
        if self.logs.total_duration < MIN_TOTAL_DURATION:
            out.append(
                f"{self.logs.total_duration:.0f} s of trajectories; "
                f"record {MIN_TOTAL_DURATION:.0f} s or more, "
                "better several of different kinds"
            )
        if peak < MIN_PEAK_SPEED:
            out.append(
                f"no joint is faster than {peak:.2g} rad/s; record a run that reaches "
                f"{MIN_PEAK_SPEED:g} rad/s or more"
            )
        return tuple(out)

    def list_untestable_effects(self) -> tuple[UntestableMotionEffect, ...]:
        """What the logs cannot show, each effect and need once."""
        needs: dict[tuple[str, str], list[str]] = {}
        for effect, place, what in self.untested_laws:
            needs.setdefault((effect, what), []).append(place)
        joints, out = {f"J{j + 1}" for j in range(self.logs.joint_count)}, []
        for (effect, what), places in needs.items():
            place = "all" if joints <= set(places) else ", ".join(places)
            out.append(UntestableMotionEffect(effect, place, what))
        if not self.columns.scene.arm.known.any():
            what = "a known payload: without one a common error of all drive gains and masses are "
            out.append(UntestableMotionEffect("drive_gain", "all", f"{what}the same"))
        return tuple(out)

    def describe_wrong_torque_units(self) -> tuple[str, ...]:
        """Notices of torques whose size no error of a drive or of the masses explains."""
        scene, scales = self.columns.scene, dict[int, tuple[float, str]]()
        if scene.arm.has_shared_inertial_parameters and known_link_mass_mask(scene.arm.robot).all():
            drawn = scene.regressor @ scene.arm.nominal_inertial_parameters
            j = int(np.argmax((drawn**2).sum(axis=0)))
            scale = float(drawn[:, j] @ scene.load_torque[:, j] / (drawn[:, j] @ drawn[:, j]))
            if not MIN_PLAUSIBLE_TORQUE_SCALE < scale < MAX_PLAUSIBLE_TORQUE_SCALE:
                scales[j] = scale, f"the masses of {scene.arm.robot.name}"
        for term, (value, _) in zip(self.terms, self.selection.joint_estimates, strict=True):
            if term.effect == "drive_gain" and abs(value[0]) > MAX_GAIN_ERROR:
                scales[term.joint_index] = float(1.0 + value[0]), "masses that all joints share"
        return tuple(
            f"the torques of joint {j + 1} are {scale:.3g} times what {masses} need: another unit "
            "or sign; currents? then name the columns i1_A, i2_A, ... and give drive_gain=; here "
            "each joint has masses of its own"
            for j, (scale, masses) in scales.items()
        )

    def find_torque_delay(self) -> FaultAmount:
        """By which torques were logged after the motion [s]."""
        delay = ZERO_DELAY
        for term, (value, sigma) in zip(self.terms, self.selection.joint_estimates, strict=True):
            if term.effect == "delay" and abs(value[0]) > MIN_DELAY:
                delay = replace(delay, value=float(value[0]), sigma=float(sigma[0]))
        return delay


def search_torque_laws(
    arm: TorqueArm, logs: MotionLogs, excluded_effects: Sequence[str]
) -> TorqueLawSearch:
    """The laws that the fitted rows of some logs call for."""
    scene = ArmMotion.build(arm, logs)
    context = FittedBody.fit_with_friction(scene)
    columns = context.build_torque_columns(scene)
    every, lacking = list_testable_terms(columns.scene, excluded_effects)
    terms = [term for term in every if term.effect != "payload"]
    if len(terms) < len(every):
        terms += find_payloads_by_run(columns, terms)
    laws = TorqueDictionary.build(columns, columns.estimate_whitening(terms))
    choice = select_effects_by_evidence(CandidateLibrary.from_terms(laws, terms, []))
    hidden = ((effect, "all", "motion in which the rigid body does not imitate it")
              for effect, _ in choice.library.untestable)  # fmt: skip
    return TorqueLawSearch(columns, context, choice, (*lacking, *hidden))


def build_motion_effects(
    law_search: TorqueLawSearch,
    validation: CrossValidation,
    repeats: SubsampleSelections,
    removed_delay: FaultAmount,
    link_change: LinkChange | None,
) -> tuple[MotionEffect, ...]:
    """What the torques show, with what each effect is worth; those that close most first.

    removed_delay: that was taken out of the torques.  link_change: a link whose parameters are not
    as given.
    """
    normal, logs, unit = validation.regression, validation.logs, validation.logs.unit
    value, sigma = validation.values, validation.sigmas
    usual = validation.compute_rms_by_joint(
        validation.compute_held_out_residuals([RIGID_BODY_GROUP, USUAL_FRICTION_GROUP]),
        logs.is_row_moving,
    )
    effects: list[MotionEffect] = []

    def is_minor(worth: dict[str, tuple[float, float]], before: Array) -> bool:
        """Whether an effect closes little of what the step before its kind leaves (n,)."""
        shares = ((a**2 - b**2) / max(before[int(joint[1:]) - 1] ** 2, 1e-300)
                  for joint, (a, b) in worth.items())  # fmt: skip
        return bool(max(shares) < MINOR_EFFECT_SQUARE_FRACTION)

    # Laws: confirmed where most halves of the data show them, too.
    whole = removed_delay
    for number, term in enumerate(law_search.terms):
        at = normal.column_slices[term.text]
        if (
            removed_delay.value and term.effect == "delay"
        ):  # what the shift of the torques left of it
            rest = value[at].item(), sigma[at].item()
            whole = replace(removed_delay, value=removed_delay.value + rest[0], sigma=rest[1])
            continue
        others = [part for part in normal.column_groups if part != term.text]
        worth = validation.compare_rms_by_joint(validation.compute_held_out_residuals(others))
        rivals = ((rival.candidate.term, rho2) for rival, rho2, _ in find_alternatives(
            *law_search.selection.compare_with_others(number)))  # fmt: skip
        frequency = repeats.selection_frequency([term.key])
        effects.append(MotionEffect(
            term.effect, term.place, term.law.build_amounts(value[at], sigma[at], unit, term.tuned),
            worth, tuple(MotionAlternative(t.effect, t.place, rho2, t.law.separate)
                         for t, rho2 in rivals),
            frequency, frequency >= MIN_REPEAT_SHARE, is_minor(worth, usual), term.law.family,
        ))  # fmt: skip

    # Coulomb and viscous friction of each joint, where the rows show them [z test, Bonferroni].
    rigid = validation.compute_rms_by_joint(
        validation.compute_held_out_residuals([RIGID_BODY_GROUP]), logs.is_row_moving
    )
    for number, column in enumerate(
        normal.column_indices_of_groups([USUAL_FRICTION_GROUP]).tolist()
    ):
        z = value[column] / sigma[column] if sigma[column] > 0.0 else 0.0
        if float(ndtr(-z)) * 2 * logs.joint_count > FALSE_NAME_PROBABILITY:
            continue
        worth = validation.compare_rms_by_joint(
            validation.compute_held_out_residuals(normal.column_groups, excluded_columns=(column,))
        )
        unit_of = unit if number % 2 == 0 else f"{unit} s/rad"
        amount = FaultAmount("friction", float(value[column]), unit_of, float(sigma[column]))
        effects.append(
            MotionEffect(
                USUAL_FRICTION_EFFECTS[number % 2],
                f"J{number // 2 + 1}",
                (amount,),
                worth,
                minor=is_minor(worth, rigid),
                family=FRICTION_CURVE_FAMILY,
            )
        )

    # A delay that was taken out before, and a link that is not as given.
    if removed_delay.value:
        worth = validation.compare_rms_by_joint(
            validation.compute_held_out_residuals(normal.column_groups, with_delay_removed=False)
        )
        minor = is_minor(worth, usual)
        effects.insert(0, MotionEffect("delay", "all", (whole,), worth, minor=minor))
    if link_change is not None:
        last, law = logs.joint_count - 1, TORQUE_LAWS["payload"]
        names = {k: ("payload" if k == last else "link_inertia", f"L{k + 1}")
                 for k in range(last + 1)}  # fmt: skip
        effects.insert(
            0,
            MotionEffect(
                *names[link_change.link_index],
                law.build_amounts(
                    link_change.inertial_parameters, link_change.inertial_parameter_sigmas, ""
                ),
                link_change.rms_before_and_after_by_joint,
                tuple(
                    MotionAlternative(*names[k], 1.0, law.separate)
                    for k in link_change.alternative_links
                ),
                minor=is_minor(link_change.rms_before_and_after_by_joint, link_change.rms_before),
            ),
        )
    return tuple(sorted(effects, key=lambda one: (one.minor, -one.relative_gain)))


def find_verdict(
    effects: Sequence[MotionEffect], unexplained: Sequence[Unexplained], motion_lacks: Sequence[str]
) -> MotionVerdict:
    """What may be said of the cause."""
    main = [e for e in effects if e.established and not e.minor]
    if motion_lacks or any(one.share > MAX_UNEXPLAINED_SQUARE_SHARE for one in unexplained):
        return "unknown"
    if not main:
        return "unknown" if unexplained else "none"
    beyond_usual = [e for e in main if e.effect not in USUAL_FRICTION_EFFECTS]
    first = max(beyond_usual or main, key=lambda one: one.relative_gain)
    # Forms of one curve over speed or angle at a joint are one cause.
    form = effect_family(first.effect), first.place
    same = [e for e in beyond_usual if (effect_family(e.effect), e.place) == form]
    others = [a for a in first.alternatives if (effect_family(a.effect), a.place) != form]
    return "one_of" if others or (len(same) > 1 and form[0] == ANGLE_TORQUE_FAMILY) else "named"


def effect_family(effect: str) -> str:
    """The family of an effect: forms of one friction curve are one."""
    if effect in USUAL_FRICTION_EFFECTS:
        return FRICTION_CURVE_FAMILY
    return TORQUE_LAWS[effect].family or effect if effect in TORQUE_LAWS else effect
