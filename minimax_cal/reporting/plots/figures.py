"""Pictures of a calibration (needs matplotlib: pip install minimax-cal[plot])."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = (".png", ".svg", ".pdf")
BEFORE, AFTER = "#d55e00", "#0072b2"  # told apart by colour-blind eyes too [Okabe and Ito 2008]


def save(figure: Figure, path: Path) -> None:
    """Write a figure whole; the suffix, one of PICTURES, chooses the format."""
    kind = path.suffix.lower().lstrip(".")
    stream = io.BytesIO()
    stamp = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": None}[kind]
    figure.savefig(stream, format=kind, dpi=150, metadata=stamp)
    write_whole(path, stream.getvalue())


def save_errors(fit: Fit, path: Path) -> None:
    """Errors before and after: pose by pose, and their distribution on held-out poses."""
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator
    except ModuleNotFoundError as error:
        raise OptionError("a picture needs matplotlib: pip install minimax-cal[plot]") from error
    mpl.rcParams["svg.hashsalt"] = "minimax-cal"  # the same picture gives the same file

    def distances(key: str) -> Array:
        return 1e3 * np.asarray(np.linalg.norm(fit.errors[key], axis=-1))

    held = fit.accuracy["holdout"].poses > 0
    keys = ("nominal", "holdout") if held else ("nominal_train", "train")
    where = "held-out poses" if held else "training poses (none held out)"
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    for key, colour, name in zip(keys, (BEFORE, AFTER), ("nominal", "calibrated"), strict=True):
        distance = distances(key)
        a = fit.accuracy[key]
        pose = np.broadcast_to(np.arange(1, distance.shape[1] + 1), distance.shape)
        seen = np.isfinite(distance)
        text = f"{name}: RMS {a.rms_mm:.3f} mm, max {a.max_mm:.3f} mm"
        left.plot(pose[seen], distance[seen], ".", color=colour, label=text)
        values = np.sort(distance[seen])
        share = 100.0 * (np.arange(len(values)) + 1) / len(values)
        right.step(values, share, where="post", color=colour, label=name)
    left.set(xlabel=f"pose ({where})", ylabel="position error (mm)", yscale="log")
    right.set(xlabel="position error (mm)", ylabel="points with less error (%)", xscale="log")
    right.set_title("Cumulative distribution")
    for axes in (left, right):
        axes.grid(visible=True, alpha=0.3)
    left.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1.08), ncols=2)
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.suptitle(f"{fit.robot.name}, objective {fit.objective}", fontweight="bold")
    save(figure, path)
