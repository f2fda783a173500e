"""Geometry and effects in one fit: what is told, saved, exported and corrected with.

Points weigh alike, but for their u95, as in the accuracy that is claimed.  (Weights by the noise of
instrument and joints are what effects are sought with.  What a model lacks looks like noise of the
joints there, and a fit with such weights meets new poses of real arms worse.)
Compliances are not negative, nothing moves the arm by more than an arm can be off, and effects of
several parameters have priors of their own size (`sizes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.linear_trials import (
    CrossValidatable,
    fit_prior_weights,
    list_unscaled_parameters,
)
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.accuracy import Accuracy, summarise_point_errors
from minimax_cal.fitting.uncertainty import (
    Estimator,
    PosewiseFit,
    Uncertainty,
    estimate_uncertainty,
)
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.measuring.session_frames import SessionFrames
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import (
    NO_EFFECTS,
    Term,
    at_bound_mask,
    effect_parameter_bounds,
    effect_parameter_names_and_units,
    snap_to_near_bounds,
)
from minimax_cal.modelling.effects_in_model import extend_model_with_effects, split_values_by_effect
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel, apply_active_step
from minimax_cal.solvers.bounded_least_squares import solve_bounded_normal_equations

MAX_GAUSS_NEWTON_PASSES = 6  # of Gauss and Newton at most; columns of effects are made anew in each
MIN_RELATIVE_SQUARE_GAIN = 1e-4  # relative change of the weighed square that ends them


@dataclass(frozen=True, eq=False)
class GeometryEffectFit(CrossValidatable):
    """Geometry with some effects, fitted together.

    parameter_values: with the effects' values.  model: linear where the fit ended.
    at_bound: (e,) True where an effect's parameter is at a bound.
    """

    study: LinearisedGeometry
    terms: tuple[Term, ...]
    parameter_values: ParameterValues
    model: PointModel
    at_bound: Array

    @cached_property
    def estimator(self) -> Estimator:
        """How the fit weighs its poses."""
        active = self.model.active.copy()
        active[len(active) - len(self.at_bound) :] &= ~self.at_bound
        return Estimator(self.model.with_active(active), np.ones(len(self.model.y)))

    @cached_property
    def pose_linearisation(self) -> PosewiseFit:
        """Pose by pose, linear where the fit ended."""
        return PosewiseFit(self.estimator, self.parameter_values)

    @cached_property
    def cell(self) -> Cell:
        """What predicts."""
        return self.build_cell(self.parameter_values)

    def build_cell(self, state: ParameterValues) -> Cell:
        """What would predict with other values."""
        study, effects = self.study, NO_EFFECTS
        if self.terms:
            effects = split_values_by_effect(self.terms, study.scene, state.effects)
        sessions = SessionFrames.from_measurements(study.data)
        return Cell.from_parameters(study.robot, state, study.data.target_names, effects, sessions)

    @cached_property
    def training_accuracy(self) -> Accuracy:
        """On the poses of the fit."""
        return summarise_point_errors(self.cell.error(self.study.data))

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Of all parameters, by leaving out groups of poses; NaN on a bound."""
        units = (
            effect_parameter_names_and_units(self.terms, self.cell.pose_arm(self.study.data))[1]
            if self.terms
            else ()
        )
        group = cluster_poses(self.study.data)
        return estimate_uncertainty(self.estimator, self.parameter_values, group, units)


def fit_geometry_and_effects(study: LinearisedGeometry, terms: Sequence[Term]) -> GeometryEffectFit:
    """The joint fit of geometry and effects, from the geometry of the study.

    The frames of further sessions are the first of its effects.
    """
    robot, data, free = study.robot, study.data, study.fit.effects.terms
    terms = (*free, *(term for term in terms if not term.frees_session_frames))
    base = study.model.with_active(study.fit.identification.active)
    allowed = effect_parameter_bounds(study.scene, terms)
    state = replace(study.fit.state, effects=np.zeros(len(allowed)))
    parts = list_unscaled_parameters(terms, study.scene)
    for _ in range(MAX_GAUSS_NEWTON_PASSES):
        model, state = (
            extend_model_with_effects(base, robot, data, state, terms) if terms else (base, state)
        )
        poses = PosewiseFit(Estimator(model, np.ones(len(model.y))), state)
        weight = fit_prior_weights(poses, state.effects, parts)
        prior = np.concatenate([np.zeros(len(poses.prior) - len(weight)), weight])
        pull = poses.score.sum(axis=0) + poses.prior * poses.prior_deviation
        pull[len(pull) - len(weight) :] -= weight * state.effects
        normal_matrix = poses.normal_matrix + np.diag(prior)
        room = np.tile([-np.inf, np.inf], (len(pull), 1))
        room[len(room) - len(allowed) :] = allowed - state.effects[:, None]
        step = solve_bounded_normal_equations(normal_matrix, pull, *room.T)
        gain = float(2.0 * step @ pull - step @ normal_matrix @ step)
        square = float((poses.error**2).sum())
        state = apply_active_step(model, state, step)
        if gain <= MIN_RELATIVE_SQUARE_GAIN * square:
            break
    state = replace(state, effects=snap_to_near_bounds(state.effects, allowed))
    model, state = (
        extend_model_with_effects(base, robot, data, state, terms) if terms else (base, state)
    )
    prior = model.prior.weight.copy()
    prior[len(prior) - len(weight) :] += weight
    model = replace(model, prior=replace(model.prior, weight=prior))
    return GeometryEffectFit(study, terms, state, model, at_bound_mask(state.effects, allowed))
