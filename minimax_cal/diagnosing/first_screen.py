"""What a diagnosis prints first: its sentences, and the error budget in at most six steps."""

from __future__ import annotations

from minimax_cal.diagnosing.result import Diagnosis, in_words
from minimax_cal.ground.tables import Cell, Table

MAX_STEPS = 6  # rows of the budget: nominal, geometry, effects, noise
STEPS = {"nominal": "nominal arm", "geometric": "calibrated geometry"}


def budget_table(found: Diagnosis) -> Table:
    """Held-out errors step by step, later effects as one step where there are many."""
    every = [(name_of(step.name), step.holdout) for step in found.ladder]
    most = MAX_STEPS - 1  # the last row is the noise
    if len(every) > most:
        more = len(every) - most + 1
        every = [*every[: most - 1], (f"+ {more} more effects", every[-1][1])]
    rows: list[tuple[Cell, ...]] = [(name, held.rms_mm, held.max_mm) for name, held in every]
    known = "" if found.floor.certain else ", at most"
    rows.append((f"measurement noise{known}", found.floor.value, ""))
    return Table(
        "error budget, step by step, on held-out poses",
        ("model", "RMS mm", "max mm"),
        tuple(rows),
        ("", ".3f", ".3f"),
    )


def name_of(step: str) -> str:
    """A step of the ladder in words, as + joint compliance at joint 2."""
    if not step.startswith("+ "):
        return STEPS.get(step, step)
    effect, _, place = step.removeprefix("+ ").partition(" ")
    return f"+ {effect.replace('_', ' ')} {in_words(place, effect)}"
