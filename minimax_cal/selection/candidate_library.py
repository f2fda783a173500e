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

from minimax_cal.core.arrays import Array
from minimax_cal.selection.gram_products import CandidateColumns, RatioProducts
from minimax_cal.selection.noise_model import LinearProblem, Noise
from minimax_cal.selection.subsample_products import SharedGrams, SubsampleProducts

EffectKey = tuple[str, str]


@dataclass(frozen=True, eq=False)
class LawColumns:
    """A law at a place, with the rows it would add to the error.

    term: what the dictionary calls it.  text: its unique name; key: its family and its place.
    columns: (N, d) rows per unit of each parameter.  prior_variations: (N, r) by which these may
    differ, one sigma per unit of the parameter owner (r,).  nonnegative: (d,) True for parameters
    that are never below 0.  typical_size: the usual size of a parameter.  tuned_number_count:
    numbers of the law that are searched, and cost as parameters do.  may_repeat_at_place: whether
    one place may hold several of the family.
    """

    term: Any
    text: str
    key: EffectKey
    columns: Array
    prior_variations: Array
    varied_parameters: Array
    nonnegative: Array
    typical_size: float
    tuned_number_count: int
    may_repeat_at_place: bool


class LawDictionary(Protocol):
    """The laws of a domain, for one problem."""

    @property
    def problem(self) -> LinearProblem:
        """Whose rows the columns are."""

    def spec(self, term: Any) -> LawColumns | None:
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


MIN_VISIBLE_FIELD_FRACTION = 1e-8  # share of a field that poses must show
MIN_PROJECTED_FIELD_FRACTION = (
    1e-5  # share of a field that must remain after projection for it to be tested
)


@dataclass(frozen=True, eq=False)
class LawCandidate:
    """A law with its columns in the matrix of all candidates.

    column_indices: (d,) columns.  variation_column_indices: (r,) further columns, one sigma each
    per unit of main[owner]. frequencies_tried: of a line, how many frequencies were looked at, at
    all places, to find it and its like. nonnegative: (d,) True for parameters that are never below
    0.  The others as in `LawColumns`.
    """

    term: Any
    text: str
    key: EffectKey
    column_indices: Array
    variation_column_indices: Array
    varied_parameters: Array
    frequencies_tried: float
    nonnegative: Array
    typical_size: float
    tuned_number_count: int
    may_repeat_at_place: bool

    @property
    def family(self) -> str:
        """The effect, wherever it is."""
        return self.key[0]

    @property
    def is_spectral_line(self) -> bool:
        """Whether it was found by a search over frequencies."""
        return self.frequencies_tried > 1.0


@dataclass(frozen=True, eq=False)
class EqualShapeCandidates:
    """Candidates of equal numbers of columns and doubts, compared all at once.

    column_indices: (c, d) columns; all_column_indices: (c, d + r) those of doubts besides;
    varied_parameters: (c, r).  charged_parameter_counts: (c,) parameters that each is charged for;
    frequencies_tried: (c,).  typical_sizes: (c,) size of a parameter; nonnegative: (c,) whether no
    body has the other sign.
    """

    candidates: tuple[LawCandidate, ...]
    column_indices: Array
    all_column_indices: Array
    varied_parameters: Array
    charged_parameter_counts: Array
    frequencies_tried: Array
    typical_sizes: Array
    nonnegative: Array

    @staticmethod
    def from_candidates(same: Sequence[LawCandidate]) -> EqualShapeCandidates:
        """Of candidates."""
        main, doubt = (
            np.array([getattr(c, name) for c in same])
            for name in ("column_indices", "variation_column_indices")
        )
        return EqualShapeCandidates(
            tuple(same),
            main,
            np.concatenate([main, doubt], axis=1),
            np.array([c.varied_parameters for c in same]),
            np.array([len(c.column_indices) + c.tuned_number_count for c in same]),
            np.array([c.frequencies_tried for c in same]),
            np.array([c.typical_size for c in same]),
            np.array([len(c.nonnegative) == 1 and c.nonnegative.all() for c in same]),
        )


@lru_cache(maxsize=32)
def group_by_shape(candidates: tuple[LawCandidate, ...]) -> tuple[EqualShapeCandidates, ...]:
    """Candidates by their numbers of columns and doubts."""
    found: dict[tuple[int, int], list[LawCandidate]] = {}
    for c in candidates:
        found.setdefault((len(c.column_indices), len(c.variation_column_indices)), []).append(c)
    return tuple(map(EqualShapeCandidates.from_candidates, found.values()))


@dataclass(frozen=True, eq=False)
class TemporaryCandidates:
    """Candidates whose columns are stored nowhere: each is compared a few times only.

    columns: (N, d) their columns.  projected_columns: (d, N) what geometry does not imitate of
    them.
    """

    candidates: tuple[LawCandidate, ...]
    columns: Array
    projected_columns: Array

    def contains(self, candidate: LawCandidate) -> bool:
        """Whether a candidate's columns are these."""
        return any(candidate is one for one in self.candidates)


@dataclass(frozen=True, eq=False)
class CandidateLibrary:
    """All candidates that these data can test.

    products: of their columns, which all libraries of the same data share; of a part, swept:
    there nothing is tuned, and no line sought.  untestable: family and what the data lack.
    later_candidates: candidates stored later, by their text.  spectral_lines: as the last search
    found them.
    """

    dictionary: LawDictionary
    products: RatioProducts
    candidates: tuple[LawCandidate, ...]
    untestable: tuple[EffectKey, ...] = ()
    later_candidates: dict[str, LawCandidate] = field(default_factory=dict)
    spectral_lines: TemporaryCandidates | None = None

    @staticmethod
    def without_candidates(dictionary: LawDictionary) -> CandidateLibrary:
        """No candidates yet."""
        return CandidateLibrary(dictionary, RatioProducts(CandidateColumns(dictionary.problem)), ())

    @staticmethod
    def from_terms(
        dictionary: LawDictionary, terms: Sequence[Any], untestable: Sequence[EffectKey]
    ) -> CandidateLibrary:
        """Of some laws, without those that the nuisance columns imitate."""
        lib = CandidateLibrary.without_candidates(dictionary)
        stack = CandidateBuilder(dictionary)
        candidates = tuple(c for c in map(stack.build_candidate, terms) if c is not None)
        lib.products.columns.append(stack.columns)
        return replace(
            lib, candidates=candidates, untestable=tuple(untestable)
        ).drop_imitated_candidates()

    @property
    def problem(self) -> LinearProblem:
        """The problem."""
        return self.dictionary.problem

    @cached_property
    def law_count(self) -> int:
        """How many candidates were not found by a search over frequencies."""
        return sum(not c.is_spectral_line for c in self.candidates)

    @property
    def candidate_columns(self) -> Array:
        """(N, D) fields of all candidates as rows."""
        return self.products.columns.candidate_columns

    def add_terms(self, terms_with_tries: Sequence[tuple[Any, float]]) -> list[LawCandidate]:
        """Candidates of further terms, their columns stored.  terms_with_tries: with their
        tries.
        """
        stack = CandidateBuilder(self.dictionary, self.products.columns.count)
        out = []
        for term, tries in terms_with_tries:
            c = self.later_candidates.get(term.text) or stack.build_candidate(term, tries)
            if c is not None:
                self.later_candidates[c.text] = c
                out.append(c)
        self.products.columns.append(stack.columns)
        return out

    def build_temporary_candidates(
        self, terms_with_tries: Sequence[tuple[Any, float]]
    ) -> TemporaryCandidates:
        """Candidates of further terms that are not stored.  terms_with_tries: with their tries."""
        stack = CandidateBuilder(self.dictionary)
        found = (stack.build_candidate(term, tries) for term, tries in terms_with_tries)
        candidates = tuple(c for c in found if c is not None)
        return TemporaryCandidates(
            candidates, stack.columns, self.products.columns.project_out_nuisance(stack.columns)
        )

    def store_spectral_line(self, candidate: LawCandidate) -> tuple[CandidateLibrary, LawCandidate]:
        """The library with a candidate among those stored, and the candidate there."""
        if self.spectral_lines is None or not self.spectral_lines.contains(candidate):
            return self, candidate
        found = self.add_terms([(candidate.term, candidate.frequencies_tried)])[0]
        rest = replace(
            self.spectral_lines,
            candidates=tuple(o for o in self.spectral_lines.candidates if o is not candidate),
        )
        return replace(self, candidates=(*self.candidates, found), spectral_lines=rest), found

    def projected_fields(self, candidate: LawCandidate) -> Array:
        """(d + r, N) what geometry does not imitate of a candidate's columns and their doubts."""
        index = np.concatenate([candidate.column_indices, candidate.variation_column_indices])
        if self.spectral_lines is not None and self.spectral_lines.contains(candidate):
            return np.asarray(self.spectral_lines.projected_columns[index])
        return self.products.projected_candidate_columns(index)

    @property
    def is_subsample(self) -> bool:
        """Whether some rows alone count."""
        return isinstance(self.products, SubsampleProducts)

    def take_rows(self, whole_grams: SharedGrams, row_mask: Array) -> CandidateLibrary:
        """The library for some of the rows alone.  row_mask: (N,) True for those that count."""
        return replace(
            self, products=SubsampleProducts(whole_grams, row_mask), spectral_lines=None
        ).drop_imitated_candidates()

    def drop_imitated_candidates(self) -> CandidateLibrary:
        """The library without candidates that geometry imitates."""
        whole, left = self.products.column_and_projected_squares()
        every = (self.candidate_columns**2).sum(axis=0)  # what a part shows less of is rounding
        clear = (left > MIN_PROJECTED_FIELD_FRACTION * whole) & (
            whole > MIN_VISIBLE_FIELD_FRACTION * every
        )
        shown = tuple(c for c in self.candidates if clear[c.column_indices].all())
        gone = {c.family for c in self.candidates} - {c.family for c in shown}
        lacking = [(name, "poses at which geometry does not imitate it") for name in sorted(gone)]
        return replace(self, candidates=shown, untestable=(*self.untestable, *lacking))


class CandidateBuilder:
    """Columns as they are gathered, each stored once."""

    def __init__(self, dictionary: LawDictionary, count: int = 0) -> None:
        self.dictionary, self.count = dictionary, count
        self.blocks: list[Array] = [np.zeros((len(dictionary.problem.error), 0))]
        self.seen: dict[bytes, int] = {}

    @property
    def columns(self) -> Array:
        """(N, d) all of them."""
        return np.concatenate(self.blocks, axis=1)

    def store_columns(self, columns: Array) -> Array:
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

    def build_candidate(self, term: Any, frequencies_tried: float = 1.0) -> LawCandidate | None:
        """One candidate; None if it adds nothing to any row."""
        found = self.dictionary.spec(term)
        if found is None:
            return None
        columns = np.concatenate([found.columns, found.prior_variations], axis=1)
        main, doubt = np.split(self.store_columns(columns), [found.columns.shape[1]])
        return LawCandidate(
            term=found.term,
            text=found.text,
            key=found.key,
            column_indices=main,
            variation_column_indices=doubt,
            varied_parameters=found.varied_parameters,
            frequencies_tried=frequencies_tried,
            nonnegative=found.nonnegative,
            typical_size=found.typical_size,
            tuned_number_count=found.tuned_number_count,
            may_repeat_at_place=found.may_repeat_at_place,
        )
