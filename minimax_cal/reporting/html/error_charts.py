"""How the errors are distributed, and what they go with: before and after, held out or not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.reporting.html.chart_parts import (
    TRACE_LOOKS,
    build_axis,
    build_chart,
    build_chart_layout,
    build_line_trace,
    build_log_or_linear_axis,
    build_panel_title,
    build_point_traces,
    panel_domain,
    plotly_axis_name,
    plotly_layout_axis_name,
)
from minimax_cal.reporting.html.report_content import (
    ChartBlock,
    escape_figure_label,
    round_for_json,
    select_drawn_indices,
)
from minimax_cal.reporting.html.report_sources import PosesWithErrors

MAX_DISTRIBUTION_STEPS = 400  # steps of a distribution that are drawn
MAX_RUNNING_MEDIAN_BINS = 12  # bins of a running median
MIN_POSES_PER_BIN = 5  # poses of a bin of it
JOINT_CHART_COLUMNS = 3
MIN_LOG_ERROR_RATIO = (
    100.0  # ratio of the largest to the smallest error that asks for a logarithmic axis
)
MIN_DRAWN_ERROR_MM = 1e-7  # errors below are rounding [mm]

BeforeAfterNames = tuple[str, str]
DrawTrace = Callable[[str, str, Array, int], dict[str, Any]]  # look, name, sizes (m, k), panel
POSITION_ERROR_LABEL = "position error (mm)"
HELD_OUT_POSES_LABEL, TRAINING_POSES_LABEL = "held-out poses", "training poses"


class PoseGroup(NamedTuple):
    """Held-out or training poses.  before, after: (m, k) sizes of errors [mm]."""

    name: str
    before: Array
    after: Array


class ChartPanels(NamedTuple):
    """Panels side by side, as plotly draws them."""

    traces: list[dict[str, Any]]
    layout: dict[str, Any]


class ChartedPoses(NamedTuple):
    """Poses drawn one by one.  sentence: how many are not, empty where all are."""

    pose_indices: Array
    sentence: str


class RunningMedian(NamedTuple):
    """Medians of x and y in bins, (bins,) each."""

    x: Array
    y: Array


def error_lengths(point_errors: Array) -> Array:
    """(m, k) sizes of errors (m, k, 3), NaN where not measured."""
    return np.asarray(np.linalg.norm(point_errors, axis=-1))


def rms_error_of_each_pose(point_errors: Array) -> Array:
    """(m,) RMS of the targets of each pose."""
    square = error_lengths(point_errors) ** 2
    seen = np.isfinite(square)
    return np.asarray(np.sqrt(np.nansum(square, axis=1) / np.maximum(seen.sum(axis=1), 1)))


def split_held_out_and_training(poses: PosesWithErrors) -> list[PoseGroup]:
    """Held-out and training poses, those that there are, each with sizes before and after."""
    before, after = error_lengths(poses.before), error_lengths(poses.after)
    parts = ((HELD_OUT_POSES_LABEL, poses.held), (TRAINING_POSES_LABEL, ~poses.held))
    seen = np.isfinite(after).any(axis=1)
    return [
        PoseGroup(name, before[rows], after[rows]) for name, rows in parts if (rows & seen).any()
    ]


def finite_drawable_values(values: Array) -> Array:
    """The numbers among values, rounding lifted to `MIN_DRAWN_ERROR_MM` so that a logarithm
    exists.
    """
    return np.asarray(np.maximum(values[np.isfinite(values)], MIN_DRAWN_ERROR_MM))


def all_error_lengths(poses: PosesWithErrors) -> Array:
    """All sizes of errors, before and after."""
    return np.concatenate(
        [
            finite_drawable_values(values)
            for _, *pair in split_held_out_and_training(poses)
            for values in pair
        ]
    )


def build_split_panels(
    poses: PosesWithErrors,
    names: BeforeAfterNames,
    build_trace: DrawTrace,
    x: dict[str, Any],
    y: dict[str, Any],
    **more: Any,
) -> ChartPanels:
    """Traces and layout of held-out and training poses side by side, on axes x and y."""
    found = split_held_out_and_training(poses)
    traces: list[dict[str, Any]] = []
    titles = [build_panel_title(name, i, len(found)) for i, (name, *_) in enumerate(found)]
    layout = build_chart_layout(annotations=titles, **more)
    for i, (_, *pair) in enumerate(found):
        looks = zip(TRACE_LOOKS, names, pair, strict=False)
        traces += [build_trace(look, name, values, i) for look, name, values in looks]
        layout |= build_panel_axes(i, len(found), x, y if i == 0 else {**y, "title": {"text": ""}})
    return ChartPanels(traces, layout)


def build_panel_axes(
    panel_index: int, panel_count: int, x: dict[str, Any], y: dict[str, Any]
) -> dict[str, Any]:
    """The axes of one panel beside others."""
    x, y = {**x, "domain": panel_domain(panel_index, panel_count)}, {**y}
    if panel_index:
        x["anchor"], y["anchor"] = (
            plotly_axis_name("y", panel_index),
            plotly_axis_name("x", panel_index),
        )
        y["matches"] = "y"
    return {
        plotly_layout_axis_name("x", panel_index): x,
        plotly_layout_axis_name("y", panel_index): y,
    }


def describe_error_percentiles(
    poses: PosesWithErrors, names: BeforeAfterNames, percent_text: str, percent: float
) -> str:
    """Percentiles in words."""
    return " ".join(
        f"On {name}, {percent_text} of the points lie within "
        f"{np.percentile(finite_drawable_values(one), percent):.3f} mm "
        f"({names[0]}) and {np.percentile(finite_drawable_values(other), percent):.3f}"
        f" mm ({names[1]})."
        for name, one, other in split_held_out_and_training(poses)
    )


def build_cumulative_error_chart(poses: PosesWithErrors, names: BeforeAfterNames) -> ChartBlock:
    """Which share of the points has less error than x."""

    def steps(look: str, name: str, values: Array, panel: int) -> dict[str, Any]:
        size = np.sort(finite_drawable_values(values))
        at = np.unique(
            np.linspace(0, len(size) - 1, min(len(size), MAX_DISTRIBUTION_STEPS)).astype(int)
        )
        share = 100.0 * (at + 1) / len(size)
        return build_line_trace(
            look, name, size[at], share, panel_index=panel, as_steps=True, showlegend=panel == 0
        )

    axes = (
        build_log_or_linear_axis(
            POSITION_ERROR_LABEL, all_error_lengths(poses), ratio=MIN_LOG_ERROR_RATIO
        ),
        build_axis("points with less error (%)"),
    )
    says = (
        f"Cumulative distribution of the position error. "
        f"{describe_error_percentiles(poses, names, '95 %', 95.0)}"
    )
    return build_chart("cumulative", "Which share of the points is better than a limit", says,
                  *build_split_panels(poses, names, steps, *axes), 260)  # fmt: skip


def build_target_box_chart(poses: PosesWithErrors, names: BeforeAfterNames) -> ChartBlock:
    """Quartiles and extremes of each target."""
    targets = [escape_figure_label(name) for name in poses.data.target_names]

    def quartiles(look: str, name: str, values: Array, panel: int) -> dict[str, Any]:
        return build_box_trace(look, name, targets, values, panel_index=panel)

    axes = (
        build_axis("") | {"type": "category"},
        build_log_or_linear_axis(POSITION_ERROR_LABEL, all_error_lengths(poses)),
    )
    says = (
        f"Box charts of the position error of each target, {names[0]} and {names[1]}: median, "
        "quartiles, smallest and largest error."
    )
    return build_chart("boxes", "Target by target", says,
                  *build_split_panels(poses, names, quartiles, *axes, boxmode="group"))  # fmt: skip


def build_box_trace(
    look: str, name: str, targets: list[str], error_lengths: Array, *, panel_index: int
) -> dict[str, Any]:
    """Boxes of one look: quartiles, and whiskers to the extremes; none where nothing was seen."""
    seen = np.flatnonzero(np.isfinite(error_lengths).any(axis=0)).tolist()
    at = np.array(
        [
            np.percentile(finite_drawable_values(error_lengths[:, i]), [0, 25, 50, 75, 100])
            for i in seen
        ]
    )
    low, q1, median, q3, high = at.reshape(-1, 5).T
    colour, symbol, _, soft = TRACE_LOOKS[look]
    fill = "back" if symbol.endswith("open") else soft
    return {
        "type": "box",
        "name": escape_figure_label(name),
        "legendgroup": name,
        "offsetgroup": name,
        "x": [targets[i] for i in seen],
        "lowerfence": round_for_json(low),
        "q1": round_for_json(q1),
        "median": round_for_json(median),
        "q3": round_for_json(q3),
        "upperfence": round_for_json(high),
        "line": {"color": colour, "width": 2},
        "fillcolor": fill,
        "showlegend": panel_index == 0,
        "xaxis": plotly_axis_name("x", panel_index),
        "yaxis": plotly_axis_name("y", panel_index),
    }


def select_drawn_poses(poses: PosesWithErrors) -> ChartedPoses:
    """Indices of the poses drawn one by one, and what to say if these are not all."""
    chosen = select_drawn_indices(rms_error_of_each_pose(poses.after))
    all_of_them = len(chosen) == len(poses.held)
    sentence = (
        f"{len(chosen)} of {len(poses.held)} poses are drawn: the worst, and an even choice of the "
        "others; lines are of all."
    )
    return ChartedPoses(chosen, "" if all_of_them else sentence)


def pose_hover_texts(poses: PosesWithErrors, pose_indices: Array) -> Array:
    """What each pose is called."""
    return np.array([poses.data.called(poses.data.line[i]) for i in pose_indices])


def running_median(x: Array, y: Array) -> RunningMedian:
    """Running median of y in bins of x that hold equally many poses."""
    order = np.argsort(x, kind="stable")
    bins = np.array_split(order, min(MAX_RUNNING_MEDIAN_BINS, max(len(x) // MIN_POSES_PER_BIN, 1)))
    return RunningMedian(*(np.array([np.median(v[b]) for b in bins]) for v in (x, y)))


def joint_axis_titles(poses: PosesWithErrors) -> list[str]:
    """Joints with the unit in which people read them."""
    return [f"joint {j + 1} ({'mm' if s else 'deg'})" for j, s in enumerate(poses.data.sliding)]


def joint_values_in_display_units(poses: PosesWithErrors) -> Array:
    """(m, n) joint values as people read them."""
    return np.asarray(poses.data.q * np.where(poses.data.sliding, 1e3, 180.0 / np.pi))


def pose_errors_before_and_after(poses: PosesWithErrors) -> list[Array]:
    """(m,) RMS of each pose before and after, rounding lifted [mm]."""
    return [
        np.maximum(rms_error_of_each_pose(error), MIN_DRAWN_ERROR_MM)
        for error in (poses.before, poses.after)
    ]


def build_pose_scatter_traces(
    poses: PosesWithErrors,
    names: BeforeAfterNames,
    x: Array,
    pose_indices: Array,
    panel_index: int = 0,
) -> list[Any]:
    """The chosen poses against x (m,), and running medians of all."""
    views = list(zip(TRACE_LOOKS, names, pose_errors_before_and_after(poses), strict=False))
    seen = np.isfinite(x)
    lines = [
        build_line_trace(
            look,
            f"{name}, median",
            *running_median(x[seen], size[seen]),
            panel_index=panel_index,
            showlegend=panel_index == 0,
        )
        for look, name, size in views
    ]
    drawn = [(look, name, size[pose_indices]) for look, name, size in views]
    text = pose_hover_texts(poses, pose_indices)
    return (
        build_point_traces(
            x[pose_indices], drawn, poses.held[pose_indices], panel_index=panel_index, text=text
        )
        + lines
    )


def build_error_by_joint_chart(poses: PosesWithErrors, names: BeforeAfterNames) -> ChartBlock:
    """The error of each pose against each joint."""
    chosen, cut = select_drawn_poses(poses)
    q, titles = joint_values_in_display_units(poses), joint_axis_titles(poses)
    columns = min(len(titles), JOINT_CHART_COLUMNS)
    rows = -(-len(titles) // columns)
    traces: list[dict[str, Any]] = []
    layout = build_chart_layout(grid={"rows": rows, "columns": columns, "pattern": "independent",
                         "xgap": 0.16, "ygap": 0.36})  # fmt: skip
    for j, title in enumerate(titles):
        traces += build_pose_scatter_traces(poses, names, q[:, j], chosen, j)
        more: dict[str, Any] = {"matches": "y"} if j else {}
        layout[plotly_layout_axis_name("x", j)] = build_axis(title, nticks=5)
        layout[plotly_layout_axis_name("y", j)] = build_log_or_linear_axis(
            "error (mm)" if j % columns == 0 else "", *pose_errors_before_and_after(poses), **more
        )
    says = (
        "The error of each pose (RMS of its targets) against each joint; a line that rises or "
        f"waves speaks of a cause in that joint. Lines are running medians. {cut}"
    ).strip()
    return build_chart("joints", "Error against each joint", says, traces, layout, 90 + 230 * rows)


def build_error_by_quantity_chart(
    poses: PosesWithErrors,
    names: BeforeAfterNames,
    name_title_and_label: tuple[str, str, str],
    x: Array,
) -> ChartBlock:
    """The error of each pose against something else.  name_title_and_label: name, title, label of
    the axis.
    """
    name, title, xlabel = name_title_and_label
    chosen, cut = select_drawn_poses(poses)
    layout = build_chart_layout(
        xaxis=build_axis(xlabel),
        yaxis=build_log_or_linear_axis(
            "error of a pose (mm)", *pose_errors_before_and_after(poses)
        ),
    )
    says = (
        f"The error of each pose (RMS of its targets) against {xlabel}. Lines are running "
        f"medians. {cut}"
    ).strip()
    return build_chart(
        name, title, says, build_pose_scatter_traces(poses, names, x, chosen), layout
    )


def build_error_over_time_charts(
    poses: PosesWithErrors, names: BeforeAfterNames
) -> tuple[ChartBlock, ...]:
    """Against visit order, and against time, temperature and load where these were written down."""
    told = ("Error by visit order", "visit (first to last)") if poses.has_visit_order else (
        "Error by row", "row of the file (it tells no visit order)")  # fmt: skip
    out = [build_error_by_quantity_chart(poses, names, ("order", *told), poses.visit_numbers)]
    for column, name, title, xlabel in (
        ("time", "time", "Error over time", "time (s)"),
        ("temperature", "temperature", "Error against temperature", "temperature (°C)"),
        ("payload", "payload", "Error against payload", "payload (kg)"),
    ):
        values = poses.data.columns.get(column, np.zeros(0))
        if np.isfinite(values).any() and np.ptp(values[np.isfinite(values)]) > 0.0:
            out.append(build_error_by_quantity_chart(poses, names, (name, title, xlabel), values))
    return tuple(out)
