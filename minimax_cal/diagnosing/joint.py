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

from minimax_cal.diagnosing.study import Study
from minimax_cal.diagnosing.trial import Predicting, unsized, weights_of
from minimax_cal.fitting.accuracy import Accuracy, accuracy
from minimax_cal.fitting.uncertainty import Estimator, Poses, Uncertainty, uncertainty_of
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import clusters
from minimax_cal.measuring.stations import Sessions
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import NOTHING, Term, at_bounds, bounds, names_of, settled
from minimax_cal.modelling.joint_fit import extended, fitted
from minimax_cal.modelling.model import Model, moved
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.bounded import bounded

PASSES = 6  # of Gauss and Newton at most; columns of effects are made anew in each
SETTLED = 1e-4  # relative change of the weighed square that ends them


@dataclass(frozen=True, eq=False)
class Joint(Predicting):
    """Geometry with some effects, fitted together.

    state: with the effects' values.  model: linear where the fit ended.
    rests: (e,) True where an effect's parameter is at a bound.
    """

    study: Study
    terms: tuple[Term, ...]
    state: State
    model: Model
    rests: Array

    @cached_property
    def estimator(self) -> Estimator:
        """How the fit weighs its poses."""
        active = self.model.active.copy()
        active[len(active) - len(self.rests) :] &= ~self.rests
        return Estimator(self.model.only(active), np.ones(len(self.model.y)))

    @cached_property
    def poses(self) -> Poses:
        """Pose by pose, linear where the fit ended."""
        return Poses(self.estimator, self.state)

    @cached_property
    def cell(self) -> Cell:
        """What predicts."""
        return self.with_state(self.state)

    def with_state(self, state: State) -> Cell:
        """What would predict with other values."""
        study, effects = self.study, NOTHING
        if self.terms:
            effects = fitted(self.terms, study.scene, state.effects)
        sessions = Sessions.of(study.data)
        return Cell.of(study.robot, state, study.data.target_names, effects, sessions)

    @cached_property
    def train(self) -> Accuracy:
        """On the poses of the fit."""
        return accuracy(self.cell.error(self.study.data))

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Of all parameters, by leaving out groups of poses; NaN on a bound."""
        units = names_of(self.terms, self.cell.scene(self.study.data))[1] if self.terms else ()
        group = clusters(self.study.data)
        return uncertainty_of(self.estimator, self.state, group, units)


def joint(study: Study, terms: Sequence[Term]) -> Joint:
    """The joint fit of geometry and effects, from the geometry of the study.

    The frames of further sessions are the first of its effects.
    """
    robot, data, free = study.robot, study.data, study.fit.effects.terms
    terms = (*free, *(term for term in terms if not term.frees_frames))
    base = study.model.only(study.fit.identification.active)
    allowed = bounds(study.scene, terms)
    state = replace(study.fit.state, effects=np.zeros(len(allowed)))
    parts = unsized(terms, study.scene)
    for _ in range(PASSES):
        model, state = extended(base, robot, data, state, terms) if terms else (base, state)
        poses = Poses(Estimator(model, np.ones(len(model.y))), state)
        weight = weights_of(poses, state.effects, parts)
        prior = np.concatenate([np.zeros(len(poses.prior) - len(weight)), weight])
        pull = poses.score.sum(axis=0) + poses.prior * poses.off
        pull[len(pull) - len(weight) :] -= weight * state.effects
        normal_matrix = poses.normal_matrix + np.diag(prior)
        room = np.tile([-np.inf, np.inf], (len(pull), 1))
        room[len(room) - len(allowed) :] = allowed - state.effects[:, None]
        step = bounded(normal_matrix, pull, *room.T)
        gain = float(2.0 * step @ pull - step @ normal_matrix @ step)
        square = float((poses.error**2).sum())
        state = moved(model, state, step)
        if gain <= SETTLED * square:
            break
    state = replace(state, effects=settled(state.effects, allowed))
    model, state = extended(base, robot, data, state, terms) if terms else (base, state)
    prior = model.prior.weight.copy()
    prior[len(prior) - len(weight) :] += weight
    model = replace(model, prior=replace(model.prior, weight=prior))
    return Joint(study, terms, state, model, at_bounds(state.effects, allowed))
