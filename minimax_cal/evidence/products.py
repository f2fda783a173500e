"""Cross-products of columns, rows weighed for any ratio of the noises, each formed once.

A row with the variance ratio v weighs 1/(1 + ratio v).  Along the logarithm of the ratio that is a
smooth step whose nearest poles lie pi beside the real line, so that a polynomial through so many
Chebyshev points in every decade gives all weights, and with them all products, to rounding.  The
products of some poses are those of all poses less those of the others.
"""

from __future__ import annotations

from functools import cached_property
from itertools import groupby

import numpy as np
from scipy.linalg import block_diag

from minimax_cal.evidence.noise import FREE, RATIOS, Noise, Rows, likeliest, told_apart
from minimax_cal.ground.arrays import Array

NODES = 20  # points in a decade of ratios; as many ratios asked for pay for them
ALL = slice(None)
ANGLES = np.pi * (2.0 * np.arange(NODES) + 1.0) / (2.0 * NODES)


class Columns:
    """Columns of the geometry, the error, and candidates, as they are gathered; each stored once.

    The candidates' are stored twice: as they are, and less what geometry imitates, so that little
    is lost where products of what is left are differences.
    """

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        self.fixed = rows.basis.shape[1] + 1  # geometry and the error
        self.count = 0
        self.held = np.empty((256, len(rows.error)))
        self.plain = np.empty((0, len(rows.error)))
        self.held[: self.fixed] = np.concatenate([rows.basis.T, rows.error[None]])

    @property
    def raw(self) -> Array:
        """(N, D) candidates' columns."""
        return self.plain[: self.count].T

    @property
    def clear(self) -> Array:
        """(p + 1 + D, N) geometry, the error, and columns less what geometry imitates."""
        return self.held[: self.fixed + self.count]

    def append(self, columns: Array) -> Array:
        """Indices of new columns (N, d) among the candidates'."""
        at = self.count + np.arange(columns.shape[1])
        self.count += len(at)
        self.plain = grown(self.plain, self.count)
        self.held = grown(self.held, self.fixed + self.count)
        self.plain[at] = columns.T
        self.held[self.fixed + at] = self.cleared(columns)
        return at

    def cleared(self, columns: Array) -> Array:
        """(d, N) columns (N, d) less what geometry imitates."""
        basis = self.rows.basis
        return np.asarray(columns.T - (columns.T @ basis) @ basis.T)


def grown(store: Array, count: int) -> Array:
    """The store with room for so many rows."""
    if count <= len(store):
        return store
    more = np.empty((max(count, 3 * len(store) // 2), store.shape[1]))
    more[: len(store)] = store
    return more


class Sums:
    """Products at some ratios, summed over some rows, each formed when it is first asked for.

    ratios: (g,).  rows: of the sums, all or some.  total: sums that are taken less these.
    once: whether they are asked for only once.
    """

    def __init__(
        self,
        columns: Columns,
        ratios: Array,
        rows: slice | Array = ALL,
        total: Sums | None = None,
        *,
        once: bool = False,
    ) -> None:
        self.columns, self.rows, self.total, self.once = columns, rows, total, once
        spread = columns.rows.variance_ratio[rows]
        self.weights = 1.0 / (1.0 + np.outer(ratios, spread))  # (g, N)
        self.lines: dict[int, Array] = {}
        self.sets: dict[tuple[bytes, int], Array] = {}
        self.whole = np.zeros((0, len(ratios)))

    def across(self, index: Array) -> Array:
        """(f, g, D) products of some columns with all."""
        self.form(index)
        return np.stack([self.lines[int(i)] for i in index])

    def square(self, index: Array) -> Array:
        """(g, f, f) products among some columns."""
        if self.once:
            own = self.columns.clear[index]
            halves = (own * weight for weight in np.sqrt(self.weights))
            return np.stack([half @ half.T for half in halves])
        self.form(index)
        return np.stack([self.lines[int(i)][:, index] for i in index], axis=1)

    def form(self, index: Array) -> None:
        """Form the products of some columns with all that are there."""
        width = len(self.columns.clear)
        once = {int(i) for i in index}  # two of the chosen may share a column
        short = sorted((self.width(i), i) for i in once if self.width(i) < width)
        for start, group in groupby(short, key=lambda one: one[0]):
            members = [i for _, i in group]
            new = self.between(members, start)
            for i, line in zip(members, new, strict=True):
                self.lines[i] = np.concatenate([self.lines[i], line], axis=1) if start else line

    def between(self, members: list[int], start: int) -> Array:
        """(f, g, d) products of some columns with all from a first on; the fewer are weighed."""
        mine = self.columns.clear[members][:, self.rows]
        there = self.columns.clear[start:, self.rows]
        out = np.empty((len(mine), len(self.weights), len(there)))
        for i, weight in enumerate(self.weights):
            few = len(mine) < len(there)
            out[:, i] = (mine * weight) @ there.T if few else mine @ (there * weight).T
        if self.total is None:
            return out
        self.total.form(np.array(members))
        return np.stack([self.total.lines[i][:, start:] for i in members]) - out

    def width(self, i: int) -> int:
        """How many products of a column are there already."""
        return self.lines[int(i)].shape[1] if int(i) in self.lines else 0

    def among(self, index: Array) -> Array:
        """(c, d, d, g) products within each of c sets of columns (c, d)."""
        mark = (index.tobytes(), index.shape[1])
        if mark not in self.sets:
            own = within(self.columns.clear[index][..., self.rows], self.weights)
            self.sets[mark] = own if self.total is None else self.total.among(index) - own
        return self.sets[mark]

    def squares(self) -> Array:
        """(D, g) squares of candidates' columns as they are."""
        new = self.columns.plain[len(self.whole) : self.columns.count, self.rows]
        more = new**2 @ self.weights.T
        if self.total is not None:
            more = self.total.squares()[len(self.whole) :] - more
        self.whole = np.concatenate([self.whole, more])
        return self.whole


def within(fields: Array, weights: Array) -> Array:
    """(c, d, d, g) weighted products within sets of columns (c, d, N).  weights: (g, N)."""
    c, d, _ = fields.shape
    out = np.empty((c, d, d, len(weights)))
    for i in range(d):
        for j in range(i + 1):
            out[:, i, j] = out[:, j, i] = (fields[:, i] * fields[:, j]) @ weights.T
    return out


class Products:
    """Products for any ratio, of all rows or of those that are kept.

    kept: (N,) whether a row counts.  all: the products of all rows, where some do not count.
    """

    def __init__(self, columns: Columns, kept: Array, all: Products | None = None) -> None:
        self.columns, self.kept, self.all = columns, kept, all
        self.grid = self.summed(RATIOS)
        self.decades: dict[int, Sums] = {}
        self.asked: dict[int, int] = {}
        self.noises: dict[bytes, Noise] = {}

    def clear(self, index: Array) -> Array:
        """(d, N) candidates' columns less what geometry imitates."""
        return np.asarray(self.columns.clear[self.columns.fixed + index])

    def of(self, kept: Array) -> Products:
        """The products of some rows only.  kept: (N,)."""
        return Products(self.columns, kept, self.all or self)

    def summed(self, ratios: Array, decade: int | None = None) -> Sums:
        """Products at some ratios, or at the nodes of a decade."""
        if self.all is None:
            return Sums(self.columns, ratios)
        total = self.all.grid if decade is None else self.all.decade(decade)
        return Sums(self.columns, ratios, np.flatnonzero(~self.kept), total)

    def decade(self, number: int) -> Sums:
        """Products at the nodes of a decade of ratios."""
        if number not in self.decades:
            self.decades[number] = self.summed(10.0 ** nodes(number), number)
        return self.decades[number]

    def parts(self, ratios: Array, asked: int) -> list[tuple[int | None, Array, Sums, Array]]:
        """Number of the decade, which ratios (s,), of which products and how (s, g) combined.

        asked: by how much this counts towards forming the products of a decade.
        """
        numbers = np.floor(np.log10(np.maximum(ratios, 1e-300))).astype(int)
        if ratios is RATIOS:
            return [(None, np.arange(len(RATIOS)), self.grid, np.eye(len(RATIOS)))]
        out: list[tuple[int | None, Array, Sums, Array]] = []
        for number in map(int, np.unique(numbers)):
            here = np.flatnonzero(numbers == number)
            self.asked[number] = self.asked.get(number, 0) + asked * len(here)
            if ratios[here[0]] == 0.0:
                out.append((number, here, self.grid, np.eye(1, len(RATIOS))))
            elif self.all is None and self.asked[number] <= NODES:
                once = Sums(self.columns, ratios[here], once=True)
                out.append((None, here, once, np.eye(len(here))))
            else:
                between = interpolation(np.log10(ratios[here]), nodes(number))
                out.append((number, here, self.decade(number), between))
        return out

    @cached_property
    def span(self) -> Array:
        """(p, r) combinations of the geometry's columns that the rows tell apart."""
        p = self.columns.fixed - 1
        if self.all is None:
            return np.eye(p)
        index = np.arange(p)
        return told_apart(self.grid.square(index)[0])

    @cached_property
    def count(self) -> int:
        """Rows that were measured and count."""
        rows = self.columns.rows
        lost = ~self.kept.reshape(rows.weight.shape) & (rows.weight > 0.0)
        return rows.count - int(np.count_nonzero(lost))

    def dof(self, index: Array) -> int:
        """Degrees of freedom beside the geometry and some of the candidates' columns."""
        return self.count - int(self.span.shape[1]) - len(index)

    def noise(self, index: Array) -> Noise:
        """The noise beside some of the candidates' columns."""
        mark = index.tobytes()
        if mark not in self.noises:
            self.noises[mark] = self.likeliest(index)
        return self.noises[mark]

    def likeliest(self, index: Array) -> Noise:
        """The noise, computed."""
        rows, p, dof = self.columns.rows, self.columns.fixed - 1, self.dof(index)
        if dof < FREE:
            error = rows.error[self.kept]
            return Noise(0.0, float(error @ error) / max(self.count, 1) + 1e-18, 0.0)
        chosen = np.concatenate([np.arange(p), self.columns.fixed + index, [p]])
        turn = block_diag(self.span, np.eye(len(index) + 1))

        formed: dict[int, Array] = {}

        def grams(ratios: Array) -> Array:
            gram = np.empty((len(ratios), len(chosen), len(chosen)))
            for number, here, summed, combined in self.parts(ratios, 0):
                if number is None:
                    gram[here] = np.tensordot(combined, summed.square(chosen), 1)
                    continue
                if number not in formed:
                    formed[number] = summed.square(chosen)
                gram[here] = np.tensordot(combined, formed[number], 1)
            return gram if self.all is None else turn.T @ gram @ turn

        return likeliest(grams, rows, dof, self.kept)

    def told_apart(self, lines: Array, axis: int) -> Array:
        """The geometry's columns along an axis, as the combinations that the rows tell apart."""
        if self.all is None:
            return lines
        return np.asarray(np.moveaxis(np.moveaxis(lines, axis, -1) @ self.span, -1, axis))

    def across(self, ratios: Array, index: Array) -> tuple[Array, Array, Array]:
        """Products of the geometry and of some candidates' columns with all (s, f, p + 1 + D), of
        the error with all (s, p + 1 + D), and squares of the candidates' as they are (s, D).
        """
        p = self.columns.fixed - 1
        fixed = np.concatenate([np.arange(p), p + 1 + index, [p]])
        out = np.empty((len(ratios), len(fixed), len(self.columns.clear)))
        whole = np.empty((len(ratios), self.columns.count))
        for _, here, summed, combined in self.parts(ratios, 1):
            out[here] = np.moveaxis(combined @ summed.across(fixed), 1, 0)
            whole[here] = combined @ summed.squares().T
        lines, error = out[:, :-1], out[:, -1]
        if self.all is not None:
            geometry = self.told_apart(lines[:, :p], axis=1)
            lines = np.concatenate([geometry, lines[:, p:]], axis=1)
        return lines, error, whole

    def among(self, ratios: Array, index: Array) -> Array:
        """(s, c, d, d) products within sets of candidates' columns (c, d)."""
        out = np.empty((len(ratios), *index.shape, index.shape[1]))
        for _, here, summed, combined in self.parts(ratios, 0):
            own = summed.among(index + self.columns.fixed)
            out[here] = np.moveaxis(own @ combined.T, -1, 0)
        return out


def nodes(number: int) -> Array:
    """(g,) Chebyshev points of a decade, as powers of ten."""
    return np.asarray(number + 0.5 - 0.5 * np.cos(ANGLES))


def interpolation(x: Array, at: Array) -> Array:
    """(s, g) values at x of the polynomials that are 1 at one Chebyshev point and 0 at the others.

    By the barycentric formula [Berrut and Trefethen 2004].
    """
    off = x[:, None] - at
    met = off == 0.0
    part = np.where(np.arange(len(at)) % 2, -1.0, 1.0) * np.sin(ANGLES) / np.where(met, 1.0, off)
    part = np.where(met.any(axis=1, keepdims=True), met.astype(float), part)
    return np.asarray(part / part.sum(axis=1, keepdims=True))
