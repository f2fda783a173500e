"""Errors pose by pose, nominal and with minimax: the right halves of paper M's Fig. 2 to 4."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from experiments.conditions import Outcome
from minimax_cal.reporting.plots.figures import AFTER, BEFORE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = (("ap", "AP (mm)"), ("ao", "AO (mrad)"), ("ao_angle", "AO' (mrad)"))


def picture(title: str, found: dict[str, Outcome]) -> Figure:
    """Training poses in their order; of the three reflectors each is a dot."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.2), layout="constrained")
    for axes, (kind, name) in zip(figure.subplots(1, 3), SHOWN, strict=True):
        for condition, colour in (("nominal", BEFORE), ("minimax", AFTER)):
            errors = found[condition].train
            value = np.asarray(getattr(errors, kind)).reshape(len(errors.ao), -1)
            pose = np.repeat(np.arange(1, len(value) + 1), value.shape[1])
            axes.plot(pose, value.ravel(), ".", ms=3, color=colour, label=condition)
        axes.set(xlabel="pose", ylabel=name, yscale="log")
        axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    return figure
