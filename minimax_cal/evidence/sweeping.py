"""Products of the rows of a part, from those of all rows at a few ratios of the noises.

Products of all rows are formed once, when a search of some part first asks for them.  Those of the
part are these less the products of the rows that it lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from minimax_cal.evidence.noise import Noise
from minimax_cal.evidence.products import (
    Beside,
    Columns,
    Lines,
    Products,
    Some,
    Squares,
    Sums,
    View,
    within,
)
from minimax_cal.ground.arrays import Array

COUNT = 7  # ratios beside 0, between those of the noises beside nothing and beside all effects
ROOM = 4.0  # by which a part's ratio may lie outside these
LOWER = 4  # ratios beside 0 at which a candidate is compared
SMALL = 0.03  # of the largest ratio: the least that is not 0


class Grams(Sums):
    """Products of all rows, at ratios (s,), the least 0, each kept for the searches of parts.

    noises: of all rows, beside some of the effects found, and beside all of them.
    """

    def __init__(self, columns: Columns, noises: list[Noise]) -> None:
        super().__init__(columns, ratios_about(noises))
        self.lines, self.pairs = Lines(len(self.ratios)), Squares(len(self.ratios))

    def products(self, index: Array, others: Some) -> Array:
        """As `Sums.products`."""
        if isinstance(others, slice):
            return self.lines.across(super().products, index, others)
        return self.pairs.across(super().products, index, others)


def ratios_about(noises: list[Noise]) -> Array:
    """(s,) ratios at which a part's noises are compared, ascending from 0."""
    found = [noise.ratio for noise in noises if noise.ratio > 0.0]
    if not found:
        return np.array([0.0, SMALL, 1.0])
    high = ROOM * max(found)
    low = min(min(found) / ROOM, SMALL * high)
    return np.concatenate([[0.0], np.geomspace(low, high, COUNT)])


class Lacking(Sums):
    """Products of all rows less those of the rows that a part lacks.  gone: (N,) True for these."""

    def __init__(self, grams: Grams, gone: Array) -> None:
        super().__init__(grams.columns, grams.ratios, gone)
        self.grams = grams

    def products(self, index: Array, others: Some) -> Array:
        """As `Sums.products`."""
        return np.asarray(self.grams.products(index, others) - super().products(index, others))

    def among(self, index: Array) -> Array:
        """As `Sums.among`."""
        return np.asarray(self.grams.among(index) - within(self.fields[index], self.weights))

    def squares(self) -> Array:
        """As `Sums.squares`."""
        return np.asarray(self.grams.squares() - super().squares())


class Swept(Products):
    """Products of the rows that are kept, at the ratios of Grams.  kept: (N,) whether a row counts.

    swept: beside the combinations of the geometry's columns that these rows tell apart.
    """

    def __init__(self, grams: Grams, kept: Array) -> None:
        super().__init__(grams.columns, kept)
        self.ratios = grams.ratios
        self.swept = Beside(Lacking(grams, ~kept), some=True)
        self.rank = self.swept.span.shape[1]

    @cached_property
    def geometry(self) -> Array:
        """(r, N) the geometry's columns, as the combinations that the rows tell apart."""
        return np.asarray(self.swept.span.T @ self.columns.clear[: self.columns.fixed - 1])

    def views(self, ratios: Array) -> list[View]:
        """As `Products.views`."""
        here = np.searchsorted(self.ratios, ratios)
        return [(np.arange(len(ratios)), self.swept, np.eye(len(self.ratios))[here])]

    def find_ratio(self, cost: Callable[[Array], Array]) -> float:
        """The ratio of least cost among those of the Grams."""
        return float(self.ratios[int(np.argmin(cost(self.ratios)))])

    def ratios_below(self, noise: Noise) -> Array:
        """(s,) the ratios at which candidates are compared beside a noise, the largest first."""
        below = self.ratios[self.ratios <= noise.ratio][::-1]
        return np.asarray(np.concatenate([below[:-1][:LOWER], below[-1:]]))
