"""The sections about a diagnosis: the gap, its causes, and what remains open."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.reporting.html.content import Block, Section, missing, text
from minimax_cal.reporting.html.gap_tables import (
    effect_parameters,
    effects_table,
    ladder_table,
    place_tables,
    rival_table,
    untestable_table,
)
from minimax_cal.reporting.html.more_charts import curve_chart, waterfall
from minimax_cal.reporting.html.sources import Diagnosed, Sources, reading

NO_GAP = (
    "Not in this report: it was made without a diagnosis; give the file of `minimax-cal diagnose "
    "-o` as well."
)
CURVES = ("residual", "order")


def gap_section(sources: Sources) -> Section:
    """How far the gap closes, rung by rung."""
    blocks: list[Block] = []
    for gap in sources.gaps:
        blocks += [waterfall(gap.content), ladder_table(gap.content), text(closing(gap))]
    return Section("gap", "The gap, step by step", tuple(blocks) or (missing(NO_GAP),))


def closing(gap: Diagnosed) -> str:
    """How much of the gap closed, and how it does on the end of the session."""
    g = gap.content.gap
    out = "Each step is judged on held-out poses; the noise floor is what noise alone would leave."
    if math.isfinite(g.closed):
        low, high = (100.0 * end for end in g.closed_ci95)
        ends = f" (95 % interval {low:.0f} to {high:.0f} %)" if math.isfinite(low) else ""
        out += f" The steps after geometry close {100.0 * g.closed:.0f} % of the gap{ends}."
    last = g.blocked.get("final_rms_mm", math.nan)
    first = g.blocked.get("geometric_rms_mm", math.nan)
    if math.isfinite(last):
        out += (
            f" With the last {g.blocked.get('last_poses', 0):.0f} poses of the session held out "
            f"instead, geometry leaves {first:.3f} mm RMS and the last step {last:.3f} mm."
        )
    return out


def causes_section(sources: Sources) -> Section:
    """What was found, what else it could be, and what to measure next."""
    blocks: list[Block] = []
    for gap in sources.gaps:
        c = gap.content
        held = gap.poses[0].held if gap.poses else np.zeros(0, dtype=bool)
        with reading(gap.path, "effects or curves"):
            if c.effects:
                blocks += [effects_table(c), effect_parameters(c)]
            else:
                blocks.append(text("No effect beyond geometry was found."))
            blocks += [curve_chart(k, c.curves[k], held) for k in CURVES if k in c.curves]
            rivals = rival_table(c)
            if rivals.rows:
                blocks.append(rivals)
                blocks.append(
                    text(
                        "Likeness is how much of the named effect's motion the rival imitates (1: "
                        "all of it). Power is what these data have to tell the two apart: 25 is "
                        "enough, and the measurement proposed aims at that."
                    )
                )
            elif c.effects:
                blocks.append(text("No rival explains the effects as well: nothing is to be "
                                   "measured to tell them apart."))  # fmt: skip
        if not c.curves:
            blocks.append(missing("The file holds no curves to draw."))
    return Section("causes", "Causes, and their rivals", tuple(blocks) or (missing(NO_GAP),))


def untestable_section(sources: Sources) -> Section:
    """What is neither found nor excluded."""
    blocks: list[Block] = []
    for gap in sources.gaps:
        table = untestable_table(gap.content)
        blocks.append(
            table
            if table.rows
            else text("Every effect of the library could be tested with these data.")
        )
    return Section("untestable", "What could not be tested", tuple(blocks) or (missing(NO_GAP),))


def where_section(sources: Sources) -> Section:
    """Where the errors lie before any cause is named."""
    blocks: list[Block] = []
    for gap in sources.gaps:
        with reading(gap.path, "where"):
            if gap.content.where:
                blocks += place_tables(gap.content.where)
                worst = gap.content.where["by_region"]["worst"]
                if worst:
                    blocks.append(text(f"Worst region: {worst}."))
    title = "Where geometry leaves errors"
    return Section("where", title, tuple(blocks) or (missing(NO_GAP),))
