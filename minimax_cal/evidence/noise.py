"""A linear problem with two kinds of noise, and its noises by restricted maximum likelihood.

The rows are given such that the covariance s^2 I + t^2 V of the two noises is diagonal, V the
variance ratios: then every later step is plain weighted least squares.  s and t are estimated by
restricted maximum likelihood [Patterson and Thompson 1971].  Nothing here knows a robot.

A row with the variance ratio v weighs 1/(1 + ratio v).  Along the logarithm of the ratio that is a
smooth step whose nearest poles lie pi beside the real line, so that a polynomial through so many
Chebyshev points in every decade gives all weights to rounding, and with them all products, what
is left of these when columns are projected out, and likelihoods.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np

from minimax_cal.evidence.limits import LEAST_NOISE_DOF
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import column_scales, project_out, scale_symmetric

RATIOS = np.concatenate([[0.0], np.logspace(-3, 5, 9)])  # among which the likeliest is sought
ZERO = -300  # the decade of the ratio 0
NODES = 18  # points in a decade of ratios: products to rounding
FEW = 14  # points in two decades where a likelihood is least: to 1e-7 of it
FINE = 401  # points between which a polynomial's least value is sought


@cache
def points(count: int) -> Array:
    """(g,) Chebyshev points between 0 and 1."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * (2.0 * np.arange(count) + 1.0) / (2.0 * count)))


def nodes(number: int) -> Array:
    """(g,) ratios in a decade; in ZERO the ratio 0 alone."""
    return np.asarray(10.0 ** (number + points(NODES))) if number > ZERO else np.zeros(1)


def interpolation(x: Array, count: int) -> Array:
    """(s, g) values at x of the polynomials that are 1 at one Chebyshev point and 0 at the others.

    By the barycentric formula [Berrut and Trefethen 2004].
    """
    at = points(count)
    off = x[:, None] - at
    met = off == 0.0
    size = np.sqrt(at * (1.0 - at)) * np.where(np.arange(count) % 2, -1.0, 1.0)
    part = size / np.where(met, 1.0, off)
    part = np.where(met.any(axis=1, keepdims=True), met.astype(float), part)
    return np.asarray(part / part.sum(axis=1, keepdims=True))


FINE_POINTS: Array = np.linspace(0.0, 1.0, FINE)
FINE_WEIGHTS = interpolation(FINE_POINTS, FEW)  # (f, g) how values there follow from those at a few


def find_ratio(cost: Callable[[Array], Array]) -> float:
    """The ratio of least cost, 0 if none of RATIOS costs less.  cost: (g,) of ratios (g,)."""
    best = int(np.argmin(cost(RATIOS)))
    if not best:
        return 0.0
    # Between the neighbours the cost is a polynomial in the logarithm of the ratio; beside its
    # least value on a fine grid the vertex of the parabola through that and its neighbours.
    low, high = np.log10(RATIOS[[max(best - 1, 1), min(best + 1, len(RATIOS) - 1)]])
    values = FINE_WEIGHTS @ cost(10.0 ** (low + (high - low) * points(FEW)))
    at, step = int(np.argmin(values)), 0.0
    if 0 < at < FINE - 1:
        before, here, after = values[at - 1 : at + 2]
        bend = before - 2.0 * here + after
        step = float(0.5 * (before - after) / bend) if bend > 0.0 else 0.0
    return float(10.0 ** (low + (high - low) * (FINE_POINTS[at] + step / (FINE - 1))))


# ---- ratios --------------------------------------------------------------------------------------


RANK = 1e-5  # singular value of the scaled Jacobian below which a direction is no direction
SAME = 1e-12  # added to products of unit columns where some are the same
ROUNDING = 0.1  # of the noise of computed rows: no variance is estimated below its square


@dataclass(frozen=True, eq=False)
class Problem:
    """Rows of a linear fit in which two noises are diagonal.

    error: (N,) what is to be explained.  basis: (N, p) orthonormal span of the nuisance columns,
    always projected out.  variance_ratio: (N,) variance that the second noise adds to a row, over
    that of the first, relative to its mean; size: the mean.  group: (N,) from 0, of rows that err
    together.  measured: (N,) False for rows that hold no number.  exact: a noise below it is
    rounding: the rows were computed, not measured.
    """

    error: Array
    basis: Array
    variance_ratio: Array
    size: float
    group: Array
    measured: Array
    exact: float

    @property
    def count(self) -> int:
        """Rows that were measured."""
        return int(np.count_nonzero(self.measured))

    def beside(self, columns: Array) -> Self:
        """With columns (N, q) projected out as nuisance is, as far as they are determined.

        columns: of factors whose priors weigh as one row of unit error; a direction that is
        determined by no more than that is left.
        """
        rest = project_out(columns, self.basis)
        span, size, _ = np.linalg.svd(rest, full_matrices=False)
        span = span[:, size > 1.0]
        error = project_out(self.error, span)
        return replace(self, error=error, basis=np.concatenate([self.basis, span], axis=1))


def orthonormal(matrix: Array) -> Array:
    """Orthonormal columns with the span of a matrix (N, p) whose columns are first scaled."""
    norm = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, norm > 0] / norm[norm > 0]
    return np.asarray(np.linalg.qr(scaled @ told_apart(scaled.T @ scaled))[0])


def identified(gram: Array) -> Array:
    """(p, r) combinations of parameters that turn a Gram matrix (p, p) into 1."""
    norm = np.sqrt(np.diag(gram))
    used = norm > 0.0
    whole = told_apart(scale_symmetric(gram[np.ix_(used, used)], norm[used]))
    out = np.zeros((len(gram), whole.shape[1]))
    out[used] = whole / norm[used][:, None]
    return out


def told_apart(gram: Array) -> Array:
    """(p, r) combinations that turn a Gram matrix (p, p) of unit columns into 1."""
    values, vectors = np.linalg.eigh(gram)
    kept = values > RANK**2 * values[-1] if len(values) else np.zeros(0, dtype=bool)
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))


def inflation(field: Array, rest: Array, group: Array, dof: int) -> float:
    """How much noisier rows are along a field than all together, as groups of them tell it, >= 1.

    By the jackknife, no group judging itself: wrong points, an instrument whose directions differ,
    and groups whose rows err alike give a field no more weight than they deserve.  field: (N,) as
    fitted, and rest: (N,) without it, both white.  group: (N,) from 0.
    """
    own = np.bincount(group, field * field)
    whole = float(own.sum())
    if whole <= 0.0:
        return 1.0
    rest = rest - field
    pull = np.bincount(group, field * rest) / np.maximum(1.0 - own / whole, 0.1)
    variance = max(float(rest @ rest) / max(dof, 1), 1e-300)
    return max(float(pull @ pull) / (whole * variance), 1.0)


@dataclass(frozen=True)
class Noise:
    """ratio: variance that the joints add to a mean row over that of the instrument.

    variance: of the instrument per coordinate [m^2].  jitter: standard deviation of a joint [rad].
    """

    ratio: float
    variance: float
    jitter: float

    def weights(self, rows: Problem) -> Array:
        """(N,) inverse variances [1/m^2]."""
        return np.asarray(1.0 / (self.variance * (1.0 + self.ratio * rows.variance_ratio)))


def remaining(rows: Problem, weight: Array, known: Array) -> Array:
    """(N,) what the weighted least squares on geometry and known columns leaves of the error [m].

    weight: (N,) inverse variances, 0 for rows that are not fitted.  known: (N, q).
    """
    columns = np.concatenate([rows.basis, known], axis=1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    gram = columns.T @ (columns * weight[:, None])
    value = np.linalg.lstsq(gram, columns.T @ (weight * rows.error), rcond=1e-12)[0]
    return np.asarray(rows.error - columns @ value)


def restricted(rows: Problem, known: Array) -> Noise:
    """Noise by restricted maximum likelihood.  known: (N, q) further columns that are fitted."""
    columns = np.concatenate([rows.basis, known, rows.error[:, None]], axis=1)
    dof = rows.count - columns.shape[1] + 1
    if dof < LEAST_NOISE_DOF:
        return noise_of(0.0, float(rows.error @ rows.error) / max(rows.count, 1), rows)

    def cost(ratios: Array) -> tuple[Array, Array]:
        halves = (columns / np.sqrt(1.0 + r * rows.variance_ratio)[:, None] for r in ratios)
        gram = np.array([half.T @ half for half in halves])
        return costs(gram, ratios, rows.variance_ratio, dof)

    ratio = find_ratio(lambda ratios: cost(ratios)[0])
    return noise_of(ratio, float(cost(np.array([ratio]))[1][0]) / dof, rows)


def noise_of(ratio: float, variance: float, rows: Problem) -> Noise:
    """Both noises of a ratio and of the variance of the instrument, no less than rounding is."""
    variance = max(variance, (ROUNDING * rows.exact) ** 2)
    return Noise(ratio, variance, float(np.sqrt(ratio * variance / rows.size)))


def costs(gram: Array, ratios: Array, varied: Array, dof: int) -> tuple[Array, Array]:
    """-2 log restricted likelihood (g,) at ratios (g,) [Patterson and Thompson 1971].

    And squares (g,) of what is left of the error.  gram: (g, p + 1, p + 1) weighted products of
    what is fitted and, last, the error.  varied: variance ratios of the rows that count.
    """
    gram = gram + 0.0
    gram[:, -1, -1] += 1e-300
    logs = np.log(np.einsum("rpp->rp", triangles(gram)))
    squares = np.exp(2.0 * logs[:, -1])
    spread = np.log1p(ratios[:, None] * varied).sum(axis=1)
    return dof * np.log(squares) + spread + 2.0 * logs[:, :-1].sum(axis=1), squares


def triangles(gram: Array) -> Array:
    """(s, f, f) lower triangles whose squares are matrices (s, f, f), as near as those allow."""
    scale = column_scales(gram)[..., None]
    unit = gram / scale / np.swapaxes(scale, 1, 2)
    try:
        return np.asarray(scale * np.linalg.cholesky(unit))
    except np.linalg.LinAlgError:  # two columns are the same, or the geometry imitates one
        lift = SAME + 2.0 * np.maximum(-np.linalg.eigvalsh(unit)[:, 0], 0.0)
        eye = np.eye(gram.shape[-1])
        return np.asarray(scale * np.linalg.cholesky(unit + lift[:, None, None] * eye))


# ---- components ----------------------------------------------------------------------------------


MAX_ROUNDS = 60
VARIANCE_TOLERANCE = 1e-3  # relative change of every variance in the last round
MIN_VARIANCE, MAX_VARIANCE = 1e-10, 1e6  # of a factor, the first of the noise too
MIN_DOF = 1e-12  # of a factor


@dataclass(frozen=True, eq=False)
class Components:
    """noise: variance of a number.  variance: (g,) of each group's factors.

    mean: (c,) of the factors, given the data.  moment: (c, c) mean of their products, given the
    data.
    """

    noise: float
    variance: Array
    mean: Array
    moment: Array


def fit_components(
    gram: Array, gradient: Array, square: float, dof: float, group: Array,
    start: Array | None = None, rounds: int = MAX_ROUNDS, tolerance: float = VARIANCE_TOLERANCE,
) -> Components:  # fmt: skip
    """Restricted maximum likelihood by its fixed point [Harville 1977].

    start: (g,) variances to begin with.  rounds: at most.  tolerance: that ends them; with 0 the
    result is a smooth function of what is given.

    gram: (c, c) products of the factors' columns, parameters taken out.  gradient: (c,) their
    products with the errors.  square: of the errors.  dof: numbers less parameters.  group: (c,)
    whose factors share a variance.
    """
    variance = np.ones(int(group.max(initial=-1)) + 1) if start is None else start
    noise = max(square / dof, MIN_VARIANCE)
    for _ in range(rounds):
        before = np.append(variance, noise)
        cover = np.linalg.inv(gram / noise + np.diag(1.0 / variance[group]))
        mean = cover @ gradient / noise
        told = np.maximum(1.0 - np.diag(cover) / variance[group], 0.0)
        one = np.bincount(group, mean**2) / (np.bincount(group, told) + MIN_DOF)
        left = square - 2.0 * mean @ gradient + mean @ gram @ mean
        noise = max(left / max(dof - told.sum(), 1.0), MIN_VARIANCE)
        variance = np.clip(one, MIN_VARIANCE, MAX_VARIANCE)
        if np.all(np.abs(np.log(np.append(variance, noise) / before)) < tolerance):
            break
    return Components(float(noise), variance, mean, cover + np.outer(mean, mean))
