"""Which names hold: found again when the search is repeated on subsamples of the poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.diagnosing.result import Alternative, Finding
from minimax_cal.evidence.library import Key
from minimax_cal.evidence.limits import CERTAIN, FREQUENT, HALF
from minimax_cal.evidence.selection import Choice
from minimax_cal.evidence.stability import Repeats, repeated, subsamples
from minimax_cal.ground.arrays import Array


def judged_again(
    findings: Sequence[Finding], whole: Choice, group: Array, jobs: int = 1, cluster: str = ""
) -> tuple[Finding, ...]:
    """The findings, sought again in subsamples of the poses.

    whole: what was chosen on all poses.  group: (N,) of rows that stay together.  jobs, cluster: as
    `repeated` has them.
    """
    if not findings:
        return ()
    found = repeated(whole, subsamples(group), jobs=jobs, cluster=cluster)
    return tuple(judged(one, whole, found) for one in findings)


def judged(finding: Finding, whole: Choice, repeats: Repeats) -> Finding:
    """A finding with the names that take its place in subsamples, and how often one is found."""
    same = stands_for(finding, repeats)
    known = {finding.term.key, *(c.key for c in whole.chosen), *same}
    instead = [key for key in repeats.instead_of(same) if key not in known]
    more = [one for key in instead for one in as_alternative(finding, whole, key)]
    finding = replace(finding, alternatives=(*finding.alternatives, *more))
    return replace(finding, again=repeats.frequency(stands_for(finding, repeats)))


def stands_for(finding: Finding, repeats: Repeats) -> set[Key]:
    """Keys that are the effect: its own, its alternatives', and all joints for one or one for all.

    repeats: whose names are looked at.
    """
    effect, place = finding.term.key
    every = {key for names in repeats.names for key in names}
    wide = {key for key in every if key[0] == effect and "all" in (place, key[1])}
    return {finding.term.key, *((a.effect, a.place) for a in finding.alternatives), *wide}


def as_alternative(finding: Finding, whole: Choice, key: Key) -> list[Alternative]:
    """A name that takes an effect's place, as its alternative; none if all rows exclude it."""
    at = [c.term for c in whole.chosen].index(finding.term)
    table, one = whole.beside_others(at)
    other = next((other for other in table.everyone if other.candidate.key == key), None)
    if other is None:
        return []
    size, rho2 = table.likeness(one, other.candidate)
    loss = one.evidence - other.evidence
    return [Alternative(*key, rho2, size * (1.0 - rho2), loss)]


def often(findings: Sequence[Finding]) -> list[Finding]:
    """Those found often enough to be in the model, or of which nobody could be asked."""
    return [found for found in findings if not found.again < FREQUENT]


def asked(findings: Sequence[Finding]) -> bool:
    """Whether the poses were enough to ask how often some of them are found."""
    return any(np.isfinite(found.again) for found in findings)


def loose_among(effects: Sequence[Finding], sure: Sequence[Finding]) -> list[Finding]:
    """Effects that are there by their chance, but under no name that holds.

    sure: what is established and was taken by the ladder: a name that was found again, but helps at
    no poses left out, holds as little as one that changes; unless one that holds stands for it.
    """
    held = {found.term.key for found in sure}
    loose = [f for f in effects if f.term.key not in held and f.p_value < CERTAIN]
    return [f for f in loose if not (f.established and any(is_same(one, f) for one in sure))]


def is_same(one: Finding, other: Finding) -> bool:
    """Whether an effect is the other at all joints, or one of them, or a rival told with it."""
    return is_named(other, one.term.key)


def is_named(finding: Finding, key: Key) -> bool:
    """Whether an effect, or a rival told with it, is so called, at all joints or one of them."""
    effect, place = key
    names = [finding.term.key, *((rival.effect, rival.place) for rival in finding.alternatives)]
    return any(effect == name and (place == at or "all" in (place, at)) for name, at in names)


def mostly_loose(effects: Sequence[Finding], sure: Sequence[Finding]) -> bool:
    """Whether most of what is there has no name that holds.  sure: those that do."""
    loose = sum(found.size for found in loose_among(effects, sure))
    return loose > HALF * (loose + sum(found.size for found in sure))
