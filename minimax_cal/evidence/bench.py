"""Where candidates are compared beside the effects already chosen, at several ratios of noises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import fdtrc

from minimax_cal.evidence.library import Aside, Candidate, Library
from minimax_cal.evidence.limits import LINES
from minimax_cal.evidence.noise import Noise, inflation
from minimax_cal.evidence.products import within
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.table import EFFECTS

ROUNDING = 1e-15  # share of a square that is no more than rounding
SAME = 1e-12  # added to products of unit columns where some are the same
SHRINK = np.array([1.0, 0.4, 0.12, 0.03, 0.0])  # of the ratio, when one is added


@dataclass(frozen=True, eq=False)
class Added:
    """A candidate added to what was chosen before.

    gain: by how much -2 log likelihood falls.  evidence: the gain less what so many free
    parameters would gain of themselves.  ratio, variance: the noise then.
    value: (d,) and sigma: (d,) of its parameters.
    """

    candidate: Candidate
    gain: float
    evidence: float
    ratio: float
    variance: float
    value: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Settings:
    """Columns at several ratios of the noises, geometry and chosen effects projected out.

    ratios: (s,).  part: (s, D, f) coordinates of the columns in the orthonormal span of what is
    projected out; before: (s, f) of the error.  pull: (s, D) products of what is left of a column
    and of the error.  total: (s,) squares of the error.  whole: (s, D) of the columns, unprojected.
    logs: (s,) log determinants of the covariance and of the fixed effects.  own: products
    (s, c, d, d) within sets of columns (c, d), unprojected.
    """

    ratios: Array
    part: Array
    before: Array
    pull: Array
    total: Array
    whole: Array
    logs: Array
    own: Callable[[Array], Array]

    def blocks(self, index: Array) -> Array:
        """(s, c, d, d) products, projected, of c sets of columns (c, d)."""
        part = self.part[:, index]
        return np.asarray(self.own(index) - part @ np.swapaxes(part, -1, -2))

    def solve(self, index: Array, block: Array, ridge: Array) -> tuple[Array, Array, Array]:
        """Values and diagonals of the inverse (s, c, d), and decreases of the square (s, c).

        index: (c, d) columns.  block: (s, c, d, d) their products.  ridge: (s, c, d).
        """
        d = index.shape[1]
        block = block + ridge[..., None] * np.eye(d)
        pull = self.pull[:, index]
        diagonal = np.einsum("scdd->scd", block)
        alive = diagonal > np.maximum(1e-7 * self.whole[:, index], 1e-200)
        if d == 1:
            inverse = np.where(alive, 1.0 / np.where(alive, diagonal, 1.0), 0.0)
            return inverse * pull, inverse, (inverse * pull * pull)[..., 0]
        scale = np.where(alive, 1.0 / np.sqrt(np.where(alive, diagonal, 1.0)), 0.0)
        values, vectors = np.linalg.eigh(block * scale[..., :, None] * scale[..., None, :])
        kept = np.where(values > 1e-9, 1.0 / np.where(values > 1e-9, values, 1.0), 0.0)
        basis = vectors * scale[..., :, None]
        value = basis @ (kept * (pull[..., None, :] @ basis)[..., 0, :])[..., None]
        value = value[..., 0]
        return value, (basis**2 @ kept[..., None])[..., 0], (value * pull).sum(axis=-1)

    def added_all(self, same: Sequence[Candidate], dof: int) -> tuple[Array, Array, Array, Array]:
        """Decrease of the square by each candidate; values, their variances; Occam's factor.

        Doubts have the prior that the values found imply.  same: of equal numbers of columns.
        """
        main = np.array([c.main for c in same])
        both = np.concatenate([main, np.array([c.doubt for c in same])], axis=1)
        d = main.shape[1]
        block = self.blocks(both)
        none = np.zeros((len(self.ratios), *main.shape))
        value, inverse, gain = self.solve(main, block[..., :d, :d], none)
        if both.shape[1] == d:
            return gain, value, inverse, np.zeros(gain.shape)
        variance = np.maximum(self.total[:, None] - gain, 1e-300)[..., None] / dof
        owner = np.broadcast_to([c.owner for c in same], (*gain.shape, both.shape[1] - d))
        size = np.maximum(np.abs(np.take_along_axis(value, owner, axis=-1)), 1e-30)
        ridge = np.concatenate([none, variance / size**2], axis=-1)
        value, inverse, gain = self.solve(both, block, ridge)
        loose = block[..., d:, d:] * size[..., :, None] * size[..., None, :] / variance[..., None]
        volume = np.linalg.slogdet(np.eye(both.shape[1] - d) + loose)[1]
        return gain, value[..., :d], inverse[..., :d], volume


@dataclass(frozen=True, eq=False)
class Bench:
    """Where candidates are compared: beside what was chosen, over several ratios of the noises.

    tries: laws that are compared, for the chance of a false name.  dof: degrees of freedom.
    fixed: what is projected out, in rows.
    """

    library: Library
    chosen: tuple[Candidate, ...]
    noise: Noise
    settings: Settings
    fixed: Fixed
    dof: int
    tries: float

    @cached_property
    def base(self) -> float:
        """-2 log restricted likelihood without a further effect."""
        return float((self.dof * np.log(self.settings.total) + self.settings.logs).min())

    @cached_property
    def everyone(self) -> list[Added]:
        """Every candidate of the library, the best first."""
        found = self.ranked(self.library.candidates)
        if self.library.lines is not None:
            found += self.lines.ranked(self.library.lines.candidates)
        return sorted(found, key=lambda one: -one.evidence)

    @cached_property
    def lines(self) -> Bench:
        """The bench for the library's lines."""
        return self.beside(self.library.lines or self.library.aside(()))

    def knows(self, c: Candidate) -> bool:
        """Whether the candidate was stored, or one of the lines, when this bench was made."""
        return max(c.main) < self.settings.pull.shape[1] or self.line(c) is not None

    def line(self, c: Candidate) -> Candidate | None:
        """The line that was stored as a candidate later."""
        lines = self.library.lines.candidates if self.library.lines else ()
        return next((one for one in lines if one.term.text == c.term.text), None)

    def added(self, c: Candidate) -> Added:
        """A candidate beside what was chosen, at its best ratio."""
        line = self.line(c)
        if line is None:
            return self.compared([c])[0]
        return replace(self.lines.compared([line])[0], candidate=c)

    def ranked(self, among: Sequence[Candidate]) -> list[Added]:
        """Candidates by evidence."""
        kinds: dict[tuple[int, int], list[Candidate]] = {}
        for c in among:
            kinds.setdefault((len(c.main), len(c.doubt)), []).append(c)
        found = [one for same in kinds.values() for one in self.compared(same)]
        return sorted(found, key=lambda one: -one.evidence)

    def compared(self, same: list[Candidate]) -> list[Added]:
        """Candidates with the same numbers of columns and doubts, all at once."""
        s = self.settings
        gain, value, inverse, volume = s.added_all(same, self.dof)
        rest = np.maximum(s.total[:, None] - gain, 1e-300)
        cost = self.dof * np.log(rest) + s.logs[:, None]
        out = []
        for i, (c, at) in enumerate(zip(same, np.argmin(cost, axis=0), strict=True)):
            variance = float(rest[at, i] / self.dof)
            up = max(self.base - float(cost[at, i]), 0.0)
            sigma = np.sqrt(np.maximum(inverse[at, i] * variance, 0.0))
            worth = up - float(volume[at, i]) - occam(c, up)
            worth -= prior_penalty(c, value[at, i], sigma)
            ratio = float(s.ratios[at])
            out.append(Added(c, up, worth, ratio, variance, value[at, i], sigma))
        return out

    def p_value(self, one: Added, wide: float = 1.0) -> float:
        """Probability that a candidate without effect gains so much, the best of all tries.

        wide: by how much the rows are noisier along it than all together, as `inflation`.
        """
        d = len(one.candidate.main) + one.candidate.shapes
        free = max(self.dof - d, 1)
        ratio = np.expm1(min(one.gain / self.dof, 50.0)) * free / d / wide
        return float(min(1.0, fdtrc(d, free, ratio) * self.looked_at(one.candidate)))

    def looked_at(self, c: Candidate) -> float:
        """Candidates of its kind, over the share of the level that the kind has."""
        return c.tries / LINES if c.is_line else self.tries / (1.0 - 2.0 * LINES)

    def improbable(self, one: Added, level: float) -> bool:
        """Whether a gain is less probable than a level, by all rows and by groups of them."""
        return self.p_value(one) < level and self.p_value(one, self.wide(one)) < level

    def wide(self, one: Added) -> float:
        """By how much rows are noisier along a candidate than all together."""
        at = int(np.argmax(self.settings.ratios == one.ratio))
        field, rest = self.fixed.white(self.library.fields(one.candidate)[: len(one.value)], at)
        return inflation(one.value @ field, rest, self.library.rows.group, self.dof)

    def likeness(self, one: Added, other: Candidate) -> tuple[float, float]:
        """lambda of an effect found, and rho^2: the share of its motion that another imitates."""
        at = int(np.argmax(self.settings.ratios == one.ratio))
        d = len(one.candidate.main)
        fields = [self.library.fields(one.candidate)[:d], self.library.fields(other)]
        both = self.fixed.gram(np.concatenate(fields), at)
        size = float(one.value @ both[:d, :d] @ one.value)
        across = one.value @ both[:d, d:]
        own = np.diag(both)[d:]  # zero where geometry imitates a column
        scale = np.sqrt(np.maximum(own, 1e-12 * own.max(initial=0.0) + 1e-300))
        inverse = np.linalg.pinv(both[d:, d:] / np.outer(scale, scale), 1e-9, hermitian=True)
        shared = float((across / scale) @ inverse @ (across / scale))
        return size / one.variance, min(shared / max(size, 1e-300), 1.0)

    def beside(self, aside: Aside) -> Bench:
        """The bench for candidates that are not stored, instead of those that are."""
        weights = self.fixed.weights
        part, pull = self.fixed.projected(aside.clear)
        settings = replace(
            self.settings,
            part=part,
            pull=pull,
            whole=(weights @ aside.raw**2),
            own=lambda index: np.moveaxis(within(aside.clear[index], weights), -1, 0),
        )
        return replace(self, settings=settings)


@dataclass(frozen=True, eq=False)
class Fixed:
    """What is projected out, in rows, for columns that are stored nowhere.

    rows: (f, N).  factors: (s, f, f) lower triangles of the rows' products.  weights: (s, N).
    before: (s, f) as in `Settings`.  error: (N,).
    """

    rows: Array
    factors: Array
    weights: Array
    before: Array
    error: Array

    def gram(self, columns: Array, at: int) -> Array:
        """(d, d) products of columns (d, N), projected, at one of the ratios."""
        own = columns * self.weights[at]
        part = solve_triangular(self.factors[at], self.rows @ own.T, lower=True)
        return np.asarray(own @ columns.T - part.T @ part)

    def white(self, columns: Array, at: int) -> tuple[Array, Array]:
        """Columns (d, N) and the error (N,), projected, their rows of the same variance."""
        both = np.concatenate([columns, self.error[None]]) * self.weights[at]
        part = solve_triangular(self.factors[at], self.rows @ both.T, lower=True)
        back = solve_triangular(self.factors[at], self.rows, lower=True)
        left = (both / np.maximum(self.weights[at], 1e-300) - part.T @ back) * np.sqrt(
            self.weights[at]
        )
        return left[:-1], left[-1]

    def projected(self, columns: Array) -> tuple[Array, Array]:
        """Coordinates (s, d, f) of columns (d, N) in the span; (s, d) products with the error."""
        part = np.stack([
            solve_triangular(factor, (self.rows * weight) @ columns.T, lower=True).T
            for factor, weight in zip(self.factors, self.weights, strict=True)
        ])  # fmt: skip
        pull = (self.weights * self.error) @ columns.T
        return part, pull - (part @ self.before[..., None])[..., 0]


def occam(c: Candidate, gain: float) -> float:
    """What d free parameters must gain to be worth it: d (1 + log of the gain of each)."""
    d = len(c.main) + c.shapes
    return d * (1.0 + float(np.log(max(gain / d, 1.0)))) + 2.0 * float(np.log(c.tries))


def prior_penalty(c: Candidate, value: Array, sigma: Array) -> float:
    """What values far beyond the usual cost, and signs that no body has."""
    effect = EFFECTS[c.term.effect]
    cost = float(((value / effect.typical) ** 2).sum())
    if effect.positive and len(value) == 1 and value[0] < 0.0:
        cost += float((value[0] / max(sigma[0], 1e-300)) ** 2)
    return cost


def bench(lib: Library, chosen: Sequence[Candidate], fits: Sequence[Added] = ()) -> Bench:
    """The place to compare further candidates beside those chosen.

    fits: values of the chosen, where their doubts matter.
    """
    products = lib.products
    main, loose, ridge = columns_of(chosen, fits)
    noise, dof = products.noise(main), products.dof(main)
    ratios = noise.ratio * SHRINK if noise.ratio > 0.0 else np.zeros(1)
    index = np.concatenate([main, loose])
    p, fit = products.columns.fixed - 1, products.span.shape[1]
    fixed, error, whole = products.across(ratios, index)
    gram = np.concatenate(
        [products.told_apart(fixed[:, :, :p], axis=2), fixed[:, :, p + 1 + index]], axis=2
    )
    r = fit + len(main)
    gram[:, range(r, r + len(loose)), range(r, r + len(loose))] += ridge * noise.variance  # a prior
    factors = triangles(gram)
    part = np.stack([
        solve_triangular(factor, lines[:, p:], lower=True, check_finite=False).T
        for factor, lines in zip(factors, fixed, strict=True)
    ])  # fmt: skip
    before, part = part[:, 0], part[:, 1:]
    square = error[:, p]
    total = np.maximum(square - (before**2).sum(axis=1), ROUNDING * square + 1e-300)
    size = np.einsum("sff->sf", factors)[:, :r]
    spread = np.log1p(ratios[:, None] * lib.rows.variance_ratio[products.kept]).sum(axis=1)
    settings = Settings(
        ratios=ratios,
        part=part,
        before=before,
        pull=error[:, p + 1 :] - (part @ before[..., None])[..., 0],
        total=total,
        whole=whole,
        logs=spread + 2.0 * np.log(size).sum(axis=1),
        own=lambda index: products.among(ratios, index),
    )
    geometry = products.told_apart(products.columns.clear[:p], axis=0)
    rows = np.concatenate([geometry, products.clear(index)])
    weights = products.kept / (1.0 + np.outer(ratios, lib.rows.variance_ratio))
    held = Fixed(rows, factors, weights, before, lib.rows.error)
    tries = float(sum(not c.is_line for c in lib.candidates))
    return Bench(lib, tuple(chosen), noise, settings, held, dof, tries)


def triangles(gram: Array) -> Array:
    """(s, f, f) lower triangles whose squares are matrices (s, f, f)."""
    scale = np.sqrt(np.einsum("sff->sf", gram))[..., None]
    unit = gram / scale / np.swapaxes(scale, 1, 2)
    try:
        return np.asarray(scale * np.linalg.cholesky(unit))
    except np.linalg.LinAlgError:  # two of the chosen are the same on these poses
        return np.asarray(scale * np.linalg.cholesky(unit + SAME * np.eye(gram.shape[-1])))


def columns_of(
    chosen: Sequence[Candidate], fits: Sequence[Added] = ()
) -> tuple[Array, Array, Array]:
    """Columns of the chosen, of their doubts, and the ridge of each doubt [1/unit^2]."""
    none = np.zeros(0, dtype=int)
    main = np.concatenate([none, *(c.main for c in chosen)])
    values = {id(one.candidate): one.value for one in fits}
    loose, ridge = [none], [np.zeros(0)]
    for c in chosen:
        if len(c.doubt) and len(values.get(id(c), ())):
            loose.append(c.doubt)
            ridge.append(1.0 / np.maximum(values[id(c)][c.owner] ** 2, 1e-60))
    return main, np.concatenate(loose), np.concatenate(ridge)
