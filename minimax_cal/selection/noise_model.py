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

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import column_norms_from_gram, divide_by_scales, project_out
from minimax_cal.selection.thresholds import MIN_NOISE_DEGREES_OF_FREEDOM

SEARCHED_NOISE_RATIOS = np.concatenate(
    [[0.0], np.logspace(-3, 5, 9)]
)  # among which the likeliest is sought
ZERO_RATIO_DECADE = -300  # the decade of the ratio 0
CHEBYSHEV_NODES_PER_DECADE = 18  # points in a decade of ratios: products to rounding
LIKELIHOOD_NODE_COUNT = 14  # points in two decades where a likelihood is least: to 1e-7 of it
FINE_GRID_SIZE = 401  # points between which a polynomial's least value is sought


@cache
def chebyshev_points(count: int) -> Array:
    """(g,) Chebyshev points between 0 and 1."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * (2.0 * np.arange(count) + 1.0) / (2.0 * count)))


def decade_noise_ratios(decade: int) -> Array:
    """(g,) ratios in a decade; in ZERO the ratio 0 alone."""
    return (
        np.asarray(10.0 ** (decade + chebyshev_points(CHEBYSHEV_NODES_PER_DECADE)))
        if decade > ZERO_RATIO_DECADE
        else np.zeros(1)
    )


def chebyshev_interpolation(x: Array, point_count: int) -> Array:
    """(s, g) values at x of the polynomials that are 1 at one Chebyshev point and 0 at the others.

    By the barycentric formula [Berrut and Trefethen 2004].
    """
    at = chebyshev_points(point_count)
    off = x[:, None] - at
    met = off == 0.0
    size = np.sqrt(at * (1.0 - at)) * np.where(np.arange(point_count) % 2, -1.0, 1.0)
    part = size / np.where(met, 1.0, off)
    part = np.where(met.any(axis=1, keepdims=True), met.astype(float), part)
    return np.asarray(part / part.sum(axis=1, keepdims=True))


FINE_GRID: Array = np.linspace(0.0, 1.0, FINE_GRID_SIZE)
FINE_GRID_INTERPOLATION = chebyshev_interpolation(
    FINE_GRID, LIKELIHOOD_NODE_COUNT
)  # (f, g) how values there follow from those at a few


def find_best_noise_ratio(compute_deviance: Callable[[Array], Array]) -> float:
    """The ratio of least cost, 0 if none of RATIOS costs less.  compute_deviance: (g,) of ratios
    (g,).
    """
    best = int(np.argmin(compute_deviance(SEARCHED_NOISE_RATIOS)))
    if not best:
        return 0.0
    # Between the neighbours the cost is a polynomial in the logarithm of the ratio; beside its
    # least value on a fine grid the vertex of the parabola through that and its neighbours.
    low, high = np.log10(
        SEARCHED_NOISE_RATIOS[[max(best - 1, 1), min(best + 1, len(SEARCHED_NOISE_RATIOS) - 1)]]
    )
    values = FINE_GRID_INTERPOLATION @ compute_deviance(
        10.0 ** (low + (high - low) * chebyshev_points(LIKELIHOOD_NODE_COUNT))
    )
    at, step = int(np.argmin(values)), 0.0
    if 0 < at < FINE_GRID_SIZE - 1:
        before, here, after = values[at - 1 : at + 2]
        bend = before - 2.0 * here + after
        step = float(0.5 * (before - after) / bend) if bend > 0.0 else 0.0
    return float(10.0 ** (low + (high - low) * (FINE_GRID[at] + step / (FINE_GRID_SIZE - 1))))


# ---- ratios --------------------------------------------------------------------------------------


MIN_IDENTIFIABLE_SINGULAR_VALUE = (
    1e-5  # singular value of the scaled Jacobian below which a direction is no direction
)
DUPLICATE_COLUMN_RIDGE = 1e-12  # added to products of unit columns where some are the same
MIN_COMPUTED_NOISE_FRACTION = (
    0.1  # of the noise of computed rows: no variance is estimated below its square
)


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """Rows of a linear fit in which two noises are diagonal.

    error: (N,) what is to be explained.  nuisance_basis: (N, p) orthonormal span of the nuisance
    columns, always projected out.  variance_ratio: (N,) variance that the second noise adds to a
    row, over that of the first, relative to its mean; mean_variance_ratio: the mean.  row_groups:
    (N,) from 0, of rows that err together.  measured: (N,) False for rows that hold no number.
    rounding_noise: a noise below it is rounding: the rows were computed, not measured.
    """

    error: Array
    nuisance_basis: Array
    variance_ratio: Array
    mean_variance_ratio: float
    row_groups: Array
    measured: Array
    rounding_noise: float

    @property
    def measured_row_count(self) -> int:
        """Rows that were measured."""
        return int(np.count_nonzero(self.measured))

    def with_nuisance_columns(self, columns: Array) -> Self:
        """With columns (N, q) projected out as nuisance is, as far as they are determined.

        columns: of factors whose priors weigh as one row of unit error; a direction that is
        determined by no more than that is left.
        """
        rest = project_out(columns, self.nuisance_basis)
        span, size, _ = np.linalg.svd(rest, full_matrices=False)
        span = span[:, size > 1.0]
        error = project_out(self.error, span)
        return replace(
            self, error=error, nuisance_basis=np.concatenate([self.nuisance_basis, span], axis=1)
        )


def orthonormal_basis(matrix: Array) -> Array:
    """Orthonormal columns with the span of a matrix (N, p) whose columns are first scaled."""
    norm = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, norm > 0] / norm[norm > 0]
    return np.asarray(np.linalg.qr(scaled @ distinguishable_combinations(scaled.T @ scaled))[0])


def identifiable_combinations(gram: Array) -> Array:
    """(p, r) combinations of parameters that turn a Gram matrix (p, p) into 1."""
    norm = np.sqrt(np.diag(gram))
    used = norm > 0.0
    whole = distinguishable_combinations(divide_by_scales(gram[np.ix_(used, used)], norm[used]))
    out = np.zeros((len(gram), whole.shape[1]))
    out[used] = whole / norm[used][:, None]
    return out


def distinguishable_combinations(gram: Array) -> Array:
    """(p, r) combinations that turn a Gram matrix (p, p) of unit columns into 1."""
    values, vectors = np.linalg.eigh(gram)
    kept = (
        values > MIN_IDENTIFIABLE_SINGULAR_VALUE**2 * values[-1]
        if len(values)
        else np.zeros(0, dtype=bool)
    )
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))


def estimate_noise_inflation(
    whitened_field: Array, whitened_residual: Array, row_groups: Array, degrees_of_freedom: int
) -> float:
    """How much noisier rows are along a field than all together, as groups of them tell it, >= 1.

    By the jackknife, no group judging itself: wrong points, an instrument whose directions differ,
    and groups whose rows err alike give a field no more weight than they deserve.  whitened_field:
    (N,) as fitted, and whitened_residual: (N,) without it, both white.  row_groups: (N,) from 0.
    """
    own = np.bincount(row_groups, whitened_field * whitened_field)
    whole = float(own.sum())
    if whole <= 0.0:
        return 1.0
    whitened_residual = whitened_residual - whitened_field
    pull = np.bincount(row_groups, whitened_field * whitened_residual) / np.maximum(
        1.0 - own / whole, 0.1
    )
    variance = max(
        float(whitened_residual @ whitened_residual) / max(degrees_of_freedom, 1), 1e-300
    )
    return max(float(pull @ pull) / (whole * variance), 1.0)


@dataclass(frozen=True)
class Noise:
    """joint_to_instrument_ratio: variance that the joints add to a mean row over that of the
    instrument.

    variance: of the instrument per coordinate [m^2].  joint_jitter: standard deviation of a joint
    [rad].
    """

    joint_to_instrument_ratio: float
    variance: float
    joint_jitter: float

    def row_weights(self, problem: LinearProblem) -> Array:
        """(N,) inverse variances [1/m^2]."""
        return np.asarray(
            1.0 / (self.variance * (1.0 + self.joint_to_instrument_ratio * problem.variance_ratio))
        )


def weighted_residual(problem: LinearProblem, weights: Array, fitted_columns: Array) -> Array:
    """(N,) what the weighted least squares on geometry and known columns leaves of the error [m].

    weights: (N,) inverse variances, 0 for rows that are not fitted.  fitted_columns: (N, q).
    """
    columns = np.concatenate([problem.nuisance_basis, fitted_columns], axis=1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    gram = columns.T @ (columns * weights[:, None])
    value = np.linalg.lstsq(gram, columns.T @ (weights * problem.error), rcond=1e-12)[0]
    return np.asarray(problem.error - columns @ value)


def estimate_noise_by_reml(problem: LinearProblem, fitted_columns: Array) -> Noise:
    """Noise by restricted maximum likelihood.  fitted_columns: (N, q) further columns that are
    fitted.
    """
    columns = np.concatenate(
        [problem.nuisance_basis, fitted_columns, problem.error[:, None]], axis=1
    )
    dof = problem.measured_row_count - columns.shape[1] + 1
    if dof < MIN_NOISE_DEGREES_OF_FREEDOM:
        return build_noise(
            0.0, float(problem.error @ problem.error) / max(problem.measured_row_count, 1), problem
        )

    def cost(ratios: Array) -> tuple[Array, Array]:
        halves = (columns / np.sqrt(1.0 + r * problem.variance_ratio)[:, None] for r in ratios)
        gram = np.array([half.T @ half for half in halves])
        return restricted_deviances(gram, ratios, problem.variance_ratio, dof)

    ratio = find_best_noise_ratio(lambda ratios: cost(ratios)[0])
    return build_noise(ratio, float(cost(np.array([ratio]))[1][0]) / dof, problem)


def build_noise(ratio: float, variance: float, problem: LinearProblem) -> Noise:
    """Both noises of a ratio and of the variance of the instrument, no less than rounding is."""
    variance = max(variance, (MIN_COMPUTED_NOISE_FRACTION * problem.rounding_noise) ** 2)
    return Noise(ratio, variance, float(np.sqrt(ratio * variance / problem.mean_variance_ratio)))


def restricted_deviances(
    grams: Array, noise_ratios: Array, row_variance_ratios: Array, degrees_of_freedom: int
) -> tuple[Array, Array]:
    """-2 log restricted likelihood (g,) at ratios (g,) [Patterson and Thompson 1971].

    And squares (g,) of what is left of the error.  grams: (g, p + 1, p + 1) weighted products of
    what is fitted and, last, the error.  row_variance_ratios: variance ratios of the rows that
    count.
    """
    grams = grams + 0.0
    grams[:, -1, -1] += 1e-300
    logs = np.log(np.einsum("rpp->rp", robust_cholesky_factors(grams)))
    squares = np.exp(2.0 * logs[:, -1])
    spread = np.log1p(noise_ratios[:, None] * row_variance_ratios).sum(axis=1)
    return degrees_of_freedom * np.log(squares) + spread + 2.0 * logs[:, :-1].sum(axis=1), squares


def robust_cholesky_factors(grams: Array) -> Array:
    """(s, f, f) lower triangles whose squares are matrices (s, f, f), as near as those allow."""
    scale = column_norms_from_gram(grams)[..., None]
    unit = grams / scale / np.swapaxes(scale, 1, 2)
    try:
        return np.asarray(scale * np.linalg.cholesky(unit))
    except np.linalg.LinAlgError:  # two columns are the same, or the geometry imitates one
        lift = DUPLICATE_COLUMN_RIDGE + 2.0 * np.maximum(-np.linalg.eigvalsh(unit)[:, 0], 0.0)
        eye = np.eye(grams.shape[-1])
        return np.asarray(scale * np.linalg.cholesky(unit + lift[:, None, None] * eye))


# ---- components ----------------------------------------------------------------------------------


MAX_REML_ITERATIONS = 60
REML_VARIANCE_TOLERANCE = 1e-3  # relative change of every variance in the last round
MIN_FACTOR_VARIANCE, MAX_FACTOR_VARIANCE = 1e-10, 1e6  # of a factor, the first of the noise too
MIN_FACTOR_DEGREES_OF_FREEDOM = 1e-12  # of a factor


@dataclass(frozen=True, eq=False)
class VarianceComponents:
    """noise: variance of a number.  variance: (g,) of each group's factors.

    mean: (c,) of the factors, given the data.  second_moment: (c, c) mean of their products, given
    the data.
    """

    noise: float
    variance: Array
    mean: Array
    second_moment: Array


def fit_variance_components(
    gram: Array,
    gradient: Array,
    error_square: float,
    degrees_of_freedom: float,
    factor_groups: Array,
    start_variances: Array | None = None,
    max_iterations: int = MAX_REML_ITERATIONS,
    tolerance: float = REML_VARIANCE_TOLERANCE,
) -> VarianceComponents:
    """Restricted maximum likelihood by its fixed point [Harville 1977].

    start_variances: (g,) variances to begin with.  max_iterations: at most.  tolerance: that ends
    them; with 0 the result is a smooth function of what is given.

    gram: (c, c) products of the factors' columns, parameters taken out.  gradient: (c,) their
    products with the errors.  error_square: of the errors.  degrees_of_freedom: numbers less
    parameters.  factor_groups: (c,) whose factors share a variance.
    """
    variance = (
        np.ones(int(factor_groups.max(initial=-1)) + 1)
        if start_variances is None
        else start_variances
    )
    noise = max(error_square / degrees_of_freedom, MIN_FACTOR_VARIANCE)
    for _ in range(max_iterations):
        before = np.append(variance, noise)
        cover = np.linalg.inv(gram / noise + np.diag(1.0 / variance[factor_groups]))
        mean = cover @ gradient / noise
        told = np.maximum(1.0 - np.diag(cover) / variance[factor_groups], 0.0)
        one = np.bincount(factor_groups, mean**2) / (
            np.bincount(factor_groups, told) + MIN_FACTOR_DEGREES_OF_FREEDOM
        )
        left = error_square - 2.0 * mean @ gradient + mean @ gram @ mean
        noise = max(left / max(degrees_of_freedom - told.sum(), 1.0), MIN_FACTOR_VARIANCE)
        variance = np.clip(one, MIN_FACTOR_VARIANCE, MAX_FACTOR_VARIANCE)
        if np.all(np.abs(np.log(np.append(variance, noise) / before)) < tolerance):
            break
    return VarianceComponents(float(noise), variance, mean, cover + np.outer(mean, mean))
