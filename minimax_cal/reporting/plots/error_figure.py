"""Pictures of a calibration (needs matplotlib)."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any
from warnings import catch_warnings, filterwarnings

import numpy as np
from numpy.typing import ArrayLike

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.optional_packages import install_command

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure, FigureBase

    from minimax_cal.fitting.fit import Fit

PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
BEFORE_COLOUR, AFTER_COLOUR = (
    "#d55e00",
    "#0072b2",
)  # told apart by colour-blind eyes too [Okabe and Ito 2008]
ERROR_COLOUR_MAP = "OrRd"  # pale is small, dark is large: one hue, for colour-blind eyes too
MATPLOTLIB_NEEDED_MESSAGE = f"a picture needs matplotlib: {install_command('minimax-cal[plot]')}"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches.  Raises OptionError without matplotlib."""
    try:
        from matplotlib import figure
    except ModuleNotFoundError as error:
        raise OptionError(MATPLOTLIB_NEEDED_MESSAGE) from error
    return figure.Figure(figsize=(width, height), layout="constrained")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure whole; the suffix, one of PICTURES, chooses the format."""
    from matplotlib import rc_context
    from matplotlib.text import Text

    kind = path.suffix.lower().lstrip(".")
    stream = io.BytesIO()
    stamp = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": None}[kind]
    with (
        rc_context({"svg.hashsalt": "minimax-cal"}),  # the same picture gives the same file
        catch_warnings(),
    ):
        # labels of huge numbers leave no room for the axes: nothing that a user could mend
        filterwarnings("ignore", "constrained_layout not applied", UserWarning)
        powers = {  # the labels of ticks; all else may hold a name, and a name a dollar sign
            label
            for axes in figure.axes
            for axis in (axes.xaxis, axes.yaxis)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks())
            for label in (tick.label1, tick.label2)
        }
        for words in set(figure.findobj(Text)) - powers:
            words.set_parse_math(False)
        figure.savefig(stream, format=kind, dpi=150, metadata=stamp)
    write_file_atomically(path, stream.getvalue())


def build_log_colour_scale(values: Array, quantile: float) -> LogNorm:
    """A colour scale for lengths, from a quantile of the positive ones to the largest [mm]."""
    from matplotlib.colors import LogNorm

    known = values[np.isfinite(values) & (values > 0.0)]
    known = known if len(known) else np.ones(1)
    low, high = float(np.quantile(known, quantile)), float(known.max())
    return LogNorm(low, max(high, 1.5 * low))


def set_plain_log_ticks(axis: Axis, values: ArrayLike) -> None:
    """Labels 0.1 0.2 0.5 1 on a logarithmic axis; the powers of ten alone where those are many."""
    from matplotlib.ticker import LogLocator, NullFormatter

    many = np.nanmax(values) > 200.0 * np.nanmin(values)
    axis.set_major_locator(LogLocator(subs=(1.0,) if many else (1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def show_ticks_in_millimetres(axes: Axes) -> None:
    """Show the ticks of a panel, whose axes are in metres, in millimetres."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{1e3 * value:.0f}")


def add_colour_bar(
    figure: FigureBase, mappable: Any, axes_grid: Array, label: str, side: str
) -> None:
    """A colour bar beside its panels, or at their bottom, with plain numbers."""
    bar = figure.colorbar(
        mappable, ax=list(axes_grid.flat), label=label, extend="min", location=side, shrink=0.8
    )
    set_plain_log_ticks(bar.long_axis, [mappable.norm.vmin, mappable.norm.vmax])


def save_errors(fit: Fit, path: Path) -> None:
    """`plot_errors` as a file."""
    write_figure(plot_errors(fit), path)


def plot_errors(fit: Fit) -> Figure:
    """Errors before and after: pose by pose, and their distribution on held-out poses.

    Parameters
    ----------
    fit
        A calibration.

    Returns
    -------
    matplotlib.figure.Figure
        Errors in mm.

    Raises
    ------
    OptionError
        Without matplotlib.

    Examples
    --------
    >>> mc.plot_errors(fit).savefig("errors.png")
    """
    figure = new_figure(9, 4.0)
    from matplotlib.ticker import MaxNLocator

    held = fit.accuracy["holdout"].poses > 0
    keys = ("nominal", "holdout") if held else ("nominal_train", "train")
    where = "held-out poses" if held else "training poses (none held out)"
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    for key, colour, name in zip(
        keys, (BEFORE_COLOUR, AFTER_COLOUR), ("nominal", "calibrated"), strict=True
    ):
        distance = 1e3 * np.linalg.norm(fit.errors[key], axis=-1)
        a = fit.accuracy[key]
        pose = np.broadcast_to(np.arange(1, len(distance) + 1)[:, None], distance.shape)
        seen = np.isfinite(distance)
        text = f"{name}: RMS {a.rms_mm:.3f} mm, max {a.max_mm:.3f} mm"
        left.plot(pose[seen], distance[seen], ".", color=colour, label=text)
        values = np.sort(distance[seen])
        share = 100.0 * (np.arange(len(values)) + 1) / len(values)
        right.step(values, share, where="post", color=colour, label=name)
    left.set(xlabel=f"pose ({where})", ylabel="position error (mm)", yscale="log")
    right.set(xlabel="position error (mm)", ylabel="points with less error (%)", xscale="log")
    every = 1e3 * np.concatenate([np.linalg.norm(fit.errors[k], axis=-1).ravel() for k in keys])
    for axis in (left.yaxis, right.xaxis):
        set_plain_log_ticks(axis, every[every > 0.0])
    for axes in (left, right):
        axes.grid(visible=True, alpha=0.3)
    figure.legend(*left.get_legend_handles_labels(), frameon=False, loc="outside lower center",
                  ncols=2)  # fmt: skip
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    title = textwrap.fill(f"{fit.cell.robot.name}, objective {fit.objective}", 80)
    figure.suptitle(title, fontweight="bold")
    return figure
