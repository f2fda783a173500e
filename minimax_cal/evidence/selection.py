"""Which effects explain what geometry leaves: they are selected by evidence, one after another.

A candidate is judged by how much it raises the likelihood when it is added to the geometry and to
the effects already chosen, the ratio of joint noise to instrument noise being estimated anew each
time: an effect that is left out looks like noise of the joints, and would hide behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from minimax_cal.evidence.bench import (
    Added,
    Bench,
    against_signs,
    bench,
    columns_of,
    credible,
    together,
)
from minimax_cal.evidence.library import Candidate, Dictionary, Library
from minimax_cal.evidence.limits import (
    CONTENDERS,
    LEAST_DOF,
    LEAST_NOISE_DOF,
    LEVEL,
    MOST,
    NEAR,
    NEAR_SHARE,
    REFINED,
    SELDOM,
    TIE,
    TUNINGS,
)
from minimax_cal.evidence.noise import Noise
from minimax_cal.evidence.products import Products
from minimax_cal.evidence.sweeping import Grams
from minimax_cal.ground.arrays import Array

NOTHING: Array = np.zeros(0, dtype=int)


@dataclass(frozen=True, eq=False)
class Choice:
    """The effects selected.

    library: with all columns that were tried.  found: the effects, as each was when it was chosen.
    noise: with all of them.
    """

    library: Library
    found: tuple[Added, ...]
    noise: Noise

    @property
    def chosen(self) -> tuple[Candidate, ...]:
        """The candidates."""
        return tuple(one.candidate for one in self.found)

    def beside_others(self, number: int) -> tuple[Bench, Added]:
        """Where an effect is compared with its rivals, beside the others, and the effect there.

        Of no effect it is held here: those of all would fill the memory.
        """
        table = bench(self.library, *without(self.found, number))
        return table, table.added(self.found[number].candidate)

    @cached_property
    def estimates(self) -> tuple[tuple[Array, Array], ...]:
        """Values and sigmas (d,) of the parameters of each effect, all estimated together."""
        return together(self.library, self.found, self.noise)

    @cached_property
    def grams(self) -> Grams:
        """What the searches of parts of the rows start from."""
        products = self.library.products
        return Grams(products.columns, [products.noise(NOTHING), self.noise])

    def part(self, kept: Array) -> Library:
        """What a part of the rows may choose from, all that this search tuned; kept: (N,)."""
        lib = self.library
        lines = [c for c in lib.found.values() if c.is_line and c not in lib.candidates]
        return replace(lib, candidates=(*lib.candidates, *lines)).part(self.grams, kept)

    def portable(self) -> Choice:
        """For parts of the rows in another process: without what is worked out again from it."""
        plain = Products(self.library.products.columns)
        out = replace(self, library=replace(self.library, products=plain, lines=None))
        out.__dict__["grams"] = self.grams
        return out

    @property
    def known(self) -> Array:
        """(N, q) their columns."""
        return self.library.columns[:, columns_of(self.chosen)[0]]

    @property
    def doubted(self) -> Array:
        """(N, q + r) their columns, and those by which their laws may differ, if that is enough.

        r = 0 where the laws would have to differ by more than anybody doubts.
        """
        if not credible(self.library, self.found, self.noise):
            return self.known
        main, loose, _ = columns_of(self.chosen, self.found)
        return self.library.columns[:, np.concatenate([main, loose])]


def select(
    lib: Library,
    *,
    level: float = LEVEL,
    first: Sequence[Added] = (),
) -> Choice:
    """Forward selection behind a Bonferroni gate, with replacement, dropping and noise updates.

    lib: of all rows, or of some, as `Choice.part` gives it: no other is looked at, nothing is
    tuned, and replacement waits for the end.  level: chance of a false name on data without an
    effect.  first: what was chosen with other weights.
    """
    # Start from the effects selected with other weights, if any.
    fits: list[Added] = []
    known = {c.text: c for c in lib.candidates}
    for one in first:
        c = one.candidate
        mine = known.get(c.text) or next(iter(lib.with_terms([(c.term, c.tries)])), None)
        if mine is None:
            continue
        if c.text not in known:
            lib = replace(lib, candidates=(*lib.candidates, mine))
        fits.append(replace(one, candidate=mine))
    noise = noise_beside(lib, fits)
    if noise.variance < lib.rows.exact**2 or lib.products.dof(NOTHING) < LEAST_DOF:
        return Choice(lib, (), noise)
    if fits:
        lib, fits = refine_effects(lib, fits, level, last=True)
        noise = noise_beside(lib, fits)

    # Forward steps: lines sought again in what remains, the best addition, replacement, the noise.
    for _ in range(MOST):
        if not lib.is_part:
            fitted = lib.columns[:, columns_of([one.candidate for one in fits])[0]]
            heard = [one.candidate.term for one in fits if one.candidate.is_line]
            found = lib.dictionary.lines(noise, fitted, heard)
            no_lines = tuple(c for c in lib.candidates if not c.is_line)  # of an earlier step
            lib = replace(lib, candidates=no_lines, lines=lib.aside(found) if found else None)
        table = bench(lib, [one.candidate for one in fits], fits)
        if table.dof < LEAST_DOF:
            break
        lib, best = find_best_addition(lib, table, fits, level)
        if not best:
            break
        fits = [*fits, *best]
        if not lib.is_part and (len(fits) <= REFINED or len(fits) % SELDOM == 0):
            lib, fits = refine_effects(lib, fits, level)
        noise = noise_beside(lib, fits)
    if len(fits) > REFINED or lib.is_part:
        lib, fits = refine_effects(lib, fits, level)
    return Choice(lib, tuple(fits), noise_beside(lib, fits))


def noise_beside(lib: Library, fits: Sequence[Added]) -> Noise:
    """The noise beside what was chosen."""
    return lib.products.noise(columns_of([one.candidate for one in fits])[0])


def without(fits: Sequence[Added], number: int) -> tuple[list[Candidate], list[Added]]:
    """All but one of the chosen, as `bench` wants them."""
    others = [one for i, one in enumerate(fits) if i != number]
    return [one.candidate for one in others], others


def is_taken(c: Candidate, chosen: Sequence[Candidate]) -> bool:
    """Whether an effect is at a place already; lines of one cause may be several."""
    same = [other for other in chosen if other.key == c.key]
    return any(not c.repeats or other.text == c.text for other in same)


def find_best_addition(
    lib: Library, table: Bench, fits: Sequence[Added], level: float
) -> tuple[Library, list[Added]]:
    """The candidate that adds most evidence and is significant; none if none is.

    fits: the effects that were chosen.
    """
    best: Added | None = None
    least = against_signs(lib, fits, table.noise)
    seen: set[tuple[str, str]] = set()
    room = table.dof - LEAST_NOISE_DOF  # parameters that rows can still tell
    for one in table.everyone:
        # In the order of evidence; with tuning an inferior one may still overtake the best.
        if one.evidence <= 0.0 or len(one.candidate.main) > room:
            continue
        reach = max(NEAR, NEAR_SHARE * best.gain) if best and not lib.is_part else 0.0
        if best and one.evidence < best.evidence - reach:
            break
        if one.candidate.key in seen or is_taken(one.candidate, table.chosen):
            continue
        if table.improbable(one, level):
            # Tuned, on all rows; the library takes the tuned candidate in place of the first.
            seen.add(one.candidate.key)
            better = one if lib.is_part else tuned(table, one)
            if better.candidate is not one.candidate:
                new = lib.with_terms([(better.candidate.term, one.candidate.tries)])[0]
                kept = tuple(new if c is one.candidate else c for c in lib.candidates)
                lib, better = replace(lib, candidates=kept), replace(better, candidate=new)
            # Less what it owes to signs that are physically impossible, its own or others'.
            if lib.lines is None or not lib.lines.holds(better.candidate):
                owed = max(against_signs(lib, [*fits, better], table.noise) - least, 0.0)
                gain = max(better.gain - owed, 0.0)
                better = replace(better, gain=gain, evidence=better.evidence - owed)
            if better.evidence > 0.0 and table.p_value(better) < level:
                best = better if not best or better.evidence > best.evidence else best
        if len(seen) == CONTENDERS:
            break
    if not best:
        return lib, []
    lib, stored = lib.stored(best.candidate)
    return lib, [replace(best, candidate=stored)]


def tuned(table: Bench, best: Added) -> Added:
    """A candidate with what its law has chosen (a moment, a time constant) searched more finely.

    The candidate returned belongs to no library yet.
    """
    for _ in range(TUNINGS):
        near = table.library.dictionary.finer(best.candidate.term)
        if not near:
            break
        aside = table.library.aside([(term, 1.0) for term in near])
        ranked = table.beside(aside).ranked(aside.candidates)
        if not ranked or ranked[0].evidence <= best.evidence:
            break
        best = ranked[0]
    return best


def tuned_again(choice: Choice) -> Choice:
    """The choice of a part of the rows, each effect tuned by these alone, and stored nowhere."""
    best = [tuned(*choice.beside_others(number)) for number in range(len(choice.found))]
    found = (
        replace(one, candidate=replace(one.candidate, term=other.candidate.term))
        for one, other in zip(choice.found, best, strict=True)
    )
    return replace(choice, found=tuple(found))


def refine_effects(
    lib: Library, fits: list[Added], level: float, *, last: bool = False
) -> tuple[Library, list[Added]]:
    """Replace each effect by any that does better, and drop what is no longer needed.

    last: whether the last, too, which otherwise was just chosen beside the others.
    """
    count = len(fits) - (not last)
    if count < 1:
        return lib, fits
    for _ in range(3):
        changed = False
        for number in range(min(count, REFINED)):
            chosen, others = without(fits, number)
            table = bench(lib, chosen, others)
            own = table.added(fits[number].candidate)
            top = next((o for o in table.everyone if not is_taken(o.candidate, chosen)), own)
            if top.candidate is not own.candidate and top.evidence > own.evidence + TIE:
                lib, stored = lib.stored(top.candidate)
                fits[number], changed = replace(top, candidate=stored), True
            elif table.p_value(own) > level:
                return refine_effects(lib, others, level, last=last)
            else:
                fits[number] = own
        if not changed:
            break
    return lib, fits


def best_variant(dictionary: Dictionary, chosen: Sequence[Any], several: Sequence[Any]) -> Any:
    """The variant of a law that explains most beside the laws chosen before."""
    lib = Library.empty(dictionary)
    before = lib.with_terms([(term, 1.0) for term in chosen])
    among = lib.with_terms([(term, 1.0) for term in several])
    if not among:
        return several[0]
    table = bench(replace(lib, candidates=tuple(among)), before)
    return tuned(table, table.everyone[0]).candidate.term
