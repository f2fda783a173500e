"""What a diagnosis prints first: its sentences, and the error budget in at most six steps."""

from __future__ import annotations

from collections import Counter

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.modelling.effects.words import name_step

NAMED = {"geometric": "calibrated geometry (least squares)"}  # `calibrate` may have another
MAX_STEPS = 6  # rows of the budget: nominal, geometry, effects, noise


def budget_table(found: Diagnosis) -> Table:
    """Held-out errors step by step, what follows the main causes as one step if it is long."""
    every = [(NAMED.get(step.name) or name_step(step.name), step.holdout) for step in found.ladder]
    most = MAX_STEPS - 1  # the last row is the noise
    if len(every) > most:
        main = [f.term.step for f in found.main]
        last = max((i for i, step in enumerate(found.ladder) if step.name in main), default=1)
        kept = min(last + 1, most - 1)
        every = [*every[:kept], (rest_of(found, kept), every[-1][1])]
    rows: list[tuple[Cell, ...]] = [(name, held.rms_mm, held.max_mm) for name, held in every]
    known = "" if found.floor.certain else ", at most"
    rows.append((f"measurement noise{known}", found.floor.value, ""))
    return Table(
        "error budget, step by step, on held-out poses",
        ("model", "RMS mm", "max mm"),
        tuple(rows),
        ("", ".3f", ".3f"),
    )


def rest_of(found: Diagnosis, kept: int) -> str:
    """The steps after those kept, counted by kind, as + 16 minor and 2 possible effects."""
    of_kind = (("main", found.main), ("minor", found.minor))
    kinds = {f.term.step: kind for kind, some in of_kind for f in some}
    counts = Counter(kinds.get(step.name, "possible") for step in found.ladder[kept:])
    said = [f"{counts[kind]} {kind}" for kind in ("main", "minor", "possible") if counts[kind]]
    return f"+ {' and '.join(said)} effect{'s' if counts.total() > 1 else ''}"
