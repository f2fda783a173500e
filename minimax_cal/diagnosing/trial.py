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

from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.limits import MAX_RISE
from minimax_cal.fitting.between_sessions import amounts, change_of, frame_changes
from minimax_cal.fitting.beyond import are_needed, step_without
from minimax_cal.fitting.uncertainty import Estimator, Linearised, Poses, quantile
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import scale_symmetric
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term, at_bounds, bounds
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.modelling.joint_fit import extended
from minimax_cal.solvers.bounded import bounded
from minimax_cal.solvers.least_squares import solve_normal

RIDGE = 1e-12  # of a unit field: what nothing tells stays finite
ROUNDS = 20  # of expectation and maximisation


def unsized(terms: Sequence[Term], scene: Scene) -> list[slice]:
    """The parameters of each effect of several, among all, that no prior or sign holds."""
    out, at = [], 0
    for term in terms:
        columns = term.columns(scene)
        own = slice(at, at + len(columns.names))
        at = own.stop
        loose = int((~EFFECTS[term.effect].upward(columns)).sum())  # they come last
        if loose > 1 and not len(columns.ridge) and not term.frees_frames:
            out.append(slice(own.stop - loose, own.stop))
    return out


def weights_of(poses: Linearised, values: Array, parts: Sequence[slice]) -> Array:
    """(e,) weights of the priors, beside squares of errors [m^2 per unit^2]; 0 outside the parts.

    poses: linear at a state with effects of values (e,), the last of its parameters, all free.
    """
    weight = np.zeros(len(values))
    if not parts:
        return weight
    gram, pull = poses.normal_matrix, poses.gradient + poses.prior * poses.off
    p = len(gram) - len(values)
    across = solve_normal(gram[:p, :p], gram[:p, p:])
    left = gram[p:, p:] - gram[p:, :p] @ across  # what geometry leaves of the effects
    size = np.sqrt(np.diag(gram)[p:])  # how far a unit moves all points
    left = scale_symmetric(left, size)
    told = (pull[p:] - across.T @ pull[:p]) / size + left @ (values * size)
    square = float((poses.error**2).sum())
    least = square - float(pull @ solve_normal(gram, pull[:, None])[:, 0])
    variance = least / max(3 * int(np.count_nonzero(poses.seen)) - len(gram), 1)
    for part in parts:
        weight[part] = variance / square  # as if each might explain all that is left
    free = np.isin(np.arange(len(weight)), np.concatenate([np.r_[part] for part in parts]))
    left += RIDGE * np.eye(len(left))
    # the others, alone or with priors of their own, are projected out once
    across = solve_normal(left[np.ix_(~free, ~free)], left[np.ix_(~free, free)])
    told = told[free] - across.T @ told[~free]
    left = left[np.ix_(free, free)] - left[np.ix_(free, ~free)] @ across
    for _ in range(ROUNDS):
        covariance = np.linalg.inv(left + np.diag(weight[free]))
        second = np.zeros(len(weight))
        second[free] = (covariance @ told) ** 2 + variance * np.diag(covariance)
        for part in parts:
            weight[part] = variance / np.mean(second[part])
    return np.asarray(weight * size**2)


# ---- trials --------------------------------------------------------------------------------------


class Predicting(ABC):
    """A linearised fit that predicts groups of poses, each without that group."""

    @property
    @abstractmethod
    def poses(self) -> Linearised:
        """Where the fit ended."""

    @cached_property
    def needs(self) -> dict[bytes, bool]:
        """Of folds that were asked for, whether the fit needs them."""
        return {}

    @cached_property
    def squares(self) -> dict[bytes, float]:
        """Of folds that were left out, the sum of squares there."""
        return {}

    def spared(self, folds: Sequence[Array]) -> list[Array]:
        """The folds, masks (m,) of the poses, without which the fit keeps all of its parameters."""
        new = {fold.tobytes(): fold for fold in folds if fold.tobytes() not in self.needs}
        if new:
            grams = np.array([self.poses.gram_of(fold) for fold in new.values()])
            found = are_needed(self.poses.normal_matrix, grams)
            self.needs.update(zip(new, found.tolist(), strict=True))
        return [fold for fold in folds if not self.needs[fold.tobytes()]]

    def cross_validated(self, folds: Sequence[Array]) -> float:
        """Sum of squares at folds left out in turn [m^2], linear; infinite where one is needed."""
        if len(self.spared(folds)) < len(folds):
            return float("inf")
        total = 0.0
        for fold in folds:
            mark = fold.tobytes()
            if mark not in self.squares:
                left = self.poses.jacobian[fold] @ step_without(self.poses, fold)
                self.squares[mark] = float(((self.poses.error[fold] - left) ** 2).sum())
            total += self.squares[mark]
        return total


class Trials:
    """Columns of geometry and effects, made once at the geometric fit."""

    def __init__(self, study: Study, effects: Sequence[Sequence[Term]]) -> None:
        free, scene = study.fit.effects.terms, study.scene
        parts = [[term for term in terms if not term.frees_frames] for terms in effects]
        every = [*free, *(term for terms in parts for term in terms)]
        model, state = study.model.only(study.fit.identification.active), study.fit.state
        if every:
            model, state = extended(model, study.robot, study.data, state, every)
        self.whole = Poses(Estimator(model, np.ones(len(model.y))), state)
        self.error, self.jacobian = self.whole.error, self.whole.jacobian
        allowed = bounds(scene, every)
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
                 for part in unsized([term], scene)]
            )  # fmt: skip
        self.known: dict[bytes, tuple[Array, Array]] = {}

    def sums_of(self, part: Array) -> tuple[Array, Array]:
        """J'J (p, p) and J'e (p,) of some poses.  part: mask (m,)."""
        mark = part.tobytes()
        if mark not in self.known:
            rows = self.jacobian[part].reshape(-1, self.jacobian.shape[2])
            self.known[mark] = rows.T @ rows, rows.T @ self.error[part].ravel()
        return self.known[mark]

    def trial(self, numbers: Sequence[int]) -> Trial:
        """Geometry with some of the effects, by their numbers."""
        index = np.concatenate([self.geometry, *(self.columns[i] for i in numbers)])
        start = Linear(self, index, np.zeros(len(index)), np.zeros(len(index)))
        first, place = len(self.geometry), {at: i for i, at in enumerate(index.tolist())}
        parts = [
            slice(place[int(span[0])] - first, place[int(span[-1])] + 1 - first)
            for i in numbers
            for span in self.sized[i]
        ]
        weight = np.zeros(len(index))
        weight[first:] = weights_of(start, np.zeros(len(index) - first), parts)
        normal_matrix = start.normal_matrix + np.diag(weight)
        pull = start.gradient + start.prior * start.off
        step = bounded(normal_matrix, pull, *self.allowed[index].T)
        rests = at_bounds(step, self.allowed[index])
        return Trial(Linear(self, index, step, weight, rests), step[first:])


@dataclass(frozen=True, eq=False)
class Linear(Linearised):
    """Some of the columns, after a step of their parameters.

    index: (p,) of all columns.  step: (p,).  weight: (p,) of priors of mean 0 besides the model's.
    rests: (p,) True for parameters at a bound, which are not free.
    """

    trials: Trials
    index: Array
    step: Array
    weight: Array
    rests: Array | None = None

    @cached_property
    def free(self) -> Array:
        """(q,) where the free parameters stand among the p."""
        every = np.arange(len(self.index))
        return every if self.rests is None else every[~self.rests]

    @cached_property
    def error(self) -> Array:
        """(m, r) errors."""
        return np.asarray(self.trials.error - self.trials.jacobian[..., self.index] @ self.step)

    @cached_property
    def jacobian(self) -> Array:
        """(m, r, q) derivative by the free parameters."""
        return np.asarray(self.trials.jacobian[..., self.index[self.free]])

    @cached_property
    def prior(self) -> Array:
        """(q,) its weights."""
        return np.asarray((self.trials.whole.prior[self.index] + self.weight)[self.free])

    @cached_property
    def off(self) -> Array:
        """(q,) how far the parameters are from the prior's mean."""
        return np.asarray((self.trials.whole.off[self.index] - self.step)[self.free])

    @property
    def seen(self) -> Array:
        """(k, m) which points were measured."""
        return self.trials.whole.seen

    def sums_of(self, part: Array) -> tuple[Array, Array]:
        """J'J (q, q) and J'e (q,) of some poses.  part: mask (m,)."""
        gram, pull = self.trials.sums_of(part)
        own = self.index[self.free]
        return gram[np.ix_(own, own)], pull[own] - gram[np.ix_(own, self.index)] @ self.step


@dataclass(frozen=True, eq=False)
class Trial(Predicting):
    """Geometry with some effects, fitted together in one step.

    linear: where the step ends.  values: (e,) of the effects' parameters.
    """

    linear: Linear
    values: Array

    @property
    def poses(self) -> Linear:
        """Where the step ends."""
        return self.linear

    @property
    def square(self) -> float:
        """Sum of squares at the poses of the fit [m^2]."""
        return float((self.linear.error**2).sum())

    def no_worse(self, other: Trial) -> bool:
        """Whether the poses of the fit are predicted as well as by another."""
        return self.square <= (1.0 + MAX_RISE) ** 2 * other.square


# ---- since when ----------------------------------------------------------------------------------


def session_notices(study: Study, findings: Sequence[Finding]) -> Iterator[str]:
    """Effects that hold from a session on, with intervals, and where each session's frame stands.

    findings: with values and sigmas of the last fit.
    """
    names = list(study.data.frames)
    for finding in findings:
        if "session" not in finding.term.choice:
            continue
        value, sigma = np.array(finding.values), np.array(finding.sigmas)
        half = quantile(0.95, study.fit.uncertainty.dof) * sigma
        found = amounts(finding.names, finding.units, value, sigma, half)
        change = change_of(finding.term, names, found, finding.p_value)
        yield f"{name_effect(change.effect, change.place)}: {change.when} by {change.sizes}"
    if len(names) > 1:
        yield from (frame.sentence for frame in frame_changes(study.geometric, study.fit))
