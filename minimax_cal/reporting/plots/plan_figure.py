"""The picture of a plan (needs matplotlib)."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.planning.result import SEPARATION_CRITERION, Plan
from minimax_cal.reporting.plots.error_figure import (
    AFTER_COLOUR,
    BEFORE_COLOUR,
    new_figure,
    show_ticks_in_millimetres,
    write_figure,
)

CANDIDATE_COLOUR = "#bbbbbb"
MAX_DRAWN_TRACKER_DISTANCE_SPANS = (
    1.0  # of the candidates' span: a tracker farther off is told by an arrow
)


def save_plan(plan: Plan, path: Path) -> None:
    """Where the flange goes, from the side and from above, and what other numbers would tell."""
    figure = new_figure(13.5, 4.4)
    side, above, growth = figure.subplots(1, 3, width_ratios=(1.0, 1.2, 1.1))
    draw_flange_views(plan, side, above)
    draw_accuracy_growth(plan, growth)
    title = (
        f"{plan.cell.robot.name}: {plan.poses} poses by criterion {plan.criterion}, at least "
        f"{100.0 * plan.efficiency:.0f} % of the best possible"
    )
    figure.suptitle(textwrap.fill(title, 120), fontweight="bold")
    write_figure(figure, path)


def view_axes_from_vertical(vertical: Array) -> Array:
    """(3, 3) two level directions and the vertical, as rows."""
    level = np.eye(3)[int(np.argmin(np.abs(vertical)))]
    level = level - vertical * (vertical @ level)
    level = level / np.linalg.norm(level)
    return np.stack([level, np.cross(vertical, level), vertical])


def draw_flange_views(plan: Plan, side_axes: Any, top_axes: Any) -> None:
    """The flange at the candidates and at the poses chosen, the way, and the tracker."""
    robot, axes = plan.cell.robot, view_axes_from_vertical(plan.cell.robot.up)
    everywhere, chosen = (robot.pose(q)[:, :3, 3] @ axes.T for q in (plan.candidates.q, plan.q))
    eye = axes @ plan.place

    def out(points: Array) -> Array:
        return np.asarray(np.hypot(points[..., 0], points[..., 1]))

    for points, colour, size, name in (
        (everywhere, CANDIDATE_COLOUR, 1.0, "candidates"),
        (chosen, AFTER_COLOUR, 18.0, "chosen"),
    ):
        side_axes.scatter(out(points), points[:, 2], s=size, color=colour, label=name)
        top_axes.scatter(points[:, 0], points[:, 1], s=size, color=colour)
    top_axes.plot(chosen[:, 0], chosen[:, 1], color=AFTER_COLOUR, linewidth=0.6, alpha=0.7)
    panels = (
        (side_axes, np.stack([out(everywhere), everywhere[:, 2]], 1), np.array([out(eye), eye[2]])),
        (top_axes, everywhere[:, :2], eye[:2]),
    )
    far = (
        max(distance_in_spans(points, place) for _, points, place in panels)
        > MAX_DRAWN_TRACKER_DISTANCE_SPANS
    )
    for one, points, place in panels:
        draw_tracker_mark(one, points, place, f"{np.linalg.norm(eye):.1f} m away" if far else "")
    side_axes.set(xlabel="flange, distance from the base's vertical (mm)", ylabel="height (mm)")
    top_axes.set(xlabel="flange from above, along (mm)", ylabel="across (mm)")
    for one in (side_axes, top_axes):
        one.set_aspect("equal", adjustable="datalim")
        one.grid(visible=True, alpha=0.3)
        show_ticks_in_millimetres(one)
    side_axes.legend(frameon=False, fontsize="small")


def distance_in_spans(points: Array, position: Array) -> float:
    """How far a place is from the middle of points (m, 2), in their span."""
    return float(np.linalg.norm(position - points.mean(axis=0)) / np.ptp(points, axis=0).max())


def draw_tracker_mark(
    axes: Any, points: Array, tracker_position: Array, distance_text: str
) -> None:
    """The tracker, or the way to it where it would leave a thumbnail of the arm.

    distance_text: how far it is away, empty where it is near.
    """
    if not distance_text:
        axes.plot(*tracker_position, "^", color=BEFORE_COLOUR, linestyle="", label="tracker")
        return
    middle, span = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    way = (tracker_position - middle) / np.linalg.norm(tracker_position - middle)
    tip = middle + 0.75 * span * way
    arrow = {"arrowstyle": "-|>", "color": BEFORE_COLOUR, "linewidth": 1.5}
    axes.annotate("", tip, xytext=middle + 0.55 * span * way, arrowprops=arrow)
    axes.plot([], [], color=BEFORE_COLOUR, label=f"arrow: to the tracker, {distance_text}")
    axes.plot(*tip, alpha=0.0)  # within the limits


def draw_accuracy_growth(plan: Plan, axes: Any) -> None:
    """Sigma of a position, or power, against the number of poses."""
    poses = [row.poses for row in plan.growth]
    power = plan.criterion == SEPARATION_CRITERION
    curves = (
        {"power": [row.size for row in plan.growth]}
        if power
        else {
            "mean": [row.mean for row in plan.growth],
            "worst": [row.worst for row in plan.growth],
        }
    )
    for (name, pairs), style in zip(curves.items(), ("-", "--"), strict=False):
        for place, colour, who in ((0, AFTER_COLOUR, "planned"), (1, BEFORE_COLOUR, "random")):
            values = [1.0 / pair[place] if power else 1e6 * pair[place] for pair in pairs]
            axes.plot(poses, values, style, marker="o", ms=4, color=colour, label=f"{name}, {who}")
    if power:
        axes.axhline(plan.separation[0].needed, color="black", linewidth=0.8, label="enough")
    ylabel = "power" if power else "predicted sigma of a position (µm)"
    axes.set(xlabel="poses", ylabel=ylabel, ylim=(0.0, None))
    axes.set_xticks(poses)
    axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False, fontsize="small")
