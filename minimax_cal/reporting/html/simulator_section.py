"""The section about the arm in a simulator: its ladder, and what it could not hold."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from minimax_cal.modelling.effects.words import name_step
from minimax_cal.reporting.html.charts import axis, figure, frame, line, log_axis
from minimax_cal.reporting.html.content import Block, Blocks, Figure, caveat, label, text
from minimax_cal.reporting.html.sources import Sources
from minimax_cal.simulators.motion.result import MotionGap
from minimax_cal.simulators.result import SimulatorGap


def blocks(sources: Sources) -> Blocks:
    """The ladder as a chart and a table, and in words; the same along trajectories."""
    along = [] if sources.motion is None else motion_blocks(sources.motion)
    gap = sources.simulator
    if gap is None:
        return along
    out: list[Block] = [ladder_chart(gap), gap.table(), text(gap.headline())]
    out += [caveat(f"Not in the model: {said}.") for said in gap.left_out]
    if gap.written:
        out.append(text(f"The corrected model is {gap.written}; the last figures are of it."))
    return [*out, *along]


def motion_blocks(gap: MotionGap) -> Blocks:
    """How far the model moves as the arm does, and what it could not hold."""
    first, *driven = gap.tables()
    out: list[Block] = [first, text(gap.headline()), *driven]
    out += [text(f"{said[0].upper()}{said[1:]}.") for said in gap.sentences()]
    if gap.written:
        out.append(text(f"The corrected model is {gap.written}."))
    return out


def ladder_chart(gap: SimulatorGap) -> Figure:
    """The ladder in the simulator."""
    rungs = gap.every
    held = np.array([rung.holdout_rms_mm for rung in rungs])
    worst = np.array([rung.holdout_max_mm for rung in rungs])
    said = np.array([rung.predicted_rms_mm for rung in rungs])
    at = np.arange(float(len(rungs)))
    traces: list[dict[str, Any]] = []
    for name, symbol, x in (
        ("held-out RMS in the simulator", "circle", held),
        ("as the fit says", "circle-open", said),
        ("largest, held out", "line-ns-open", worst),
    ):
        marker = {"color": "ink", "symbol": symbol, "size": 10, "line": {"width": 2}}
        traces.append(
            line("after", name, x, at, mode="markers", marker=marker) | {"line": {"width": 0}}
        )
    if math.isfinite(gap.floor) and gap.floor > 0.0:
        ends = np.array([-0.5, len(rungs) - 0.5])
        traces.append(line("third", "noise floor", np.full(2, gap.floor), ends))
    layout = frame(
        xaxis=log_axis("error (mm)", held, worst),
        yaxis=axis("", tickvals=at.tolist(),
                   ticktext=[label(name_step(rung.name)) for rung in rungs],
                   range=[len(rungs) - 0.5, -0.5], automargin=True, zeroline=False),
    )  # fmt: skip
    title = "The simulated arm, from the model as given to the corrected one"
    return figure("simulator", title, gap.headline(), traces, layout, 120 + 40 * len(rungs))
