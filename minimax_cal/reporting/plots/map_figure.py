"""The picture of a map of the workspace (needs matplotlib)."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.reporting.plots.error_figure import (
    ERROR_COLOUR_MAP,
    add_colour_bar,
    build_log_colour_scale,
    new_figure,
    show_ticks_in_millimetres,
    write_figure,
)
from minimax_cal.validation.evaluation import AFTER, BEFORE
from minimax_cal.validation.workspace_maps import MapSection, WorkspaceMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNREACHED_COLOUR = "#dfe3e8"  # where no joints come
MIN_REACHED_FRACTION = (
    0.5  # share of a bin's samples among the training poses: fewer is extrapolation
)
POINT_STYLE_BY_HELD_OUT: dict[bool, dict[str, Any]] = {  # held out or not: size and rim of a point
    False: {"s": 14, "linewidths": 0.3, "edgecolors": "#777777"},
    True: {"s": 34, "linewidths": 0.9, "edgecolors": "black"},
}


def save_map(found: WorkspaceMap, path: Path) -> None:
    """Draw a map.  path: its suffix, one of `figures.PICTURES`, chooses the format."""
    columns = 3 if found.predicted else 2
    figure = new_figure(3.9 * columns, 9.0)
    grid = np.asarray(figure.subplots(2, columns, squeeze=False, sharex="row", sharey="row"))
    if found.predicted:
        draw_predicted_radius_maps(figure, grid[:, :1], found)
    draw_observed_error_maps(figure, grid[:, -2:], found)
    for row, part in zip(grid, found.sections, strict=True):
        x, y = (edges[[0, -1]] for edges in part.edges)
        row[0].set(ylabel=title_in_millimetres(part.axes[1]), xlim=x, ylim=y)
        for axes in row:
            axes.set(xlabel=title_in_millimetres(part.axes[0]), aspect="equal")
            show_ticks_in_millimetres(axes)
            axes.grid(visible=True, alpha=0.3)
            axes.set_facecolor(UNREACHED_COLOUR)
    title = textwrap.fill(f"{found.robot}: position over the workspace, base frame", 30 * columns)
    figure.suptitle(title, fontweight="bold")
    figure.supxlabel(describe_map_legend(found), fontsize="small")
    write_figure(figure, path)


def title_in_millimetres(title: str) -> str:
    """The title of an axis in metres that is shown in millimetres."""
    return title.replace("(m)", "(mm)")


def describe_map_legend(workspace_map: WorkspaceMap) -> str:
    """What the rows, the line and the points mean."""
    height, thick = 1e3 * workspace_map.height, 1e3 * workspace_map.slab
    return (
        "upper row: half-plane through axis 1, into which all poses are turned; lower row: "
        f"horizontal slab at {height:.0f} mm, {thick:.0f} mm thick (pale points lie outside it).\n"
        "line: on its far side most joints that come there lie beyond the training poses "
        "(extrapolation); grey: no joints come there.\nlarge ringed points: held-out poses; small "
        "points: training poses"
    )


def draw_predicted_radius_maps(
    figure: Figure, axes_grid: Array, workspace_map: WorkspaceMap
) -> None:
    """The worst radius in each bin."""
    every = [1e3 * part.worst.reshape(-1) for part in workspace_map.sections]
    scale = build_log_colour_scale(np.concatenate(every), 0.02)
    for axes, part in zip(axes_grid[:, 0], workspace_map.sections, strict=True):
        shown = axes.pcolormesh(
            *part.edges, 1e3 * part.worst.T, norm=scale, cmap=ERROR_COLOUR_MAP, rasterized=True
        )
        draw_training_region_outline(axes, part)
        axes.set_title("predicted, the worst of each bin", fontsize="medium")
    add_colour_bar(figure, shown, axes_grid, "radius that holds 95 % (mm)", "bottom")


def draw_observed_error_maps(figure: Figure, axes_grid: Array, workspace_map: WorkspaceMap) -> None:
    """Errors of the poses that were measured, before and after on one colour scale."""
    seen = workspace_map.seen
    scale = build_log_colour_scale(1e3 * np.concatenate([seen.before, seen.after]), 0.02)
    x, y, z = seen.place.T
    flat = np.abs(z - workspace_map.height) <= 0.5 * workspace_map.slab
    views = ((np.hypot(x, y), z, np.ones(len(x), dtype=bool)), (x, y, flat))
    for row, part, (across, along, inside) in zip(
        axes_grid, workspace_map.sections, views, strict=True
    ):
        pairs = ((BEFORE, seen.before), (AFTER, seen.after))
        for axes, (name, off) in zip(row, pairs, strict=True):
            ground = np.where(part.count > 0, 0.0, np.nan)
            axes.pcolormesh(*part.edges, ground.T, cmap="Greys", vmin=0, vmax=1, rasterized=True)
            draw_training_region_outline(axes, part)
            error = 1e3 * off
            for held, mark in POINT_STYLE_BY_HELD_OUT.items():
                for mask, alpha in ((~inside, 0.25), (inside, 1.0)):
                    rows = np.flatnonzero(mask & (seen.held == held) & np.isfinite(error))
                    rows = rows[np.argsort(error[rows])]  # the worst on top
                    shown = axes.scatter(
                        across[rows], along[rows], c=error[rows], norm=scale, cmap=ERROR_COLOUR_MAP,
                        alpha=alpha, zorder=3, **mark,
                    )  # fmt: skip
            axes.set_title(f"observed, {name}", fontsize="medium")
    add_colour_bar(figure, shown, axes_grid, "error of the targets' centroid (mm)", "bottom")


def draw_training_region_outline(axes: Axes, section: MapSection) -> None:
    """A line around the bins that the training poses reach."""
    from matplotlib.collections import LineCollection

    inside = np.pad(
        section.reached >= MIN_REACHED_FRACTION, 1
    )  # NaN, where no joints come, is no more
    i, j = np.nonzero(inside[1:, :] != inside[:-1, :])  # across x, then across y
    a, b = np.nonzero(inside[:, 1:] != inside[:, :-1])
    x, y = section.edges
    walls = [((x[u], y[v - 1]), (x[u], y[v])) for u, v in zip(i, j, strict=True)]
    floors = [((x[u - 1], y[v]), (x[u], y[v])) for u, v in zip(a, b, strict=True)]
    axes.add_collection(LineCollection([*walls, *floors], colors="black", linewidths=1.0))
