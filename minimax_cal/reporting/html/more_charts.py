"""Charts of correlations, of an error budget and of what a diagnosis leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from minimax_cal.diagnosing.curves import VIEWS, Curve
from minimax_cal.diagnosing.result import IF_REAL, Diagnosis
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.words import capitalise
from minimax_cal.modelling.effects.words import own_name
from minimax_cal.reporting.html.charts import (
    LOOKS,
    axis,
    broken,
    figure,
    frame,
    key,
    line,
    log_axis,
    two_looks,
)
from minimax_cal.reporting.html.content import Figure, label, plain, some

MOST_LABELS = 24  # of a side of the map of correlations
STRETCH = 2.0  # an axis that a few points stretch more than this is cut


def correlations(known: Uncertainty) -> tuple[tuple[str, ...], Array]:
    """Names of the identified parameters, and their correlations; NaN without a variance."""
    place = np.flatnonzero(known.active)
    names = tuple(known.names.all[i] for i in place)
    return names, known.correlation[np.ix_(place, place)]


def correlation_map(known: Uncertainty) -> Figure:
    """Correlations of the identified parameters, as a matrix of colours."""
    told, found = correlations(known)
    names = [label(name) for name in told]
    rows = [plain(row, 3) for row in found]
    trace = {
        "type": "heatmap", "x": names, "y": names, "z": rows, "zmin": -1.0, "zmax": 1.0,
        "colorscale": [[0.0, "before"], [0.5, "back"], [1.0, "after"]],
        "colorbar": {"title": {"text": "correlation"}, "thickness": 10, "orientation": "h",
                     "len": 0.8, "y": 1.02, "yanchor": "bottom",
                     "tickvals": [-1, 0, 1], "tickangle": 0},
        "hovertemplate": "%{x}, %{y}: %{z:.3f}<extra></extra>",
        "xaxis": key("x", 0), "yaxis": key("y", 0),
    }  # fmt: skip
    # more labels than these hide each other; all are told where one points
    every = int(np.ceil(len(names) / MOST_LABELS))
    short = [own_name(name) for name in names]
    short = short if len(set(short)) == len(short) else names
    tick = {"type": "category", "tickfont": {"size": 10}, "showgrid": False,
            "tickvals": names[::every], "ticktext": short[::every]}  # fmt: skip
    layout = frame(
        xaxis=axis("") | tick | {"tickangle": -90},
        yaxis=axis("") | tick | {"autorange": "reversed"},
    )
    off = np.abs(found[~np.eye(len(found), dtype=bool)])
    worst = f"; the largest is {np.nanmax(off):.3f}" if np.isfinite(off).any() else ""
    says = f"Correlations of {len(names)} identified parameters{worst}."
    height = int(np.clip(150 + 14 * len(names), 320, 720))
    return figure("correlations", "Which parameters hang together", says, (trace,), layout, height)


def waterfall(gap: Diagnosis) -> Figure:
    """The error budget of a diagnosis, as on a first screen."""
    *steps, _ = (r for table in gap.first_tables() for r in table.rows if r[0] != IF_REAL)
    return budget_chart("ladder", steps, gap.floor.value)


def budget_chart(
    name: str,
    steps: Sequence[Sequence[Any]],
    floor: float = math.nan,
    said: Sequence[float] = (),
) -> Figure:
    """What each step leaves of the error.

    steps: name, held-out RMS, largest.  said: RMS as a fit says.  floor: of the noise, NaN where
    not known.  All [mm].
    """
    names, held, worst = zip(*steps, strict=True)
    at, ends = np.arange(len(steps)), np.array([-0.5, len(steps) - 0.5])
    marks = [("RMS", "circle", held), ("largest", "line-ns-open", worst)]
    marks += [("RMS, as the fit says", "circle-open", tuple(said))] if said else []
    traces: list[dict[str, Any]] = []
    for words, symbol, x in marks:
        marker = {"color": "ink", "symbol": symbol, "size": 10, "line": {"width": 2}}
        traces.append(
            line("after", words, np.array(x), at, mode="markers", marker=marker)
            | {"line": {"width": 0}}
        )
    if floor > 0.0:
        traces.append(line("third", "noise", np.full(2, floor), ends))
    marks_are = "dot RMS, bar largest" + ", circle as the fit says" * bool(said)
    sizes = (np.array(one) for one in (held, worst, [floor] if floor > 0.0 else []))
    layout = frame(
        xaxis=log_axis(f"error (mm): {marks_are}", *sizes),
        yaxis=axis("", tickvals=at.tolist(), ticktext=[label(name) for name in names],
                   range=ends[::-1].tolist(), automargin=True, zeroline=False,
                   tickfont={"size": 11}),
        margin={"l": 56, "r": 12, "t": 8, "b": 44}, showlegend=False,
    )  # fmt: skip
    title = f"Held-out RMS error: {held[0]:.3f} mm, in the end {held[-1]:.3f} mm"
    says = "The whole model on held-out poses, step by step; the dotted line is the noise, at most."
    return figure(name, title, says, traces, layout, 72 + 22 * len(steps))


def curve_chart(name: str, curve: Curve, held: Array) -> Figure:
    """Something against something, as the diagnosis saved it.

    held: (m,) True where held out, or of length 0 where that is not known.
    """
    x, views = curve.x, list(zip(VIEWS, curve.y, strict=False))
    mask = held if len(held) else np.zeros(x.shape[-1], dtype=bool)
    mask = np.broadcast_to(mask, x.shape).ravel()
    chosen = some(np.nanmax(np.abs([np.nan_to_num(y.ravel()) for _, y in views]), axis=0))
    looks = zip(LOOKS, views, strict=False)
    drawn = [(look, words, y.ravel()[chosen]) for look, (words, y) in looks]
    sizes = [y for _, _, y in drawn]
    ylabel, outside = broken(curve.ylabel), ""
    if name == "order":
        yaxis = log_axis(ylabel, *sizes)
    else:
        ends, outside = most_of(np.concatenate(sizes))
        yaxis = axis(ylabel, range=ends) if ends else axis(ylabel)
    traces = two_looks(x.ravel()[chosen], drawn, mask[chosen])
    layout = frame(xaxis=axis(label(curve.xlabel)), yaxis=yaxis)
    cut = f" {len(chosen)} of {x.size} points are drawn." if len(chosen) < x.size else ""
    title = capitalise(curve.title)
    says = f"{title}: {curve.ylabel} against {curve.xlabel}; {spread(views)}.{cut}{outside}"
    return figure(f"curve-{name}", title, says, traces, layout)


def most_of(values: Array) -> tuple[list[float], str]:
    """Limits of an axis that a few far points would stretch, and what to say of these points.

    Empty where there are no such points.
    """
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [2.0, 98.0])
    room = 0.25 * (high - low)
    out = int(((known < low - room) | (known > high + room)).sum())
    if np.ptp(known) < STRETCH * (high - low + 2.0 * room) or not high > low:
        return [], ""
    return [float(low - room), float(high + room)], (
        f" {out} of {len(known)} points lie outside of what is drawn; a double click shows them."
    )


def spread(views: Sequence[tuple[str, Array]]) -> str:
    """RMS of each view, in words."""
    return ", ".join(f"{name} RMS {np.sqrt(np.nanmean(y**2)):.3g}" for name, y in views)
