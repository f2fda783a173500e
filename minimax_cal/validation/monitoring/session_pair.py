"""The poses of a calibration and new ones in one linear problem, by products of its columns.

The errors of both are J x + F u + noise.  x, free: base, links and effects of the calibration, and
where instrument and reflectors stand now.  u, random: what the model lacks (`lack`), the same
functions in both, so that poses alike in both tell of a change what poses unlike cannot.  How large
u and the noise are is found by restricted maximum likelihood [Patterson and Thompson 1971].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotrf, dpotri

from minimax_cal.core.arrays import Array

MAX_REML_ROUNDS = 40  # of the fixed point that finds the variances, at most
MAX_RELATIVE_VARIANCE_CHANGE = 0.02  # share of every variance by which a last round may change it
MIN_RELATIVE_EIGENVALUE = 1e-10  # of a column's own square: what no pose tells stays where it is
MIN_NOISE_VARIANCE = 1e-8  # of the noise's variance, in its own unit
MIN_LACK_VARIANCE = 1e-4  # of a factor's variance: a turn of a microradian tells nothing
OLD, NEW, FOOT = range(3)  # where rows come from
KNOWN_COMPONENT = -1  # component of factors whose variance is 1


@dataclass(frozen=True, eq=False)
class RowProducts:
    """Rows of some poses: products (q, q) of their columns, the error last; how many were measured.

    source: OLD, NEW or FOOT.
    """

    gram: Array
    count: int
    source: int


@dataclass(frozen=True, eq=False)
class SessionVariances:
    """Of what is random.  noise: (3,) by source, in units of what it was.  factor: (l,) of u.

    dof: of the noise of the new poses.  deviance: -2 log restricted likelihood, less a constant.
    """

    noise: Array
    factor: Array
    dof: float
    deviance: float


class CandidateScores(NamedTuple):
    """(c,) change of each candidate, its sigma, and its degrees of freedom."""

    change: Array
    sigma: Array
    dof: Array


class JointChanges(NamedTuple):
    """(d,) changes of some candidates, all together, and their sigmas."""

    change: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class SessionPair:
    """Products of the columns x, u, candidates and error, part by part.

    free, random: how many columns each.  component: (random,) which factors share a variance, KNOWN
    for those whose variance is 1.  column: (c,) parameters that the candidates are; zero: (c,) True
    for zero positions, which are free while the variances are sought.  near: variances of some of
    the factors, the first, from which these are sought.
    """

    parts: tuple[RowProducts, ...]
    free: int
    random: int
    component: Array
    column: Array
    zero: Array
    near: Array
    found: SessionVariances | None = None

    @cached_property
    def variances(self) -> SessionVariances:
        """The likeliest, or those that are given."""
        return self.found or fit_variances_by_reml(self)

    @property
    def noise_ratio(self) -> float:
        """By how much the new poses are noisier than those of the calibration were."""
        noise = self.variances.noise
        return float(np.sqrt(noise[NEW] / noise[OLD]))

    def weighted_products(self, noise: Array) -> Array:
        """(q, q) products of all parts, each by its noise."""
        return np.asarray(sum(part.gram / noise[part.source] for part in self.parts))

    @cached_property
    def estimated_products(self) -> Array:
        """The same by the noises found."""
        return self.weighted_products(self.variances.noise)

    @property
    def candidate_columns(self) -> Array:
        """(c,) their columns."""
        return self.free + self.random + np.arange(len(self.column))

    def prior_precision(self, fitted: Array) -> Array:
        """(f,) what is known of columns before any pose.  fitted: (f,) which columns."""
        known = np.zeros(len(self.estimated_products))
        known[self.free : self.free + self.random] = 1.0 / self.variances.factor
        return np.asarray(known[fitted])

    def select_fitted_columns(self, chosen: Array) -> Array:
        """(f,) columns that are fitted: x, u and some candidates."""
        return np.append(np.arange(self.free + self.random), self.candidate_columns[chosen])

    def schur_complement(self, fitted: Array) -> Array:
        """(c + 1, c + 1) products of candidates and error less what fitted columns explain."""
        asked = np.append(self.candidate_columns, len(self.estimated_products) - 1)
        across = self.estimated_products[np.ix_(fitted, asked)]
        gram = self.estimated_products[np.ix_(fitted, fitted)] + np.diag(
            self.prior_precision(fitted)
        )
        return np.asarray(
            self.estimated_products[np.ix_(asked, asked)]
            - across.T @ solve_semidefinite(gram, across)
        )

    def candidate_scores(self, chosen: Array) -> CandidateScores:
        """Each candidate's change beside chosen ones, its sigma, its degrees of freedom: (c,) each.

        The variance is part noise, of many degrees of freedom, and part of what the model lacks,
        which is known from as many places as poses stand in [Satterthwaite 1946].
        """
        fitted = self.select_fitted_columns(chosen)
        every, alone = (
            self.schur_complement(some) for some in (fitted, fitted[self.is_known(fitted)])
        )
        size, noise = (np.maximum(np.diag(one)[:-1], 1e-300) for one in (every, alone))
        by_noise = np.minimum(size / noise, 1.0)  # share of the variance
        places = max(sum(part.source != FOOT for part in self.parts) - 1, 1)
        dof = 1.0 / (by_noise**2 / self.variances.dof + (1.0 - by_noise) ** 2 / places)
        return CandidateScores(every[:-1, -1] / size, 1.0 / np.sqrt(size), dof)

    def is_known(self, fitted: Array) -> Array:
        """(f,) True for columns that are not what the model lacks."""
        lacking = np.zeros(len(self.estimated_products), dtype=bool)
        lacking[self.free : self.free + self.random] = self.component >= 0
        return ~lacking[fitted]

    def largest_sigma_factor(self) -> float:
        """By how much what the model lacks widens the least sure sigma."""
        none = np.zeros(0, dtype=int)
        fitted = self.select_fitted_columns(none)
        every, alone = (
            np.diag(self.schur_complement(some))[:-1]
            for some in (fitted, fitted[self.is_known(fitted)])
        )
        return float(np.sqrt(np.max(alone / np.maximum(every, 1e-300), initial=1.0)))

    def jackknife_sigma(self, chosen: Array, more: int) -> float:
        """Sigma of one more candidate's change by fits without each part: the jackknife."""
        fitted, at = self.select_fitted_columns(chosen), int(self.candidate_columns[more])
        parts = [part for part in self.parts if part.source != FOOT]
        without = [
            self.estimated_products - part.gram / self.variances.noise[part.source]
            for part in parts
        ]
        found = np.array([self.candidate_change(gram, fitted, at) for gram in without])
        known = found[np.isfinite(found)]
        off = known - self.candidate_change(self.estimated_products, fitted, at)
        return float(np.sqrt((len(known) - 1) / max(len(known), 1) * np.sum(off**2)))

    def candidate_change(self, gram: Array, fitted: Array, at: int) -> float:
        """A candidate's change beside fitted columns; NaN where nothing tells it."""
        asked = np.array([at, len(gram) - 1])
        across = gram[np.ix_(fitted, asked)]
        own = gram[np.ix_(fitted, fitted)] + np.diag(self.prior_precision(fitted))
        left = gram[np.ix_(asked, asked)] - across.T @ solve_semidefinite(own, across)
        told = left[0, 0] > MIN_RELATIVE_EIGENVALUE * gram[at, at] > 0.0
        return float(left[0, 1] / left[0, 0]) if told else np.nan

    def left_out_gains(self, chosen: Array, more: int) -> Array:
        """(g,) by how much each new part, left out in its turn, comes nearer with one more."""
        new = [part for part in self.parts if part.source != OLD]
        before, after = (
            self.select_fitted_columns(some) for some in (chosen, np.append(chosen, more))
        )
        return np.array(
            [
                self.predicted_square(part, before) - self.predicted_square(part, after)
                for part in new
            ]
        )

    def predicted_square(self, part: RowProducts, fitted: Array) -> float:
        """Squared errors of a part that the others predict, in units of its noise."""
        own = part.gram / self.variances.noise[part.source]
        rest = self.estimated_products - own
        gram = rest[np.ix_(fitted, fitted)] + np.diag(self.prior_precision(fitted))
        step = solve_semidefinite(gram, rest[fitted, -1:])[:, 0]
        pull = own[fitted, -1]
        return float(own[-1, -1] - 2.0 * step @ pull + step @ own[np.ix_(fitted, fitted)] @ step)

    def joint_changes(self, chosen: Array) -> JointChanges:
        """(d,) of chosen candidates, all of them together, and (d,) sigmas."""
        fitted = self.select_fitted_columns(chosen)
        gram = self.estimated_products[np.ix_(fitted, fitted)] + np.diag(
            self.prior_precision(fitted)
        )
        right = np.concatenate([self.estimated_products[fitted, -1:], np.eye(len(fitted))], axis=1)
        found = solve_semidefinite(gram, right)
        variance = np.maximum(np.diag(found[:, 1:]), 0.0)
        at = np.arange(len(fitted) - len(chosen), len(fitted))
        return JointChanges(found[at, 0], np.sqrt(variance[at]))

    def shift_by_lack_of_fit(self) -> Array:
        """(free, random) by how much u moved the x of the calibration: minus its share of it."""
        none = np.zeros((len(self.estimated_products), len(self.estimated_products)))
        old = sum((part.gram for part in self.parts if part.source == OLD), start=none)
        x, u = np.arange(self.free), self.free + np.arange(self.random)
        return -solve_semidefinite(old[np.ix_(x, x)], old[np.ix_(x, u)])

    def with_variances_from(self, other: SessionPair) -> SessionPair:
        """Another of the same sessions with the variances of this one."""
        return replace(other, found=self.variances)


def solve_semidefinite(gram: Array, right: Array) -> Array:
    """Solutions of a positive semi-definite system in columns of any unit."""
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    size = np.where(size > 0.0, size, 1.0)[:, None]
    unit = gram / size / size.T + MIN_RELATIVE_EIGENVALUE * np.eye(len(gram))
    try:
        found = cho_solve(cho_factor(unit, check_finite=False), right / size, check_finite=False)
    except np.linalg.LinAlgError:  # no better than rounding allows
        found = np.linalg.pinv(unit, rcond=MIN_RELATIVE_EIGENVALUE, hermitian=True) @ (right / size)
    return np.asarray(found / size)


def invert_semidefinite(gram: Array) -> Array:
    """Of a positive semi-definite matrix, as `solve_semidefinite` takes it: a third of its work."""
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    size = np.where(size > 0.0, size, 1.0)
    root, failed = dpotrf(gram / np.outer(size, size) + MIN_RELATIVE_EIGENVALUE * np.eye(len(gram)))
    if failed:  # no better than rounding allows
        return solve_semidefinite(gram, np.eye(len(gram)))
    half = np.triu(dpotri(root)[0])
    return np.asarray((half + np.triu(half, 1).T) / np.outer(size, size))


def fit_variances_by_reml(both: SessionPair) -> SessionVariances:
    """Restricted maximum likelihood by its fixed point [Harville 1977].

    The new poses are no less noisy than those of the calibration; those of the foot as is stated.
    """
    x = np.append(np.arange(both.free), both.candidate_columns[both.zero])
    f, r = len(x), both.random
    rows = np.concatenate([x, both.free + np.arange(r), [len(both.parts[0].gram) - 1]])
    grams = np.zeros((3, len(rows), len(rows)))
    counts = np.zeros(3)
    for part in both.parts:
        grams[part.source] += part.gram[np.ix_(rows, rows)]
        counts[part.source] += part.count
    noise, factor = np.ones(3), np.append(both.near, np.ones(r))[:r]
    kinds = [both.component == kind for kind in np.unique(both.component) if kind >= 0]
    for _ in range(MAX_REML_ROUNDS):
        prior = np.append(np.zeros(f), 1.0 / factor)
        gram = np.tensordot(1.0 / noise, grams, 1)
        cover = invert_semidefinite(gram[:-1, :-1] + np.diag(prior))
        value = cover @ gram[:-1, -1]
        left = [g[-1, -1] - 2.0 * value @ g[:-1, -1] + value @ g[:-1, :-1] @ value for g in grams]
        square = np.maximum(left, 0.0)
        paid = np.array([np.sum(cover * g[:-1, :-1]) for g in grams]) / noise
        free = np.maximum(counts - paid, 0.5)
        ratio = noise[NEW] / noise[OLD]
        common = (square[OLD] + square[NEW] / ratio) / (free[OLD] + free[NEW])
        common = max(float(common), MIN_NOISE_VARIANCE if counts[OLD] else 1.0)
        if counts[OLD] and counts[NEW]:
            ratio = max(float(square[NEW] / free[NEW]) / common, 1.0)
        before, noise = np.append(noise, factor), np.array([common, common * ratio, 1.0])
        told = np.clip(1.0 - np.diag(cover)[f:] / factor, 1e-12, 1.0)
        for some in kinds:
            one = float(np.sum(value[f:][some] ** 2) / np.sum(told[some]))
            factor[some] = max(one, MIN_LACK_VARIANCE)
        if np.all(np.abs(np.log(np.append(noise, factor) / before)) < MAX_RELATIVE_VARIANCE_CHANGE):
            break

    # The log determinant of a matrix scaled to a unit diagonal.
    matrix = np.tensordot(1.0 / noise, grams, 1)[:-1, :-1] + np.diag(prior)
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    size = np.where(size > 0.0, size, 1.0)
    unit = matrix / np.outer(size, size) + MIN_RELATIVE_EIGENVALUE * np.eye(len(matrix))
    deviance = (
        float(counts @ np.log(noise) + np.log(factor).sum())
        + float(np.linalg.slogdet(unit)[1] + 2.0 * np.log(size).sum())
        + float(np.sum(square / noise) + np.sum(value[f:] ** 2 / factor))
    )
    return SessionVariances(noise, factor, max(float(free[NEW]), 1.0), deviance)


def student_critical_value(level: Array, dof: Array) -> Array:
    """Sigmas that chance exceeds, either way, with the probabilities given [Student]."""
    return np.asarray(scipy.stats.t.isf(0.5 * level, dof))
