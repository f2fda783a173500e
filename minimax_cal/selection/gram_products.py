"""Cross-products of columns, rows weighed for any ratio of the noises, each formed once.

Products at the nodes of a decade give those at any ratio there (see `noise_ratios`).  The geometry
is projected out once at every node; what is left is as smooth.  `subsample_products` has those of
some rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.selection.noise_model import (
    CHEBYSHEV_NODES_PER_DECADE,
    MIN_IDENTIFIABLE_SINGULAR_VALUE,
    SEARCHED_NOISE_RATIOS,
    ZERO_RATIO_DECADE,
    LinearProblem,
    Noise,
    build_noise,
    chebyshev_interpolation,
    decade_noise_ratios,
    distinguishable_combinations,
    find_best_noise_ratio,
    restricted_deviances,
    robust_cholesky_factors,
)
from minimax_cal.selection.thresholds import MIN_NOISE_DEGREES_OF_FREEDOM

MIN_PROJECTED_SQUARE_FRACTION = (
    MIN_IDENTIFIABLE_SINGULAR_VALUE**2
)  # of a column's square: what is left of one that geometry imitates is no less
MAX_WEIGHTED_NUMBERS_AT_ONCE = 1_000_000  # weighed numbers that are held at once
COMPARED_RATIO_FACTORS = np.array(
    [1.0, 0.4, 0.12, 0.03, 0.0]
)  # of the ratio, when an effect is added


class CandidateColumns:
    """Columns of the geometry, the error, and candidates, as they are gathered; each stored once.

    The candidates' are stored twice: as they are, and less what geometry imitates, so that little
    is lost where products of what is left are differences.
    """

    def __init__(self, rows: LinearProblem) -> None:
        self.rows = rows
        self.fixed: int = rows.nuisance_basis.shape[1] + 1  # geometry and the error
        self.count = 0
        self.held = grow_array(np.empty((256, len(rows.error))), self.fixed)
        self.plain = np.empty((0, len(rows.error)))
        self.held[: self.fixed] = np.concatenate([rows.nuisance_basis.T, rows.error[None]])

    @property
    def candidate_columns(self) -> Array:
        """(N, D) candidates' columns."""
        return self.plain[: self.count].T

    @property
    def projected_columns(self) -> Array:
        """(p + 1 + D, N) geometry, the error, and columns less what geometry imitates."""
        return self.held[: self.fixed + self.count]

    def append(self, columns: Array) -> Array:
        """Indices of new columns (N, d) among the candidates'."""
        at = self.count + np.arange(columns.shape[1])
        self.count += len(at)
        self.plain = grow_array(self.plain, self.count)
        self.held = grow_array(self.held, self.fixed + self.count)
        self.plain[at] = columns.T
        self.held[self.fixed + at] = self.project_out_nuisance(columns)
        return at

    def project_out_nuisance(self, columns: Array) -> Array:
        """(d, N) columns (N, d) less what geometry imitates."""
        basis = self.rows.nuisance_basis
        return np.asarray(columns.T - (columns.T @ basis) @ basis.T)


def grow_array(array: Array, min_length: int, axis: int = 0) -> Array:
    """The store with room for so many along an axis."""
    if min_length <= array.shape[axis]:
        return array
    room = max(min_length, 5 * array.shape[axis] // 4) - array.shape[axis]
    shape = (*array.shape[:axis], room, *array.shape[axis + 1 :])
    return np.concatenate([array, np.empty(shape)], axis=axis)


ColumnSelection = slice | Array  # columns, by where they stand
ComputeProducts = Callable[
    [Array, ColumnSelection], Array
]  # products (f, g, d) of columns (f,) with some


class ProductRowCache:
    """Products of some columns with all, at g ratios, each formed when it is first asked for.

    Whoever asks brings what forms them, and is not held here: two that hold each other stay in
    memory, which these fill, until someone looks for such pairs.
    """

    def __init__(self, depth: int) -> None:
        self.held = np.empty((0, depth, 0))
        self.place: dict[int, int] = {}
        self.width = 0

    def products_with_slice(
        self, compute_products: ComputeProducts, row_columns: Array, column_slice: slice
    ) -> Array:
        """(f, g, d) products of columns with those of a slice."""
        known, width = len(self.place), column_slice.stop
        new = find_uncached_columns(row_columns, self.place)
        self.held = grow_array(grow_array(self.held, known + len(new)), width, axis=2)
        if width > self.width:
            if known:
                late = slice(self.width, width)
                self.held[:known, :, late] = compute_products(np.array(list(self.place)), late)
            self.width = width
        if len(new):
            self.held[known : known + len(new), :, : self.width] = compute_products(
                new, slice(0, self.width)
            )
            self.place.update(zip(new.tolist(), range(known, known + len(new)), strict=True))
        return np.asarray(self.held[find_cache_positions(row_columns, self.place), :, column_slice])


class ProductBlockCache:
    """Products among some columns, at g ratios, each formed once; who asks brings what forms it."""

    def __init__(self, depth: int) -> None:
        self.held = np.empty((0, depth, 0))
        self.place: dict[int, int] = {}

    def products_among(
        self, compute_products: ComputeProducts, row_columns: Array, other_columns: Array
    ) -> Array:
        """(f, g, d) products of columns with others."""
        new = find_uncached_columns(np.concatenate([row_columns, other_columns]), self.place)
        if len(new):
            known = len(self.place)
            every = np.concatenate([np.array(list(self.place), dtype=int), new])
            self.place.update(zip(new.tolist(), range(known, len(every)), strict=True))
            self.held = grow_array(grow_array(self.held, len(every)), len(every), axis=2)
            block = compute_products(new, every)
            self.held[known : len(every), :, : len(every)] = block
            self.held[:known, :, known : len(every)] = np.swapaxes(block, 0, 2)[:known]
        at, beside = (
            find_cache_positions(row_columns, self.place),
            find_cache_positions(other_columns, self.place),
        )
        return np.moveaxis(self.held[at[:, None], :, beside[None]], -1, 1)


def find_uncached_columns(column_indices: Array, cache_positions: dict[int, int]) -> Array:
    """Columns that have no place yet, each once."""
    return np.array(
        [i for i in dict.fromkeys(column_indices.tolist()) if i not in cache_positions], dtype=int
    )


def find_cache_positions(column_indices: Array, cache_positions: dict[int, int]) -> Array:
    """(f,) the places of columns."""
    return np.array([cache_positions[i] for i in column_indices.tolist()], dtype=int)


class WeightedProducts:
    """Products at some ratios (g,), summed over rows.  some: (N,) True for those; None: all."""

    def __init__(self, columns: CandidateColumns, ratios: Array, some: Array | None = None) -> None:
        varied = columns.rows.variance_ratio
        self.columns, self.ratios = columns, ratios
        self.some = None if some is None else np.flatnonzero(some)
        self.clear = None if some is None else columns.projected_columns[:, self.some]
        self.weights = 1.0 / (1.0 + np.outer(ratios, varied if some is None else varied[some]))
        self.alike = not varied.any()  # one noise: ratios change nothing
        self.sets: dict[tuple[bytes, int], Array] = {}
        self.whole = np.zeros((0, len(ratios)))

    @property
    def row_subset_columns(self) -> Array:
        """(p + 1 + D, n) the columns of `CandidateColumns.clear` at these rows."""
        return self.columns.projected_columns if self.clear is None else self.clear

    def weighted_products(self, row_columns: Array, other_columns: ColumnSelection) -> Array:
        """(f, g, d) of columns with others; the fewer are weighed."""
        fields = self.row_subset_columns
        there = fields[other_columns]
        if len(there) < len(row_columns):
            return np.swapaxes(self.multiply_weighted(there, fields[row_columns]), 0, 2)
        return self.multiply_weighted(fields[row_columns], there)

    def multiply_weighted(self, left_columns: Array, right_columns: Array) -> Array:
        """(f, g, d) weighed products of columns (f, n) and (d, n)."""
        g, n = self.weights.shape
        if self.alike:
            one = left_columns @ right_columns.T
            return np.asarray(
                np.broadcast_to(one[:, None], (len(left_columns), g, len(right_columns)))
            )
        out = np.empty((len(left_columns), g, len(right_columns)))
        step = max(1, MAX_WEIGHTED_NUMBERS_AT_ONCE // (g * max(n, 1)))
        for i in range(0, len(left_columns), step):
            block = left_columns[i : i + step, None] * self.weights
            flat = block.reshape(len(block) * g, n) @ right_columns.T  # of no rows 0
            out[i : i + step] = flat.reshape(len(block), g, len(right_columns))
        return out

    def products_within_sets(self, column_sets: Array) -> Array:
        """(c, d, d, g) products within each of c sets of columns (c, d)."""
        mark = (column_sets.tobytes(), column_sets.shape[1])
        if mark not in self.sets:
            self.sets[mark] = weighted_products_within_sets(
                self.row_subset_columns[column_sets], self.weights
            )
        return self.sets[mark]

    def candidate_squares(self) -> Array:
        """(D, g) squares of candidates' columns as they are."""
        new = self.columns.plain[len(self.whole) : self.columns.count]
        new = new if self.some is None else new[:, self.some]
        self.whole = np.concatenate([self.whole, new**2 @ self.weights.T])
        return self.whole


def weighted_products_within_sets(column_sets: Array, weights: Array) -> Array:
    """(c, d, d, g) weighted products within sets of columns (c, d, N).  weights: (g, N)."""
    c, d, _ = column_sets.shape
    out = np.empty((c, d, d, len(weights)))
    for i in range(d):
        for j in range(i + 1):
            out[:, i, j] = out[:, j, i] = (column_sets[:, i] * column_sets[:, j]) @ weights.T
    return out


class ProjectedGrams:
    """What is left of products at some ratios when the geometry is projected out.

    Columns count from the error, 0: the candidates' follow, the geometry's leave nothing.
    span: (p, r) combinations of the geometry's columns that the rows tell apart.
    factor: (g, r, r) lower triangles of these combinations' products.  logs: (g,) log determinants
    of those.  error: (g,) squares of the error, unprojected.
    """

    def __init__(self, sums: WeightedProducts, *, some: bool = False) -> None:
        """some: whether the rows may not tell all of the geometry's columns apart."""
        self.fixed = p = sums.columns.fixed - 1
        self.sums, depth = sums, len(sums.ratios)
        gram = np.moveaxis(sums.weighted_products(np.arange(p), slice(0, p)), 0, 1)
        self.span = distinguishable_combinations(gram[0]) if some else np.eye(p)
        gram = self.span.T @ gram @ self.span if some else gram
        self.factor = robust_cholesky_factors(gram)
        self.inverse = np.linalg.inv(self.factor) @ self.span.T
        self.logs = 2.0 * np.log(np.einsum("grr->gr", self.factor)).sum(axis=1)
        self.error = sums.weighted_products(np.array([p]), slice(p, p + 1))[0, :, 0]
        self.lines, self.pairs = ProductRowCache(depth), ProductBlockCache(depth)
        self.sets: dict[tuple[bytes, int], Array] = {}
        self.held = np.empty((depth, self.span.shape[1], 0))
        self.known = np.zeros(0, dtype=bool)

    @property
    def column_count(self) -> int:
        """How many columns there are."""
        return 1 + self.sums.columns.count

    def span_coordinates(self, column_selection: ColumnSelection) -> Array:
        """(g, r, d) coordinates of columns in the geometry's span, each formed once."""
        width = self.column_count
        if width > len(self.known):
            self.held = grow_array(self.held, width, axis=2)
            self.known = np.pad(self.known, (0, width - len(self.known)))
        if not self.known[column_selection].all():
            index = np.arange(width)[column_selection]
            new = np.unique(index[~self.known[index]])
            run = slice(int(new[0]), int(new[-1]) + 1)  # which needs no copy of the columns
            missing = run if 2 * len(new) > run.stop - run.start else new
            raw = self.sums.weighted_products(
                np.arange(self.fixed), self.shift_past_geometry(missing)
            )
            self.held[:, :, missing] = self.inverse @ np.moveaxis(raw, 0, 1)
            self.known[missing] = True
        return np.asarray(self.held[:, :, column_selection])

    def shift_past_geometry(self, column_selection: ColumnSelection) -> ColumnSelection:
        """Where columns stand behind the geometry's."""
        if isinstance(column_selection, slice):
            return slice(column_selection.start + self.fixed, column_selection.stop + self.fixed)
        return column_selection + self.fixed

    def projected_products(self, row_columns: Array, other_columns: ColumnSelection) -> Array:
        """(f, g, d) products of columns with others."""
        shared = np.swapaxes(self.span_coordinates(row_columns), 1, 2) @ self.span_coordinates(
            other_columns
        )
        whole = self.sums.weighted_products(
            row_columns + self.fixed, self.shift_past_geometry(other_columns)
        )
        return np.asarray(whole - np.moveaxis(shared, 0, 1))

    def projected_products_with_all(self, row_columns: Array) -> Array:
        """(f, g, 1 + D) products of columns with all."""
        return self.lines.products_with_slice(
            self.projected_products, row_columns, slice(0, self.column_count)
        )

    def projected_gram(self, column_indices: Array) -> Array:
        """(g, f, f) products among columns."""
        return np.moveaxis(
            self.pairs.products_among(self.projected_products, column_indices, column_indices), 1, 0
        )

    def projected_products_within_sets(self, column_sets: Array) -> Array:
        """(c, d, d, g) products within each of c sets of columns (c, d)."""
        mark = (column_sets.tobytes(), column_sets.shape[1])
        if mark not in self.sets:
            part = self.span_coordinates(column_sets.ravel())
            part = np.moveaxis(part.reshape(*part.shape[:2], *column_sets.shape), 1, -1)
            shared = part @ np.swapaxes(part, -1, -2)
            self.sets[mark] = self.sums.products_within_sets(
                column_sets + self.fixed
            ) - np.moveaxis(shared, 0, -1)
        return self.sets[mark]


RatioInterpolation = tuple[
    Array, ProjectedGrams, Array
]  # which ratios (s,), of which products, how (s, g) combined


@dataclass(frozen=True, eq=False)
class ProductsAtRatios:
    """Products at ratios (s,), geometry projected out, of q columns and the error with all.

    products_with_candidates: (s, q, D) with the candidates'.  error_products: (s, 1 + D) of the
    error with itself and those. unprojected_error_square: (s,) of the error, unprojected.
    column_squares: (s, D) squares of the candidates' as they are. geometry_factors: (s, r, r) lower
    triangles of the geometry's products; geometry_coordinates: (s, r, 1 + q) coordinates of the
    error and of the q columns in its span; geometry_log_determinants: (s,) log determinants.
    gradients: (s, q) of the q columns with the error.  build_products_within_sets: products (s, c,
    d, d) within sets of candidates' columns (c, d).
    """

    products_with_candidates: Array
    error_products: Array
    unprojected_error_square: Array
    column_squares: Array
    geometry_factors: Array
    geometry_coordinates: Array
    geometry_log_determinants: Array
    gradients: Array
    build_products_within_sets: Callable[[Array], Array]


def regularise_projected_squares(projected_squares: Array, column_squares: Array) -> Array:
    """Squares of what geometry leaves of columns, such that no sum of unit columns is rounding.

    column_squares: squares of the columns as they are.  What is added is a share of what is left: a
    column and the same column with more geometry in it are one.
    """
    return np.asarray(
        (1.0 + MIN_PROJECTED_SQUARE_FRACTION)
        * np.maximum(projected_squares, MIN_PROJECTED_SQUARE_FRACTION * column_squares)
    )


class RatioProducts:
    """Products for any ratio, of all rows.  kept: (N,) whether a row counts.

    count: of rows that were measured.  rank: of the geometry's columns.
    """

    def __init__(self, columns: CandidateColumns, kept: Array | None = None) -> None:
        self.columns = columns
        self.rank: int = columns.fixed - 1
        self.kept = np.ones(len(columns.rows.error), dtype=bool) if kept is None else kept
        self.count = int(np.count_nonzero(self.kept & columns.rows.measured))
        self.formed: dict[int | None, ProjectedGrams] = {}
        self.noises: dict[bytes, Noise] = {}
        self.last: tuple[bytes, Array] = (b"", np.empty(0))

    def geometry_and_candidate_columns(self, column_indices: Array) -> Array:
        """(p + q, N) the geometry's columns and some of the candidates' (q,), as `clear` has them.

        Those asked for last are held: of all effects together they would fill the memory.
        """
        mark = column_indices.tobytes()
        if self.last[0] != mark or not self.last[1].size:
            self.last = (
                mark,
                np.concatenate(
                    [self.geometry_columns, self.projected_candidate_columns(column_indices)]
                ),
            )
        return self.last[1]

    def projected_candidate_columns(self, column_indices: Array) -> Array:
        """(d, N) candidates' columns less what geometry imitates."""
        return np.asarray(self.columns.projected_columns[self.columns.fixed + column_indices])

    def projected_grams(self, decade: int | None) -> ProjectedGrams:
        """What the geometry leaves of the products of a decade; None: at RATIOS."""
        if decade not in self.formed:
            ratios = SEARCHED_NOISE_RATIOS if decade is None else decade_noise_ratios(decade)
            self.formed[decade] = ProjectedGrams(WeightedProducts(self.columns, ratios))
        return self.formed[decade]

    def interpolate_ratios(self, noise_ratios: Array) -> list[RatioInterpolation]:
        """Which ratios (s,), of which products, and how (s, g) combined."""
        if noise_ratios is SEARCHED_NOISE_RATIOS:
            return [
                (
                    np.arange(len(SEARCHED_NOISE_RATIOS)),
                    self.projected_grams(None),
                    np.eye(len(SEARCHED_NOISE_RATIOS)),
                )
            ]
        logs = np.log10(np.maximum(noise_ratios, 10.0**ZERO_RATIO_DECADE))
        numbers = np.floor(logs).astype(int)
        out: list[RatioInterpolation] = []
        for number in map(int, np.unique(numbers)):
            here = np.flatnonzero(numbers == number)
            alone = np.ones((len(here), 1))
            between = (
                chebyshev_interpolation(logs[here] - number, CHEBYSHEV_NODES_PER_DECADE)
                if number > ZERO_RATIO_DECADE
                else alone
            )
            out.append((here, self.projected_grams(number), between))
        return out

    def column_and_projected_squares(self) -> tuple[Array, Array]:
        """(D,) squares of the candidates' columns, all rows alike, and of what geometry leaves."""
        columns = self.columns
        own = (columns.projected_columns[columns.fixed :] ** 2) @ self.kept
        ((_, beside, between),) = self.interpolate_ratios(np.zeros(1))
        part = np.tensordot(between[0], beside.span_coordinates(slice(1, beside.column_count)), 1)
        return columns.plain[: columns.count] ** 2 @ self.kept, own - (part**2).sum(axis=0)

    def degrees_of_freedom(self, column_indices: Array) -> int:
        """Degrees of freedom beside the geometry and some of the candidates' columns."""
        return self.count - self.rank - len(column_indices)

    def estimate_noise(self, column_indices: Array) -> Noise:
        """The noise beside some of the candidates' columns, by restricted maximum likelihood."""
        mark, rows, dof = (
            column_indices.tobytes(),
            self.columns.rows,
            self.degrees_of_freedom(column_indices),
        )
        if mark in self.noises:
            return self.noises[mark]
        varied = rows.variance_ratio[self.kept]

        def cost(ratios: Array) -> tuple[Array, Array]:
            gram, logs = self.projected_gram_at_ratios(ratios, column_indices)
            value, squares = restricted_deviances(gram, ratios, varied, dof)
            return value + logs, squares

        if dof < MIN_NOISE_DEGREES_OF_FREEDOM:
            error = rows.error[self.kept]
            noise = Noise(0.0, float(error @ error) / max(self.count, 1) + 1e-18, 0.0)
        else:
            ratio = self.find_best_noise_ratio(lambda ratios: cost(ratios)[0])
            noise = build_noise(ratio, float(cost(np.array([ratio]))[1][0]) / dof, rows)
        self.noises[mark] = noise
        return noise

    def find_best_noise_ratio(self, compute_deviance: Callable[[Array], Array]) -> float:
        """The ratio of least cost."""
        return find_best_noise_ratio(compute_deviance)

    def projected_gram_at_ratios(
        self, noise_ratios: Array, column_indices: Array
    ) -> tuple[Array, Array]:
        """(s, q + 1, q + 1) products among candidates' columns (q,) and, last, the error.

        Geometry is projected out at ratios (s,); and (s,) log determinants of its products.
        """
        chosen = np.append(1 + column_indices, 0)
        gram = np.empty((len(noise_ratios), len(chosen), len(chosen)))
        logs, whole = (
            np.empty(len(noise_ratios)),
            np.empty((len(noise_ratios), len(column_indices))),
        )
        for here, beside, between in self.interpolate_ratios(noise_ratios):
            gram[here] = np.tensordot(between, beside.projected_gram(chosen), 1)
            whole[here] = between @ beside.sums.candidate_squares()[column_indices].T
            logs[here] = between @ beside.logs
        each = range(len(column_indices))
        gram[:, each, each] = regularise_projected_squares(gram[:, each, each], whole)
        return gram, logs

    @property
    def geometry_columns(self) -> Array:
        """(p, N) the geometry's columns."""
        return self.columns.projected_columns[: self.columns.fixed - 1]

    def compared_noise_ratios(self, noise: Noise) -> Array:
        """(s,) ratios at which candidates are compared beside a noise, the largest first."""
        return (
            noise.joint_to_instrument_ratio * COMPARED_RATIO_FACTORS
            if noise.joint_to_instrument_ratio > 0.0
            else np.zeros(1)
        )

    def products_at_ratios(self, noise_ratios: Array, column_indices: Array) -> ProductsAtRatios:
        """Products at ratios (s,) of some candidates' columns (q,) and of the error."""
        s, q, r = len(noise_ratios), len(column_indices), self.rank
        fixed = np.append(0, 1 + column_indices)
        lines = np.empty((s, 1 + q, 1 + self.columns.count))
        square, logs = np.empty(s), np.empty(s)
        whole = np.empty((s, self.columns.count))
        factor, part = np.empty((s, r, r)), np.empty((s, r, 1 + q))
        views = self.interpolate_ratios(noise_ratios)
        for here, beside, between in views:
            lines[here] = np.moveaxis(between @ beside.projected_products_with_all(fixed), 1, 0)
            whole[here] = between @ beside.sums.candidate_squares().T
            square[here], logs[here] = between @ beside.error, between @ beside.logs
            factor[here] = np.tensordot(between, beside.factor, 1)
            part[here] = np.tensordot(between, beside.span_coordinates(fixed), 1)

        def among(sets: Array) -> Array:
            out = np.empty((s, *sets.shape, sets.shape[1]))
            for here, beside, between in views:
                own = beside.projected_products_within_sets(1 + sets)
                out[here] = np.moveaxis(own @ between.T, -1, 0)
            return out

        pull = lines[:, 1:, 0]
        return ProductsAtRatios(
            lines[:, 1:, 1:], lines[:, 0], square, whole, factor, part, logs, pull, among
        )
