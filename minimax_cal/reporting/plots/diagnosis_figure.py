"""The picture of a diagnosis (needs matplotlib)."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.diagnosing.residual_curves import (
    RESIDUAL_VIEW_NAMES,
    ResidualCurve,
    ResidualViews,
    build_residual_curve,
    build_visit_order_curve,
)
from minimax_cal.modelling.effects.effect_names import format_budget_step
from minimax_cal.reporting.plots.error_figure import (
    AFTER_COLOUR,
    BEFORE_COLOUR,
    ERROR_COLOUR_MAP,
    add_colour_bar,
    build_log_colour_scale,
    new_figure,
    set_plain_log_ticks,
    show_ticks_in_millimetres,
    write_figure,
)

MAX_STEP_NAME_LETTERS = 36  # letters of a step in a line
MAX_STEP_FONT_SIZE, TOTAL_STEP_FONT_SIZE = (
    10.0,
    200.0,
)  # size of letters, and of all rungs' together: none touches another
VIEW_COLOURS = dict(zip(RESIDUAL_VIEW_NAMES, (BEFORE_COLOUR, AFTER_COLOUR, "#999999"), strict=True))


# ---- drawing -----------------------------------------------------------------------------------


def draw_error_budget(axes: Any, diagnosis: Diagnosis) -> None:
    """The error step by step, from the nominal robot down to the noise."""
    steps = diagnosis.ladder
    held = np.array([step.holdout.rms_mm for step in steps])
    train = np.array([step.train.rms_mm for step in steps])
    worst = np.array([step.holdout.max_mm for step in steps])
    at = np.arange(len(steps))
    axes.plot(held, at, "o-", color=AFTER_COLOUR, lw=1.0, label="held-out RMS")
    axes.plot(train, at, "o", color="black", mfc="none", ms=9, label="training RMS")
    axes.plot(worst, at, "|", color="black", ms=11, mew=2, label="largest, held out")
    if diagnosis.floor.value > 0.0:
        axes.axvline(diagnosis.floor.value, color="grey", ls="--", label="noise")
    numbers = np.concatenate([held, train, worst, [diagnosis.floor.value]])
    numbers = numbers[np.isfinite(numbers)]
    if numbers.min() > 0.0 and numbers.max() > 10.0 * numbers.min():
        axes.set_xscale("log")
        set_plain_log_ticks(axes.xaxis, numbers)
    else:
        axes.set_xlim(left=0.0)
    letters = min(MAX_STEP_FONT_SIZE, TOTAL_STEP_FONT_SIZE / len(steps))
    axes.set_yticks(
        at,
        [textwrap.fill(format_budget_step(step.name), MAX_STEP_NAME_LETTERS) for step in steps],
        fontsize=letters,
    )
    axes.set_ylim(len(steps) - 0.5, -0.5)
    right = axes.secondary_yaxis("right")
    right.set_yticks(at, [f"{value:.3f}" for value in held], fontsize=letters)
    right.tick_params(length=0)
    axes.set_xlabel("error (mm); on the right: held-out RMS")
    axes.grid(visible=True, axis="x", alpha=0.3)
    put_legend_above(axes, 2)


def put_legend_above(axes: Any, column_count: int) -> None:
    """The legend above the axes, where no point can lie under it."""
    axes.legend(
        frameon=False,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=column_count,
        fontsize="small",
        handletextpad=0.2,
        columnspacing=1.0,
        borderaxespad=0.1,
    )


def draw_residual_curve(
    axes: Any, remaining_errors: ResidualViews, curve: ResidualCurve, *, log_scale: bool = False
) -> None:
    """Points of training poses small and pale, of held-out poses large."""
    held = np.broadcast_to(remaining_errors.holdout_mask, curve.x.shape)
    for number, (y, (name, colour)) in enumerate(zip(curve.y, VIEW_COLOURS.items(), strict=False)):
        depth = 2.0 + number % 2  # the last view lies under the others
        axes.plot(curve.x[~held], y[~held], ".", color=colour, ms=4, alpha=0.5, zorder=depth)
        axes.plot(curve.x[held], y[held], "o", color=colour, ms=5, label=name, zorder=depth)
    axes.plot([], [], ".", color="black", ms=4, label="small: fitted")
    if log_scale and all(np.nanmin(y) > 0.0 for y in curve.y):
        axes.set_yscale("log")
        set_plain_log_ticks(axes.yaxis, np.concatenate(curve.y))
    elif not log_scale:
        axes.axhline(0.0, color="grey", lw=0.8)
    axes.set(xlabel=curve.xlabel, ylabel=curve.ylabel)
    axes.grid(visible=True, alpha=0.3)
    put_legend_above(axes, 4)


def padded_axis_limits(values: Array, widest_range: float) -> tuple[float, float]:
    """Limits of an axis that hold the values, a third as wide as the widest at least."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    half = 0.55 * max(high - low, widest_range / 3.0)
    return (low + high) / 2.0 - half, (low + high) / 2.0 + half


def draw_workspace_error_maps(subfigure: Any, remaining_errors: ResidualViews) -> None:
    """The errors over the workspace from above and from the side, all on one colour scale."""
    sizes = remaining_errors.error_distances()
    scale = build_log_colour_scale(np.concatenate([size.ravel() for size in sizes]), 0.05)
    up = remaining_errors.scene.robot.up
    tall = int(np.argmax(np.abs(up)))
    first, second = (axis for axis in range(3) if axis != tall)
    across, deep, high = (
        remaining_errors.measured_points[..., first],
        remaining_errors.measured_points[..., second],
        remaining_errors.measured_points @ up,
    )
    views = (("top", deep, f"{'xyz'[second]} (mm)"), ("side", high, "height (mm)"))
    widest = float(max(np.nanmax(along) - np.nanmin(along) for along in (across, deep, high)))
    wide = len(sizes) > 1  # one view stands beside the other; two above each other
    grid = subfigure.subplots(
        len(sizes), 2, squeeze=False, sharex=True, sharey="row" if wide else "none"
    )
    panels = [(view, *each) for view in views for each in zip(sizes, VIEW_COLOURS, strict=False)]
    for axes, ((view, down, label), size, name) in zip(grid.flat, panels, strict=True):
        order = np.argsort(np.nan_to_num(size), axis=None)  # the worst on top
        shown = axes.scatter(
            across.ravel()[order], down.ravel()[order],
            c=size.ravel()[order], norm=scale, cmap=ERROR_COLOUR_MAP, s=11, linewidths=0.3,
            edgecolors="#777777",
        )  # fmt: skip
        axes.set_aspect("equal", adjustable="box")
        show_ticks_in_millimetres(axes)
        axes.set(xlim=padded_axis_limits(across, widest), ylim=padded_axis_limits(down, widest))
        axes.set_title(f"{name}, {view}", fontsize="medium")
        axes.grid(visible=True, alpha=0.3)
        if axes in grid[:, 0] or not wide:
            axes.set_ylabel(label)
        if axes in grid[-1]:
            axes.set_xlabel(f"{'xyz'[first]} (mm)")
    add_colour_bar(subfigure, shown, grid, "error of a point (mm)", "right" if wide else "bottom")


def describe_verdict(diagnosis: Diagnosis) -> str:
    """The verdict in a few words."""
    names = [f.name for f in diagnosis.main_findings]
    shares = sum(f.share for f in diagnosis.main_findings if f.share > 0.0)
    share = f"{100.0 * shares:.0f} % of the squared error {diagnosis.describe_share_reference}"
    found = f"{format_first_names(names, 3)} explains {share}"
    return {
        "none": "no cause beyond geometry and noise",
        "named": found,
        "one_of": f"{found} (or what looks like it)",
        "unknown": f"unexplained in part; {found}" if names else "unexplained",
        "not_repeatable": "does not return to the same place",
    }[diagnosis.verdict]


def save_diagnosis(diagnosis: Diagnosis, path: Path | str) -> None:
    """The gap step by step, what is left against its cause, by visit order, and in the workspace.

    path: its suffix, one of `figures.PICTURES`, chooses the format.
    """
    left = diagnosis.leftover()
    residual, order = build_residual_curve(left), build_visit_order_curve(left)
    figure = new_figure(12.5, 10)
    title = textwrap.fill(f"{diagnosis.robot}: {describe_verdict(diagnosis)}", 110)
    figure.suptitle(title, fontweight="bold")
    parts: Any = figure.subfigures(2, 2, height_ratios=(4, 5), wspace=0.03, hspace=0.03)
    ends = (diagnosis.ladder[i].holdout.rms_mm for i in (0, -1))
    fall = "a  RMS error from {:.3f} to {:.3f} mm".format(*ends)
    titles = (fall, f"b  {residual.title}", f"c  {order.title}",
              "d  errors over the workspace (base frame)")  # fmt: skip
    for part, title in zip(parts.flat, titles, strict=True):
        part.suptitle(title, x=0.01, ha="left")
    draw_error_budget(parts[0, 0].subplots(), diagnosis)
    draw_residual_curve(parts[0, 1].subplots(), left, residual)
    draw_residual_curve(parts[1, 0].subplots(), left, order, log_scale=True)
    draw_workspace_error_maps(parts[1, 1], left)
    write_figure(figure, Path(path))
