"""Which names hold: found again, chosen anew, when each fifth of the poses is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from minimax_cal.diagnosing.gap import folds
from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.alternatives import alternatives
from minimax_cal.evidence.bench import Added, Bench, bench
from minimax_cal.evidence.limits import (
    AGAIN,
    ALONE,
    ASKED,
    CERTAIN,
    DIFFER,
    DWARFED,
    ENOUGH,
    FOLDS,
    HALF,
    LEAST_DOF,
    MOST,
    SAME,
    WEAK,
)
from minimax_cal.evidence.noise import identified, remaining
from minimax_cal.evidence.selection import NOTHING, Choice, select
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.table import EFFECTS

UNASKED = float("nan")  # how often an effect is found again where poses are too few to ask


@dataclass(frozen=True)
class Again:
    """What the search tells that is made anew without each fifth of the groups.

    findings: each with how often it was found again.  met: square of what effects leave of the
    fifths without which they were sought, over that of geometry alone; each row counts as the rest
    of the poses tells it.  NaN where poses are too few to ask.
    """

    findings: tuple[Finding, ...]
    met: float


def judged_again(findings: Sequence[Finding], whole: Choice, study: Study) -> Again:
    """The findings, sought anew without each fifth.  whole: what was chosen on all poses."""
    if not findings:
        return Again((), UNASKED)
    part = folds(study.data, FOLDS)
    known: list[list[bool]] = [[] for _ in findings]
    rich, choices = 0, []
    for number in range(FOLDS):
        rest = whole.part(study.rows.at(part != number))
        rich += rest.products.dof(NOTHING) >= LEAST_DOF
        choice = select(rest, level=AGAIN, seldom=MOST)
        choices.append(choice)
        for one, times in zip(findings, known, strict=True):
            if is_found(one, choice, whole):
                times.append(True)
            elif shows(one, choice, whole):
                times.append(is_uncontested(one, choice, whole))
    enough = rich >= ASKED
    again = [
        replace(
            one,
            again=share(times) if enough else UNASKED,
            dwarfed=any(dwarfs(other, one) for other in findings),
        )
        for one, times in zip(findings, known, strict=True)
    ]
    alone, beside = np.sum([predicted(choice) for choice in choices], axis=0)
    return Again(tuple(again), float(beside / max(alone, 1e-300)) if enough else UNASKED)


def predicted(choice: Choice) -> Array:
    """(2,) squares of what geometry, and with it effects, leave of rows that were not kept [m^2].

    Rows count by their variance over that of what is left of them: what the rows that were kept do
    not tell of another, the one end of a joint, is no test.
    """
    lib = choice.library
    rows, kept = lib.rows, lib.products.kept.astype(bool)
    every, none = choice.noise.weights(rows), np.zeros((len(kept), 0))
    values = [value for value, _ in choice.estimates]
    moved = choice.known @ np.concatenate([*values, np.zeros(0)])
    left = [
        remaining(replace(rows, error=error), every * kept, none)[~kept]
        for error in (rows.error, rows.error - moved)
    ]
    columns = np.concatenate([rows.basis, choice.known], axis=1)
    told = columns[kept] * every[kept, None]
    unit = columns[~kept] @ identified(columns[kept].T @ told)
    share = 1.0 / (1.0 + every[~kept] * (unit**2).sum(axis=1))
    return np.array([share @ one**2 for one in left])


def often(findings: Sequence[Finding]) -> list[Finding]:
    """Those found often enough to be in the model, or of which nobody could be asked."""
    return [found for found in findings if not found.again < WEAK]


def asked(findings: Sequence[Finding]) -> bool:
    """Whether the poses were enough to ask how often some of them are found."""
    return any(np.isfinite(found.again) for found in findings)


def share(found: Sequence[bool]) -> float:
    """How often an effect was found in the parts that could show it; too few of them show none."""
    return sum(found) / len(found) if len(found) >= ASKED else 0.0


def loose_among(effects: Sequence[Finding], sure: Sequence[Finding]) -> list[Finding]:
    """Effects that are there by their chance, but under no name that holds.

    sure: what is established and was taken by the ladder: a name that was found again, but helps at
    no poses left out, holds as little as one that changes; unless one that holds stands for it.
    """
    held = {found.term.key for found in sure}
    loose = [f for f in effects if f.term.key not in held and f.p_value < CERTAIN]
    return [f for f in loose if not (f.established and any(stands_for(one, f) for one in sure))]


def stands_for(one: Finding, other: Finding) -> bool:
    """Whether an effect is the other at all joints, or one of them, or a rival told with it."""
    effect, place = one.term.key
    names = [other.term.key, *((rival.effect, rival.place) for rival in other.alternatives)]
    return any(effect == name and (place == at or "all" in (place, at)) for name, at in names)


def mostly_loose(effects: Sequence[Finding], sure: Sequence[Finding]) -> bool:
    """Whether most of what is there has no name that holds.  sure: those that do."""
    loose = sum(found.size for found in loose_among(effects, sure))
    return loose > HALF * (loose + sum(found.size for found in sure))


def dwarfs(large: Finding, small: Finding) -> bool:
    """Whether an effect may be what the law of a far larger one lacks: of the same course.

    How the time, or the way to a pose, acts on a machine no formula tells to the per cent.
    """
    one, other = (EFFECTS[found.term.effect] for found in (large, small))
    alike = one.follows == other.follows == "time" or (one.of_move and other.of_move)
    return alike and small.size < DWARFED * large.size


def is_found(finding: Finding, choice: Choice, whole: Choice) -> bool:
    """Whether a choice has an effect, or a rival that was told with it, as large as before."""
    rivals = {(a.effect, a.place) for a in finding.alternatives}
    effect, place = finding.term.key
    own, before = (estimates_of(finding, one) for one in (choice, whole))
    if not own:  # all joints hold one, too
        alike = {candidate.key for candidate in choice.chosen}
        wide = any(name == effect and "all" in (place, other) for name, other in alike)
        return wide or bool(alike & rivals) or is_rival(finding, choice)
    if own.keys() != before.keys() or laws_there(finding, choice) != laws_there(finding, whole):
        return True  # another variant of the law, or another of its lines, takes its share
    return all(agree(own[text], before[text]) for text in own)


def laws_there(finding: Finding, choice: Choice) -> set[tuple[str, frozenset[str]]]:
    """What a choice has of an effect at its place and at all places, or at any if it is at all.

    As places, and what their variants are told by, whatever the numbers.
    """
    effect, place = finding.term.key
    return {
        (c.term.place, frozenset(c.term.choice))
        for c in choice.chosen
        if c.term.effect == effect and (place == "all" or c.term.place in (place, "all"))
    }


def is_rival(finding: Finding, choice: Choice) -> bool:
    """Whether an effect that a part names instead cannot be told from this one there."""
    pairs = zip(choice.benches, choice.fits, strict=True)
    return any(
        other.candidate.key == finding.term.key
        for table, one in pairs
        for other, _, _ in alternatives(table, one)
    )


def is_uncontested(finding: Finding, choice: Choice, whole: Choice) -> bool:
    """Whether a part that names nothing else tells of an effect, asked for by itself, as before.

    To search the whole library costs power, which a part lacks for a faint effect; that it does not
    come first there speaks against its name only if another does.
    """
    table, one = bench_without(finding, choice, whole), fit_of(finding, whole)
    if one is None or len(table.chosen) < len(choice.chosen):
        return False
    found = table.added(one.candidate)
    sure = table.chance(found, table.wide(found)) < ALONE
    return sure and agree((found.value, found.sigma), (one.value, one.sigma))


def shows(finding: Finding, choice: Choice, whole: Choice) -> bool:
    """Whether a part, as noisy as it is, has enough of an effect as large as before.

    One that holds less than half of what all poses show of it, and little, is no test of its name:
    the poses that it lacks, the end of a joint, are those that tell.
    """
    one = fit_of(finding, whole)
    if one is None:
        return True
    table = bench_without(finding, choice, whole)
    there = replace(one, ratio=table.settings.ratios[0], variance=choice.noise.variance)
    size, _ = table.likeness(there, one.candidate)
    return size > min(ENOUGH, HALF * finding.size)


def fit_of(finding: Finding, whole: Choice) -> Added | None:
    """An effect as it was found, beside the others; of several lines the strongest."""
    return next((fit for fit in whole.fits if fit.candidate.term == finding.term), None)


def bench_without(finding: Finding, choice: Choice, whole: Choice) -> Bench:
    """The bench of a part, beside those effects alone that all poses have besides one."""
    before = {candidate.key for candidate in whole.chosen} - {finding.term.key}
    return bench(choice.library, [c for c in choice.chosen if c.key in before])


def estimates_of(finding: Finding, choice: Choice) -> dict[str, tuple[Array, Array]]:
    """Values and sigmas of the parameters of an effect's terms, by the text of each."""
    pairs = zip(choice.chosen, choice.estimates, strict=True)
    return {c.term.text: values for c, values in pairs if c.key == finding.term.key}


def agree(part: tuple[Array, Array], whole: tuple[Array, Array]) -> bool:
    """Whether the parameters of a part are those of the whole, within the sigmas of both."""
    (ours, sigma), (theirs, other) = part, whole
    variance = sigma**2 + other**2 + 1e-300
    off, size = (float((x**2 / variance).sum()) for x in (ours - theirs, theirs))
    return bool(off < max(chi2.isf(DIFFER, len(ours)), SAME * size))
