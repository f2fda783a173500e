"""Products of the rows of a part, from those of all rows at a few ratios of the noises.

Products of all rows are formed once, when a search of some part first asks for them.  Those of the
part are these less the products of the rows that it lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.selection.gram_products import (
    CandidateColumns,
    ColumnSelection,
    ProductBlockCache,
    ProductRowCache,
    ProjectedGrams,
    RatioInterpolation,
    RatioProducts,
    WeightedProducts,
    weighted_products_within_sets,
)
from minimax_cal.selection.noise_model import Noise

SUBSAMPLE_RATIO_COUNT = (
    7  # ratios beside 0, between those of the noises beside nothing and beside all effects
)
SUBSAMPLE_RATIO_RANGE_FACTOR = 4.0  # by which a part's ratio may lie outside these
MAX_COMPARED_RATIOS = 4  # ratios beside 0 at which a candidate is compared
MIN_NONZERO_RATIO_FRACTION = 0.03  # of the largest ratio: the least that is not 0


class SharedGrams(WeightedProducts):
    """Products of all rows, at ratios (s,), the least 0, each kept for the searches of parts.

    noises: of all rows, beside some of the effects found, and beside all of them.
    """

    def __init__(self, columns: CandidateColumns, noises: list[Noise]) -> None:
        super().__init__(columns, build_ratio_grid(noises))
        self.lines, self.pairs = (
            ProductRowCache(len(self.ratios)),
            ProductBlockCache(len(self.ratios)),
        )

    def weighted_products(self, row_columns: Array, other_columns: ColumnSelection) -> Array:
        """As `WeightedProducts.weighted_products`."""
        if isinstance(other_columns, slice):
            return self.lines.products_with_slice(
                super().weighted_products, row_columns, other_columns
            )
        return self.pairs.products_among(super().weighted_products, row_columns, other_columns)


def build_ratio_grid(noises: list[Noise]) -> Array:
    """(s,) ratios at which a part's noises are compared, ascending from 0."""
    found = [
        noise.joint_to_instrument_ratio for noise in noises if noise.joint_to_instrument_ratio > 0.0
    ]
    if not found:
        return np.array([0.0, MIN_NONZERO_RATIO_FRACTION, 1.0])
    high = SUBSAMPLE_RATIO_RANGE_FACTOR * max(found)
    low = min(min(found) / SUBSAMPLE_RATIO_RANGE_FACTOR, MIN_NONZERO_RATIO_FRACTION * high)
    return np.concatenate([[0.0], np.geomspace(low, high, SUBSAMPLE_RATIO_COUNT)])


class ProductsWithoutRows(WeightedProducts):
    """Products of all rows less those of the rows that a part lacks.  gone: (N,) True for these."""

    def __init__(self, grams: SharedGrams, gone: Array) -> None:
        super().__init__(grams.columns, grams.ratios, gone)
        self.grams = grams

    def weighted_products(self, row_columns: Array, other_columns: ColumnSelection) -> Array:
        """As `WeightedProducts.weighted_products`."""
        return np.asarray(
            self.grams.weighted_products(row_columns, other_columns)
            - super().weighted_products(row_columns, other_columns)
        )

    def products_within_sets(self, column_sets: Array) -> Array:
        """As `WeightedProducts.products_within_sets`."""
        return np.asarray(
            self.grams.products_within_sets(column_sets)
            - weighted_products_within_sets(self.row_subset_columns[column_sets], self.weights)
        )

    def candidate_squares(self) -> Array:
        """As `WeightedProducts.candidate_squares`."""
        return np.asarray(self.grams.candidate_squares() - super().candidate_squares())


class SubsampleProducts(RatioProducts):
    """Products of the rows that are kept, at the ratios of Grams.  kept: (N,) whether a row counts.

    swept: beside the combinations of the geometry's columns that these rows tell apart.
    """

    def __init__(self, grams: SharedGrams, kept: Array) -> None:
        super().__init__(grams.columns, kept)
        self.ratios = grams.ratios
        self.swept = ProjectedGrams(ProductsWithoutRows(grams, ~kept), some=True)
        self.rank = self.swept.span.shape[1]

    @cached_property
    def geometry_columns(self) -> Array:
        """(r, N) the geometry's columns, as the combinations that the rows tell apart."""
        return np.asarray(
            self.swept.span.T @ self.columns.projected_columns[: self.columns.fixed - 1]
        )

    def interpolate_ratios(self, noise_ratios: Array) -> list[RatioInterpolation]:
        """As `RatioProducts.interpolate_ratios`."""
        here = np.searchsorted(self.ratios, noise_ratios)
        return [(np.arange(len(noise_ratios)), self.swept, np.eye(len(self.ratios))[here])]

    def find_best_noise_ratio(self, compute_deviance: Callable[[Array], Array]) -> float:
        """The ratio of least cost among those of the Grams."""
        return float(self.ratios[int(np.argmin(compute_deviance(self.ratios)))])

    def compared_noise_ratios(self, noise: Noise) -> Array:
        """(s,) the ratios at which candidates are compared beside a noise, the largest first."""
        below = self.ratios[self.ratios <= noise.joint_to_instrument_ratio][::-1]
        return np.asarray(np.concatenate([below[:-1][:MAX_COMPARED_RATIOS], below[-1:]]))
