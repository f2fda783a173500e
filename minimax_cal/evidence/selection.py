"""Which effects explain what geometry leaves: tests, selection, rivals.

A candidate is judged by how much it raises the likelihood when it is added to the geometry and to
the effects already chosen, the ratio of joint noise to instrument noise being estimated anew each
time: an effect that is left out looks like noise of the joints, and would hide behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import stats

from minimax_cal.evidence.noise import Noise, Rows, restricted
from minimax_cal.evidence.periodogram import strongest_lines
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term

LEVEL = 0.005  # chance of any false name on data without an effect
FAINT = 1e-5  # share of a field that must remain after projection for it to be tested
EXACT = 1e-8  # noise below which data were computed, not measured [m]
TIE = 2.0  # of evidence that a replacement must gain
SMALL, PLENTY = 0.02, 2000.0  # of degrees of freedom beyond so many: less gain is no matter
REFINED = 6  # effects among which each is compared anew with all others
NEAR, CONTENDERS = 20.0, 3  # candidates within so much evidence, at most so many, are tuned
TUNINGS = 3  # rounds of a finer search
SHRINK = np.array([1.0, 0.4, 0.12, 0.03, 0.0])  # of the ratio, when one is added


@dataclass(frozen=True, eq=False)
class Candidate:
    """A term with its columns in the matrix of all candidates.

    main: (d,) columns.  doubt: (r,) further columns, one sigma each per unit of main[owner].
    tries: how many variants like this one were looked at to find it.
    """

    term: Term
    main: Array
    doubt: Array
    owner: Array
    tries: float = 1.0

    @property
    def key(self) -> tuple[str, str]:
        """Effect and place."""
        return self.term.effect, self.term.place


@dataclass(frozen=True, eq=False)
class Library:
    """All candidates that these data can test.

    columns: (N, D) their fields as rows.  untestable: effect and what the data lack.
    """

    scene: Scene
    rows: Rows
    columns: Array
    candidates: tuple[Candidate, ...]
    untestable: tuple[tuple[str, str], ...] = ()

    def with_terms(self, terms: Sequence[tuple[Term, float]]) -> tuple[Library, list[Candidate]]:
        """The library with further columns, and their candidates.  terms: with their tries."""
        stack = Stack(self.scene, self.rows, self.columns.shape[1])
        found = [stack.add(term, tries) for term, tries in terms]
        columns = np.concatenate([self.columns, *stack.blocks], axis=1)
        return replace(self, columns=columns), [c for c in found if c is not None]


class Stack:
    """Columns as they are gathered, each stored once."""

    def __init__(self, scene: Scene, rows: Rows, count: int = 0) -> None:
        self.scene, self.rows, self.count = scene, rows, count
        self.blocks: list[Array] = [np.zeros((len(rows.error), 0))]
        self.seen: dict[bytes, int] = {}

    def place(self, fields: Array) -> Array:
        """Indices of the columns of fields (d, k, 3, m)."""
        out = []
        for column in self.rows.of(fields).T:
            mark = np.float32(column[:: max(1, len(column) // 64)]).tobytes()
            if mark not in self.seen:
                self.seen[mark] = self.count
                self.blocks.append(column[:, None])
                self.count += 1
            out.append(self.seen[mark])
        return np.array(out, dtype=int)

    def add(self, term: Term, tries: float = 1.0) -> Candidate | None:
        """One candidate; None if nothing of it moves a point."""
        columns = term.columns(self.scene)
        fields = columns.displacement(self.scene)
        if not np.any(fields):
            return None
        doubts, owners = [np.zeros((0, *fields.shape[1:]))], []
        for number, doubt in columns.doubts(self.scene):
            doubts.append(doubt)
            owners += [number] * len(doubt)
        main, doubt = self.place(fields), self.place(np.concatenate(doubts))
        return Candidate(term, main, doubt, np.array(owners, dtype=int), tries)


def library(scene: Scene, rows: Rows, exclude: Sequence[str] = ()) -> Library:
    """Every effect at every place in every variant that the data can test."""
    stack = Stack(scene, rows)
    found: list[Candidate | None] = []
    untestable = []
    for name, effect in EFFECTS.items():
        if name in exclude:
            continue
        if missing := effect.needs(scene):
            untestable.append((name, missing))
            continue
        places = effect.places(scene)
        for place in places:
            found += [stack.add(Term(name, place, c)) for c in effect.choices(scene, place)]
        if not places:
            untestable.append((name, "poses or joints at which it would show"))
    candidates = [c for c in found if c is not None]
    columns = np.concatenate(stack.blocks, axis=1)
    whole = np.linalg.norm(columns, axis=0) ** 2
    left = whole - ((rows.basis.T @ columns) ** 2).sum(axis=0)
    clear = left > FAINT * whole
    shown = tuple(c for c in candidates if clear[c.main].all())
    gone = {c.term.effect for c in candidates} - {c.term.effect for c in shown}
    untestable += [(name, "poses at which geometry does not imitate it") for name in sorted(gone)]
    return Library(scene, rows, columns, shown, tuple(untestable))


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
class Setting:
    """Weighted rows at one ratio of the noises, geometry and chosen effects projected out.

    columns: (N, D).  part: (p, D) their coordinates in what is projected out.  error: (N,).
    logs: log determinants of the covariance and of the fixed effects.  whole: (D,) squares.
    """

    ratio: float
    columns: Array
    part: Array
    error: Array
    logs: float
    whole: Array

    @cached_property
    def total(self) -> float:
        """Square of the error."""
        return float(self.error @ self.error)

    @cached_property
    def pull(self) -> Array:
        """(D,) products with the error."""
        return np.asarray(self.error @ self.columns)

    def gram(self, index: Array) -> Array:
        """(d, d) products of some columns, projected."""
        own, part = self.columns[:, index], self.part[:, index]
        return np.asarray(own.T @ own - part.T @ part)

    def blocks(self, index: Array) -> Array:
        """(c, d, d) products, projected, of c sets of columns (c, d)."""
        own = self.columns[:, index.reshape(-1)].T.reshape(*index.shape, -1)
        part = self.part[:, index.reshape(-1)].T.reshape(*index.shape, -1)
        return np.asarray(own @ np.swapaxes(own, 1, 2) - part @ np.swapaxes(part, 1, 2))

    def solve(self, index: Array, ridge: Array) -> tuple[Array, Array, Array]:
        """Values (c, d), diagonals of the inverse (c, d), and decreases of the square (c,).

        index: (c, d) columns.  ridge: (c, d).
        """
        d = index.shape[1]
        block = self.blocks(index)
        block[:, np.arange(d), np.arange(d)] += ridge
        pull = self.pull[index]
        diagonal = np.einsum("cdd->cd", block)
        alive = diagonal > 1e-7 * self.whole[index]
        if d == 1:
            inverse = np.where(alive, 1.0 / np.where(alive, diagonal, 1.0), 0.0)
            return inverse * pull, inverse, (inverse * pull * pull)[:, 0]
        scale = np.where(alive, 1.0 / np.sqrt(np.where(alive, diagonal, 1.0)), 0.0)
        values, vectors = np.linalg.eigh(block * scale[:, :, None] * scale[:, None, :])
        kept = np.where(values > 1e-9, 1.0 / np.where(values > 1e-9, values, 1.0), 0.0)
        basis = vectors * scale[:, :, None]
        inverse = (basis * kept[:, None, :]) @ np.swapaxes(basis, 1, 2)
        value = (inverse @ pull[..., None])[..., 0]
        return value, np.einsum("cdd->cd", inverse), (value * pull).sum(axis=1)

    def added_all(self, same: Sequence[Candidate], dof: int) -> tuple[Array, Array, Array, Array]:
        """Decrease of the square by each candidate; values, their variances; Occam's factor.

        Doubts have the prior that the values found imply.  same: of equal numbers of columns.
        """
        index = np.array([c.main for c in same])
        d = index.shape[1]
        value, inverse, gain = self.solve(index, np.zeros(index.shape))
        if not len(same[0].doubt):
            return gain, value, inverse, np.zeros(len(same))
        variance = np.maximum(self.total - gain, 1e-300)[:, None] / dof
        doubt = np.array([c.doubt for c in same])
        owner = np.array([c.owner for c in same])
        size = np.maximum(np.abs(np.take_along_axis(value, owner, axis=1)), 1e-30)
        ridge = np.concatenate([np.zeros(index.shape), variance / size**2], axis=1)
        value, inverse, gain = self.solve(np.concatenate([index, doubt], axis=1), ridge)
        loose = self.blocks(doubt) * size[:, :, None] * size[:, None, :] / variance[..., None]
        volume = np.linalg.slogdet(np.eye(doubt.shape[1]) + loose)[1]
        return gain, value[:, :d], inverse[:, :d], volume

    def likeness(self, one: Added, other: Candidate) -> tuple[float, float]:
        """lambda of an effect found, and rho^2: the share of its motion that another imitates."""
        main, rival = one.candidate.main, np.concatenate([other.main, other.doubt])
        both = self.gram(np.concatenate([main, rival]))
        d = len(main)
        size = float(one.value @ both[:d, :d] @ one.value)
        across = one.value @ both[:d, d:]
        scale = np.sqrt(np.maximum(np.diag(both)[d:], 1e-300))
        inverse = np.linalg.pinv(both[d:, d:] / np.outer(scale, scale), 1e-9, hermitian=True)
        shared = float((across / scale) @ inverse @ (across / scale))
        return size / one.variance, min(shared / max(size, 1e-300), 1.0)


@dataclass(frozen=True, eq=False)
class Bench:
    """Where candidates are compared: beside what was chosen, over several ratios of the noises.

    tries: candidates that are compared, for the chance of a false name.  dof: degrees of freedom.
    """

    library: Library
    chosen: tuple[Candidate, ...]
    noise: Noise
    settings: tuple[Setting, ...]
    dof: int
    tries: float

    @cached_property
    def base(self) -> float:
        """-2 log restricted likelihood without a further effect."""
        return float(min(self.dof * np.log(s.total) + s.logs for s in self.settings))

    @cached_property
    def everyone(self) -> list[Added]:
        """Every candidate of the library, the best first."""
        return self.ranked(self.library.candidates)

    def added(self, c: Candidate) -> Added:
        """A candidate beside what was chosen, at its best ratio."""
        return self.compared([c])[0]

    def setting(self, one: Added) -> Setting:
        """The rows at the ratio at which a candidate fits best."""
        return next(s for s in self.settings if s.ratio == one.ratio)

    def ranked(self, among: Sequence[Candidate]) -> list[Added]:
        """Candidates by evidence."""
        kinds: dict[tuple[int, int], list[Candidate]] = {}
        for c in among:
            kinds.setdefault((len(c.main), len(c.doubt)), []).append(c)
        found = [one for same in kinds.values() for one in self.compared(same)]
        return sorted(found, key=lambda one: -one.evidence)

    def compared(self, same: list[Candidate]) -> list[Added]:
        """Candidates with the same numbers of columns and doubts, all at once."""
        best = np.full(len(same), np.inf)
        out: list[Added | None] = [None] * len(same)
        for s in self.settings:
            gain, value, inverse, volume = s.added_all(same, self.dof)
            rest = np.maximum(s.total - gain, 1e-300)
            cost = self.dof * np.log(rest) + s.logs
            for i in np.flatnonzero(cost < best):
                best[i] = cost[i]
                c, variance = same[i], float(rest[i] / self.dof)
                up = max(self.base - float(cost[i]), 0.0)
                sigma = np.sqrt(np.maximum(inverse[i] * variance, 0.0))
                penalty = occam(c, up) + prior_penalty(c, value[i], sigma)
                worth = up - float(volume[i]) - penalty
                out[i] = Added(c, up, worth, s.ratio, variance, value[i], sigma)
        return [one for one in out if one is not None]

    def p_value(self, one: Added) -> float:
        """Probability that a candidate without effect gains so much, the best of all tries."""
        d = len(one.candidate.main)
        free = max(self.dof - d, 1)
        ratio = np.expm1(min(one.gain / self.dof, 50.0)) * free / d
        return float(min(1.0, stats.f.sf(ratio, d, free) * self.tries * one.candidate.tries))


def occam(c: Candidate, gain: float) -> float:
    """What d free parameters must gain to be worth it: d (1 + log of the gain of each)."""
    d = len(c.main)
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
    rows = lib.rows
    main, loose, ridge = columns_of(chosen, fits)
    noise = restricted(rows, lib.columns[:, main])
    fixed = np.concatenate([rows.basis, lib.columns[:, main]], axis=1)
    doubt = lib.columns[:, loose]
    dof = rows.count - fixed.shape[1]
    ratios = noise.ratio * SHRINK if noise.ratio > 0.0 else np.zeros(1)
    settings = []
    for ratio in ratios:
        spread = 1.0 + ratio * rows.variance_ratio
        root = 1.0 / np.sqrt(spread)
        matrix = np.concatenate([fixed, doubt], axis=1) * root[:, None]
        error, columns = rows.error * root, lib.columns * root[:, None]
        if len(loose):  # a prior is some more rows
            pad = np.zeros((len(loose), matrix.shape[1]))
            pad[:, fixed.shape[1] :] = np.diag(np.sqrt(ridge * noise.variance))
            matrix = np.concatenate([matrix, pad])
            error = np.concatenate([error, np.zeros(len(loose))])
            columns = np.concatenate([columns, np.zeros((len(loose), columns.shape[1]))])
        basis, triangle = np.linalg.qr(matrix)
        error = error - basis @ (basis.T @ error)
        size = np.abs(np.diag(triangle)[: fixed.shape[1]])
        logs = np.log(spread).sum() + 2.0 * np.log(np.maximum(size, 1e-300)).sum()
        whole = (columns**2).sum(axis=0)
        settings.append(
            Setting(float(ratio), columns, basis.T @ columns, error, float(logs), whole)
        )
    return Bench(lib, tuple(chosen), noise, tuple(settings), dof, float(len(lib.candidates)))


def columns_of(chosen: Sequence[Candidate], fits: Sequence[Added]) -> tuple[Array, Array, Array]:
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


@dataclass(frozen=True, eq=False)
class Choice:
    """The effects selected.

    library: with all columns that were tried.  fits: of each, the others given.
    benches: of each, for its rivals.  noise: with all of them.
    """

    library: Library
    fits: tuple[Added, ...]
    benches: tuple[Bench, ...]
    noise: Noise

    @property
    def chosen(self) -> tuple[Candidate, ...]:
        """The candidates."""
        return tuple(one.candidate for one in self.fits)

    @property
    def known(self) -> Array:
        """(N, q) their columns."""
        return self.library.columns[:, columns_of(self.chosen, ())[0]]


def select(lib: Library, most: int = 20, *, ripple: bool = True) -> Choice:
    """Forward selection behind a Bonferroni gate, with replacement, dropping and noise updates.

    ripple: whether to look for lines of gears besides.
    """
    fits: list[Added] = []
    noise = restricted(lib.rows, known_columns(lib, fits))
    if noise.variance < EXACT**2:
        return Choice(lib, (), (), noise)
    tables: dict[tuple[int, ...], Bench] = {}
    for _ in range(most):
        if ripple:
            found = strongest_lines(lib.scene, lib.rows, noise, known_columns(lib, fits))
            lib, extra = lib.with_terms(found)
            lib = replace(lib, candidates=(*plain(lib), *extra))
        table = bench(lib, [one.candidate for one in fits], fits)
        tables[tuple(id(c) for c in table.chosen)] = table
        lib, best = addition(lib, table, fits)
        if not best:
            break
        fits = refined(lib, [*fits, *best])
        noise = restricted(lib.rows, known_columns(lib, fits))
    benches = []
    for i, one in enumerate(fits):
        chosen, others = without(fits, i)
        table = tables.get(tuple(map(id, chosen))) or bench(lib, chosen, others)
        if max(one.candidate.main) >= table.settings[0].columns.shape[1]:  # tuned since
            table = bench(lib, chosen, others)
        benches.append(table)
    final = tuple(b.added(one.candidate) for b, one in zip(benches, fits, strict=True))
    return Choice(lib, final, tuple(benches), noise)


def plain(lib: Library) -> tuple[Candidate, ...]:
    """The candidates without lines that were found: those of an earlier round."""
    return tuple(c for c in lib.candidates if c.tries == 1.0)


def known_columns(lib: Library, fits: Sequence[Added]) -> Array:
    """(N, q) columns of what was chosen."""
    return lib.columns[:, columns_of([one.candidate for one in fits], ())[0]]


def without(fits: Sequence[Added], number: int) -> tuple[list[Candidate], list[Added]]:
    """All but one of the chosen, as `bench` wants them."""
    others = [one for i, one in enumerate(fits) if i != number]
    return [one.candidate for one in others], others


def repeated(c: Candidate, chosen: Sequence[Candidate]) -> bool:
    """Whether an effect is at a place already; lines may be many."""
    same = [other for other in chosen if other.key == c.key]
    return any(c.tries == 1.0 or other is c for other in same)


def addition(lib: Library, table: Bench, fits: Sequence[Added]) -> tuple[Library, list[Added]]:
    """The candidate that adds most evidence and passes the gate; none if none does.

    The best few are tuned before they are compared.
    """
    ranked = [one for one in table.everyone if one.evidence > 0.0]
    open_ones = [
        one for one in ranked
        if not repeated(one.candidate, table.chosen)
        and table.p_value(one) < LEVEL
        and one.gain > SMALL * (table.dof - PLENTY)
    ]  # fmt: skip
    if not open_ones:
        return lib, []
    best = open_ones[0]
    seen: set[tuple[str, str]] = set()
    for one in open_ones:
        close = one.evidence > open_ones[0].evidence - max(NEAR, 0.2 * open_ones[0].gain)
        if close and one.candidate.key not in seen and len(seen) < CONTENDERS:
            seen.add(one.candidate.key)
            better = tuned(lib, fits, one)
            lib, better = adopted(lib, better, one.candidate)
            best = better if better.evidence > best.evidence or one is best else best
    return lib, [best]


def tuned(lib: Library, fits: Sequence[Added], best: Added) -> Added:
    """A candidate with what its law has chosen (a moment, a time constant) searched more finely.

    The candidate returned belongs to no library yet: `adopted` gives it a place.
    """
    for _ in range(TUNINGS):
        term = best.candidate.term
        near = EFFECTS[term.effect].finer(lib.scene, term.choice)
        if not near:
            break
        few, chosen = narrow(lib, [one.candidate for one in fits])
        values = [replace(one, candidate=c) for one, c in zip(fits, chosen, strict=True)]
        few, among = few.with_terms([(replace(term, choice=choice), 1.0) for choice in near])
        top = bench(few, chosen, values).ranked(among)[0]
        if top.evidence <= best.evidence:
            break
        best = top
    return best


def adopted(lib: Library, one: Added, instead: Candidate) -> tuple[Library, Added]:
    """The library with a tuned candidate in the place of the one it came from."""
    if one.candidate is instead:
        return lib, one
    wider, found = lib.with_terms([(one.candidate.term, instead.tries)])
    kept = [found[0] if c is instead else c for c in lib.candidates]
    return replace(wider, candidates=tuple(kept)), replace(one, candidate=found[0])


def narrow(lib: Library, among: Sequence[Candidate]) -> tuple[Library, list[Candidate]]:
    """A library of some candidates only, and these with their columns there."""
    at, parts, out = 0, [np.zeros((len(lib.rows.error), 0))], []
    for c in among:
        parts += [lib.columns[:, c.main], lib.columns[:, c.doubt]]
        d, r = len(c.main), len(c.doubt)
        out.append(replace(c, main=np.arange(at, at + d), doubt=np.arange(at + d, at + d + r)))
        at += d + r
    return replace(lib, columns=np.concatenate(parts, axis=1), candidates=tuple(out)), out


def refined(lib: Library, fits: list[Added]) -> list[Added]:
    """Replace each effect by any that does better, and drop what is no longer needed."""
    if len(fits) == 1:
        return fits
    for _ in range(3):
        changed = False
        for number in range(
            min(len(fits) - 1, REFINED)
        ):  # the last one was just chosen beside the others
            chosen, others = without(fits, number)
            table = bench(lib, chosen, others)
            own = table.added(fits[number].candidate)
            top = next(o for o in table.everyone if not repeated(o.candidate, chosen))
            if top.candidate is not own.candidate and top.evidence > own.evidence + TIE:
                fits[number], changed = top, True
            elif table.p_value(own) > LEVEL:
                fits = others
                return refined(lib, fits)
            else:
                fits[number] = own
        if not changed:
            break
    return fits


def best_variant(scene: Scene, rows: Rows, chosen: Sequence[Term], several: Sequence[Term]) -> Term:
    """The variant of a law that explains most beside the effects chosen before."""
    empty = Library(scene, rows, np.zeros((len(rows.error), 0)), ())
    lib, before = empty.with_terms([(term, 1.0) for term in chosen])
    lib, among = lib.with_terms([(term, 1.0) for term in several])
    if not among:
        return several[0]
    table = bench(replace(lib, candidates=tuple(among)), before)
    fits = [Added(c, 0.0, 0.0, 0.0, 0.0, np.zeros(0), np.zeros(0)) for c in before]
    return tuned(lib, fits, table.everyone[0]).candidate.term
