"""Which effects are confirmed: found again when the search is repeated on subsamples of poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.diagnosing.diagnosis import Finding
from minimax_cal.selection.candidate_library import EffectKey
from minimax_cal.selection.stability_selection import SubsampleSelections
from minimax_cal.selection.thresholds import (
    CERTAIN_P_VALUE,
    MAIN_PART_FRACTION,
    MIN_MODEL_FREQUENCY,
)


def list_equivalent_keys(
    finding: Finding, subsample_selections: SubsampleSelections
) -> set[EffectKey]:
    """Keys that count as the effect: its own, its alternatives', and all joints for one or one for
    all.

    subsample_selections: whose keys are looked at.
    """
    effect, place = finding.term.key
    every = {key for names in subsample_selections.found_keys for key in names}
    wide = {key for key in every if key[0] == effect and "all" in (place, key[1])}
    return {finding.term.key, *((a.effect, a.place) for a in finding.alternatives), *wide}


def select_frequent(findings: Sequence[Finding]) -> list[Finding]:
    """Those found often enough to be in the model, or whose frequency is not known."""
    return [found for found in findings if not found.again < MIN_MODEL_FREQUENCY]


def has_frequencies(findings: Sequence[Finding]) -> bool:
    """Whether the poses were enough to know the frequency of any."""
    return any(np.isfinite(found.again) for found in findings)


def find_unconfirmed(effects: Sequence[Finding], confirmed: Sequence[Finding]) -> list[Finding]:
    """Effects that are significant beyond doubt, but under no name that is confirmed.

    confirmed: and taken by the error budget: a name that was found again, but helps at no poses
    held out, holds as little as one that changes; unless it covers a confirmed one.
    """
    keys = {found.term.key for found in confirmed}
    return [
        f
        for f in effects
        if f.term.key not in keys
        and f.p_value < CERTAIN_P_VALUE
        and not (
            f.established and any(has_key_or_alternative(f, one.term.key) for one in confirmed)
        )
    ]


def has_key_or_alternative(finding: Finding, key: EffectKey) -> bool:
    """Whether an effect, or an alternative of it, has a key, at all joints or one of them."""
    effect, place = key
    names = [finding.term.key, *((rival.effect, rival.place) for rival in finding.alternatives)]
    return any(effect == name and (place == at or "all" in (place, at)) for name, at in names)


def is_mostly_unconfirmed(effects: Sequence[Finding], confirmed: Sequence[Finding]) -> bool:
    """Whether most of what is significant, by its size, has no confirmed name."""
    loose = sum(found.size for found in find_unconfirmed(effects, confirmed))
    return loose > MAIN_PART_FRACTION * (loose + sum(found.size for found in confirmed))
