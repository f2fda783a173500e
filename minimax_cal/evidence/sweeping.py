"""Products of the rows of a part, from those of all rows at a few ratios of the noises.

The products of all columns with each other are formed once at every ratio.  Those of a part are
these less the products of the rows that it lacks; the nuisance columns are swept out of them at
once, so that nothing that a search asks of a part looks at rows again.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from minimax_cal.evidence.noise import Noise, told_apart, triangles
from minimax_cal.evidence.products import LEAST, At, Columns, Products
from minimax_cal.ground.arrays import Array

COUNT = 7  # ratios beside 0, between those of the noises beside nothing and beside all effects
ROOM = 4.0  # by which a part's ratio may lie outside these
LOWER = 4  # ratios beside 0 at which a candidate is compared
SMALL = 0.03  # of the largest ratio: the least that is not 0


class Grams:
    """Products (s, n, n) of geometry, error and candidates' columns, at ratios (s,), the least 0.

    noises: of all rows, beside some of the effects found, and beside all of them.
    """

    def __init__(self, columns: Columns, noises: list[Noise]) -> None:
        self.columns, self.ratios = columns, ratios_about(noises)
        self.products = self.among(np.ones(len(self.columns.rows.error), dtype=bool))

    def among(self, some: Array) -> Array:
        """(s, n, n) products of the rows (N,) that are True."""
        weights = 1.0 / (1.0 + np.outer(self.ratios, self.columns.rows.variance_ratio[some]))
        fields = self.columns.clear[:, some]
        out = np.empty((len(self.ratios), len(fields), len(fields)))
        for product, weight in zip(out, weights, strict=True):
            half = fields * np.sqrt(weight)
            product[:] = half @ half.T
        return out


def ratios_about(noises: list[Noise]) -> Array:
    """(s,) ratios at which a part's noises are compared, ascending from 0."""
    found = [noise.ratio for noise in noises if noise.ratio > 0.0]
    if not found:
        return np.array([0.0, SMALL, 1.0])
    high = ROOM * max(found)
    low = min(min(found) / ROOM, SMALL * high)
    return np.concatenate([[0.0], np.geomspace(low, high, COUNT)])


class Swept(Products):
    """Products of the rows that are kept, geometry swept out: as `Products`, at the Grams' ratios.

    kept: (N,) whether a row counts.  left: (s, 1 + D, 1 + D) of the error and candidates' columns.
    """

    def __init__(self, grams: Grams, kept: Array) -> None:
        super().__init__(grams.columns, kept)
        self.ratios, p = grams.ratios, self.rank
        every = grams.products - grams.among(~kept)
        self.span = told_apart(every[0, :p, :p])
        self.rank = self.span.shape[1]
        self.factor = triangles(self.span.T @ every[:, :p, :p] @ self.span)
        self.logs = 2.0 * np.log(np.einsum("srr->sr", self.factor)).sum(axis=1)
        self.part = np.linalg.inv(self.factor) @ (self.span.T @ every[:, :p, p:])
        self.square = every[:, p, p].copy()
        self.left = every[:, p:, p:] - np.swapaxes(self.part, 1, 2) @ self.part
        weights = kept / (1.0 + np.outer(self.ratios, self.columns.rows.variance_ratio))
        self.whole = weights @ self.columns.raw**2

    def geometry(self) -> Array:
        """(r, N) the geometry's columns, as the combinations that the rows tell apart."""
        return np.asarray(self.span.T @ self.columns.clear[: self.columns.fixed - 1])

    def find_ratio(self, cost: Callable[[Array], Array]) -> float:
        """The ratio of least cost among those of the Grams."""
        return float(self.ratios[int(np.argmin(cost(self.ratios)))])

    def gram(self, ratios: Array, index: Array) -> tuple[Array, Array]:
        """As `Products.gram`."""
        here, each = np.searchsorted(self.ratios, ratios), range(len(index))
        chosen = np.concatenate([1 + index, [0]])
        gram = self.left[here[:, None, None], chosen[:, None], chosen]
        gram[:, each, each] += LEAST * self.whole[here[:, None], index]
        return gram, self.logs[here]

    def ratios_below(self, noise: Noise) -> Array:
        """(s,) the ratios at which candidates are compared beside a noise, the largest first."""
        below = self.ratios[self.ratios <= noise.ratio][::-1]
        return np.asarray(np.concatenate([below[:-1][:LOWER], below[-1:]]))

    def at(self, ratios: Array, index: Array) -> At:
        """Products at some of the ratios (s,), as `Products.at`."""
        here = np.searchsorted(self.ratios, ratios)
        chosen = np.concatenate([[0], 1 + index])
        lines = self.left[here[:, None], chosen]
        part = self.part[here][:, :, chosen]

        def own(sets: Array) -> Array:
            return np.asarray(
                self.left[here[:, None, None, None], 1 + sets[..., None], 1 + sets[:, None]]
            )

        return At(
            lines[:, 1:, 1:],
            lines[:, 0],
            self.square[here],
            self.whole[here],
            self.factor[here],
            part,
            self.logs[here],
            lines[:, 1:, 0],
            own,
        )
