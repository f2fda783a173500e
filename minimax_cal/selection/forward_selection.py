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

from minimax_cal.core.arrays import Array
from minimax_cal.selection.candidate_library import CandidateLibrary, LawCandidate, LawDictionary
from minimax_cal.selection.candidate_tests import (
    CandidateFit,
    CandidateTests,
    are_prior_variations_plausible,
    build_candidate_tests,
    deviance_of_sign_constraints,
    estimate_jointly,
    list_columns_and_ridges,
)
from minimax_cal.selection.gram_products import RatioProducts
from minimax_cal.selection.noise_model import Noise
from minimax_cal.selection.subsample_products import SharedGrams
from minimax_cal.selection.thresholds import (
    EFFECTS_BETWEEN_REFINEMENTS,
    FALSE_NAME_PROBABILITY,
    MAX_REFINED_EFFECTS,
    MAX_SELECTED_EFFECTS,
    MAX_TUNED_CANDIDATES,
    MAX_TUNED_EVIDENCE_DEFICIT,
    MAX_TUNED_RELATIVE_DEFICIT,
    MAX_TUNING_ROUNDS,
    MIN_NOISE_DEGREES_OF_FREEDOM,
    MIN_REPLACEMENT_EVIDENCE_GAIN,
    MIN_SELECTION_DEGREES_OF_FREEDOM,
)

NO_COLUMNS: Array = np.zeros(0, dtype=int)


@dataclass(frozen=True, eq=False)
class EffectSelection:
    """The effects selected.

    library: with all columns that were tried.  candidate_fits: the effects, as each was when it was
    chosen. noise: with all of them.
    """

    library: CandidateLibrary
    candidate_fits: tuple[CandidateFit, ...]
    noise: Noise

    @property
    def candidates(self) -> tuple[LawCandidate, ...]:
        """The candidates."""
        return tuple(one.candidate for one in self.candidate_fits)

    def compare_with_others(self, effect_number: int) -> tuple[CandidateTests, CandidateFit]:
        """Where an effect is compared with its rivals, beside the others, and the effect there.

        Of no effect it is held here: those of all would fill the memory.
        """
        table = build_candidate_tests(
            self.library, *leave_out_effect(self.candidate_fits, effect_number)
        )
        return table, table.fit_candidate(self.candidate_fits[effect_number].candidate)

    @cached_property
    def joint_estimates(self) -> tuple[tuple[Array, Array], ...]:
        """Values and sigmas (d,) of the parameters of each effect, all estimated together."""
        return estimate_jointly(self.library, self.candidate_fits, self.noise)

    @cached_property
    def shared_grams(self) -> SharedGrams:
        """What the searches of parts of the rows start from."""
        products = self.library.products
        return SharedGrams(products.columns, [products.estimate_noise(NO_COLUMNS), self.noise])

    def take_rows(self, row_mask: Array) -> CandidateLibrary:
        """What a part of the rows may choose from, all that this search tuned; row_mask: (N,)."""
        lib = self.library
        lines = [
            c
            for c in lib.later_candidates.values()
            if c.is_spectral_line and c not in lib.candidates
        ]
        return replace(lib, candidates=(*lib.candidates, *lines)).take_rows(
            self.shared_grams, row_mask
        )

    def without_caches(self) -> EffectSelection:
        """For parts of the rows in another process: without what is worked out again from it."""
        plain = RatioProducts(self.library.products.columns)
        out = replace(self, library=replace(self.library, products=plain, spectral_lines=None))
        out.__dict__["shared_grams"] = self.shared_grams
        return out

    @property
    def effect_columns(self) -> Array:
        """(N, q) their columns."""
        return self.library.candidate_columns[:, list_columns_and_ridges(self.candidates)[0]]

    @property
    def effect_and_variation_columns(self) -> Array:
        """(N, q + r) their columns, and those by which their laws may differ, if that is enough.

        r = 0 where the laws would have to differ by more than anybody doubts.
        """
        if not are_prior_variations_plausible(self.library, self.candidate_fits, self.noise):
            return self.effect_columns
        main, loose, _ = list_columns_and_ridges(self.candidates, self.candidate_fits)
        return self.library.candidate_columns[:, np.concatenate([main, loose])]


def select_effects_by_evidence(
    library: CandidateLibrary,
    *,
    false_name_probability: float = FALSE_NAME_PROBABILITY,
    previous_fits: Sequence[CandidateFit] = (),
) -> EffectSelection:
    """Forward selection behind a Bonferroni gate, with replacement, dropping and noise updates.

    library: of all rows, or of some, as `EffectSelection.take_rows` gives it: no other is looked
    at, nothing is tuned, and replacement waits for the end.  false_name_probability: chance of a
    false name on data without an effect.  previous_fits: what was chosen with other weights.
    """
    # Start from the effects selected with other weights, if any.
    fits: list[CandidateFit] = []
    known = {c.text: c for c in library.candidates}
    for one in previous_fits:
        c = one.candidate
        mine = known.get(c.text) or next(
            iter(library.add_terms([(c.term, c.frequencies_tried)])), None
        )
        if mine is None:
            continue
        if c.text not in known:
            library = replace(library, candidates=(*library.candidates, mine))
        fits.append(replace(one, candidate=mine))
    noise = estimate_noise_beside(library, fits)
    if (
        noise.variance < library.problem.rounding_noise**2
        or library.products.degrees_of_freedom(NO_COLUMNS) < MIN_SELECTION_DEGREES_OF_FREEDOM
    ):
        return EffectSelection(library, (), noise)
    if fits:
        library, fits = refine_effects(library, fits, false_name_probability, include_last=True)
        noise = estimate_noise_beside(library, fits)

    # Forward steps: lines sought again in what remains, the best addition, replacement, the noise.
    for _ in range(MAX_SELECTED_EFFECTS):
        if not library.is_subsample:
            fitted = library.candidate_columns[
                :, list_columns_and_ridges([one.candidate for one in fits])[0]
            ]
            heard = [one.candidate.term for one in fits if one.candidate.is_spectral_line]
            found = library.dictionary.lines(noise, fitted, heard)
            no_lines = tuple(
                c for c in library.candidates if not c.is_spectral_line
            )  # of an earlier step
            library = replace(
                library,
                candidates=no_lines,
                spectral_lines=library.build_temporary_candidates(found) if found else None,
            )
        table = build_candidate_tests(library, [one.candidate for one in fits], fits)
        if table.degrees_of_freedom < MIN_SELECTION_DEGREES_OF_FREEDOM:
            break
        library, best = find_best_addition(library, table, fits, false_name_probability)
        if not best:
            break
        fits = [*fits, *best]
        if not library.is_subsample and (
            len(fits) <= MAX_REFINED_EFFECTS or len(fits) % EFFECTS_BETWEEN_REFINEMENTS == 0
        ):
            library, fits = refine_effects(library, fits, false_name_probability)
        noise = estimate_noise_beside(library, fits)
    if len(fits) > MAX_REFINED_EFFECTS or library.is_subsample:
        library, fits = refine_effects(library, fits, false_name_probability)
    return EffectSelection(library, tuple(fits), estimate_noise_beside(library, fits))


def estimate_noise_beside(
    library: CandidateLibrary, candidate_fits: Sequence[CandidateFit]
) -> Noise:
    """The noise beside what was chosen."""
    return library.products.estimate_noise(
        list_columns_and_ridges([one.candidate for one in candidate_fits])[0]
    )


def leave_out_effect(
    candidate_fits: Sequence[CandidateFit], effect_number: int
) -> tuple[list[LawCandidate], list[CandidateFit]]:
    """All but one of the chosen, as `build_candidate_tests` wants them."""
    others = [one for i, one in enumerate(candidate_fits) if i != effect_number]
    return [one.candidate for one in others], others


def is_place_taken(candidate: LawCandidate, selected_candidates: Sequence[LawCandidate]) -> bool:
    """Whether an effect is at a place already; lines of one cause may be several."""
    same = [other for other in selected_candidates if other.key == candidate.key]
    return any(not candidate.may_repeat_at_place or other.text == candidate.text for other in same)


def find_best_addition(
    library: CandidateLibrary,
    candidate_tests: CandidateTests,
    candidate_fits: Sequence[CandidateFit],
    false_name_probability: float,
) -> tuple[CandidateLibrary, list[CandidateFit]]:
    """The candidate that adds most evidence and is significant; none if none is.

    candidate_fits: the effects that were chosen.
    """
    best: CandidateFit | None = None
    least = deviance_of_sign_constraints(library, candidate_fits, candidate_tests.noise)
    seen: set[tuple[str, str]] = set()
    room = (
        candidate_tests.degrees_of_freedom - MIN_NOISE_DEGREES_OF_FREEDOM
    )  # parameters that rows can still tell
    for one in candidate_tests.ranked_candidates:
        # In the order of evidence; with tuning an inferior one may still overtake the best.
        if one.evidence <= 0.0 or len(one.candidate.column_indices) > room:
            continue
        reach = (
            max(MAX_TUNED_EVIDENCE_DEFICIT, MAX_TUNED_RELATIVE_DEFICIT * best.likelihood_gain)
            if best and not library.is_subsample
            else 0.0
        )
        if best and one.evidence < best.evidence - reach:
            break
        if one.candidate.key in seen or is_place_taken(
            one.candidate, candidate_tests.selected_candidates
        ):
            continue
        if candidate_tests.is_significant(one, false_name_probability):
            # Tuned, on all rows; the library takes the tuned candidate in place of the first.
            seen.add(one.candidate.key)
            better = one if library.is_subsample else tune_candidate(candidate_tests, one)
            if better.candidate is not one.candidate:
                new = library.add_terms([(better.candidate.term, one.candidate.frequencies_tried)])[
                    0
                ]
                kept = tuple(new if c is one.candidate else c for c in library.candidates)
                library, better = replace(library, candidates=kept), replace(better, candidate=new)
            # Less what it owes to signs that are physically impossible, its own or others'.
            if library.spectral_lines is None or not library.spectral_lines.contains(
                better.candidate
            ):
                owed = max(
                    deviance_of_sign_constraints(
                        library, [*candidate_fits, better], candidate_tests.noise
                    )
                    - least,
                    0.0,
                )
                gain = max(better.likelihood_gain - owed, 0.0)
                better = replace(better, likelihood_gain=gain, evidence=better.evidence - owed)
            if better.evidence > 0.0 and candidate_tests.p_value(better) < false_name_probability:
                best = better if not best or better.evidence > best.evidence else best
        if len(seen) == MAX_TUNED_CANDIDATES:
            break
    if not best:
        return library, []
    library, stored = library.store_spectral_line(best.candidate)
    return library, [replace(best, candidate=stored)]


def tune_candidate(candidate_tests: CandidateTests, candidate_fit: CandidateFit) -> CandidateFit:
    """A candidate with what its law has chosen (a moment, a time constant) searched more finely.

    The candidate returned belongs to no library yet.
    """
    for _ in range(MAX_TUNING_ROUNDS):
        near = candidate_tests.library.dictionary.finer(candidate_fit.candidate.term)
        if not near:
            break
        aside = candidate_tests.library.build_temporary_candidates([(term, 1.0) for term in near])
        ranked = candidate_tests.with_temporary_candidates(aside).rank_candidates(aside.candidates)
        if not ranked or ranked[0].evidence <= candidate_fit.evidence:
            break
        candidate_fit = ranked[0]
    return candidate_fit


def retune_selection(selection: EffectSelection) -> EffectSelection:
    """The choice of a part of the rows, each effect tuned by these alone, and stored nowhere."""
    best = [
        tune_candidate(*selection.compare_with_others(number))
        for number in range(len(selection.candidate_fits))
    ]
    found = (
        replace(one, candidate=replace(one.candidate, term=other.candidate.term))
        for one, other in zip(selection.candidate_fits, best, strict=True)
    )
    return replace(selection, candidate_fits=tuple(found))


def refine_effects(
    library: CandidateLibrary,
    candidate_fits: list[CandidateFit],
    false_name_probability: float,
    *,
    include_last: bool = False,
) -> tuple[CandidateLibrary, list[CandidateFit]]:
    """Replace each effect by any that does better, and drop what is no longer needed.

    include_last: whether the last, too, which otherwise was just chosen beside the others.
    """
    count = len(candidate_fits) - (not include_last)
    if count < 1:
        return library, candidate_fits
    for _ in range(3):
        changed = False
        for number in range(min(count, MAX_REFINED_EFFECTS)):
            chosen, others = leave_out_effect(candidate_fits, number)
            table = build_candidate_tests(library, chosen, others)
            own = table.fit_candidate(candidate_fits[number].candidate)
            top = next(
                (o for o in table.ranked_candidates if not is_place_taken(o.candidate, chosen)), own
            )
            if (
                top.candidate is not own.candidate
                and top.evidence > own.evidence + MIN_REPLACEMENT_EVIDENCE_GAIN
            ):
                library, stored = library.store_spectral_line(top.candidate)
                candidate_fits[number], changed = replace(top, candidate=stored), True
            elif table.p_value(own) > false_name_probability:
                return refine_effects(
                    library, others, false_name_probability, include_last=include_last
                )
            else:
                candidate_fits[number] = own
        if not changed:
            break
    return library, candidate_fits


def select_best_variant(
    dictionary: LawDictionary, selected_terms: Sequence[Any], variants: Sequence[Any]
) -> Any:
    """The variant of a law that explains most beside the laws chosen before."""
    lib = CandidateLibrary.without_candidates(dictionary)
    before = lib.add_terms([(term, 1.0) for term in selected_terms])
    among = lib.add_terms([(term, 1.0) for term in variants])
    if not among:
        return variants[0]
    table = build_candidate_tests(replace(lib, candidates=tuple(among)), before)
    return tune_candidate(table, table.ranked_candidates[0]).candidate.term
