"""How often a name is found again: the search repeated on subsamples of the groups of rows.

Each round parts the groups at random, and each part is left out in turn, so that every group is as
often asked as any other.  A name's frequency is the share of the subsamples that find it
[Meinshausen and Buehlmann 2010; Shah and Samworth 2013].
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.parallel import run_in_parallel
from minimax_cal.selection.candidate_library import EffectKey
from minimax_cal.selection.candidate_tests import CandidateFit, CandidateTests
from minimax_cal.selection.forward_selection import (
    NO_COLUMNS,
    EffectSelection,
    select_effects_by_evidence,
)
from minimax_cal.selection.thresholds import (
    ALTERNATIVE_EVIDENCE_DEFICIT,
    FALSE_NAME_PROBABILITY,
    MAX_LUCKY_EVIDENCE_DEFICIT,
    MIN_ALTERNATIVE_FREQUENCY,
    MIN_SELECTION_DEGREES_OF_FREEDOM,
    SUBSAMPLE_FALSE_NAME_PROBABILITY,
    SUBSAMPLE_PART_COUNT,
    SUBSAMPLE_ROUND_COUNT,
    SUFFICIENT_SEPARATION_POWER,
)

UNKNOWN_FREQUENCY = float("nan")  # the frequency where rows are too few to leave any out


@dataclass(frozen=True)
class SubsampleSelections:
    """What searches of the subsamples find.

    found_keys: of those whose rows were enough to ask.  subsample_count: how many subsamples there
    are.
    """

    found_keys: tuple[frozenset[EffectKey], ...]
    subsample_count: int

    def selection_frequency(self, keys: Collection[EffectKey]) -> float:
        """The share of subsamples that find one of the keys; NaN where too few can be asked."""
        if 2 * len(self.found_keys) < self.subsample_count:
            return UNKNOWN_FREQUENCY
        return sum(not found.isdisjoint(keys) for found in self.found_keys) / len(self.found_keys)

    def find_replacing_keys(self, keys: Collection[EffectKey]) -> list[EffectKey]:
        """Names that take the place of keys: found without them, and hardly ever beside them."""
        without = [found for found in self.found_keys if found.isdisjoint(keys)]
        beside = [found for found in self.found_keys if not found.isdisjoint(keys)]
        every = sorted({key for found in without for key in found})
        counts = {key: sum(key in found for found in without) for key in every}
        seldom = {key: sum(key in found for found in beside) < counts[key] for key in every}
        return [
            key
            for key in every
            if seldom[key] and counts[key] >= MIN_ALTERNATIVE_FREQUENCY * len(self.found_keys)
        ]


def build_half_masks(row_groups: Array, round_count: int) -> list[Array]:
    """Masks (N,) of the rows of complementary halves.  row_groups: as `build_subsample_masks` has
    it.
    """
    rng, count = np.random.default_rng(0), int(row_groups.max()) + 1
    first = [(rng.permutation(count) < count // 2)[row_groups] for _ in range(round_count)]
    return [kept for half in first for kept in (half, ~half)]


def build_subsample_masks(row_groups: Array) -> list[Array]:
    """Masks (N,) of the rows of each subsample.  row_groups: (N,) from 0, of rows that stay
    together.
    """
    rng, count = np.random.default_rng(0), int(row_groups.max()) + 1
    parts = [
        (rng.permutation(count) % SUBSAMPLE_PART_COUNT)[row_groups]
        for _ in range(SUBSAMPLE_ROUND_COUNT)
    ]
    return [part != left for part in parts for left in range(SUBSAMPLE_PART_COUNT)]


def select_on_subsamples(
    selection: EffectSelection,
    row_masks: Sequence[Array],
    *,
    false_name_probability: float = SUBSAMPLE_FALSE_NAME_PROBABILITY,
    process_count: int = 1,
    cluster_address: str = "",
) -> SubsampleSelections:
    """The search of subsamples, each choosing among what that of all rows tuned.

    row_masks: (N,) of the rows of each.  false_name_probability: chance of a false name in one.
    process_count: processes, -1 for one a core.  cluster_address: address of a Dask scheduler
    instead.
    """
    one = selection.without_caches()
    calls = [(one, kept, false_name_probability) for kept in row_masks]
    found = dict(
        run_in_parallel(
            select_keys_on_rows,
            calls,
            process_count=process_count,
            scheduler_address=cluster_address,
        )
    )
    names = [found[number] for number in range(len(row_masks))]
    return SubsampleSelections(tuple(keys for keys in names if keys is not None), len(row_masks))


def select_keys_on_rows(
    selection: EffectSelection, row_mask: Array, false_name_probability: float
) -> frozenset[EffectKey] | None:
    """What the search of a part finds; None where its rows are too few.  row_mask: (N,) of its
    rows.
    """
    part = selection.take_rows(row_mask)
    if part.products.degrees_of_freedom(NO_COLUMNS) < MIN_SELECTION_DEGREES_OF_FREEDOM:
        return None
    return frozenset(
        c.key
        for c in select_effects_by_evidence(
            part, false_name_probability=false_name_probability
        ).candidates
    )


# ---- alternatives --------------------------------------------------------------------------------


def find_alternatives(
    candidate_tests: CandidateTests, candidate_fit: CandidateFit
) -> list[tuple[CandidateFit, float, float]]:
    """Other effects or places that may be the truth, with rho^2 and the power to tell them apart.

    Those that do nearly as well; and those that do worse by some luck, the data having too little
    power to tell them apart.  Where they have it, what is needed beside another too is no other
    name for it: both are there, or something else is.
    """
    out, seen = (
        [],
        {candidate_fit.candidate.key, *(c.key for c in candidate_tests.selected_candidates)},
    )
    for other in candidate_tests.ranked_candidates:
        if other.candidate.key in seen or other.evidence <= 0.0:
            continue
        close = other.evidence > candidate_fit.evidence - ALTERNATIVE_EVIDENCE_DEFICIT
        alike = other.candidate.family == candidate_fit.candidate.family  # as all joints hold one
        if not close and (
            alike or other.evidence < candidate_fit.evidence - MAX_LUCKY_EVIDENCE_DEFICIT
        ):
            continue
        size, rho2 = candidate_tests.similarity_to_candidate(candidate_fit, other.candidate)
        power = size * (1.0 - rho2)
        if power < SUFFICIENT_SEPARATION_POWER or (
            close
            and candidate_tests.p_value_beside_candidate(candidate_fit, other.candidate)
            >= FALSE_NAME_PROBABILITY
        ):
            seen.add(other.candidate.key)
            out.append((other, rho2, power))
    return out
