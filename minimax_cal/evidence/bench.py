"""Where candidates are compared beside the effects already chosen, at several ratios of noises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import fdtrc

from minimax_cal.evidence.library import Aside, Candidate, Kind, Library, kinds
from minimax_cal.evidence.limits import CREDIBLE, LINES
from minimax_cal.evidence.noise import Noise, inflation, triangles
from minimax_cal.evidence.products import Products, regularised, within
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import column_scales, scale_symmetric
from minimax_cal.solvers.bounded import bounded

ROUNDING = 1e-15  # share of a square that is no more than rounding


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

    def added_all(self, kind: Kind, dof: int) -> tuple[Array, Array, Array, Array]:
        """Decrease of the square by each candidate; values, their variances; Occam's factor.

        Doubts have the prior that the values found imply.
        """
        main, both = kind.main, kind.both
        d = main.shape[1]
        block = self.blocks(both)
        none = np.zeros((len(self.ratios), *main.shape))
        value, inverse, gain = self.solve(main, block[..., :d, :d], none)
        if both.shape[1] == d:
            return gain, value, inverse, np.zeros(gain.shape)
        variance = np.maximum(self.total[:, None] - gain, 1e-300)[..., None] / dof
        owner = np.broadcast_to(kind.owner, (*gain.shape, both.shape[1] - d))
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
        """Candidates that are worth it, the best first, and the best of each kind."""
        found = self.ranked(self.library.candidates)
        if self.library.lines is not None:
            found += self.lines.ranked(self.library.lines.candidates)
        return sorted(found, key=lambda one: -one.evidence)

    @cached_property
    def lines(self) -> Bench:
        """The bench for the library's lines."""
        return self.beside(self.library.lines or self.library.aside(()))

    def added(self, c: Candidate) -> Added:
        """A candidate beside what was chosen, at its best ratio."""
        for line in self.library.lines.candidates if self.library.lines else ():
            if line.text == c.text:  # it was stored as a candidate later
                return replace(self.lines.compared(Kind.of([line]))[0], candidate=c)
        return self.compared(Kind.of([c]))[0]

    def ranked(self, among: Sequence[Candidate]) -> list[Added]:
        """Candidates that are worth it by evidence, and the best of each kind."""
        found = [one for kind in kinds(tuple(among)) for one in self.compared(kind)]
        return sorted(found, key=lambda one: -one.evidence)

    def compared(self, kind: Kind) -> list[Added]:
        """Candidates of a kind that are worth it, and the best."""
        s, each = self.settings, np.arange(len(kind.candidates))
        gain, value, inverse, volume = s.added_all(kind, self.dof)
        rest = np.maximum(s.total[:, None] - gain, 1e-300)
        cost = self.dof * np.log(rest) + s.logs[:, None]
        at = np.argmin(cost, axis=0)
        variance = rest[at, each] / self.dof
        up = np.maximum(self.base - cost[at, each], 0.0)
        value = value[at, each]
        sigma = np.sqrt(np.maximum(inverse[at, each] * variance[:, None], 0.0))
        # Evidence: the gain less what so many free parameters must gain (Occam), what values far
        # beyond the usual cost, and what a sign that is physically impossible gains.
        d, usual = kind.free, ((value / kind.typical[:, None]) ** 2).sum(axis=1)
        occam = d * (1.0 + np.log(np.maximum(up / d, 1.0))) + 2.0 * np.log(kind.tries)
        wrong = kind.positive & (value[:, 0] < 0.0)
        sign = wrong * (value[:, 0] / np.maximum(sigma[:, 0], 1e-300)) ** 2
        worth = up - volume[at, each] - occam - (usual + sign)
        shown = np.union1d(np.flatnonzero(worth > 0.0), [np.argmax(worth)])
        return [
            Added(
                kind.candidates[i],
                float(up[i]),
                float(worth[i]),
                float(s.ratios[at[i]]),
                float(variance[i]),
                value[i],
                sigma[i],
            )
            for i in shown.tolist()
        ]

    def chance(self, one: Added, wide: float = 1.0) -> float:
        """Probability that this candidate, without effect, gains so much; no other was tried.

        wide: by how much the rows are noisier along it than all together, as `inflation`.
        """
        d = len(one.candidate.main) + one.candidate.shapes
        free = max(self.dof - d, 1)
        ratio = np.expm1(min(one.gain / max(self.dof, 1), 50.0)) * free / d / wide
        return float(fdtrc(d, free, ratio))

    def p_value(self, one: Added, wide: float = 1.0) -> float:
        """Probability that a candidate without effect gains so much, the best of all tries."""
        return min(1.0, self.chance(one, wide) * self.looked_at(one.candidate))

    def looked_at(self, c: Candidate) -> float:
        """Candidates of its kind, over the share of the level that the kind has."""
        if not c.is_line:
            return self.tries / (1.0 - 2.0 * LINES)
        heard = [one.term for one in self.chosen if one.is_line]
        return c.tries / (1.0 if self.library.dictionary.is_expected(c.term, heard) else LINES)

    def improbable(self, one: Added, level: float) -> bool:
        """Whether a gain is less probable than a level, by all rows and by groups of them."""
        if self.p_value(one) >= level:
            return False
        at = int(np.argmax(self.settings.ratios == one.ratio))
        motion = one.value @ self.library.fields(one.candidate)[: len(one.value)]
        own, rest = self.fixed.white(motion[None], at)[0], self.fixed.left(at)
        wide = inflation(own, rest, self.library.rows.group, self.dof)
        return self.p_value(one, wide) < level

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
        inverse = np.linalg.pinv(scale_symmetric(both[d:, d:], scale), 1e-9, hermitian=True)
        shared = float((across / scale) @ inverse @ (across / scale))
        return size / one.variance, min(shared / max(size, 1e-300), 1.0)

    def p_beside(self, one: Added, other: Candidate) -> float:
        """`p_value` of an effect where another, with its doubts free, is there as well."""
        fields = [self.library.fields(other), self.library.fields(one.candidate)[: len(one.value)]]
        columns = np.concatenate(fields)
        settings = self.settings_of(columns, columns.T)
        least = []
        for count in (len(fields[0]), len(columns)):
            index = np.arange(count)[None]
            none = np.zeros((len(settings.ratios), 1, count))
            gain = settings.solve(index, settings.blocks(index), none)[2][:, 0]
            rest = np.maximum(settings.total - gain, 1e-300)
            least.append(float((self.dof * np.log(rest) + settings.logs).min()))
        return self.p_value(replace(one, gain=max(least[0] - least[1], 0.0)))

    def beside(self, aside: Aside) -> Bench:
        """The bench for candidates that are not stored, instead of those that are."""
        return replace(self, settings=self.settings_of(aside.clear, aside.raw))

    def settings_of(self, clear: Array, raw: Array) -> Settings:
        """The settings for columns that are not stored.  clear: (d, N), raw: (N, d), as `Aside`."""
        weights = self.fixed.weights
        part, pull = self.fixed.projected(clear)
        return replace(
            self.settings,
            part=part,
            pull=pull,
            whole=(weights @ raw**2),
            own=lambda index: np.moveaxis(within(clear[index], weights), -1, 0),
        )


@dataclass(frozen=True, eq=False)
class Fixed:
    """What is projected out, in rows, for columns that are stored nowhere.

    products, index: geometry's columns and some of the candidates' (q,).  factors: (s, f, f) lower
    triangles of the rows' products.  weights: (s, N).  before: (s, f) as in `Settings`.
    error: (N,).
    """

    products: Products
    index: Array
    factors: Array
    weights: Array
    before: Array
    error: Array
    lefts: dict[int, Array] = field(default_factory=dict)

    def left(self, at: int) -> Array:
        """(N,) the error at one of the ratios, projected, its rows of the same variance."""
        if at not in self.lefts:
            self.lefts[at] = self.white(self.error[None], at)[0]
        return self.lefts[at]

    @property
    def rows(self) -> Array:
        """(f, N)."""
        return self.products.beside_geometry(self.index)

    def gram(self, columns: Array, at: int) -> Array:
        """(d, d) products of columns (d, N), projected, at one of the ratios."""
        own = columns * self.weights[at]
        part = solve_triangular(self.factors[at], self.rows @ own.T, lower=True)
        return np.asarray(own @ columns.T - part.T @ part)

    def white(self, columns: Array, at: int) -> Array:
        """Columns (d, N), projected, their rows of the same variance."""
        factor = self.factors[at]
        part = solve_triangular(factor, self.rows @ (columns * self.weights[at]).T, lower=True)
        value = solve_triangular(factor, part, lower=True, trans="T")
        return np.asarray((columns - value.T @ self.rows) * np.sqrt(self.weights[at]))

    def projected(self, columns: Array) -> tuple[Array, Array]:
        """Coordinates (s, d, f) of columns (d, N) in the span; (s, d) products with the error."""
        s, d = len(self.weights), len(columns)
        part, pull = np.empty((s, d, len(self.rows))), np.empty((s, d))
        for i, (factor, weight) in enumerate(zip(self.factors, self.weights, strict=True)):
            weighed = columns * weight
            shared = self.rows @ weighed.T
            part[i] = solve_triangular(factor, shared, lower=True, check_finite=False).T
            pull[i] = weighed @ self.error
        return part, pull - (part @ self.before[..., None])[..., 0]


def bench(lib: Library, chosen: Sequence[Candidate], fits: Sequence[Added] = ()) -> Bench:
    """The place to compare further candidates beside those chosen.

    fits: values of the chosen, where their doubts matter.
    """
    products, rows = lib.products, lib.rows
    main, loose, ridge = columns_of(chosen, fits)
    noise, dof = products.noise(main), products.dof(main)
    ratios = products.ratios_below(noise)
    index = np.concatenate([main, loose])
    at = products.at(ratios, index)
    # Products of the chosen and of their doubts, which come last, with the doubts' priors.
    each = range(len(index))
    gram = at.lines[:, :, index].copy()
    gram[:, each, each] = regularised(gram[:, each, each], at.whole[:, index])
    gram[:, each, each] += np.pad(ridge * noise.variance, (len(main), 0))
    factor = triangles(gram)
    both = np.concatenate([at.pull[..., None], at.lines], axis=2)
    part = np.stack([
        solve_triangular(lower, lines, lower=True, check_finite=False).T
        for lower, lines in zip(factor, both, strict=True)
    ]) if len(index) else np.zeros((len(ratios), both.shape[2], 0))  # fmt: skip
    before, part = part[:, 0], part[:, 1:]
    total = np.maximum(at.error[:, 0] - (before**2).sum(axis=1), ROUNDING * at.square + 1e-300)
    size = np.einsum("sff->sf", factor)[:, : len(main)]
    spread = np.log1p(ratios[:, None] * rows.variance_ratio[products.kept]).sum(axis=1)
    settings = Settings(
        ratios=ratios,
        part=part,
        before=before,
        pull=at.error[:, 1:] - (part @ before[..., None])[..., 0],
        total=total,
        whole=at.whole,
        logs=spread + at.logs + 2.0 * np.log(size).sum(axis=1),
        own=at.among,
    )
    r = at.factor.shape[1]  # of geometry, whose triangles stand above those of the chosen
    whole = np.zeros((len(ratios), r + len(index), r + len(index)))
    whole[:, :r, :r], whole[:, r:, r:] = at.factor, factor
    whole[:, r:, :r] = np.swapaxes(at.part[:, :, 1:], 1, 2)
    held = Fixed(
        products,
        index,
        whole,
        products.kept / (1.0 + np.outer(ratios, rows.variance_ratio)),
        np.concatenate([at.part[:, :, 0], before], axis=1),
        rows.error,
    )
    return Bench(lib, tuple(chosen), noise, settings, held, dof, float(lib.laws))


def normal_equations(
    lib: Library, fits: Sequence[Added], noise: Noise
) -> tuple[Array, Array, Array]:
    """Products (q, q) of the columns of effects and their doubts, (q,) with the error; their units.

    fits: the effects; their values are the sizes of their doubts.
    """
    main, loose, ridge = columns_of([one.candidate for one in fits], fits)
    index = np.concatenate([main, loose])
    (whole,), _ = lib.products.gram(np.array([noise.ratio]), index)
    gram, pull = whole[:-1, :-1], whole[:-1, -1]
    gram = gram + np.diag(np.pad(ridge * noise.variance, (len(main), 0)))
    scale = column_scales(gram)
    return scale_symmetric(gram, scale), pull / scale, scale


def against_signs(lib: Library, fits: Sequence[Added], noise: Noise) -> float:
    """By how much -2 log likelihood rises where no parameter has a sign that no body has."""
    if not any(one.candidate.upward.any() for one in fits):
        return 0.0
    gram, pull, _ = normal_equations(lib, fits, noise)
    free = bounded(gram, pull, *np.full((2, len(pull)), [[-np.inf], [np.inf]]))
    off = with_signs(gram, pull, fits) - free
    return float(off @ gram @ off) / max(noise.variance, 1e-300)


def with_signs(gram: Array, pull: Array, fits: Sequence[Added]) -> Array:
    """(q,) least squares in which no parameter has a sign that no body has."""
    low, high = np.full((2, len(pull)), [[-np.inf], [np.inf]])
    upward = np.concatenate([one.candidate.upward for one in fits])
    low[: len(upward)][upward] = 0.0
    return bounded(gram, pull, low, high)


def together(
    lib: Library, fits: Sequence[Added], noise: Noise, *, free: bool = False
) -> tuple[tuple[Array, Array], ...]:
    """Values and sigmas (d,) of the parameters of effects, estimated together.

    No value has a sign that no body has, unless it is free; sigmas are those of free values.
    fits: the effects; their values are the sizes of their doubts.
    """
    if not fits:
        return ()
    gram, pull, scale = normal_equations(lib, fits, noise)
    inverse = np.linalg.pinv(gram, 1e-12, hermitian=True)
    signed = not free and any(one.candidate.upward.any() for one in fits)
    value = (with_signs(gram, pull, fits) if signed else inverse @ pull) / scale
    sigma = np.sqrt(np.maximum(np.diag(inverse), 0.0) * noise.variance) / scale
    cuts = np.cumsum([len(one.candidate.main) for one in fits])
    return tuple(zip(np.split(value, cuts)[:-1], np.split(sigma, cuts)[:-1], strict=True))


def credible(lib: Library, fits: Sequence[Added], noise: Noise) -> bool:
    """Whether what the laws of effects must differ by, to explain most, is what they may."""
    main, _, ridge = columns_of([one.candidate for one in fits], fits)
    if not len(ridge):
        return True
    gram, pull, scale = normal_equations(lib, fits, noise)
    value = np.linalg.pinv(gram, 1e-12, hermitian=True) @ pull / scale
    return bool((value[len(main) :] ** 2 * ridge < CREDIBLE**2).all())


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
