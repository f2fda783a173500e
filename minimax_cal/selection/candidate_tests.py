"""Where candidates are compared beside the effects already chosen, at several ratios of noises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import fdtrc

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import column_norms_from_gram, divide_by_scales
from minimax_cal.selection.candidate_library import (
    CandidateLibrary,
    EqualShapeCandidates,
    LawCandidate,
    TemporaryCandidates,
    group_by_shape,
)
from minimax_cal.selection.gram_products import (
    RatioProducts,
    regularise_projected_squares,
    weighted_products_within_sets,
)
from minimax_cal.selection.noise_model import (
    Noise,
    estimate_noise_inflation,
    robust_cholesky_factors,
)
from minimax_cal.selection.thresholds import (
    MAX_PRIOR_DEVIATION_SIGMAS,
    SPECTRAL_LINE_LEVEL_FRACTION,
)
from minimax_cal.solvers.bounded_least_squares import solve_bounded_normal_equations

MIN_RELATIVE_REMAINING_SQUARE = 1e-15  # share of a square that is no more than rounding


@dataclass(frozen=True, eq=False)
class CandidateFit:
    """A candidate added to what was chosen before.

    likelihood_gain: by how much -2 log likelihood falls.  evidence: the gain less what so many free
    parameters would gain of themselves.  noise_ratio, noise_variance: the noise then.
    values: (d,) and sigmas: (d,) of its parameters.
    """

    candidate: LawCandidate
    likelihood_gain: float
    evidence: float
    noise_ratio: float
    noise_variance: float
    values: Array
    sigmas: Array


@dataclass(frozen=True, eq=False)
class ProjectedProducts:
    """Columns at several ratios of the noises, geometry and chosen effects projected out.

    noise_ratios: (s,).  span_coordinates: (s, D, f) coordinates of the columns in the orthonormal
    span of what is projected out; error_coordinates: (s, f) of the error.  gradients: (s, D)
    products of what is left of a column and of the error.  error_squares: (s,) squares of the
    error.  column_squares: (s, D) of the columns, unprojected. log_determinants: (s,) log
    determinants of the covariance and of the fixed effects.  build_unprojected_grams: products (s,
    c, d, d) within sets of columns (c, d), unprojected.
    """

    noise_ratios: Array
    span_coordinates: Array
    error_coordinates: Array
    gradients: Array
    error_squares: Array
    column_squares: Array
    log_determinants: Array
    build_unprojected_grams: Callable[[Array], Array]

    def projected_grams(self, column_sets: Array) -> Array:
        """(s, c, d, d) products, projected, of c sets of columns (c, d)."""
        part = self.span_coordinates[:, column_sets]
        return np.asarray(
            self.build_unprojected_grams(column_sets) - part @ np.swapaxes(part, -1, -2)
        )

    def solve_column_sets(
        self, column_sets: Array, grams: Array, ridges: Array
    ) -> tuple[Array, Array, Array]:
        """Values and diagonals of the inverse (s, c, d), and decreases of the square (s, c).

        column_sets: (c, d) columns.  grams: (s, c, d, d) their products.  ridges: (s, c, d).
        """
        d = column_sets.shape[1]
        grams = grams + ridges[..., None] * np.eye(d)
        pull = self.gradients[:, column_sets]
        diagonal = np.einsum("scdd->scd", grams)
        alive = diagonal > np.maximum(1e-7 * self.column_squares[:, column_sets], 1e-200)
        if d == 1:
            inverse = np.where(alive, 1.0 / np.where(alive, diagonal, 1.0), 0.0)
            return inverse * pull, inverse, (inverse * pull * pull)[..., 0]
        scale = np.where(alive, 1.0 / np.sqrt(np.where(alive, diagonal, 1.0)), 0.0)
        values, vectors = np.linalg.eigh(grams * scale[..., :, None] * scale[..., None, :])
        kept = np.where(values > 1e-9, 1.0 / np.where(values > 1e-9, values, 1.0), 0.0)
        basis = vectors * scale[..., :, None]
        value = basis @ (kept * (pull[..., None, :] @ basis)[..., 0, :])[..., None]
        value = value[..., 0]
        return value, (basis**2 @ kept[..., None])[..., 0], (value * pull).sum(axis=-1)

    def fit_all_candidates(
        self, shape_group: EqualShapeCandidates, degrees_of_freedom: int
    ) -> tuple[Array, Array, Array, Array]:
        """Decrease of the square by each candidate; values, their variances; Occam's factor.

        Doubts have the prior that the values found imply.
        """
        main, both = shape_group.column_indices, shape_group.all_column_indices
        d = main.shape[1]
        block = self.projected_grams(both)
        none = np.zeros((len(self.noise_ratios), *main.shape))
        value, inverse, gain = self.solve_column_sets(main, block[..., :d, :d], none)
        if both.shape[1] == d:
            return gain, value, inverse, np.zeros(gain.shape)
        variance = (
            np.maximum(self.error_squares[:, None] - gain, 1e-300)[..., None] / degrees_of_freedom
        )
        owner = np.broadcast_to(shape_group.varied_parameters, (*gain.shape, both.shape[1] - d))
        size = np.maximum(np.abs(np.take_along_axis(value, owner, axis=-1)), 1e-30)
        ridge = np.concatenate([none, variance / size**2], axis=-1)
        value, inverse, gain = self.solve_column_sets(both, block, ridge)
        loose = block[..., d:, d:] * size[..., :, None] * size[..., None, :] / variance[..., None]
        volume = np.linalg.slogdet(np.eye(both.shape[1] - d) + loose)[1]
        return gain, value[..., :d], inverse[..., :d], volume


@dataclass(frozen=True, eq=False)
class CandidateTests:
    """Where candidates are compared: beside what was chosen, over several ratios of the
    noises.

    tested_law_count: laws that are compared, for the chance of a false name.  degrees_of_freedom:
    degrees of freedom. nuisance: what is projected out, in rows.
    """

    library: CandidateLibrary
    selected_candidates: tuple[LawCandidate, ...]
    noise: Noise
    projected_products: ProjectedProducts
    nuisance: NuisanceProjection
    degrees_of_freedom: int
    tested_law_count: float

    @cached_property
    def deviance_without_addition(self) -> float:
        """-2 log restricted likelihood without a further effect."""
        return float(
            (
                self.degrees_of_freedom * np.log(self.projected_products.error_squares)
                + self.projected_products.log_determinants
            ).min()
        )

    @cached_property
    def ranked_candidates(self) -> list[CandidateFit]:
        """Candidates that are worth it, the best first, and the best of each kind."""
        found = self.rank_candidates(self.library.candidates)
        if self.library.spectral_lines is not None:
            found += self.spectral_line_tests.rank_candidates(
                self.library.spectral_lines.candidates
            )
        return sorted(found, key=lambda one: -one.evidence)

    @cached_property
    def spectral_line_tests(self) -> CandidateTests:
        """The bench for the library's lines."""
        return self.with_temporary_candidates(
            self.library.spectral_lines or self.library.build_temporary_candidates(())
        )

    def fit_candidate(self, candidate: LawCandidate) -> CandidateFit:
        """A candidate beside what was chosen, at its best ratio."""
        for line in self.library.spectral_lines.candidates if self.library.spectral_lines else ():
            if line.text == candidate.text:  # it was stored as a candidate later
                return replace(
                    self.spectral_line_tests.fit_shape_group(
                        EqualShapeCandidates.from_candidates([line])
                    )[0],
                    candidate=candidate,
                )
        return self.fit_shape_group(EqualShapeCandidates.from_candidates([candidate]))[0]

    def rank_candidates(self, candidates: Sequence[LawCandidate]) -> list[CandidateFit]:
        """Candidates that are worth it by evidence, and the best of each kind."""
        found = [
            one for kind in group_by_shape(tuple(candidates)) for one in self.fit_shape_group(kind)
        ]
        return sorted(found, key=lambda one: -one.evidence)

    def fit_shape_group(self, shape_group: EqualShapeCandidates) -> list[CandidateFit]:
        """Candidates of a kind that are worth it, and the best."""
        s, each = self.projected_products, np.arange(len(shape_group.candidates))
        gain, value, inverse, volume = s.fit_all_candidates(shape_group, self.degrees_of_freedom)
        rest = np.maximum(s.error_squares[:, None] - gain, 1e-300)
        cost = self.degrees_of_freedom * np.log(rest) + s.log_determinants[:, None]
        at = np.argmin(cost, axis=0)
        variance = rest[at, each] / self.degrees_of_freedom
        up = np.maximum(self.deviance_without_addition - cost[at, each], 0.0)
        value = value[at, each]
        sigma = np.sqrt(np.maximum(inverse[at, each] * variance[:, None], 0.0))
        # Evidence: the gain less what so many free parameters must gain (Occam), what values far
        # beyond the usual cost, and what a sign that is physically impossible gains.
        d, usual = (
            shape_group.charged_parameter_counts,
            ((value / shape_group.typical_sizes[:, None]) ** 2).sum(axis=1),
        )
        occam = d * (1.0 + np.log(np.maximum(up / d, 1.0))) + 2.0 * np.log(
            shape_group.frequencies_tried
        )
        wrong = shape_group.nonnegative & (value[:, 0] < 0.0)
        sign = wrong * (value[:, 0] / np.maximum(sigma[:, 0], 1e-300)) ** 2
        worth = up - volume[at, each] - occam - (usual + sign)
        shown = np.union1d(np.flatnonzero(worth > 0.0), [np.argmax(worth)])
        return [
            CandidateFit(
                shape_group.candidates[i],
                float(up[i]),
                float(worth[i]),
                float(s.noise_ratios[at[i]]),
                float(variance[i]),
                value[i],
                sigma[i],
            )
            for i in shown.tolist()
        ]

    def single_test_p_value(
        self, candidate_fit: CandidateFit, noise_inflation: float = 1.0
    ) -> float:
        """Probability that this candidate, without effect, gains so much; no other was tried.

        noise_inflation: by how much the rows are noisier along it than all together, as
        `estimate_noise_inflation`.
        """
        d = len(candidate_fit.candidate.column_indices) + candidate_fit.candidate.tuned_number_count
        free = max(self.degrees_of_freedom - d, 1)
        ratio = (
            np.expm1(min(candidate_fit.likelihood_gain / max(self.degrees_of_freedom, 1), 50.0))
            * free
            / d
            / noise_inflation
        )
        return float(fdtrc(d, free, ratio))

    def p_value(self, candidate_fit: CandidateFit, noise_inflation: float = 1.0) -> float:
        """Probability that a candidate without effect gains so much, the best of all tries."""
        return min(
            1.0,
            self.single_test_p_value(candidate_fit, noise_inflation)
            * self.effective_test_count(candidate_fit.candidate),
        )

    def effective_test_count(self, candidate: LawCandidate) -> float:
        """Candidates of its kind, over the share of the level that the kind has."""
        if not candidate.is_spectral_line:
            return self.tested_law_count / (1.0 - 2.0 * SPECTRAL_LINE_LEVEL_FRACTION)
        heard = [one.term for one in self.selected_candidates if one.is_spectral_line]
        return candidate.frequencies_tried / (
            1.0
            if self.library.dictionary.is_expected(candidate.term, heard)
            else SPECTRAL_LINE_LEVEL_FRACTION
        )

    def is_significant(self, candidate_fit: CandidateFit, significance_level: float) -> bool:
        """Whether a gain is less probable than a level, by all rows and by groups of them."""
        if self.p_value(candidate_fit) >= significance_level:
            return False
        at = int(np.argmax(self.projected_products.noise_ratios == candidate_fit.noise_ratio))
        motion = (
            candidate_fit.values
            @ self.library.projected_fields(candidate_fit.candidate)[: len(candidate_fit.values)]
        )
        own, rest = (
            self.nuisance.whiten_and_project(motion[None], at)[0],
            self.nuisance.whitened_projected_error(at),
        )
        wide = estimate_noise_inflation(
            own, rest, self.library.problem.row_groups, self.degrees_of_freedom
        )
        return self.p_value(candidate_fit, wide) < significance_level

    def similarity_to_candidate(
        self, candidate_fit: CandidateFit, other_candidate: LawCandidate
    ) -> tuple[float, float]:
        """lambda of an effect found, and rho^2: the share of its motion that another imitates."""
        at = int(np.argmax(self.projected_products.noise_ratios == candidate_fit.noise_ratio))
        d = len(candidate_fit.candidate.column_indices)
        fields = [
            self.library.projected_fields(candidate_fit.candidate)[:d],
            self.library.projected_fields(other_candidate),
        ]
        both = self.nuisance.projected_gram(np.concatenate(fields), at)
        size = float(candidate_fit.values @ both[:d, :d] @ candidate_fit.values)
        across = candidate_fit.values @ both[:d, d:]
        own = np.diag(both)[d:]  # zero where geometry imitates a column
        scale = np.sqrt(np.maximum(own, 1e-12 * own.max(initial=0.0) + 1e-300))
        inverse = np.linalg.pinv(divide_by_scales(both[d:, d:], scale), 1e-9, hermitian=True)
        shared = float((across / scale) @ inverse @ (across / scale))
        return size / candidate_fit.noise_variance, min(shared / max(size, 1e-300), 1.0)

    def p_value_beside_candidate(
        self, candidate_fit: CandidateFit, other_candidate: LawCandidate
    ) -> float:
        """`p_value` of an effect where another, with its doubts free, is there as well."""
        fields = [
            self.library.projected_fields(other_candidate),
            self.library.projected_fields(candidate_fit.candidate)[: len(candidate_fit.values)],
        ]
        columns = np.concatenate(fields)
        settings = self.project_temporary_columns(columns, columns.T)
        least = []
        for count in (len(fields[0]), len(columns)):
            index = np.arange(count)[None]
            none = np.zeros((len(settings.noise_ratios), 1, count))
            gain = settings.solve_column_sets(index, settings.projected_grams(index), none)[2][:, 0]
            rest = np.maximum(settings.error_squares - gain, 1e-300)
            least.append(
                float((self.degrees_of_freedom * np.log(rest) + settings.log_determinants).min())
            )
        return self.p_value(replace(candidate_fit, likelihood_gain=max(least[0] - least[1], 0.0)))

    def with_temporary_candidates(
        self, temporary_candidates: TemporaryCandidates
    ) -> CandidateTests:
        """The bench for candidates that are not stored, instead of those that are."""
        return replace(
            self,
            projected_products=self.project_temporary_columns(
                temporary_candidates.projected_columns, temporary_candidates.columns
            ),
        )

    def project_temporary_columns(
        self, projected_columns: Array, raw_columns: Array
    ) -> ProjectedProducts:
        """The settings for columns that are not stored.  projected_columns: (d, N), raw_columns:
        (N, d), as `TemporaryCandidates`.
        """
        weights = self.nuisance.weights
        part, pull = self.nuisance.project_columns(projected_columns)
        return replace(
            self.projected_products,
            span_coordinates=part,
            gradients=pull,
            column_squares=(weights @ raw_columns**2),
            build_unprojected_grams=lambda index: np.moveaxis(
                weighted_products_within_sets(projected_columns[index], weights), -1, 0
            ),
        )


@dataclass(frozen=True, eq=False)
class NuisanceProjection:
    """What is projected out, in rows, for columns that are stored nowhere.

    products, candidate_columns: geometry's columns and some of the candidates' (q,).
    cholesky_factors: (s, f, f) lower triangles of the rows' products.  weights: (s, N).
    error_coordinates: (s, f) as in `ProjectedProducts`. error: (N,).
    """

    products: RatioProducts
    candidate_columns: Array
    cholesky_factors: Array
    weights: Array
    error_coordinates: Array
    error: Array
    whitened_error_cache: dict[int, Array] = field(default_factory=dict)

    def whitened_projected_error(self, ratio_index: int) -> Array:
        """(N,) the error at one of the ratios, projected, its rows of the same variance."""
        if ratio_index not in self.whitened_error_cache:
            self.whitened_error_cache[ratio_index] = self.whiten_and_project(
                self.error[None], ratio_index
            )[0]
        return self.whitened_error_cache[ratio_index]

    @property
    def nuisance_columns(self) -> Array:
        """(f, N)."""
        return self.products.geometry_and_candidate_columns(self.candidate_columns)

    def projected_gram(self, columns: Array, ratio_index: int) -> Array:
        """(d, d) products of columns (d, N), projected, at one of the ratios."""
        own = columns * self.weights[ratio_index]
        part = solve_triangular(
            self.cholesky_factors[ratio_index], self.nuisance_columns @ own.T, lower=True
        )
        return np.asarray(own @ columns.T - part.T @ part)

    def whiten_and_project(self, columns: Array, ratio_index: int) -> Array:
        """Columns (d, N), projected, their rows of the same variance."""
        factor = self.cholesky_factors[ratio_index]
        part = solve_triangular(
            factor, self.nuisance_columns @ (columns * self.weights[ratio_index]).T, lower=True
        )
        value = solve_triangular(factor, part, lower=True, trans="T")
        return np.asarray(
            (columns - value.T @ self.nuisance_columns) * np.sqrt(self.weights[ratio_index])
        )

    def project_columns(self, columns: Array) -> tuple[Array, Array]:
        """Coordinates (s, d, f) of columns (d, N) in the span; (s, d) products with the error."""
        s, d = len(self.weights), len(columns)
        part, pull = np.empty((s, d, len(self.nuisance_columns))), np.empty((s, d))
        for i, (factor, weight) in enumerate(zip(self.cholesky_factors, self.weights, strict=True)):
            weighed = columns * weight
            shared = self.nuisance_columns @ weighed.T
            part[i] = solve_triangular(factor, shared, lower=True, check_finite=False).T
            pull[i] = weighed @ self.error
        return part, pull - (part @ self.error_coordinates[..., None])[..., 0]


def build_candidate_tests(
    library: CandidateLibrary,
    selected_candidates: Sequence[LawCandidate],
    candidate_fits: Sequence[CandidateFit] = (),
) -> CandidateTests:
    """The place to compare further candidates beside those chosen.

    candidate_fits: values of the chosen, where their doubts matter.
    """
    products, rows = library.products, library.problem
    main, loose, ridge = list_columns_and_ridges(selected_candidates, candidate_fits)
    noise, dof = products.estimate_noise(main), products.degrees_of_freedom(main)
    ratios = products.compared_noise_ratios(noise)
    index = np.concatenate([main, loose])
    at = products.products_at_ratios(ratios, index)
    # Products of the chosen and of their doubts, which come last, with the doubts' priors.
    each = range(len(index))
    gram = at.products_with_candidates[:, :, index].copy()
    gram[:, each, each] = regularise_projected_squares(
        gram[:, each, each], at.column_squares[:, index]
    )
    gram[:, each, each] += np.pad(ridge * noise.variance, (len(main), 0))
    factor = robust_cholesky_factors(gram)
    both = np.concatenate([at.gradients[..., None], at.products_with_candidates], axis=2)
    part = np.stack([
        solve_triangular(lower, lines, lower=True, check_finite=False).T
        for lower, lines in zip(factor, both, strict=True)
    ]) if len(index) else np.zeros((len(ratios), both.shape[2], 0))  # fmt: skip
    before, part = part[:, 0], part[:, 1:]
    total = np.maximum(
        at.error_products[:, 0] - (before**2).sum(axis=1),
        MIN_RELATIVE_REMAINING_SQUARE * at.unprojected_error_square + 1e-300,
    )
    size = np.einsum("sff->sf", factor)[:, : len(main)]
    spread = np.log1p(ratios[:, None] * rows.variance_ratio[products.kept]).sum(axis=1)
    settings = ProjectedProducts(
        noise_ratios=ratios,
        span_coordinates=part,
        error_coordinates=before,
        gradients=at.error_products[:, 1:] - (part @ before[..., None])[..., 0],
        error_squares=total,
        column_squares=at.column_squares,
        log_determinants=spread + at.geometry_log_determinants + 2.0 * np.log(size).sum(axis=1),
        build_unprojected_grams=at.build_products_within_sets,
    )
    r = at.geometry_factors.shape[1]  # of geometry, whose triangles stand above those of the chosen
    whole = np.zeros((len(ratios), r + len(index), r + len(index)))
    whole[:, :r, :r], whole[:, r:, r:] = at.geometry_factors, factor
    whole[:, r:, :r] = np.swapaxes(at.geometry_coordinates[:, :, 1:], 1, 2)
    held = NuisanceProjection(
        products,
        index,
        whole,
        products.kept / (1.0 + np.outer(ratios, rows.variance_ratio)),
        np.concatenate([at.geometry_coordinates[:, :, 0], before], axis=1),
        rows.error,
    )
    return CandidateTests(
        library, tuple(selected_candidates), noise, settings, held, dof, float(library.law_count)
    )


def build_normal_equations(
    library: CandidateLibrary, candidate_fits: Sequence[CandidateFit], noise: Noise
) -> tuple[Array, Array, Array]:
    """Products (q, q) of the columns of effects and their doubts, (q,) with the error; their units.

    candidate_fits: the effects; their values are the sizes of their doubts.
    """
    main, loose, ridge = list_columns_and_ridges(
        [one.candidate for one in candidate_fits], candidate_fits
    )
    index = np.concatenate([main, loose])
    (whole,), _ = library.products.projected_gram_at_ratios(
        np.array([noise.joint_to_instrument_ratio]), index
    )
    gram, pull = whole[:-1, :-1], whole[:-1, -1]
    gram = gram + np.diag(np.pad(ridge * noise.variance, (len(main), 0)))
    scale = column_norms_from_gram(gram)
    return divide_by_scales(gram, scale), pull / scale, scale


def deviance_of_sign_constraints(
    library: CandidateLibrary, candidate_fits: Sequence[CandidateFit], noise: Noise
) -> float:
    """By how much -2 log likelihood rises where no parameter has a sign that no body has."""
    if not any(one.candidate.nonnegative.any() for one in candidate_fits):
        return 0.0
    gram, pull, _ = build_normal_equations(library, candidate_fits, noise)
    free = solve_bounded_normal_equations(
        gram, pull, *np.full((2, len(pull)), [[-np.inf], [np.inf]])
    )
    off = solve_with_sign_constraints(gram, pull, candidate_fits) - free
    return float(off @ gram @ off) / max(noise.variance, 1e-300)


def solve_with_sign_constraints(
    gram: Array, gradient: Array, candidate_fits: Sequence[CandidateFit]
) -> Array:
    """(q,) least squares in which no parameter has a sign that no body has."""
    low, high = np.full((2, len(gradient)), [[-np.inf], [np.inf]])
    upward = np.concatenate([one.candidate.nonnegative for one in candidate_fits])
    low[: len(upward)][upward] = 0.0
    return solve_bounded_normal_equations(gram, gradient, low, high)


def estimate_jointly(
    library: CandidateLibrary,
    candidate_fits: Sequence[CandidateFit],
    noise: Noise,
    *,
    ignore_signs: bool = False,
) -> tuple[tuple[Array, Array], ...]:
    """Values and sigmas (d,) of the parameters of effects, estimated together.

    No value has a sign that no body has, unless it is free; sigmas are those of free values.
    candidate_fits: the effects; their values are the sizes of their doubts.
    """
    if not candidate_fits:
        return ()
    gram, pull, scale = build_normal_equations(library, candidate_fits, noise)
    inverse = np.linalg.pinv(gram, 1e-12, hermitian=True)
    signed = not ignore_signs and any(one.candidate.nonnegative.any() for one in candidate_fits)
    value = (
        solve_with_sign_constraints(gram, pull, candidate_fits) if signed else inverse @ pull
    ) / scale
    sigma = np.sqrt(np.maximum(np.diag(inverse), 0.0) * noise.variance) / scale
    cuts = np.cumsum([len(one.candidate.column_indices) for one in candidate_fits])
    return tuple(zip(np.split(value, cuts)[:-1], np.split(sigma, cuts)[:-1], strict=True))


def are_prior_variations_plausible(
    library: CandidateLibrary, candidate_fits: Sequence[CandidateFit], noise: Noise
) -> bool:
    """Whether what the laws of effects must differ by, to explain most, is what they may."""
    main, _, ridge = list_columns_and_ridges(
        [one.candidate for one in candidate_fits], candidate_fits
    )
    if not len(ridge):
        return True
    gram, pull, scale = build_normal_equations(library, candidate_fits, noise)
    value = np.linalg.pinv(gram, 1e-12, hermitian=True) @ pull / scale
    return bool((value[len(main) :] ** 2 * ridge < MAX_PRIOR_DEVIATION_SIGMAS**2).all())


def list_columns_and_ridges(
    selected_candidates: Sequence[LawCandidate], candidate_fits: Sequence[CandidateFit] = ()
) -> tuple[Array, Array, Array]:
    """Columns of the chosen, of their doubts, and the ridge of each doubt [1/unit^2]."""
    none = np.zeros(0, dtype=int)
    main = np.concatenate([none, *(c.column_indices for c in selected_candidates)])
    values = {id(one.candidate): one.values for one in candidate_fits}
    loose, ridge = [none], [np.zeros(0)]
    for c in selected_candidates:
        if len(c.variation_column_indices) and len(values.get(id(c), ())):
            loose.append(c.variation_column_indices)
            ridge.append(1.0 / np.maximum(values[id(c)][c.varied_parameters] ** 2, 1e-60))
    return main, np.concatenate(loose), np.concatenate(ridge)
