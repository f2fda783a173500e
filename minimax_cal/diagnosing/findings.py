"""Effects and faults of the data as findings: parameters, p-value, alternatives, the whole law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.diagnosis import AlternativeEffect, Finding
from minimax_cal.diagnosing.next_measurement import (
    ConfusedEffects,
    MeasurementPlanner,
    describe_best_separation,
)
from minimax_cal.measuring.faults.data_fault import DataFault
from minimax_cal.modelling.effects.effect_names import parameter_name_without_effect
from minimax_cal.modelling.effects.scene import (
    PosedArm,
    bit_mask_to_numbers,
    joint_index_from_place,
)
from minimax_cal.modelling.effects.table import (
    EFFECTS,
    Term,
    append_wave_count_to_names,
    effect_parameter_names_and_units,
)
from minimax_cal.selection.candidate_tests import CandidateFit, CandidateTests
from minimax_cal.selection.forward_selection import EffectSelection
from minimax_cal.selection.stability_selection import find_alternatives
from minimax_cal.selection.thresholds import SUFFICIENT_SEPARATION_POWER

MAX_ADVISED_ALTERNATIVES = 3  # of an effect, for which a further measurement is worked out


def order_by_explained_square(selection: EffectSelection) -> list[int]:
    """Numbers of the effects, each taking most of what those before leave; rows of equal weight.

    Orthogonal matching pursuit over groups of columns.
    """
    lib = selection.library
    fields = [
        lib.products.projected_candidate_columns(candidate.column_indices)
        for candidate in selection.candidates
    ]
    sizes = [len(field) for field in fields]
    parts = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
    columns = np.concatenate([np.zeros((0, len(lib.problem.error))), *fields])
    columns = columns / np.linalg.norm(columns, axis=1, keepdims=True)
    gram, gradient = columns @ columns.T, columns @ lib.problem.error
    waiting, order = list(range(len(fields))), []
    taken = np.zeros(0, dtype=int)
    while waiting:
        gains = []
        for i in waiting:
            both = np.concatenate([taken, parts[i]])
            value = np.linalg.lstsq(gram[np.ix_(both, both)], gradient[both], rcond=1e-12)[0]
            gains.append(float(gradient[both] @ value))
        best = waiting.pop(int(np.argmax(gains)))
        taken = np.concatenate([taken, parts[best]])
        order.append(best)
    return order


def group_terms_by_effect(selection: EffectSelection) -> list[tuple[Term, ...]]:
    """The terms of each effect selected, the weightiest first, all lines of a joint together."""
    groups: dict[tuple[str, str], list[Term]] = {}
    for number in order_by_explained_square(selection):
        term = selection.candidates[number].term
        groups.setdefault((term.effect, term.place), []).append(term)
    every = [candidate.term for candidate in selection.candidates]
    return [complete_law(terms, every) for terms in groups.values()]


def complete_law(terms: Sequence[Term], all_terms: Sequence[Term]) -> tuple[Term, ...]:
    """The whole of an effect's law, of which its terms may be what the data ask for.

    all_terms: of all effects.
    """
    first, found = terms[0], [term.choice for term in terms]
    joint = joint_index_from_place(first.place) if first.place[:1] == "J" else None
    wide = [t.choice for t in all_terms if t.effect == first.effect and "joints" in t.choice]
    law = EFFECTS[first.effect].entire(
        found, [c for c in wide if joint in bit_mask_to_numbers(c["joints"])]
    )
    return tuple(terms) if law is found else tuple(replace(first, choice=one) for one in law)


def with_complete_law(finding: Finding, all_terms: Sequence[Term], scene: PosedArm) -> Finding:
    """A finding with the whole of its law, whose values a later fit fills in.

    all_terms: of all effects.
    """
    terms = complete_law(finding.terms, all_terms)
    if terms == finding.terms:
        return finding
    named, units = effect_parameter_names_and_units(terms, scene)
    names = tuple(parameter_name_without_effect(name) for name in named)
    none = (0.0,) * len(names)
    return replace(finding, terms=terms, names=names, units=units, values=none, sigmas=none,
                   shown=finding.terms)  # fmt: skip


def build_effect_finding(
    scene: PosedArm,
    candidate_tests: CandidateTests,
    candidate_fit: CandidateFit,
    other_effects: Sequence[tuple[Term, Array]],
    measurement_planner: MeasurementPlanner | None,
) -> Finding:
    """An effect with its alternatives, and what to measure to tell the nearest of them apart.

    candidate_tests: where it is compared.  other_effects: the other effects selected, with their
    values.
    """
    found = find_alternatives(candidate_tests, candidate_fit)
    unclear = [i for i, (_, _, power) in enumerate(found) if power < SUFFICIENT_SEPARATION_POWER]
    advice = [""] * len(found)
    if measurement_planner:
        for i in unclear[:MAX_ADVISED_ALTERNATIVES]:
            rival = found[i][0].candidate.term
            advice[i] = describe_best_separation(
                measurement_planner,
                ConfusedEffects(
                    candidate_fit.candidate.term, candidate_fit.values, rival, other_effects
                ),
            )
    columns = candidate_fit.candidate.term.columns(scene)
    return Finding(
        terms=(candidate_fit.candidate.term,),
        names=columns.names,
        units=columns.units,
        values=tuple(float(v) for v in candidate_fit.values),
        sigmas=tuple(float(v) for v in candidate_fit.sigmas),
        size=candidate_tests.similarity_to_candidate(candidate_fit, candidate_fit.candidate)[0],
        p_value=candidate_tests.p_value(candidate_fit),
        alternatives=tuple(
            AlternativeEffect(
                *other.candidate.key, rho2, power, candidate_fit.evidence - other.evidence, text
            )
            for (other, rho2, power), text in zip(found, advice, strict=True)
        ),
        fixed=columns.fixed,
    )


def add_untestable_alternatives(
    finding: Finding, scene: PosedArm, excluded_effects: Sequence[str]
) -> Finding:
    """A finding with its relatives that the data lack something for: they may be it as well.

    Relatives turn the same joint by the same driver; how similar they are is not known.
    """
    if not finding.term.place.startswith("J"):
        return finding
    own = EFFECTS[finding.term.effect]
    lacking = [
        AlternativeEffect(name, finding.term.place, 1.0, 0.0, 0.0, f"give {other.needs(scene)}")
        for name, other in EFFECTS.items()
        if (other.moves, other.follows) == (own.moves, own.follows)
        and name not in (own.name, *excluded_effects)
        and other.needs(scene)
    ]
    return replace(finding, alternatives=(*finding.alternatives, *lacking)) if lacking else finding


def merge_gear_lines(findings: Sequence[Finding]) -> list[Finding]:
    """Lines of one joint as one effect: their parameters together, the strongest first."""
    out: dict[tuple[str, str], Finding] = {}
    keys = [(found.term.effect, found.term.place) for found in findings]
    for key, found in zip(keys, findings, strict=True):
        turns = found.fixed.get("waves_per_turn")
        if turns and (EFFECTS[key[0]].follows == "wave" or keys.count(key) > 1):
            names = append_wave_count_to_names(found.names, found.term)
            found = replace(found, names=names, fixed={f"waves_per_turn {turns:.4g}": turns})
        if key not in out:
            out[key] = found
            continue
        first = out[key]
        others = {(a.effect, a.place): a for a in (*first.alternatives, *found.alternatives)}
        joined: dict[str, Any] = {
            name: (*getattr(first, name), *getattr(found, name))
            for name in ("terms", "names", "units", "values", "sigmas")
        }
        out[key] = replace(
            first,
            **joined,
            size=first.size + found.size,
            p_value=max(first.p_value, found.p_value),
            alternatives=tuple(others.values()),
            fixed={**first.fixed, **found.fixed},
        )
    return list(out.values())


def build_fault_findings(faults: Sequence[DataFault]) -> list[Finding]:
    """Faults of the data as findings, those of a kind together."""
    out = []
    for effect in dict.fromkeys(fault.effect for fault in faults):
        same = [fault for fault in faults if fault.effect == effect]
        places = {fault.place for fault in same}
        amounts = [amount for fault in same for amount in fault.parameters]
        out.append(
            Finding(
                terms=(Term(effect, places.pop() if len(places) == 1 else "all"),),
                names=tuple(a.name for a in amounts),
                units=tuple(a.unit for a in amounts),
                values=tuple(a.value for a in amounts),
                sigmas=tuple(a.sigma for a in amounts),
                rows=tuple(sorted({int(row) for fault in same for row in fault.rows})),
            )
        )
    return out
