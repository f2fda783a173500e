"""The picture of a map of the workspace (needs matplotlib: pip install minimax-cal[plot])."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.judging.maps import Section, WorkspaceMap
from minimax_cal.judging.saved import AFTER, BEFORE
from minimax_cal.reporting.plots.figures import logarithmic, new_figure, save, scale_bar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = "cividis_r"  # dark is large; even for colour-blind eyes [Nunez et al. 2018]
HATCHES = {0.5: "///", 1e-9: "xxx"}  # of bins whose share of reached samples is below this
MARKS: dict[bool, dict[str, Any]] = {  # held out or not: size and rim of a point
    False: {"s": 12, "linewidths": 0.0},
    True: {"s": 34, "linewidths": 0.9, "edgecolors": "black"},
}


def save_map(found: WorkspaceMap, path: Path) -> None:
    """Draw a map.  path: its suffix, one of `figures.PICTURES`, chooses the format."""
    columns = 4 if found.predicted else 2
    figure = new_figure(3.9 * columns, 9.0)
    grid = np.asarray(figure.subplots(2, columns, squeeze=False, sharex="row", sharey="row"))
    if found.predicted:
        draw_predicted(figure, grid[:, :2], found)
    draw_observed(figure, grid[:, -2:], found)
    for row, part in zip(grid, found.sections, strict=True):
        row[0].set(ylabel=part.axes[1], xlim=part.x[[0, -1]], ylim=part.y[[0, -1]])
        for axes in row:
            axes.set(xlabel=part.axes[0], aspect="equal")
            axes.grid(visible=True, alpha=0.3)
    figure.suptitle(f"{found.robot}: position over the workspace, base frame", fontweight="bold")
    figure.supxlabel(legend(found), fontsize="small")
    save(figure, path)


def legend(found: WorkspaceMap) -> str:
    """What the rows, the hatching and the points mean."""
    return (
        "upper row: half-plane through axis 1, into which all poses are turned; lower row: "
        f"horizontal slab at {found.height:.2f} m, {found.slab:.2f} m thick (pale points lie "
        "outside it).\nhatched: extrapolation, most joints (crossed: all) that come there lie "
        "beyond the training poses; blank: no joints come there.\nlarge ringed points: held-out "
        "poses; small points: training poses"
    )


def draw_predicted(figure: Figure, grid: Array, found: WorkspaceMap) -> None:
    """Median and worst radius in each bin."""
    every = [1e3 * part for s in found.sections for part in (s.median, s.worst)]
    scale = logarithmic(np.concatenate([part.reshape(-1) for part in every]), 0.02)
    for row, part in zip(grid, found.sections, strict=True):
        both = {"median": part.median, "worst": part.worst}
        for axes, (name, values) in zip(row, both.items(), strict=True):
            shown = axes.pcolormesh(
                part.x, part.y, 1e3 * values.T, norm=scale, cmap=COLOURS, rasterized=True
            )
            hatch(axes, part)
            axes.set_title(f"predicted, {name} of each bin", fontsize="medium")
    scale_bar(figure, shown, grid, "radius that holds 95 % (mm)", "bottom")


def draw_observed(figure: Figure, grid: Array, found: WorkspaceMap) -> None:
    """Errors of the poses that were measured, before and after on one colour scale."""
    seen = found.seen
    scale = logarithmic(1e3 * np.concatenate(list(seen.error.values())), 0.02)
    x, y, z = seen.place.T
    flat = np.abs(z - found.height) <= 0.5 * found.slab
    views = ((np.hypot(x, y), z, np.ones(len(x), dtype=bool)), (x, y, flat))
    for row, part, (across, along, inside) in zip(grid, found.sections, views, strict=True):
        for axes, name in zip(row, (BEFORE, AFTER), strict=True):
            ground = np.where(part.count > 0, 0.08, np.nan)
            axes.pcolormesh(part.x, part.y, ground.T, cmap="Greys", vmin=0, vmax=1, rasterized=True)
            hatch(axes, part)
            error = 1e3 * seen.error[name]
            for held, mark in MARKS.items():
                for mask, alpha in ((~inside, 0.25), (inside, 1.0)):
                    rows = np.flatnonzero(mask & (seen.held == held) & np.isfinite(error))
                    rows = rows[np.argsort(error[rows])]  # the worst on top
                    shown = axes.scatter(
                        across[rows], along[rows], c=error[rows], norm=scale, cmap=COLOURS,
                        alpha=alpha, zorder=3, **mark,
                    )  # fmt: skip
            axes.set_title(f"observed, {name}", fontsize="medium")
    scale_bar(figure, shown, grid, "error of the targets' centroid (mm)", "bottom")


def hatch(axes: Axes, part: Section) -> None:
    """Hatch the bins whose samples lie beyond the training poses: most of them, or all."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    least = 0.0
    for below, pattern in sorted(HATCHES.items()):
        i, j = np.nonzero((part.reached >= least) & (part.reached < below))
        least = below
        if len(i):
            ring = ((0, 0), (1, 0), (1, 1), (0, 1))
            corners = [np.column_stack([part.x[i + a], part.y[j + b]]) for a, b in ring]
            outline = Outline.make_compound_path_from_polys(np.stack(corners, axis=1))
            axes.add_patch(
                PathPatch(outline, facecolor=(1, 1, 1, 0.3), edgecolor="#666666", lw=0.0,
                          hatch=pattern)
            )  # fmt: skip
