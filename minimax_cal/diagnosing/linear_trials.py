"""Effects tried together with the geometry: linear at the geometric fit, no column made twice.

Every step of the error budget compares fits of some of the same columns.  The columns are made
once, and a trial is the solution of its share of one set of normal equations.  What a second pass
would change is of second order in the effects; the fits that are kept are exact (`joint`).

Where poses cover half of a joint's sweep, one and two waves a turn are nearly what geometry does
there.  Least squares then makes them large against each other, and new poses are met worse than by
geometry alone.  So an effect of several parameters has a Gaussian prior: all of its parameters are
as likely to move the points far, and how far is what makes the data likeliest, found by expectation
and maximisation [Dempster, Laird, Rubin 1977].  What the data tell by themselves it leaves alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import divide_by_scales
from minimax_cal.diagnosing.diagnosis import Finding
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.region_holdout import are_regions_needed, step_without_poses
from minimax_cal.fitting.session_changes import (
    build_parameter_amounts,
    describe_change,
    find_frame_changes,
)
from minimax_cal.fitting.uncertainty import Estimator, LinearisedFit, PosewiseFit, student_quantile
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import (
    EFFECTS,
    Term,
    at_bound_mask,
    effect_parameter_bounds,
)
from minimax_cal.modelling.effects_in_model import extend_model_with_effects
from minimax_cal.selection.thresholds import MAX_RELATIVE_TRAINING_RISE
from minimax_cal.solvers.bounded_least_squares import solve_bounded_normal_equations
from minimax_cal.solvers.least_squares import solve_normal_equations

RELATIVE_FIELD_RIDGE = 1e-12  # of a unit field: what nothing tells stays finite
MAX_EM_ITERATIONS = 20  # of expectation and maximisation


def list_unscaled_parameters(terms: Sequence[Term], scene: PosedArm) -> list[slice]:
    """The parameters of each effect of several, among all, that no prior or sign holds."""
    out, at = [], 0
    for term in terms:
        columns = term.columns(scene)
        own = slice(at, at + len(columns.names))
        at = own.stop
        loose = int((~EFFECTS[term.effect].nonnegative_mask(columns)).sum())  # they come last
        if loose > 1 and not len(columns.ridge) and not term.frees_session_frames:
            out.append(slice(own.stop - loose, own.stop))
    return out


def fit_prior_weights(
    linearisation: LinearisedFit, values: Array, parameter_slices: Sequence[slice]
) -> Array:
    """(e,) weights of the priors, beside squares of errors [m^2 per unit^2]; 0 outside the parts.

    linearisation: linear at a state with effects of values (e,), the last of its parameters, all
    free.
    """
    weight = np.zeros(len(values))
    if not parameter_slices:
        return weight
    gram, pull = (
        linearisation.normal_matrix,
        linearisation.gradient + linearisation.prior * linearisation.prior_deviation,
    )
    p = len(gram) - len(values)
    across = solve_normal_equations(gram[:p, :p], gram[:p, p:])
    left = gram[p:, p:] - gram[p:, :p] @ across  # what geometry leaves of the effects
    size = np.sqrt(np.diag(gram)[p:])  # how far a unit moves all points
    left = divide_by_scales(left, size)
    told = (pull[p:] - across.T @ pull[:p]) / size + left @ (values * size)
    square = float((linearisation.error**2).sum())
    least = square - float(pull @ solve_normal_equations(gram, pull[:, None])[:, 0])
    variance = least / max(3 * int(np.count_nonzero(linearisation.seen)) - len(gram), 1)
    for part in parameter_slices:
        weight[part] = variance / square  # as if each might explain all that is left
    free = np.isin(
        np.arange(len(weight)), np.concatenate([np.r_[part] for part in parameter_slices])
    )
    left += RELATIVE_FIELD_RIDGE * np.eye(len(left))
    # the others, alone or with priors of their own, are projected out once
    across = solve_normal_equations(left[np.ix_(~free, ~free)], left[np.ix_(~free, free)])
    told = told[free] - across.T @ told[~free]
    left = left[np.ix_(free, free)] - left[np.ix_(free, ~free)] @ across
    for _ in range(MAX_EM_ITERATIONS):
        covariance = np.linalg.inv(left + np.diag(weight[free]))
        second = np.zeros(len(weight))
        second[free] = (covariance @ told) ** 2 + variance * np.diag(covariance)
        for part in parameter_slices:
            weight[part] = variance / np.mean(second[part])
    return np.asarray(weight * size**2)


# ---- trials --------------------------------------------------------------------------------------


class CrossValidatable(ABC):
    """A linearised fit that predicts groups of poses, each without that group."""

    @property
    @abstractmethod
    def pose_linearisation(self) -> LinearisedFit:
        """Where the fit ended."""

    @cached_property
    def needed_fold_cache(self) -> dict[bytes, bool]:
        """Of folds that were asked for, whether the fit needs them."""
        return {}

    @cached_property
    def heldout_square_cache(self) -> dict[bytes, float]:
        """Of folds that were left out, the sum of squares there."""
        return {}

    def select_dispensable_folds(self, folds: Sequence[Array]) -> list[Array]:
        """The folds, masks (m,) of the poses, without which the fit keeps all of its parameters."""
        new = {
            fold.tobytes(): fold for fold in folds if fold.tobytes() not in self.needed_fold_cache
        }
        if new:
            grams = np.array([self.pose_linearisation.gram_of_poses(fold) for fold in new.values()])
            found = are_regions_needed(self.pose_linearisation.normal_matrix, grams)
            self.needed_fold_cache.update(zip(new, found.tolist(), strict=True))
        return [fold for fold in folds if not self.needed_fold_cache[fold.tobytes()]]

    def cross_validate_folds(self, folds: Sequence[Array]) -> float:
        """Sum of squares at folds left out in turn [m^2], linear; infinite where one is needed."""
        if len(self.select_dispensable_folds(folds)) < len(folds):
            return float("inf")
        total = 0.0
        for fold in folds:
            mark = fold.tobytes()
            if mark not in self.heldout_square_cache:
                left = self.pose_linearisation.jacobian[fold] @ step_without_poses(
                    self.pose_linearisation, fold
                )
                self.heldout_square_cache[mark] = float(
                    ((self.pose_linearisation.error[fold] - left) ** 2).sum()
                )
            total += self.heldout_square_cache[mark]
        return total


class TrialColumns:
    """Columns of geometry and effects, made once at the geometric fit."""

    def __init__(self, study: LinearisedGeometry, effects: Sequence[Sequence[Term]]) -> None:
        free, scene = study.fit.effects.terms, study.scene
        parts = [[term for term in terms if not term.frees_session_frames] for terms in effects]
        every = [*free, *(term for terms in parts for term in terms)]
        model, state = study.model.with_active(study.fit.identification.active), study.fit.state
        if every:
            model, state = extend_model_with_effects(model, study.robot, study.data, state, every)
        self.whole = PosewiseFit(Estimator(model, np.ones(len(model.y))), state)
        self.error, self.jacobian = self.whole.error, self.whole.jacobian
        allowed = effect_parameter_bounds(scene, every)
        count = self.jacobian.shape[2] - len(allowed)
        inf = np.full((count, 2), np.inf) * [-1.0, 1.0]
        self.allowed = np.concatenate([inf, allowed])
        starts = np.cumsum([count, *(len(term.columns(scene).names) for term in every)])
        self.geometry = np.arange(starts[len(free)])
        # of each effect: columns, and which of them have priors of their own size
        self.columns: list[Array] = []
        self.sized: list[list[Array]] = []
        at = len(free)
        for terms in parts:
            spans = [np.arange(starts[at + i], starts[at + i + 1]) for i in range(len(terms))]
            at += len(terms)
            self.columns.append(np.concatenate([np.arange(0), *spans]))
            self.sized.append(
                [span[part] for term, span in zip(terms, spans, strict=True)
                 for part in list_unscaled_parameters([term], scene)]
            )  # fmt: skip
        self.known: dict[bytes, tuple[Array, Array]] = {}

    def normal_sums(self, pose_mask: Array) -> tuple[Array, Array]:
        """J'J (p, p) and J'e (p,) of some poses.  pose_mask: mask (m,)."""
        mark = pose_mask.tobytes()
        if mark not in self.known:
            rows = self.jacobian[pose_mask].reshape(-1, self.jacobian.shape[2])
            self.known[mark] = rows.T @ rows, rows.T @ self.error[pose_mask].ravel()
        return self.known[mark]

    def fit_trial(self, effect_numbers: Sequence[int]) -> TrialFit:
        """Geometry with some of the effects, by their numbers."""
        index = np.concatenate([self.geometry, *(self.columns[i] for i in effect_numbers)])
        start = TrialLinearisation(self, index, np.zeros(len(index)), np.zeros(len(index)))
        first, place = len(self.geometry), {at: i for i, at in enumerate(index.tolist())}
        parts = [
            slice(place[int(span[0])] - first, place[int(span[-1])] + 1 - first)
            for i in effect_numbers
            for span in self.sized[i]
        ]
        weight = np.zeros(len(index))
        weight[first:] = fit_prior_weights(start, np.zeros(len(index) - first), parts)
        normal_matrix = start.normal_matrix + np.diag(weight)
        pull = start.gradient + start.prior * start.prior_deviation
        step = solve_bounded_normal_equations(normal_matrix, pull, *self.allowed[index].T)
        rests = at_bound_mask(step, self.allowed[index])
        return TrialFit(TrialLinearisation(self, index, step, weight, rests), step[first:])


@dataclass(frozen=True, eq=False)
class TrialLinearisation(LinearisedFit):
    """Some of the columns, after a step of their parameters.

    column_indices: (p,) of all columns.  step: (p,).  weight: (p,) of priors of mean 0 besides the
    model's. at_bound: (p,) True for parameters at a bound, which are not free.
    """

    trials: TrialColumns
    column_indices: Array
    step: Array
    weight: Array
    at_bound: Array | None = None

    @cached_property
    def free_parameters(self) -> Array:
        """(q,) where the free parameters stand among the p."""
        every = np.arange(len(self.column_indices))
        return every if self.at_bound is None else every[~self.at_bound]

    @cached_property
    def error(self) -> Array:
        """(m, r) errors."""
        return np.asarray(
            self.trials.error - self.trials.jacobian[..., self.column_indices] @ self.step
        )

    @cached_property
    def jacobian(self) -> Array:
        """(m, r, q) derivative by the free parameters."""
        return np.asarray(self.trials.jacobian[..., self.column_indices[self.free_parameters]])

    @cached_property
    def prior(self) -> Array:
        """(q,) its weights."""
        return np.asarray(
            (self.trials.whole.prior[self.column_indices] + self.weight)[self.free_parameters]
        )

    @cached_property
    def prior_deviation(self) -> Array:
        """(q,) how far the parameters are from the prior's mean."""
        return np.asarray(
            (self.trials.whole.prior_deviation[self.column_indices] - self.step)[
                self.free_parameters
            ]
        )

    @property
    def seen(self) -> Array:
        """(k, m) which points were measured."""
        return self.trials.whole.seen

    def sums_of_poses(self, part: Array) -> tuple[Array, Array]:
        """J'J (q, q) and J'e (q,) of some poses.  part: mask (m,)."""
        gram, pull = self.trials.normal_sums(part)
        own = self.column_indices[self.free_parameters]
        return gram[np.ix_(own, own)], pull[own] - gram[
            np.ix_(own, self.column_indices)
        ] @ self.step


@dataclass(frozen=True, eq=False)
class TrialFit(CrossValidatable):
    """Geometry with some effects, fitted together in one step.

    linear: where the step ends.  values: (e,) of the effects' parameters.
    """

    linear: TrialLinearisation
    values: Array

    @property
    def pose_linearisation(self) -> TrialLinearisation:
        """Where the step ends."""
        return self.linear

    @property
    def training_square(self) -> float:
        """Sum of squares at the poses of the fit [m^2]."""
        return float((self.linear.error**2).sum())

    def fits_no_worse(self, other: TrialFit) -> bool:
        """Whether the poses of the fit are predicted as well as by another."""
        return (
            self.training_square <= (1.0 + MAX_RELATIVE_TRAINING_RISE) ** 2 * other.training_square
        )


# ---- since when ----------------------------------------------------------------------------------


def describe_session_changes(
    study: LinearisedGeometry, findings: Sequence[Finding]
) -> Iterator[str]:
    """Effects that hold from a session on, with intervals, and where each session's frame stands.

    findings: with values and sigmas of the last fit.
    """
    names = list(study.data.frames)
    for finding in findings:
        if "session" not in finding.term.choice:
            continue
        value, sigma = np.array(finding.values), np.array(finding.sigmas)
        half = student_quantile(0.95, study.fit.uncertainty.dof) * sigma
        found = build_parameter_amounts(finding.names, finding.units, value, sigma, half)
        change = describe_change(finding.term, names, found, finding.p_value)
        yield f"{format_effect(change.effect, change.place)}: {change.when} by {change.sizes}"
    if len(names) > 1:
        yield from (frame.sentence for frame in find_frame_changes(study.geometric_cell, study.fit))
