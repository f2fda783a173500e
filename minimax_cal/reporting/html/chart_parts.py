"""The parts that charts are made of: axes, panels, points, lines.

Colours are names of the page's palette.  Before and after differ in colour and in marker or dash,
held-out and training poses in size, so that no one depends on colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.reporting.html.report_content import (
    ChartBlock,
    escape_figure_label,
    round_for_json,
)

PALETTE_COLOUR_NAMES = (
    "before",
    "after",
    "before-soft",
    "after-soft",
    "ink",
    "soft",
    "line",
    "back",
)
TRACE_LOOKS = {  # colour, marker, dash, colour of an area
    "before": ("before", "circle-open", "dash", "before-soft"),
    "after": ("after", "circle", "solid", "after-soft"),
    "third": ("soft", "diamond-open", "dot", "line"),
}
MIN_LOG_AXIS_RATIO = (
    10.0  # a larger ratio of the largest to the smallest number asks for a logarithmic axis
)
MAX_RATIO_WITH_MINOR_TICKS = 200.0  # beyond this ratio only powers of ten are marked
MAX_ONE_LINE_TITLE_LETTERS = 34  # letters of a title that need two lines


def build_axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with its unit in the title."""
    return {"title": {"text": title}, "type": "linear", **more}


def build_log_or_linear_axis(
    title: str, *values: Array, ratio: float = MIN_LOG_AXIS_RATIO, **more: Any
) -> dict[str, Any]:
    """A logarithmic axis where positive numbers spread wide, else one that starts at 0."""
    if not is_log_axis_better(*values, ratio=ratio):
        return build_axis(title, rangemode="tozero", **more)
    found = np.concatenate([np.ravel(v) for v in values])
    low, high = float(np.nanmin(found)), float(np.nanmax(found))
    steps = (1.0,) if high > MAX_RATIO_WITH_MINOR_TICKS * low else (1.0, 2.0, 5.0)
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    marks = {"tickmode": "array", "tickvals": ticks, "ticktext": [f"{t:g}" for t in ticks]}
    return {**build_axis(title, **more), "type": "log", **marks}


def break_title_in_two_lines(title: str) -> str:
    """A long title in two lines."""
    at = title.find(" ", len(title) // 2)
    parts = (
        (title[:at], title[at + 1 :])
        if len(title) > MAX_ONE_LINE_TITLE_LETTERS and at > 0
        else (title,)
    )
    return "<br>".join(map(escape_figure_label, parts))


def build_chart_layout(**axes: Any) -> dict[str, Any]:
    """A layout: the legend above, where no point can lie under it."""
    return {
        "margin": {"l": 56, "r": 12, "t": 58, "b": 44},
        "legend": {
            "orientation": "h",
            "x": 0,
            "xanchor": "left",
            "yref": "container",
            "y": 1.0,
            "yanchor": "top",
        },
        "hovermode": "closest",
        **axes,
    }


def panel_domain(panel_index: int, panel_count: int, gap: float = 0.09) -> list[float]:
    """Where a panel lies in the width."""
    width = (1.0 - gap * (panel_count - 1)) / panel_count
    left = panel_index * (width + gap)
    return [left, min(left + width, 1.0)]


def plotly_axis_name(letter: str, axis_index: int) -> str:
    """plotly's name of an axis: x, x2, x3 ..."""
    return letter if axis_index == 0 else f"{letter}{axis_index + 1}"


def plotly_layout_axis_name(letter: str, axis_index: int) -> str:
    """The same in a layout: xaxis, xaxis2, ..."""
    return f"{letter}axis" + ("" if axis_index == 0 else str(axis_index + 1))


def build_panel_title(title: str, panel_index: int, panel_count: int) -> dict[str, Any]:
    """A title of one panel, above it."""
    left, right = panel_domain(panel_index, panel_count)
    return {
        "text": escape_figure_label(title), "showarrow": False, "xref": "paper", "yref": "paper",
        "x": (left + right) / 2.0, "y": 1.0, "xanchor": "center", "yanchor": "bottom",
    }  # fmt: skip


def build_line_trace(
    look: str,
    name: str,
    x: Array,
    y: Array,
    *,
    panel_index: int = 0,
    as_steps: bool = False,
    **more: Any,
) -> dict[str, Any]:
    """A line; as steps that hold to the next x."""
    colour, _, dash, _ = TRACE_LOOKS[look]
    shape = {"shape": "hv"} if as_steps else {}
    return {
        "type": "scatter",
        "mode": "lines",
        "name": escape_figure_label(name),
        "legendgroup": name,
        "x": round_for_json(x),
        "y": round_for_json(y),
        "line": {"color": colour, "dash": dash, "width": 2, **shape},
        "xaxis": plotly_axis_name("x", panel_index),
        "yaxis": plotly_axis_name("y", panel_index),
        **more,
    }


def build_point_trace(
    look: str,
    name: str,
    x: Array,
    y: Array,
    *,
    is_held_out: bool,
    panel_index: int = 0,
    **more: Any,
) -> dict[str, Any]:
    """Points; those of held-out poses large, those of training poses small and pale."""
    colour, symbol, _, _ = TRACE_LOOKS[look]
    size, opacity = (7, 0.95) if is_held_out else (4, 0.5)
    return {
        "type": "scatter",
        "mode": "markers",
        "name": escape_figure_label(name),
        "legendgroup": name,
        "x": round_for_json(x),
        "y": round_for_json(y),
        "opacity": opacity,
        "marker": {"color": colour, "symbol": symbol, "size": size},
        "xaxis": plotly_axis_name("x", panel_index),
        "yaxis": plotly_axis_name("y", panel_index),
        **more,
    }


def is_log_axis_better(*values: Array, ratio: float = MIN_LOG_AXIS_RATIO) -> bool:
    """Whether numbers, all positive, spread so far that a logarithmic axis serves them."""
    found = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
    found = found[np.isfinite(found)]
    return bool(len(found) and found.min() > 0.0 and found.max() > ratio * found.min())


def build_point_traces(
    x: Array,
    views: Sequence[tuple[str, str, Array]],
    is_held_out: Array,
    *,
    panel_index: int = 0,
    **more: Any,
) -> list[dict[str, Any]]:
    """Points of several views (look, name, y) against x; held-out ones large.

    x, y, is_held_out: (m,).  The legend shows each name once.
    """
    out = []
    for look, name, y in views:
        for kind, chosen in ((True, is_held_out), (False, ~is_held_out)):
            if chosen.any():
                shown = {"showlegend": panel_index == 0 and (kind or not is_held_out.any())}
                rest = {k: np.asarray(v)[chosen].tolist() for k, v in more.items()}
                out.append(
                    build_point_trace(
                        look,
                        name,
                        x[chosen],
                        y[chosen],
                        is_held_out=kind,
                        panel_index=panel_index,
                        **shown,
                        **rest,
                    )
                )
    return out


def build_chart(
    name: str,
    title: str,
    description: str,
    traces: Sequence[dict[str, Any]],
    layout: dict[str, Any],
    height: int = 340,
) -> ChartBlock:
    """A chart with its words."""
    return ChartBlock(name, title, description, tuple(traces), layout, height)
