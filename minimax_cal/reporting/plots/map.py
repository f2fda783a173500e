"""The picture of a map of the workspace (needs matplotlib)."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.judging.maps import Section, WorkspaceMap
from minimax_cal.judging.saved import AFTER, BEFORE
from minimax_cal.reporting.plots.figures import (
    MAP_COLOURS,
    in_millimetres,
    logarithmic,
    new_figure,
    save,
    scale_bar,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NOWHERE = "#dfe3e8"  # where no joints come
REACHED = 0.5  # share of a bin's samples among the training poses: fewer is extrapolation
MARKS: dict[bool, dict[str, Any]] = {  # held out or not: size and rim of a point
    False: {"s": 14, "linewidths": 0.3, "edgecolors": "#777777"},
    True: {"s": 34, "linewidths": 0.9, "edgecolors": "black"},
}


def save_map(found: WorkspaceMap, path: Path) -> None:
    """Draw a map.  path: its suffix, one of `figures.PICTURES`, chooses the format."""
    columns = 3 if found.predicted else 2
    figure = new_figure(3.9 * columns, 9.0)
    grid = np.asarray(figure.subplots(2, columns, squeeze=False, sharex="row", sharey="row"))
    if found.predicted:
        draw_predicted(figure, grid[:, :1], found)
    draw_observed(figure, grid[:, -2:], found)
    for row, part in zip(grid, found.sections, strict=True):
        x, y = (edges[[0, -1]] for edges in part.edges)
        row[0].set(ylabel=millimetres(part.axes[1]), xlim=x, ylim=y)
        for axes in row:
            axes.set(xlabel=millimetres(part.axes[0]), aspect="equal")
            in_millimetres(axes)
            axes.grid(visible=True, alpha=0.3)
            axes.set_facecolor(NOWHERE)
    title = textwrap.fill(f"{found.robot}: position over the workspace, base frame", 30 * columns)
    figure.suptitle(title, fontweight="bold")
    figure.supxlabel(legend(found), fontsize="small")
    save(figure, path)


def millimetres(title: str) -> str:
    """The title of an axis in metres that is shown in millimetres."""
    return title.replace("(m)", "(mm)")


def legend(found: WorkspaceMap) -> str:
    """What the rows, the line and the points mean."""
    height, thick = 1e3 * found.height, 1e3 * found.slab
    return (
        "upper row: half-plane through axis 1, into which all poses are turned; lower row: "
        f"horizontal slab at {height:.0f} mm, {thick:.0f} mm thick (pale points lie outside it).\n"
        "line: on its far side most joints that come there lie beyond the training poses "
        "(extrapolation); grey: no joints come there.\nlarge ringed points: held-out poses; small "
        "points: training poses"
    )


def draw_predicted(figure: Figure, grid: Array, found: WorkspaceMap) -> None:
    """The worst radius in each bin."""
    every = [1e3 * part.worst.reshape(-1) for part in found.sections]
    scale = logarithmic(np.concatenate(every), 0.02)
    for axes, part in zip(grid[:, 0], found.sections, strict=True):
        shown = axes.pcolormesh(
            *part.edges, 1e3 * part.worst.T, norm=scale, cmap=MAP_COLOURS, rasterized=True
        )
        outline(axes, part)
        axes.set_title("predicted, the worst of each bin", fontsize="medium")
    scale_bar(figure, shown, grid, "radius that holds 95 % (mm)", "bottom")


def draw_observed(figure: Figure, grid: Array, found: WorkspaceMap) -> None:
    """Errors of the poses that were measured, before and after on one colour scale."""
    seen = found.seen
    scale = logarithmic(1e3 * np.concatenate([seen.before, seen.after]), 0.02)
    x, y, z = seen.place.T
    flat = np.abs(z - found.height) <= 0.5 * found.slab
    views = ((np.hypot(x, y), z, np.ones(len(x), dtype=bool)), (x, y, flat))
    for row, part, (across, along, inside) in zip(grid, found.sections, views, strict=True):
        pairs = ((BEFORE, seen.before), (AFTER, seen.after))
        for axes, (name, off) in zip(row, pairs, strict=True):
            ground = np.where(part.count > 0, 0.0, np.nan)
            axes.pcolormesh(*part.edges, ground.T, cmap="Greys", vmin=0, vmax=1, rasterized=True)
            outline(axes, part)
            error = 1e3 * off
            for held, mark in MARKS.items():
                for mask, alpha in ((~inside, 0.25), (inside, 1.0)):
                    rows = np.flatnonzero(mask & (seen.held == held) & np.isfinite(error))
                    rows = rows[np.argsort(error[rows])]  # the worst on top
                    shown = axes.scatter(
                        across[rows], along[rows], c=error[rows], norm=scale, cmap=MAP_COLOURS,
                        alpha=alpha, zorder=3, **mark,
                    )  # fmt: skip
            axes.set_title(f"observed, {name}", fontsize="medium")
    scale_bar(figure, shown, grid, "error of the targets' centroid (mm)", "bottom")


def outline(axes: Axes, part: Section) -> None:
    """A line around the bins that the training poses reach."""
    from matplotlib.collections import LineCollection

    inside = np.pad(part.reached >= REACHED, 1)  # NaN, where no joints come, is no more
    i, j = np.nonzero(inside[1:, :] != inside[:-1, :])  # across x, then across y
    a, b = np.nonzero(inside[:, 1:] != inside[:, :-1])
    x, y = part.edges
    walls = [((x[u], y[v - 1]), (x[u], y[v])) for u, v in zip(i, j, strict=True)]
    floors = [((x[u - 1], y[v]), (x[u], y[v])) for u, v in zip(a, b, strict=True)]
    axes.add_collection(LineCollection([*walls, *floors], colors="black", linewidths=1.0))
