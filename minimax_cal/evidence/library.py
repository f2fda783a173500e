"""All laws that data can test: candidates with the columns of a dictionary, each stored once.

A dictionary knows its domain (an arm, torques along a trajectory, what moved between two
calibrations); the engine knows only columns, priors and prices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np

from minimax_cal.evidence.noise import Noise, Problem
from minimax_cal.evidence.products import Columns, Products
from minimax_cal.evidence.sweeping import Grams, Swept
from minimax_cal.ground.arrays import Array

Key = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Spec:
    """A law at a place, with the rows it would add to the error.

    term: what the dictionary calls it.  text: its unique name; key: its family and its place.
    columns: (N, d) rows per unit of each parameter.  doubts: (N, r) by which these may differ, one
    sigma per unit of the parameter owner (r,).  nonnegative: (d,) True for parameters that are
    never below 0.  typical: the usual size of a parameter.  tuned: numbers of the law that are
    searched, and cost as parameters do.  repeats: whether one place may hold several of the family.
    """

    term: Any
    text: str
    key: Key
    columns: Array
    doubts: Array
    owner: Array
    nonnegative: Array
    typical: float
    tuned: int
    repeats: bool


class Dictionary(Protocol):
    """The laws of a domain, for one problem."""

    @property
    def problem(self) -> Problem:
        """Whose rows the columns are."""

    def spec(self, term: Any) -> Spec | None:
        """A law with its columns; None where it adds nothing to any row."""

    def finer(self, term: Any) -> Sequence[Any]:
        """The law with its tuned numbers closer together about those given; empty for none."""

    def lines(self, noise: Noise, known: Array, found: Sequence[Any]) -> list[tuple[Any, float]]:
        """Lines that what is left shows, with how many frequencies were tried for each.

        known: (N, q) columns fitted already.  found: lines chosen.
        """

    def is_expected(self, line: Any, found: Sequence[Any]) -> bool:
        """Whether a line is where the domain expects one, beside those found."""


# ---- the library ---------------------------------------------------------------------------------


GONE = 1e-8  # share of a field that poses must show
FAINT = 1e-5  # share of a field that must remain after projection for it to be tested


@dataclass(frozen=True, eq=False)
class Candidate:
    """A law with its columns in the matrix of all candidates.

    main: (d,) columns.  doubt: (r,) further columns, one sigma each per unit of main[owner].
    tries: of a line, how many frequencies were looked at, at all places, to find it and its like.
    upward: (d,) True for parameters that are never below 0.  The others as in `Spec`.
    """

    term: Any
    text: str
    key: Key
    main: Array
    doubt: Array
    owner: Array
    tries: float
    upward: Array
    typical: float
    shapes: int
    repeats: bool

    @property
    def family(self) -> str:
        """The effect, wherever it is."""
        return self.key[0]

    @property
    def is_line(self) -> bool:
        """Whether it was found by a search over frequencies."""
        return self.tries > 1.0


@dataclass(frozen=True, eq=False)
class Kind:
    """Candidates of equal numbers of columns and doubts, compared all at once.

    main: (c, d) columns; both: (c, d + r) those of doubts besides; owner: (c, r).  free: (c,)
    parameters that each is charged for; tries: (c,).  typical: (c,) size of a parameter;
    positive: (c,) whether no body has the other sign.
    """

    candidates: tuple[Candidate, ...]
    main: Array
    both: Array
    owner: Array
    free: Array
    tries: Array
    typical: Array
    positive: Array

    @staticmethod
    def of(same: Sequence[Candidate]) -> Kind:
        """Of candidates."""
        main, doubt = (np.array([getattr(c, name) for c in same]) for name in ("main", "doubt"))
        return Kind(
            tuple(same),
            main,
            np.concatenate([main, doubt], axis=1),
            np.array([c.owner for c in same]),
            np.array([len(c.main) + c.shapes for c in same]),
            np.array([c.tries for c in same]),
            np.array([c.typical for c in same]),
            np.array([len(c.upward) == 1 and c.upward.all() for c in same]),
        )


@lru_cache(maxsize=32)
def kinds(candidates: tuple[Candidate, ...]) -> tuple[Kind, ...]:
    """Candidates by their numbers of columns and doubts."""
    found: dict[tuple[int, int], list[Candidate]] = {}
    for c in candidates:
        found.setdefault((len(c.main), len(c.doubt)), []).append(c)
    return tuple(map(Kind.of, found.values()))


@dataclass(frozen=True, eq=False)
class Aside:
    """Candidates whose columns are stored nowhere: each is compared a few times only.

    raw: (N, d) their columns.  clear: (d, N) what geometry does not imitate of them.
    """

    candidates: tuple[Candidate, ...]
    raw: Array
    clear: Array

    def holds(self, c: Candidate) -> bool:
        """Whether a candidate's columns are these."""
        return any(c is one for one in self.candidates)


@dataclass(frozen=True, eq=False)
class Library:
    """All candidates that these data can test.

    products: of their columns, which all libraries of the same data share; of a part, swept: there
    nothing is tuned, and no line sought.  untestable: family and what the data lack.  found:
    candidates stored later, by their text.  lines: as the last search found them.
    """

    dictionary: Dictionary
    products: Products
    candidates: tuple[Candidate, ...]
    untestable: tuple[Key, ...] = ()
    found: dict[str, Candidate] = field(default_factory=dict)
    lines: Aside | None = None

    @staticmethod
    def empty(dictionary: Dictionary) -> Library:
        """No candidates yet."""
        return Library(dictionary, Products(Columns(dictionary.problem)), ())

    @staticmethod
    def of(dictionary: Dictionary, terms: Sequence[Any], untestable: Sequence[Key]) -> Library:
        """Of some laws, without those that the nuisance columns imitate."""
        lib = Library.empty(dictionary)
        stack = Stack(dictionary)
        candidates = tuple(c for c in map(stack.add, terms) if c is not None)
        lib.products.columns.append(stack.columns)
        return replace(lib, candidates=candidates, untestable=tuple(untestable)).shown()

    @property
    def rows(self) -> Problem:
        """The problem."""
        return self.dictionary.problem

    @cached_property
    def laws(self) -> int:
        """How many candidates were not found by a search over frequencies."""
        return sum(not c.is_line for c in self.candidates)

    @property
    def columns(self) -> Array:
        """(N, D) fields of all candidates as rows."""
        return self.products.columns.raw

    def with_terms(self, terms: Sequence[tuple[Any, float]]) -> list[Candidate]:
        """Candidates of further terms, their columns stored.  terms: with their tries."""
        stack = Stack(self.dictionary, self.products.columns.count)
        out = []
        for term, tries in terms:
            c = self.found.get(term.text) or stack.add(term, tries)
            if c is not None:
                self.found[c.text] = c
                out.append(c)
        self.products.columns.append(stack.columns)
        return out

    def aside(self, terms: Sequence[tuple[Any, float]]) -> Aside:
        """Candidates of further terms that are not stored.  terms: with their tries."""
        stack = Stack(self.dictionary)
        found = (stack.add(term, tries) for term, tries in terms)
        candidates = tuple(c for c in found if c is not None)
        return Aside(candidates, stack.columns, self.products.columns.cleared(stack.columns))

    def stored(self, c: Candidate) -> tuple[Library, Candidate]:
        """The library with a candidate among those stored, and the candidate there."""
        if self.lines is None or not self.lines.holds(c):
            return self, c
        found = self.with_terms([(c.term, c.tries)])[0]
        rest = replace(self.lines, candidates=tuple(o for o in self.lines.candidates if o is not c))
        return replace(self, candidates=(*self.candidates, found), lines=rest), found

    def fields(self, c: Candidate) -> Array:
        """(d + r, N) what geometry does not imitate of a candidate's columns and their doubts."""
        index = np.concatenate([c.main, c.doubt])
        if self.lines is not None and self.lines.holds(c):
            return np.asarray(self.lines.clear[index])
        return self.products.clear(index)

    @property
    def is_part(self) -> bool:
        """Whether some rows alone count."""
        return isinstance(self.products, Swept)

    def part(self, grams: Grams, kept: Array) -> Library:
        """The library for some of the rows alone.  kept: (N,) True for those that count."""
        return replace(self, products=Swept(grams, kept), lines=None).shown()

    def shown(self) -> Library:
        """The library without candidates that geometry imitates."""
        whole, left = self.products.shown()
        every = (self.columns**2).sum(axis=0)  # what a part shows less of is rounding
        clear = (left > FAINT * whole) & (whole > GONE * every)
        shown = tuple(c for c in self.candidates if clear[c.main].all())
        gone = {c.family for c in self.candidates} - {c.family for c in shown}
        lacking = [(name, "poses at which geometry does not imitate it") for name in sorted(gone)]
        return replace(self, candidates=shown, untestable=(*self.untestable, *lacking))


class Stack:
    """Columns as they are gathered, each stored once."""

    def __init__(self, dictionary: Dictionary, count: int = 0) -> None:
        self.dictionary, self.count = dictionary, count
        self.blocks: list[Array] = [np.zeros((len(dictionary.problem.error), 0))]
        self.seen: dict[bytes, int] = {}

    @property
    def columns(self) -> Array:
        """(N, d) all of them."""
        return np.concatenate(self.blocks, axis=1)

    def place(self, columns: Array) -> Array:
        """Indices of columns (N, d)."""
        out = []
        for column in columns.T:
            mark = np.float32(column).tobytes()
            if mark not in self.seen:
                self.seen[mark] = self.count
                self.blocks.append(column[:, None])
                self.count += 1
            out.append(self.seen[mark])
        return np.array(out, dtype=int)

    def add(self, term: Any, tries: float = 1.0) -> Candidate | None:
        """One candidate; None if it adds nothing to any row."""
        found = self.dictionary.spec(term)
        if found is None:
            return None
        columns = np.concatenate([found.columns, found.doubts], axis=1)
        main, doubt = np.split(self.place(columns), [found.columns.shape[1]])
        return Candidate(
            term=found.term,
            text=found.text,
            key=found.key,
            main=main,
            doubt=doubt,
            owner=found.owner,
            tries=tries,
            upward=found.nonnegative,
            typical=found.typical,
            shapes=found.tuned,
            repeats=found.repeats,
        )
