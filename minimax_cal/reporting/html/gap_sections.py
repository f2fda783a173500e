"""The sections about a diagnosis: the gap, its causes, and what remains open."""

from __future__ import annotations

import math

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.diagnosing.sentences import closed_words
from minimax_cal.ground.records import reading
from minimax_cal.ground.tables import filled
from minimax_cal.reporting.html.content import Block, Blocks, missing, text
from minimax_cal.reporting.html.more_charts import curve_chart, waterfall
from minimax_cal.reporting.html.sources import Sources
from minimax_cal.reporting.tables import remaining_table, where_tables

CURVES = ("residual", "order")


def gap_steps(gap: Diagnosis) -> Blocks:
    """How far the gap closes, rung by rung."""
    left = filled(remaining_table(gap))
    return [waterfall(gap), gap.ladder_table(), text(closing(gap)), *left]


def closing(gap: Diagnosis) -> str:
    """How much of the gap closed, and how the model does on parts left out."""
    out = "Each step is judged on held-out poses; the noise floor is what noise alone would leave."
    if math.isfinite(gap.closed):
        out += f" With the steps after geometry {closed_words(gap)}."
    if gap.beyond.worst:
        out += f" {gap.beyond.sentence()} Geometry alone: {gap.beyond.geometric_typical_mm:.3f} mm."
    return out


def causes(sources: Sources) -> Blocks:
    """What was found, what else it could be, and what to measure next.

    Parameters of effects that the fit holds too are with the fit.
    """
    gap, fit = sources.gap, sources.fit
    if not gap:
        return ()
    blocks: list[Block] = []
    if gap.effects:
        blocks.append(gap.effects_table())
        blocks += [] if fit and fit.cell.effects.terms else [gap.parameter_table()]
    else:
        blocks.append(text("No effect beyond geometry was found."))
    blocks += [curve_chart(k, gap.curves[k], gap.held) for k in CURVES if k in gap.curves]
    rivals = gap.rival_table()
    if rivals.rows:
        blocks += [
            rivals,
            text(
                "Similarity: the fraction of the effect's motion that the alternative reproduces. "
                "Power: how well these data distinguish the two. A measurement is proposed where "
                "one helps."
            ),
        ]
    elif gap.effects:
        blocks.append(text("No alternative explains the effects as well; no further measurement is "
                           "needed to distinguish them."))  # fmt: skip
    if not gap.curves:
        blocks.append(missing("The file holds no curves to draw."))
    return blocks


def untestable(gap: Diagnosis) -> Blocks:
    """What is neither found nor excluded."""
    note = missing("Every effect of the library could be tested with these data.")
    return filled(gap.untestable_table()) or [note]


def places(gap: Diagnosis) -> Blocks:
    """Where the errors lie before any cause is named."""
    if not gap.where:
        return [missing("The file does not tell where the errors lie.")]
    with reading("diagnosis", "where"):
        worst = gap.where["by_region"]["worst"]
        blocks: list[Block] = [*where_tables(gap.where)]
    return [*blocks, *([text(f"Worst region: {worst}.")] if worst else [])]
