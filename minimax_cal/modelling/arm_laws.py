"""The laws of an arm as a dictionary of the evidence: effects at places, in variants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.gears import GEAR_RIPPLE
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import EFFECTS, FREE_CHOICE_KEYS, Term
from minimax_cal.modelling.error_rows import PoseRows
from minimax_cal.modelling.gear_periodogram import (
    find_gear_lines_with_tried_counts,
    is_line_near_expected_ratio,
)
from minimax_cal.selection.candidate_library import CandidateLibrary, LawColumns
from minimax_cal.selection.noise_model import Noise

TUNED_CHOICE_KEYS = FREE_CHOICE_KEYS - {
    "turns"
}  # tuned numbers; a line's frequency is paid by its tries


@dataclass(frozen=True, eq=False)
class ArmLaws:
    """The effects of an arm, for its linearised errors.  exclude: those that are not sought."""

    scene: PosedArm
    problem: PoseRows
    exclude: Sequence[str] = ()

    def spec(self, term: Term) -> LawColumns | None:
        """An effect with its columns; None where it moves no point."""
        columns, effect = term.columns(self.scene), EFFECTS[term.effect]
        fields = columns.target_displacements(self.scene)
        if not np.any(fields):
            return None
        doubts = columns.displacement_uncertainties(self.scene)
        owner = [number for number, part in doubts for _ in part]
        loose = np.concatenate([np.zeros((0, *fields.shape[1:])), *(part for _, part in doubts)])
        tuned = (value for name, value in term.choice.items() if name in TUNED_CHOICE_KEYS)
        return LawColumns(
            term=term,
            text=term.text,
            key=term.key,
            columns=self.problem.rows_from_fields(fields),
            prior_variations=self.problem.rows_from_fields(loose),
            varied_parameters=np.array(owner, dtype=int),
            nonnegative=effect.nonnegative_mask(columns),
            typical_size=effect.typical,
            tuned_number_count=int(sum(np.isfinite(value) for value in tuned)),
            may_repeat_at_place=effect.lines and term.place != "all",
        )

    def finer(self, term: Term) -> list[Term]:
        """The effect with what its law has chosen closer together."""
        choices = EFFECTS[term.effect].finer(self.scene, term.choice)
        return [replace(term, choice=choice) for choice in choices]

    def lines(self, noise: Noise, known: Array, found: Sequence[Term]) -> list[tuple[Term, float]]:
        """Lines of gears, with the frequencies tried:
        `periodogram.find_gear_lines_with_tried_counts`.
        """
        if GEAR_RIPPLE.name in self.exclude:
            return []
        return find_gear_lines_with_tried_counts(
            self.scene, self.problem, noise, known, found_lines=found
        )

    def is_expected(self, line: Term, found: Sequence[Term]) -> bool:
        """Whether a line is where its gear's is."""
        return is_line_near_expected_ratio(self.scene, line, found)


def build_library_of_testable_arm_laws(
    posed_arm: PosedArm, rows: PoseRows, excluded_effects: Sequence[str] = ()
) -> CandidateLibrary:
    """Every effect at every place in every variant that the data can test."""
    terms, untestable = list[Term](), list[tuple[str, str]]()
    for name, effect in EFFECTS.items():
        if name in excluded_effects or effect.is_map:  # maps are sought when the rest is known
            continue
        if missing := effect.needs(posed_arm):
            untestable.append((name, missing))
            continue
        places = effect.places(posed_arm)
        for place in places:
            terms += [Term(name, place, c) for c in effect.choices(posed_arm, place)]
        if not places:
            untestable.append((name, "poses or joints at which it would show"))
    return CandidateLibrary.from_terms(
        ArmLaws(posed_arm, rows, excluded_effects), terms, untestable
    )
