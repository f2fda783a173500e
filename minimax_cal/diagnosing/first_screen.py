"""What a diagnosis prints first: its sentences, and the error budget in at most six steps."""

from __future__ import annotations

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.modelling.effects.words import name_step

MAX_STEPS = 6  # rows of the budget: nominal, geometry, effects, noise


def budget_table(found: Diagnosis) -> Table:
    """Held-out errors step by step, later effects as one step where there are many."""
    every = [(name_step(step.name), step.holdout) for step in found.ladder]
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
