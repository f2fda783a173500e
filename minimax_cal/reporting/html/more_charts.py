"""Charts of a fit (iterations, correlations) and of a diagnosis (the gap, its causes)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from minimax_cal.diagnosing.curves import VIEWS, Curve
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.words import capitalise
from minimax_cal.modelling.effects.words import name_step
from minimax_cal.reporting.html.charts import (
    LOOKS,
    axis,
    broken,
    figure,
    frame,
    heading,
    key,
    line,
    log_axis,
    two_looks,
)
from minimax_cal.reporting.html.content import Figure, label, plain, some
from minimax_cal.reporting.html.error_charts import panel_axes

LOWEST = 1e-18  # what a logarithmic axis shows of zero
STRETCH = 2.0  # an axis that a few points stretch more than this is cut


def iterations(fit: Fit) -> Figure:
    """Cost of the least squares, and how far from optimal the minimax was, step by step."""
    panels: list[tuple[str, str, Array, Array]] = []
    if fit.trace:
        cost = 1e6 * np.array(fit.trace)
        panels.append(("least squares", "cost (mm²)", np.arange(len(cost)), cost))
    if fit.minimax and fit.minimax.trace:
        kkt = np.array([s.kkt for s in fit.minimax.trace])
        at = np.array([s.iteration for s in fit.minimax.trace])
        panels.append(("minimax", "KKT residual", at, kkt))
    traces: list[dict[str, Any]] = []
    layout = frame(
        annotations=[heading(p[0], i, len(panels)) for i, p in enumerate(panels)], showlegend=False
    )
    for i, (name, ylabel, x, y) in enumerate(panels):
        y = np.maximum(y, LOWEST)
        traces.append(
            line("after", name, x, y, panel=i, mode="lines+markers", marker={"color": "after"})
        )
        part = panel_axes(
            i, len(panels), axis("iteration", dtick=max(1, len(x) // 8)), log_axis(ylabel, y)
        )
        for each in part.values():
            each.pop("matches", None)
        layout |= part
    says = "; ".join(
        f"{name}: {ylabel} from {y[0]:.3g} to {y[-1]:.3g} in {len(y) - 1} steps"
        for name, ylabel, _, y in panels
    )
    return figure("iterations", "How the fit converged", f"{says}.", traces, layout, 300)


MOST_LABELS = 24  # of a side of the map of correlations


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
    short = [name.rpartition(".")[2] for name in names]  # of an effect its parameter
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
    """The gap from the nominal robot down to the noise."""
    steps, floor = gap.ladder, gap.floor.value
    held = np.array([s.holdout.rms_mm for s in steps])
    train = np.array([s.train.rms_mm for s in steps])
    worst = np.array([s.holdout.max_mm for s in steps])
    at = np.arange(len(steps))
    traces: list[dict[str, Any]] = []
    for name, symbol, x in (
        ("held-out RMS", "circle", held),
        ("training RMS", "circle-open", train),
        ("largest, held out", "line-ns-open", worst),
    ):
        marker = {"color": "ink", "symbol": symbol, "size": 10, "line": {"width": 2}}
        traces.append(
            line("after", name, x, at, mode="markers", marker=marker) | {"line": {"width": 0}}
        )
    if floor > 0.0:
        traces.append(
            line("third", "noise floor", np.full(2, floor), np.array([-0.5, at[-1] + 0.5]))
        )
    every = np.concatenate([held, train, worst, [floor] if floor > 0.0 else []])
    names = [name_step(s.name) for s in steps]
    layout = frame(
        xaxis=log_axis("error (mm)", every),
        yaxis=axis("", tickvals=at.tolist(), ticktext=names, range=[len(steps) - 0.5, -0.5],
                   automargin=True, zeroline=False),
    )  # fmt: skip
    last = f", {steps[-1].holdout.rms_mm:.3f} mm with the effects" if len(steps) > 2 else ""
    says = (
        f"Held-out RMS: {names[0]} {steps[0].holdout.rms_mm:.3f} mm, {names[1]} "
        f"{steps[1].holdout.rms_mm:.3f} mm{last}"
    )
    tail = f"; noise alone would leave {floor:.3f} mm" if math.isfinite(floor) else ""
    title = f"Held-out error from {held[0]:.3f} mm to {held[-1]:.3f} mm"
    return figure("ladder", title, f"{says}{tail}.", traces, layout, 120 + 44 * len(steps))


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
