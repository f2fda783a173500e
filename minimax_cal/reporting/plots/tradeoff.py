"""The curve between the least RMS and the least worst error, drawn."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np

from minimax_cal.judging.tradeoff import Tradeoff
from minimax_cal.reporting.plots.figures import AFTER, BEFORE, free_side, new_figure, save


def save_tradeoff(found: Tradeoff, path: Path | str) -> None:
    """The curve, training and held out.

    path: its suffix, one of `figures.PICTURES`, chooses the format.
    """
    figure = new_figure(10, 4.2)
    from matplotlib.patheffects import withStroke

    parts = {"training poses": [c.train for c in found.choices]}
    if found.choices[0].holdout.poses:
        parts["held-out poses"] = [c.holdout for c in found.choices]
    panels = figure.subplots(1, len(parts), squeeze=False)[0]
    for axes, (name, judged), colour in zip(panels, parts.items(), (BEFORE, AFTER), strict=False):
        axes.plot([a.rms_mm for a in judged], [a.max_mm for a in judged], "o-", color=colour)
        axes.set(xlabel="RMS error (mm)", ylabel="largest error (mm)")
        axes.set_title(f"{judged[0].poses} {name}")
        axes.margins(0.15)
        axes.grid(visible=True, alpha=0.3)
        axes.autoscale_view()
        spots = np.array([(a.rms_mm, a.max_mm) for a in judged])
        for number, spot in enumerate(spots):
            text = {0: "sum", len(judged) - 1: "point"}.get(number, str(number))
            axes.annotate(
                text, spot, xytext=free_side(axes, spots, number), textcoords="offset points",
                ha="center", va="center",
                path_effects=[withStroke(linewidth=3, foreground="white")],
            )  # fmt: skip
    title = textwrap.fill(f"{found.robot}: RMS against the largest error", 80)
    figure.suptitle(title, fontweight="bold")
    save(figure, Path(path))
