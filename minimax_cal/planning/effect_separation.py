"""Poses that tell two effects apart: what one moves and the other, with the geometry, cannot.

The power of a set of poses is lambda (1 - rho^2), as `separate` has it: the square, in units of
noise, of what is left of an effect's motion as it was fitted once its rival, the geometry and the
other effects have imitated it on old and new poses together.  It is one over the variance of the
effect's amplitude in the fit that holds all of them, so that the best poses are a design for one
unknown (c-optimal); for two linear models that is the T-optimal design [Atkinson and Fedorov 1975].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.diagnosing import next_measurement
from minimax_cal.diagnosing.next_measurement import (
    PREPARATION_MINUTES,
    ConfusedEffects,
    MeasurementPlanner,
)
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.arm_laws import ArmLaws
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import effect_displacement_fields, parse_effect_text
from minimax_cal.modelling.effects.table import parse_effect_terms as terms_of
from minimax_cal.modelling.effects_in_model import pose_arm_at_values
from minimax_cal.modelling.error_rows import linearise_to_point_rows
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.planning.designs.design_exchange import ExperimentPool
from minimax_cal.planning.designs.optimality_criteria import (
    TraceCriterion,
    evaluate_information_matrix,
)
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.forward_selection import select_best_variant
from minimax_cal.selection.noise_model import estimate_noise_by_reml, identifiable_combinations

MIN_SEPARABLE_FRACTION = (
    1e-4  # 1 - rho^2 over all candidates below which two effects are the same at every pose
)
FAINT_PRIOR_INFORMATION = (
    1e-9  # information about anything beside the effect that is there in any case
)


@dataclass(frozen=True, eq=False)
class SeparationQuestion:
    """Two effects that data confuse, and the fitted cell that shows them."""

    site: MeasurementPlanner
    pair: ConfusedEffects


@dataclass(frozen=True, eq=False)
class StudyWithGivenPoses(MeasurementPlanner):
    """A site whose further poses are given: `measured_rows` and `more`, no revisits."""

    given_plan: next_measurement.MeasurementPlan = field(kw_only=True)

    @cached_property
    def measurement_plan(self) -> next_measurement.MeasurementPlan:
        """What is given."""
        return self.given_plan


def build_separation_question(
    robot: Robot, measurements: Measurements, cell: Cell, effect_texts: Sequence[str], seed: int
) -> SeparationQuestion:
    """Fit the effect in question to the data, with the effects of a cell that are not in the pair.

    robot: nominal.  effect_texts: the effect and its rival, as joint_compliance:J2.  Raises
    OptionError.
    """
    asked = [parse_effect_text(text)[:2] for text in effect_texts]
    labels = {f"{name}:{place}" for name, place in asked}
    beside = [term for term in cell.effects.terms if term.label not in labels]
    for term in beside:
        for name, place in asked:
            if term.effect == name and "all" in (term.place, place or "all"):
                raise OptionError(
                    f"separate=: the fit holds {term.label}, and {name}:{place or 'all'} is part "
                    "of the same: ask about that, or give a fit without it"
                )
    measurements = add_history_columns(measurements)
    fit = calibrate(robot, measurements, "sum", holdout=0.0, effects=(*beside, effect_texts[0]))
    measurements = fit.cell.align_to_first_session(measurements)
    state = replace(fit.cell.parameter_values, effects=np.zeros(0))
    model = build_point_model(robot, measurements)
    scene = pose_arm_at_values(robot, measurements, model, state)
    rows = linearise_to_point_rows(model, state, scene.jacobian)
    fitted = fit.cell.effects
    noise = estimate_noise_by_reml(
        rows, rows.rows_from_fields(effect_displacement_fields(fitted.terms, scene))
    )
    (other,) = terms_of(scene, effect_texts[1:], partial(select_best_variant, ArmLaws(scene, rows)))
    one, value = fitted.terms[-1], fitted.values[-1]
    if one.text == other.text:
        raise OptionError(f"separate=: {effect_texts[0]} and {effect_texts[1]} are the same effect")
    if not np.any(value):
        raise OptionError(f"separate=: the data show no {one.label}; name another")
    known = tuple(zip(fitted.terms[:-1], fitted.values[:-1], strict=True))
    return SeparationQuestion(
        MeasurementPlanner(scene, model, state, noise, seed),
        ConfusedEffects(one, value, other, known),
    )


def build_measurements_at_later_poses(posed_arm: PosedArm, q: Array) -> Measurements:
    """Poses (m, n) measured one after another once the data at hand are."""
    last = int(np.argmax(posed_arm.column("clock")))
    old = next_measurement.with_float_columns(posed_arm.data, posed_arm)
    return next_measurement.append_visits(posed_arm, old.take(np.full(len(q), last)), np.array(q))


def add_stops_to_study(
    study: MeasurementPlanner, q: Array, visible_targets: Array, is_via_stop: Array
) -> StudyWithGivenPoses:
    """The site with the stops (c, n) of a way that may be gone.

    visible_targets: (c, k) of its targets.  is_via_stop: (c,) stops at which nothing is measured.
    """
    scene, weight = study.scene, study.model.weight
    m = scene.poses
    old = next_measurement.with_float_columns(scene.data, scene)
    data = old.append_measurements(build_measurements_at_later_poses(scene, q).take(~is_via_stop))
    at = {"old": (0, m), "more": (m, int((~is_via_stop).sum()))} | {
        kind: (m, 0) for kind in (*PREPARATION_MINUTES, "old") if kind not in ("more", "old")
    }
    usual = float(np.median(weight[weight > 0.0]))
    plan = next_measurement.MeasurementPlan(
        data, np.concatenate([weight, usual * visible_targets[~is_via_stop].T], axis=1), at
    )
    return StudyWithGivenPoses(
        scene, study.model, study.state, study.noise, study.seed, given_plan=plan
    )


@dataclass(frozen=True, eq=False)
class SeparationPower:
    """What each candidate tells about the effect's amplitude, and about all that may imitate it.

    pool: the last unknown is the amplitude, in units of what was fitted.
    power_without_alternative: lambda over all candidates and old poses, the rival not fitted.
    """

    pool: ExperimentPool
    power_without_alternative: float

    @property
    def criterion(self) -> TraceCriterion:
        """One over the power."""
        weight = np.zeros((self.pool.unknown_count,) * 2)
        weight[-1, -1] = 1.0
        return TraceCriterion(weight)

    def power_with_poses(self, pose_indices: Array) -> float:
        """lambda (1 - rho^2) of old poses and those chosen."""
        return 1.0 / evaluate_information_matrix(
            self.criterion, self.pool.information_of_experiments(pose_indices)
        )

    @property
    def measured_power(self) -> float:
        """Of the old poses."""
        return self.power_with_poses(np.zeros(0, dtype=int))

    @property
    def all_candidates_power(self) -> float:
        """Of all candidates together."""
        return self.power_with_poses(np.arange(self.pool.experiment_count))

    @property
    def is_inseparable(self) -> bool:
        """Whether no pose tells the two apart."""
        return self.all_candidates_power <= MIN_SEPARABLE_FRACTION * self.power_without_alternative


def predict_separation_power(
    question: SeparationQuestion, q: Array, visible_targets: Array, is_via_stop: Array
) -> SeparationPower:
    """What the stops (c, n) of a way would tell.  visible_targets: (c, k).  is_via_stop: as
    `add_stops_to_study`.
    """
    site = add_stops_to_study(question.site, q, visible_targets, is_via_stop)
    mine, _, _ = next_measurement.effect_motions(site, question.pair.effect)
    found = np.tensordot(question.pair.effect_values, mine.target_motions, 1)[None]
    beside = next_measurement.fitted_effect_motions(site, question.pair.other_effects)
    rival = list(next_measurement.effect_motions(site, question.pair.alternative)[:2])
    parts = [part.target_motions for part in (*beside, *rival)]
    ridge = np.concatenate([part.prior_precisions for part in (*beside, *rival)])
    columns = site.row_rotations.rows_from_fields(np.concatenate([*parts, found]))
    rows = np.concatenate([site.geometry_columns, columns], axis=1) * site.row_weight_roots[:, None]
    prior = np.diag(np.concatenate([np.zeros(site.geometry_columns.shape[1]), ridge, [0.0]]))
    free = len(prior) - 1 - sum(len(part.prior_precisions) for part in rival)
    old = site.pose_row_slice(
        site.measurement_plan.select_plan_rows("old", len(question.site.scene.data.q))
    )
    return SeparationPower(
        build_effect_amplitude_pool(rows, prior, old, site.planned_arm.targets),
        power_without_alternative_columns(rows, prior, free),
    )


def build_effect_amplitude_pool(
    weighted_rows: Array, prior: Array, measured_rows: slice, target_count: int
) -> ExperimentPool:
    """Rows (N, d) in a basis in which what imitates is told to the same accuracy by everything."""
    whole = weighted_rows.T @ weighted_rows + prior
    span = identifiable_combinations(whole[:-1, :-1])
    turn = np.zeros((len(whole), span.shape[1] + 1))
    turn[:-1, :-1], turn[-1, -1] = span, 1.0
    turned = weighted_rows @ turn
    at_hand = turned[measured_rows]
    base = at_hand.T @ at_hand + turn.T @ prior @ turn
    base[np.arange(len(base) - 1), np.arange(len(base) - 1)] += FAINT_PRIOR_INFORMATION
    return ExperimentPool(
        turned[measured_rows.stop :].reshape(-1, 3 * target_count, turn.shape[1]), base
    )


def power_without_alternative_columns(
    weighted_rows: Array, prior: Array, free_column_count: int
) -> float:
    """lambda of the last column over all rows, only the first `free_column_count` columns imitating
    it.
    """
    kept = [*range(free_column_count), weighted_rows.shape[1] - 1]
    gram = (weighted_rows.T @ weighted_rows + prior)[np.ix_(kept, kept)]
    span = identifiable_combinations(gram[:-1, :-1])
    across = span.T @ gram[:-1, -1]
    return float(gram[-1, -1] - across @ across)


def suggest_other_separation(question: SeparationQuestion) -> str:
    """What else would tell them apart, by `separate`: load, sides, time, reflectors on the foot."""
    return next_measurement.describe_best_separation(question.site, question.pair)
