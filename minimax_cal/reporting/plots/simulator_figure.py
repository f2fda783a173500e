"""The picture of a simulated arm beside the real one (needs matplotlib)."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.modelling.effects.effect_names import format_budget_step
from minimax_cal.reporting.plots.error_figure import (
    AFTER_COLOUR,
    BEFORE_COLOUR,
    new_figure,
    set_plain_log_ticks,
    write_figure,
)
from minimax_cal.simulators.result import SimulatorGap

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_simulator_gap_figure(gap: SimulatorGap, path: Path | str) -> None:
    """Draw the ladder.  path: its suffix, one of `figures.PICTURES`, chooses the format."""
    write_figure(build_simulator_gap_figure(gap), Path(path))


def build_simulator_gap_figure(gap: SimulatorGap) -> Figure:
    """The ladder in the simulator, from the model as given down to the noise."""
    rungs = gap.all_steps
    held = np.array([rung.holdout_rms_mm for rung in rungs])
    worst = np.array([rung.holdout_max_mm for rung in rungs])
    said = np.array([rung.predicted_rms_mm for rung in rungs])
    at = np.arange(len(rungs))
    figure = new_figure(9, 1.6 + 0.42 * len(rungs))
    axes = figure.subplots()
    axes.barh(
        at, held, height=0.5, color=[BEFORE_COLOUR, *[AFTER_COLOUR] * (len(at) - 1)], alpha=0.35
    )
    axes.plot(held, at, "o", color="black", label="held-out RMS in the simulator")
    axes.plot(said, at, "o", color="black", mfc="none", ms=10, label="as the fit says")
    axes.plot(worst, at, "|", color="black", ms=11, mew=2, label="largest, held out")
    if math.isfinite(gap.floor) and gap.floor > 0.0:
        axes.axvline(gap.floor, color="grey", ls="--", label="noise floor")
    known = np.concatenate([held, worst, [gap.floor] if math.isfinite(gap.floor) else []])
    if (positive := known[known > 0.0]).size:
        axes.set_xscale("log")
        axes.set_xlim(0.7 * positive.min(), 1.4 * positive.max())
        set_plain_log_ticks(axes.xaxis, positive)
    axes.set_yticks(at, [textwrap.fill(format_budget_step(rung.name), 28) for rung in rungs])
    axes.set_ylim(len(rungs) - 0.5, -0.5)
    axes.set_xlabel("error (mm)")
    axes.grid(visible=True, axis="x", alpha=0.3)
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4,
                fontsize="small")  # fmt: skip
    title = f"{gap.robot} in the simulator: {gap.holdout_poses} held-out poses"
    figure.suptitle(textwrap.fill(title, 90), fontweight="bold")
    return figure
