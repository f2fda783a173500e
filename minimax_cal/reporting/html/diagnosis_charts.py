"""Charts of correlations, of an error budget and of what a diagnosis leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import capitalise_sentence
from minimax_cal.diagnosing.diagnosis import POSSIBLE_STEP_NAME, Diagnosis
from minimax_cal.diagnosing.residual_curves import RESIDUAL_VIEW_NAMES, ResidualCurve
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.modelling.effects.effect_names import parameter_name_without_effect
from minimax_cal.reporting.html.chart_parts import (
    TRACE_LOOKS,
    break_title_in_two_lines,
    build_axis,
    build_chart,
    build_chart_layout,
    build_line_trace,
    build_log_or_linear_axis,
    build_point_traces,
    plotly_axis_name,
)
from minimax_cal.reporting.html.report_content import (
    ChartBlock,
    escape_figure_label,
    round_for_json,
    select_drawn_indices,
)

MAX_CORRELATION_MAP_LABELS = 24  # of a side of the map of correlations
MAX_AXIS_STRETCH = 2.0  # an axis that a few points stretch more than this is cut


class ParameterCorrelations(NamedTuple):
    """Correlations (p, p) of named parameters."""

    names: tuple[str, ...]
    matrix: Array


class TrimmedAxis(NamedTuple):
    """Limits of an axis, empty where all points fit; how many points lie outside."""

    limits: list[float]
    sentence: str


def identified_correlations(uncertainty: Uncertainty) -> ParameterCorrelations:
    """Names of the identified parameters, and their correlations; NaN without a variance."""
    place = np.flatnonzero(uncertainty.active)
    names = tuple(uncertainty.names.all_names[i] for i in place)
    return ParameterCorrelations(names, uncertainty.correlation[np.ix_(place, place)])


def build_correlation_map(uncertainty: Uncertainty) -> ChartBlock:
    """Correlations of the identified parameters, as a matrix of colours."""
    told, found = identified_correlations(uncertainty)
    names = [escape_figure_label(name) for name in told]
    rows = [round_for_json(row, 3) for row in found]
    trace = {
        "type": "heatmap", "x": names, "y": names, "z": rows, "zmin": -1.0, "zmax": 1.0,
        "colorscale": [[0.0, "before"], [0.5, "back"], [1.0, "after"]],
        "colorbar": {"title": {"text": "correlation"}, "thickness": 10, "orientation": "h",
                     "len": 0.8, "y": 1.02, "yanchor": "bottom",
                     "tickvals": [-1, 0, 1], "tickangle": 0},
        "hovertemplate": "%{x}, %{y}: %{z:.3f}<extra></extra>",
        "xaxis": plotly_axis_name("x", 0), "yaxis": plotly_axis_name("y", 0),
    }  # fmt: skip
    # more labels than these hide each other; all are told where one points
    every = int(np.ceil(len(names) / MAX_CORRELATION_MAP_LABELS))
    short = [parameter_name_without_effect(name) for name in names]
    short = short if len(set(short)) == len(short) else names
    tick = {"type": "category", "tickfont": {"size": 10}, "showgrid": False,
            "tickvals": names[::every], "ticktext": short[::every]}  # fmt: skip
    layout = build_chart_layout(
        xaxis=build_axis("") | tick | {"tickangle": -90},
        yaxis=build_axis("") | tick | {"autorange": "reversed"},
    )
    off = np.abs(found[~np.eye(len(found), dtype=bool)])
    worst = f"; the largest is {np.nanmax(off):.3f}" if np.isfinite(off).any() else ""
    says = f"Correlations of {len(names)} identified parameters{worst}."
    height = int(np.clip(150 + 14 * len(names), 320, 720))
    return build_chart(
        "correlations", "Which parameters hang together", says, (trace,), layout, height
    )


def build_budget_chart_of_diagnosis(diagnosis: Diagnosis) -> ChartBlock:
    """The error budget of a diagnosis, as on a first screen."""
    *steps, _ = (
        r for table in diagnosis.first_tables() for r in table.rows if r[0] != POSSIBLE_STEP_NAME
    )
    return build_budget_chart("ladder", steps, diagnosis.floor.value)


def build_budget_chart(
    name: str,
    steps: Sequence[Sequence[Any]],
    noise_mm: float = math.nan,
    predicted_rms_mm: Sequence[float] = (),
) -> ChartBlock:
    """What each step leaves of the error.

    steps: name, held-out RMS, largest.  predicted_rms_mm: RMS as a fit says.  noise_mm: of the
    noise, NaN where not known.  All [mm].
    """
    names, held, worst = zip(*steps, strict=True)
    at, ends = np.arange(len(steps)), np.array([-0.5, len(steps) - 0.5])
    marks = [("RMS", "circle", held), ("largest", "line-ns-open", worst)]
    marks += (
        [("RMS, as the fit says", "circle-open", tuple(predicted_rms_mm))]
        if predicted_rms_mm
        else []
    )
    traces: list[dict[str, Any]] = []
    for words, symbol, x in marks:
        marker = {"color": "ink", "symbol": symbol, "size": 10, "line": {"width": 2}}
        traces.append(
            build_line_trace("after", words, np.array(x), at, mode="markers", marker=marker)
            | {"line": {"width": 0}}
        )
    if noise_mm > 0.0:
        traces.append(build_line_trace("third", "noise", np.full(2, noise_mm), ends))
    marks_are = "dot RMS, bar largest" + ", circle as the fit says" * bool(predicted_rms_mm)
    sizes = (np.array(one) for one in (held, worst, [noise_mm] if noise_mm > 0.0 else []))
    layout = build_chart_layout(
        xaxis=build_log_or_linear_axis(f"error (mm): {marks_are}", *sizes),
        yaxis=build_axis(
            "",
            tickvals=at.tolist(),
            ticktext=[escape_figure_label(name) for name in names],
            range=ends[::-1].tolist(),
            automargin=True,
            zeroline=False,
            tickfont={"size": 11},
        ),
        margin={"l": 56, "r": 12, "t": 8, "b": 44},
        showlegend=False,
    )
    title = f"Held-out RMS error: {held[0]:.3f} mm, in the end {held[-1]:.3f} mm"
    says = "The whole model on held-out poses, step by step; the dotted line is the noise, at most."
    return build_chart(name, title, says, traces, layout, 72 + 22 * len(steps))


def build_curve_chart(name: str, curve: ResidualCurve, is_held_out: Array) -> ChartBlock:
    """Something against something, as the diagnosis saved it.

    is_held_out: (m,) True where held out, or of length 0 where that is not known.
    """
    x, views = curve.x, list(zip(RESIDUAL_VIEW_NAMES, curve.y, strict=False))
    mask = is_held_out if len(is_held_out) else np.zeros(x.shape[-1], dtype=bool)
    mask = np.broadcast_to(mask, x.shape).ravel()
    chosen = select_drawn_indices(
        np.nanmax(np.abs([np.nan_to_num(y.ravel()) for _, y in views]), axis=0)
    )
    looks = zip(TRACE_LOOKS, views, strict=False)
    drawn = [(look, words, y.ravel()[chosen]) for look, (words, y) in looks]
    sizes = [y for _, _, y in drawn]
    ylabel, outside = break_title_in_two_lines(curve.ylabel), ""
    if name == "order":
        yaxis = build_log_or_linear_axis(ylabel, *sizes)
    else:
        ends, outside = limit_axis_without_outliers(np.concatenate(sizes))
        yaxis = build_axis(ylabel, range=ends) if ends else build_axis(ylabel)
    traces = build_point_traces(x.ravel()[chosen], drawn, mask[chosen])
    layout = build_chart_layout(xaxis=build_axis(escape_figure_label(curve.xlabel)), yaxis=yaxis)
    cut = f" {len(chosen)} of {x.size} points are drawn." if len(chosen) < x.size else ""
    title = capitalise_sentence(curve.title)
    says = (
        f"{title}: {curve.ylabel} against {curve.xlabel}; "
        f"{describe_rms_of_views(views)}.{cut}{outside}"
    )
    return build_chart(f"curve-{name}", title, says, traces, layout)


def limit_axis_without_outliers(values: Array) -> TrimmedAxis:
    """Limits of an axis that a few far points would stretch, and what to say of these points.

    Empty where there are no such points.
    """
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [2.0, 98.0])
    room = 0.25 * (high - low)
    out = int(((known < low - room) | (known > high + room)).sum())
    if np.ptp(known) < MAX_AXIS_STRETCH * (high - low + 2.0 * room) or not high > low:
        return TrimmedAxis([], "")
    sentence = (
        f" {out} of {len(known)} points lie outside of what is drawn; a double click shows them."
    )
    return TrimmedAxis([float(low - room), float(high + room)], sentence)


def describe_rms_of_views(views: Sequence[tuple[str, Array]]) -> str:
    """RMS of each view, in words."""
    return ", ".join(f"{name} RMS {np.sqrt(np.nanmean(y**2)):.3g}" for name, y in views)
