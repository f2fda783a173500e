"""The laws of an arm as a dictionary of the evidence: effects at places, in variants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.evidence.library import Library, Spec
from minimax_cal.evidence.noise import Noise
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.gears import GEAR_RIPPLE
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, FREE, Term
from minimax_cal.modelling.periodogram import is_expected, strongest_lines
from minimax_cal.modelling.rows import Posed

SHAPES = FREE - {"turns"}  # tuned numbers; a line's frequency is paid by its tries


@dataclass(frozen=True, eq=False)
class ArmLaws:
    """The effects of an arm, for its linearised errors.  exclude: those that are not sought."""

    scene: Scene
    problem: Posed
    exclude: Sequence[str] = ()

    def spec(self, term: Term) -> Spec | None:
        """An effect with its columns; None where it moves no point."""
        columns, effect = term.columns(self.scene), EFFECTS[term.effect]
        fields = columns.displacement(self.scene)
        if not np.any(fields):
            return None
        doubts = columns.doubts(self.scene)
        owner = [number for number, part in doubts for _ in part]
        loose = np.concatenate([np.zeros((0, *fields.shape[1:])), *(part for _, part in doubts)])
        tuned = (value for name, value in term.choice.items() if name in SHAPES)
        return Spec(
            term=term,
            text=term.text,
            key=term.key,
            columns=self.problem.of(fields),
            doubts=self.problem.of(loose),
            owner=np.array(owner, dtype=int),
            nonnegative=effect.upward(columns),
            typical=effect.typical,
            tuned=int(sum(np.isfinite(value) for value in tuned)),
            repeats=effect.lines and term.place != "all",
        )

    def finer(self, term: Term) -> list[Term]:
        """The effect with what its law has chosen closer together."""
        choices = EFFECTS[term.effect].finer(self.scene, term.choice)
        return [replace(term, choice=choice) for choice in choices]

    def lines(self, noise: Noise, known: Array, found: Sequence[Term]) -> list[tuple[Term, float]]:
        """Lines of gears, with the frequencies tried: `periodogram.strongest_lines`."""
        if GEAR_RIPPLE.name in self.exclude:
            return []
        return strongest_lines(self.scene, self.problem, noise, known, heard=found)

    def is_expected(self, line: Term, found: Sequence[Term]) -> bool:
        """Whether a line is where its gear's is."""
        return is_expected(self.scene, line, found)


def arm_library(scene: Scene, rows: Posed, exclude: Sequence[str] = ()) -> Library:
    """Every effect at every place in every variant that the data can test."""
    terms, untestable = list[Term](), list[tuple[str, str]]()
    for name, effect in EFFECTS.items():
        if name in exclude or effect.is_map:  # maps are sought when the rest is known
            continue
        if missing := effect.needs(scene):
            untestable.append((name, missing))
            continue
        places = effect.places(scene)
        for place in places:
            terms += [Term(name, place, c) for c in effect.choices(scene, place)]
        if not places:
            untestable.append((name, "poses or joints at which it would show"))
    return Library.of(ArmLaws(scene, rows, exclude), terms, untestable)
