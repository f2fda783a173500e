"""Products of the rows of a part, from those of all rows at a few ratios of the noises.

The products of all columns with each other are formed once at every ratio.  Those of a part are
these less the products of the rows that it lacks; the nuisance columns are swept out of them at
once, so that nothing that a search asks of a part looks at rows again.
"""

from __future__ import annotations

import numpy as np

from minimax_cal.evidence.limits import LEAST_NOISE_DOF
from minimax_cal.evidence.noise import Noise, costs, noise_of, told_apart, triangles
from minimax_cal.evidence.products import LEAST, At, Columns
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


class Swept:
    """Products of the rows that are kept, geometry swept out: as `Products`, at the Grams' ratios.

    kept: (N,) whether a row counts.  left: (s, 1 + D, 1 + D) of the error and candidates' columns.
    """

    def __init__(self, grams: Grams, kept: Array) -> None:
        self.columns, self.ratios, self.kept = grams.columns, grams.ratios, kept
        rows, p = self.columns.rows, self.columns.fixed - 1
        every = grams.products - grams.among(~kept)
        self.span = told_apart(every[0, :p, :p])
        self.factor = triangles(self.span.T @ every[:, :p, :p] @ self.span)
        self.logs = 2.0 * np.log(np.einsum("srr->sr", self.factor)).sum(axis=1)
        self.part = np.linalg.inv(self.factor) @ (self.span.T @ every[:, :p, p:])
        self.square = every[:, p, p].copy()
        self.left = every[:, p:, p:] - np.swapaxes(self.part, 1, 2) @ self.part
        weights = kept / (1.0 + np.outer(self.ratios, rows.variance_ratio))
        self.whole = weights @ self.columns.raw**2
        self.count = int(np.count_nonzero(kept & rows.measured))
        self.noises: dict[bytes, Noise] = {}

    def clear(self, index: Array) -> Array:
        """(d, N) candidates' columns less what geometry imitates."""
        return np.asarray(self.columns.clear[self.columns.fixed + index])

    def geometry(self) -> Array:
        """(r, N) the geometry's columns, as the combinations that the rows tell apart."""
        return np.asarray(self.span.T @ self.columns.clear[: self.columns.fixed - 1])

    def dof(self, index: Array) -> int:
        """Degrees of freedom beside the geometry and some of the candidates' columns."""
        return self.count - int(self.span.shape[1]) - len(index)

    def noise(self, index: Array) -> Noise:
        """The likeliest noise beside some of the candidates' columns, among the ratios."""
        mark = index.tobytes()
        if mark not in self.noises:
            self.noises[mark] = self.estimated(index)
        return self.noises[mark]

    def estimated(self, index: Array) -> Noise:
        """The noise, computed."""
        rows, dof = self.columns.rows, self.dof(index)
        if dof < LEAST_NOISE_DOF:
            error = rows.error[self.kept]
            return Noise(0.0, float(error @ error) / max(self.count, 1) + 1e-18, 0.0)
        chosen = np.concatenate([1 + index, [0]])
        gram = self.left[:, chosen[:, None], chosen]
        each = range(len(index))
        gram[:, each, each] += LEAST * self.whole[:, index]
        cost, squares = costs(gram, self.ratios, rows.variance_ratio[self.kept], dof)
        best = int(np.argmin(cost + self.logs))
        return noise_of(float(self.ratios[best]), float(squares[best]) / dof, rows)

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
