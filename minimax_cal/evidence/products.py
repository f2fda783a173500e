"""Cross-products of columns, rows weighed for any ratio of the noises, each formed once.

Products at the nodes of a decade give those at any ratio there (see `ratios`).  The geometry is
projected out once at every node; what is left is as smooth.  `sweeping` has those of some rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from minimax_cal.evidence.limits import LEAST_NOISE_DOF
from minimax_cal.evidence.noise import (
    NODES,
    RANK,
    RATIOS,
    ZERO,
    Noise,
    Problem,
    costs,
    find_ratio,
    interpolation,
    nodes,
    noise_of,
    told_apart,
    triangles,
)
from minimax_cal.ground.arrays import Array

LEAST = RANK**2  # of a column's square: what is left of one that geometry imitates is no less
BLOCK = 1_000_000  # weighed numbers that are held at once
SHRINK = np.array([1.0, 0.4, 0.12, 0.03, 0.0])  # of the ratio, when an effect is added


class Columns:
    """Columns of the geometry, the error, and candidates, as they are gathered; each stored once.

    The candidates' are stored twice: as they are, and less what geometry imitates, so that little
    is lost where products of what is left are differences.
    """

    def __init__(self, rows: Problem) -> None:
        self.rows = rows
        self.fixed: int = rows.basis.shape[1] + 1  # geometry and the error
        self.count = 0
        self.held = grown(np.empty((256, len(rows.error))), self.fixed)
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


def grown(store: Array, count: int, axis: int = 0) -> Array:
    """The store with room for so many along an axis."""
    if count <= store.shape[axis]:
        return store
    room = max(count, 5 * store.shape[axis] // 4) - store.shape[axis]
    shape = (*store.shape[:axis], room, *store.shape[axis + 1 :])
    return np.concatenate([store, np.empty(shape)], axis=axis)


Some = slice | Array  # columns, by where they stand
Formed = Callable[[Array, Some], Array]  # products (f, g, d) of columns (f,) with some


class Lines:
    """Products of some columns with all, at g ratios, each formed when it is first asked for.

    Whoever asks brings what forms them, and is not held here: two that hold each other stay in
    memory, which these fill, until someone looks for such pairs.
    """

    def __init__(self, depth: int) -> None:
        self.held = np.empty((0, depth, 0))
        self.place: dict[int, int] = {}
        self.width = 0

    def across(self, form: Formed, index: Array, some: slice) -> Array:
        """(f, g, d) products of columns with those of a slice."""
        known, width = len(self.place), some.stop
        new = unknown(index, self.place)
        self.held = grown(grown(self.held, known + len(new)), width, axis=2)
        if width > self.width:
            if known:
                late = slice(self.width, width)
                self.held[:known, :, late] = form(np.array(list(self.place)), late)
            self.width = width
        if len(new):
            self.held[known : known + len(new), :, : self.width] = form(new, slice(0, self.width))
            self.place.update(zip(new.tolist(), range(known, known + len(new)), strict=True))
        return np.asarray(self.held[at_places(index, self.place), :, some])


class Squares:
    """Products among some columns, at g ratios, each formed once; who asks brings what forms it."""

    def __init__(self, depth: int) -> None:
        self.held = np.empty((0, depth, 0))
        self.place: dict[int, int] = {}

    def across(self, form: Formed, index: Array, others: Array) -> Array:
        """(f, g, d) products of columns with others."""
        new = unknown(np.concatenate([index, others]), self.place)
        if len(new):
            known = len(self.place)
            every = np.concatenate([np.array(list(self.place), dtype=int), new])
            self.place.update(zip(new.tolist(), range(known, len(every)), strict=True))
            self.held = grown(grown(self.held, len(every)), len(every), axis=2)
            block = form(new, every)
            self.held[known : len(every), :, : len(every)] = block
            self.held[:known, :, known : len(every)] = np.swapaxes(block, 0, 2)[:known]
        at, beside = at_places(index, self.place), at_places(others, self.place)
        return np.moveaxis(self.held[at[:, None], :, beside[None]], -1, 1)


def unknown(index: Array, place: dict[int, int]) -> Array:
    """Columns that have no place yet, each once."""
    return np.array([i for i in dict.fromkeys(index.tolist()) if i not in place], dtype=int)


def at_places(index: Array, place: dict[int, int]) -> Array:
    """(f,) the places of columns."""
    return np.array([place[i] for i in index.tolist()], dtype=int)


class Sums:
    """Products at some ratios (g,), summed over rows.  some: (N,) True for those; None: all."""

    def __init__(self, columns: Columns, ratios: Array, some: Array | None = None) -> None:
        varied = columns.rows.variance_ratio
        self.columns, self.ratios = columns, ratios
        self.some = None if some is None else np.flatnonzero(some)
        self.clear = None if some is None else columns.clear[:, self.some]
        self.weights = 1.0 / (1.0 + np.outer(ratios, varied if some is None else varied[some]))
        self.alike = not varied.any()  # one noise: ratios change nothing
        self.sets: dict[tuple[bytes, int], Array] = {}
        self.whole = np.zeros((0, len(ratios)))

    @property
    def fields(self) -> Array:
        """(p + 1 + D, n) the columns of `Columns.clear` at these rows."""
        return self.columns.clear if self.clear is None else self.clear

    def products(self, index: Array, others: Some) -> Array:
        """(f, g, d) of columns with others; the fewer are weighed."""
        fields = self.fields
        there = fields[others]
        if len(there) < len(index):
            return np.swapaxes(self.spread(there, fields[index]), 0, 2)
        return self.spread(fields[index], there)

    def spread(self, few: Array, many: Array) -> Array:
        """(f, g, d) weighed products of columns (f, n) and (d, n)."""
        g, n = self.weights.shape
        if self.alike:
            one = few @ many.T
            return np.asarray(np.broadcast_to(one[:, None], (len(few), g, len(many))))
        out = np.empty((len(few), g, len(many)))
        step = max(1, BLOCK // (g * max(n, 1)))
        for i in range(0, len(few), step):
            block = few[i : i + step, None] * self.weights
            flat = block.reshape(len(block) * g, n) @ many.T  # of no rows 0
            out[i : i + step] = flat.reshape(len(block), g, len(many))
        return out

    def among(self, index: Array) -> Array:
        """(c, d, d, g) products within each of c sets of columns (c, d)."""
        mark = (index.tobytes(), index.shape[1])
        if mark not in self.sets:
            self.sets[mark] = within(self.fields[index], self.weights)
        return self.sets[mark]

    def squares(self) -> Array:
        """(D, g) squares of candidates' columns as they are."""
        new = self.columns.plain[len(self.whole) : self.columns.count]
        new = new if self.some is None else new[:, self.some]
        self.whole = np.concatenate([self.whole, new**2 @ self.weights.T])
        return self.whole


def within(fields: Array, weights: Array) -> Array:
    """(c, d, d, g) weighted products within sets of columns (c, d, N).  weights: (g, N)."""
    c, d, _ = fields.shape
    out = np.empty((c, d, d, len(weights)))
    for i in range(d):
        for j in range(i + 1):
            out[:, i, j] = out[:, j, i] = (fields[:, i] * fields[:, j]) @ weights.T
    return out


class Beside:
    """What is left of products at some ratios when the geometry is projected out.

    Columns count from the error, 0: the candidates' follow, the geometry's leave nothing.
    span: (p, r) combinations of the geometry's columns that the rows tell apart.
    factor: (g, r, r) lower triangles of these combinations' products.  logs: (g,) log determinants
    of those.  error: (g,) squares of the error, unprojected.
    """

    def __init__(self, sums: Sums, *, some: bool = False) -> None:
        """some: whether the rows may not tell all of the geometry's columns apart."""
        self.fixed = p = sums.columns.fixed - 1
        self.sums, depth = sums, len(sums.ratios)
        gram = np.moveaxis(sums.products(np.arange(p), slice(0, p)), 0, 1)
        self.span = told_apart(gram[0]) if some else np.eye(p)
        gram = self.span.T @ gram @ self.span if some else gram
        self.factor = triangles(gram)
        self.inverse = np.linalg.inv(self.factor) @ self.span.T
        self.logs = 2.0 * np.log(np.einsum("grr->gr", self.factor)).sum(axis=1)
        self.error = sums.products(np.array([p]), slice(p, p + 1))[0, :, 0]
        self.lines, self.pairs = Lines(depth), Squares(depth)
        self.sets: dict[tuple[bytes, int], Array] = {}
        self.held = np.empty((depth, self.span.shape[1], 0))
        self.known = np.zeros(0, dtype=bool)

    @property
    def width(self) -> int:
        """How many columns there are."""
        return 1 + self.sums.columns.count

    def part(self, some: Some) -> Array:
        """(g, r, d) coordinates of columns in the geometry's span, each formed once."""
        width = self.width
        if width > len(self.known):
            self.held = grown(self.held, width, axis=2)
            self.known = np.pad(self.known, (0, width - len(self.known)))
        if not self.known[some].all():
            index = np.arange(width)[some]
            new = np.unique(index[~self.known[index]])
            run = slice(int(new[0]), int(new[-1]) + 1)  # which needs no copy of the columns
            missing = run if 2 * len(new) > run.stop - run.start else new
            raw = self.sums.products(np.arange(self.fixed), self.shifted(missing))
            self.held[:, :, missing] = self.inverse @ np.moveaxis(raw, 0, 1)
            self.known[missing] = True
        return np.asarray(self.held[:, :, some])

    def shifted(self, some: Some) -> Some:
        """Where columns stand behind the geometry's."""
        if isinstance(some, slice):
            return slice(some.start + self.fixed, some.stop + self.fixed)
        return some + self.fixed

    def left(self, index: Array, others: Some) -> Array:
        """(f, g, d) products of columns with others."""
        shared = np.swapaxes(self.part(index), 1, 2) @ self.part(others)
        whole = self.sums.products(index + self.fixed, self.shifted(others))
        return np.asarray(whole - np.moveaxis(shared, 0, 1))

    def across(self, index: Array) -> Array:
        """(f, g, 1 + D) products of columns with all."""
        return self.lines.across(self.left, index, slice(0, self.width))

    def square(self, index: Array) -> Array:
        """(g, f, f) products among columns."""
        return np.moveaxis(self.pairs.across(self.left, index, index), 1, 0)

    def among(self, index: Array) -> Array:
        """(c, d, d, g) products within each of c sets of columns (c, d)."""
        mark = (index.tobytes(), index.shape[1])
        if mark not in self.sets:
            part = self.part(index.ravel())
            part = np.moveaxis(part.reshape(*part.shape[:2], *index.shape), 1, -1)
            shared = part @ np.swapaxes(part, -1, -2)
            self.sets[mark] = self.sums.among(index + self.fixed) - np.moveaxis(shared, 0, -1)
        return self.sets[mark]


View = tuple[Array, Beside, Array]  # which ratios (s,), of which products, how (s, g) combined


@dataclass(frozen=True, eq=False)
class At:
    """Products at ratios (s,), geometry projected out, of q columns and the error with all.

    lines: (s, q, D) with the candidates'.  error: (s, 1 + D) of the error with itself and those.
    square: (s,) of the error, unprojected.  whole: (s, D) squares of the candidates' as they are.
    factor: (s, r, r) lower triangles of the geometry's products; part: (s, r, 1 + q) coordinates
    of the error and of the q columns in its span; logs: (s,) log determinants.
    pull: (s, q) of the q columns with the error.  among: products (s, c, d, d) within sets of
    candidates' columns (c, d).
    """

    lines: Array
    error: Array
    square: Array
    whole: Array
    factor: Array
    part: Array
    logs: Array
    pull: Array
    among: Callable[[Array], Array]


def regularised(square: Array, whole: Array) -> Array:
    """Squares of what geometry leaves of columns, such that no sum of unit columns is rounding.

    whole: squares of the columns as they are.  What is added is a share of what is left: a column
    and the same column with more geometry in it are one.
    """
    return np.asarray((1.0 + LEAST) * np.maximum(square, LEAST * whole))


class Products:
    """Products for any ratio, of all rows.  kept: (N,) whether a row counts.

    count: of rows that were measured.  rank: of the geometry's columns.
    """

    def __init__(self, columns: Columns, kept: Array | None = None) -> None:
        self.columns = columns
        self.rank: int = columns.fixed - 1
        self.kept = np.ones(len(columns.rows.error), dtype=bool) if kept is None else kept
        self.count = int(np.count_nonzero(self.kept & columns.rows.measured))
        self.formed: dict[int | None, Beside] = {}
        self.noises: dict[bytes, Noise] = {}
        self.last: tuple[bytes, Array] = (b"", np.empty(0))

    def beside_geometry(self, index: Array) -> Array:
        """(p + q, N) the geometry's columns and some of the candidates' (q,), as `clear` has them.

        Those asked for last are held: of all effects together they would fill the memory.
        """
        mark = index.tobytes()
        if self.last[0] != mark or not self.last[1].size:
            self.last = mark, np.concatenate([self.geometry, self.clear(index)])
        return self.last[1]

    def clear(self, index: Array) -> Array:
        """(d, N) candidates' columns less what geometry imitates."""
        return np.asarray(self.columns.clear[self.columns.fixed + index])

    def beside(self, number: int | None) -> Beside:
        """What the geometry leaves of the products of a decade; None: at RATIOS."""
        if number not in self.formed:
            ratios = RATIOS if number is None else nodes(number)
            self.formed[number] = Beside(Sums(self.columns, ratios))
        return self.formed[number]

    def views(self, ratios: Array) -> list[View]:
        """Which ratios (s,), of which products, and how (s, g) combined."""
        if ratios is RATIOS:
            return [(np.arange(len(RATIOS)), self.beside(None), np.eye(len(RATIOS)))]
        logs = np.log10(np.maximum(ratios, 10.0**ZERO))
        numbers = np.floor(logs).astype(int)
        out: list[View] = []
        for number in map(int, np.unique(numbers)):
            here = np.flatnonzero(numbers == number)
            alone = np.ones((len(here), 1))
            between = interpolation(logs[here] - number, NODES) if number > ZERO else alone
            out.append((here, self.beside(number), between))
        return out

    def shown(self) -> tuple[Array, Array]:
        """(D,) squares of the candidates' columns, all rows alike, and of what geometry leaves."""
        columns = self.columns
        own = (columns.clear[columns.fixed :] ** 2) @ self.kept
        ((_, beside, between),) = self.views(np.zeros(1))
        part = np.tensordot(between[0], beside.part(slice(1, beside.width)), 1)
        return columns.plain[: columns.count] ** 2 @ self.kept, own - (part**2).sum(axis=0)

    def dof(self, index: Array) -> int:
        """Degrees of freedom beside the geometry and some of the candidates' columns."""
        return self.count - self.rank - len(index)

    def noise(self, index: Array) -> Noise:
        """The noise beside some of the candidates' columns, by restricted maximum likelihood."""
        mark, rows, dof = index.tobytes(), self.columns.rows, self.dof(index)
        if mark in self.noises:
            return self.noises[mark]
        varied = rows.variance_ratio[self.kept]

        def cost(ratios: Array) -> tuple[Array, Array]:
            gram, logs = self.gram(ratios, index)
            value, squares = costs(gram, ratios, varied, dof)
            return value + logs, squares

        if dof < LEAST_NOISE_DOF:
            error = rows.error[self.kept]
            noise = Noise(0.0, float(error @ error) / max(self.count, 1) + 1e-18, 0.0)
        else:
            ratio = self.find_ratio(lambda ratios: cost(ratios)[0])
            noise = noise_of(ratio, float(cost(np.array([ratio]))[1][0]) / dof, rows)
        self.noises[mark] = noise
        return noise

    def find_ratio(self, cost: Callable[[Array], Array]) -> float:
        """The ratio of least cost."""
        return find_ratio(cost)

    def gram(self, ratios: Array, index: Array) -> tuple[Array, Array]:
        """(s, q + 1, q + 1) products among candidates' columns (q,) and, last, the error.

        Geometry is projected out at ratios (s,); and (s,) log determinants of its products.
        """
        chosen = np.append(1 + index, 0)
        gram = np.empty((len(ratios), len(chosen), len(chosen)))
        logs, whole = np.empty(len(ratios)), np.empty((len(ratios), len(index)))
        for here, beside, between in self.views(ratios):
            gram[here] = np.tensordot(between, beside.square(chosen), 1)
            whole[here] = between @ beside.sums.squares()[index].T
            logs[here] = between @ beside.logs
        each = range(len(index))
        gram[:, each, each] = regularised(gram[:, each, each], whole)
        return gram, logs

    @property
    def geometry(self) -> Array:
        """(p, N) the geometry's columns."""
        return self.columns.clear[: self.columns.fixed - 1]

    def ratios_below(self, noise: Noise) -> Array:
        """(s,) ratios at which candidates are compared beside a noise, the largest first."""
        return noise.ratio * SHRINK if noise.ratio > 0.0 else np.zeros(1)

    def at(self, ratios: Array, index: Array) -> At:
        """Products at ratios (s,) of some candidates' columns (q,) and of the error."""
        s, q, r = len(ratios), len(index), self.rank
        fixed = np.append(0, 1 + index)
        lines = np.empty((s, 1 + q, 1 + self.columns.count))
        square, logs = np.empty(s), np.empty(s)
        whole = np.empty((s, self.columns.count))
        factor, part = np.empty((s, r, r)), np.empty((s, r, 1 + q))
        views = self.views(ratios)
        for here, beside, between in views:
            lines[here] = np.moveaxis(between @ beside.across(fixed), 1, 0)
            whole[here] = between @ beside.sums.squares().T
            square[here], logs[here] = between @ beside.error, between @ beside.logs
            factor[here] = np.tensordot(between, beside.factor, 1)
            part[here] = np.tensordot(between, beside.part(fixed), 1)

        def among(sets: Array) -> Array:
            out = np.empty((s, *sets.shape, sets.shape[1]))
            for here, beside, between in views:
                own = beside.among(1 + sets)
                out[here] = np.moveaxis(own @ between.T, -1, 0)
            return out

        pull = lines[:, 1:, 0]
        return At(lines[:, 1:, 1:], lines[:, 0], square, whole, factor, part, logs, pull, among)
