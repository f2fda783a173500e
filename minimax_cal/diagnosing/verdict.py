"""The verdict: what is established, whether it is enough, and whether anything else is there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.diagnosing.causes import Causes, loudest
from minimax_cal.diagnosing.established import asked, loose_among, mostly_loose
from minimax_cal.diagnosing.gap import Ladder
from minimax_cal.diagnosing.lack_of_fit import chance_of
from minimax_cal.diagnosing.remainder import Remainder
from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.limits import HALF, MUCH, WORTH
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term

UNSURE = "names that change with the poses"
UNASKED = "names that so few poses cannot confirm"
UNHELPFUL = "names that do not help at poses left out"
ORDERS = 2  # waves a turn that one gear shows at once

Structure = tuple[str, float]


def judged(
    findings: Sequence[Finding], causes: Causes, study: Study, ladder: Ladder, rest: Remainder
) -> tuple[str, Structure]:
    """The verdict; where what remains has structure, and the probability of that by chance.

    findings: as the ladder took them, with the faults.
    """
    traces = causes.traces
    worst = min(traces, key=lambda trace: trace.p)
    structure = (worst.name, chance_of(traces))
    sure = [found for found in findings if found.established]
    loud = loudest(study, causes.choice, traces)
    if loud:
        return "unknown", (loud.name, structure[1])
    named = [found for found in sure if np.isfinite(found.size)]  # no fault of the data
    if patched(named, study.scene):
        return "unknown", ("two laws for one joint may stand for one that is not known",
                           structure[1])  # fmt: skip
    unsure = why_loose(causes.effects, loose_among(causes.effects, named))
    if mostly_loose(causes.effects, named):
        return "unknown", (unsure, structure[1])
    if not closes_enough(named, ladder, rest):
        return "unknown", ("a curve of the joints that has no name", structure[1])
    if not named and wavers(ladder, rest):
        return "unknown", (unsure, structure[1])
    if not sure:
        return "none", structure
    return ("one_of" if any(found.alternatives for found in sure) else "named"), structure


def why_loose(effects: Sequence[Finding], loose: Sequence[Finding]) -> str:
    """What is wrong with the names that do not hold."""
    if not asked(effects):
        return UNASKED
    refused = sum(found.size for found in loose if found.established)
    return UNHELPFUL if refused > HALF * sum(found.size for found in loose) else UNSURE


def patched(findings: Sequence[Finding], scene: Scene) -> bool:
    """Whether the weightiest effect needs another law of its joint's angle: likely one unknown."""
    if not findings:
        return False
    largest = max(findings, key=lambda found: found.size)
    first = largest.term
    if not turns_by_angle(first, scene):
        return False
    several = EFFECTS[first.effect].lines and first.place != "all"
    shown = sum(len(t.columns(scene).names) for t in largest.shown or largest.terms)
    if several and shown > 2 * ORDERS:
        return True  # a series, as good for any curve
    others = [f.term for f in findings if f.term is not first and turns_by_angle(f.term, scene)]
    return any("all" in (first.place, t.place) or t.place == first.place for t in others)


def turns_by_angle(term: Term, scene: Scene) -> bool:
    """Whether it turns a joint by a formula of that joint's angle, other than a fine wave."""
    effect = EFFECTS[term.effect]
    by_formula = effect.follows == "angle" and not effect.is_map
    return by_formula and term.columns(scene).only_turns


def closes_enough(sure: Sequence[Finding], ladder: Ladder, rest: Remainder) -> bool:
    """Whether a model with something established closes half of what is predictable by groups."""
    if rest.predictable_mm**2 <= WORTH * rest.unpredictable_mm**2:
        return True
    closed = closed_by(ladder) if sure else 0.0
    return bool(closed >= HALF * (closed + rest.predictable_mm**2))


def wavers(ladder: Ladder, rest: Remainder) -> bool:
    """Whether effects of which none is established tell much."""
    return closed_by(ladder) > MUCH * rest.unpredictable_mm**2


def closed_by(ladder: Ladder) -> float:
    """By how much the ladder's last fit meets groups left out better than geometry [mm^2]."""
    fit, geometric = ladder.last, ladder.fits[0]
    count = float(fit.model.weight.sum())
    told = fit.spared(ladder.parts)
    before, after = (1e6 * one.cross_validated(told) / count for one in (geometric, fit))
    return before - after
