"""The parts that charts are made of: axes, panels, points, lines.

Colours are names of the page's palette.  Before and after differ in colour and in marker or dash,
held-out and training poses in size, so that no one depends on colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.reporting.html.content import Figure, label, plain

PALETTE = ("before", "after", "before-soft", "after-soft", "ink", "soft", "line", "back")
LOOKS = {  # colour, marker, dash, colour of an area
    "before": ("before", "circle-open", "dash", "before-soft"),
    "after": ("after", "circle", "solid", "after-soft"),
    "third": ("soft", "diamond-open", "dot", "line"),
}
WIDE = 10.0  # a larger ratio of the largest to the smallest number asks for a logarithmic axis
MANY = 200.0  # beyond this ratio only powers of ten are marked
LONG = 34  # letters of a title that need two lines


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with its unit in the title."""
    return {"title": {"text": title}, "type": "linear", **more}


def log_axis(title: str, *values: Array, ratio: float = WIDE, **more: Any) -> dict[str, Any]:
    """A logarithmic axis where positive numbers spread wide, else one that starts at 0."""
    if not is_wide(*values, ratio=ratio):
        return axis(title, rangemode="tozero", **more)
    found = np.concatenate([np.ravel(v) for v in values])
    low, high = float(np.nanmin(found)), float(np.nanmax(found))
    steps = (1.0,) if high > MANY * low else (1.0, 2.0, 5.0)
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    marks = {"tickmode": "array", "tickvals": ticks, "ticktext": [f"{t:g}" for t in ticks]}
    return {**axis(title, **more), "type": "log", **marks}


def broken(words: str) -> str:
    """A long title in two lines."""
    at = words.find(" ", len(words) // 2)
    parts = (words[:at], words[at + 1 :]) if len(words) > LONG and at > 0 else (words,)
    return "<br>".join(map(label, parts))


def frame(**axes: Any) -> dict[str, Any]:
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


def span(number: int, of: int, gap: float = 0.09) -> list[float]:
    """Where a panel lies in the width."""
    width = (1.0 - gap * (of - 1)) / of
    left = number * (width + gap)
    return [left, min(left + width, 1.0)]


def key(letter: str, number: int) -> str:
    """plotly's name of an axis: x, x2, x3 ..."""
    return letter if number == 0 else f"{letter}{number + 1}"


def long_key(letter: str, number: int) -> str:
    """The same in a layout: xaxis, xaxis2, ..."""
    return f"{letter}axis" + ("" if number == 0 else str(number + 1))


def heading(words: str, number: int, of: int) -> dict[str, Any]:
    """A title of one panel, above it."""
    left, right = span(number, of)
    return {
        "text": label(words), "showarrow": False, "xref": "paper", "yref": "paper",
        "x": (left + right) / 2.0, "y": 1.0, "xanchor": "center", "yanchor": "bottom",
    }  # fmt: skip


def line(
    look: str, name: str, x: Array, y: Array, *, panel: int = 0, step: bool = False, **more: Any
) -> dict[str, Any]:
    """A line; as steps that hold to the next x."""
    colour, _, dash, _ = LOOKS[look]
    shape = {"shape": "hv"} if step else {}
    return {
        "type": "scatter", "mode": "lines", "name": label(name), "legendgroup": name,
        "x": plain(x), "y": plain(y), "line": {"color": colour, "dash": dash, "width": 2, **shape},
        "xaxis": key("x", panel), "yaxis": key("y", panel), **more,
    }  # fmt: skip


def points(
    look: str, name: str, x: Array, y: Array, *, held: bool, panel: int = 0, **more: Any
) -> dict[str, Any]:
    """Points; those of held-out poses large, those of training poses small and pale."""
    colour, symbol, _, _ = LOOKS[look]
    size, opacity = (7, 0.95) if held else (4, 0.5)
    return {
        "type": "scatter", "mode": "markers", "name": label(name), "legendgroup": name,
        "x": plain(x), "y": plain(y), "opacity": opacity,
        "marker": {"color": colour, "symbol": symbol, "size": size},
        "xaxis": key("x", panel), "yaxis": key("y", panel), **more,
    }  # fmt: skip


def is_wide(*values: Array, ratio: float = WIDE) -> bool:
    """Whether numbers, all positive, spread so far that a logarithmic axis serves them."""
    found = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
    found = found[np.isfinite(found)]
    return bool(len(found) and found.min() > 0.0 and found.max() > ratio * found.min())


def two_looks(
    x: Array, views: Sequence[tuple[str, str, Array]], held: Array, *, panel: int = 0, **more: Any
) -> list[dict[str, Any]]:
    """Points of several views (look, name, y) against x; held-out ones large.

    x, y, held: (m,).  The legend shows each name once.
    """
    out = []
    for look, name, y in views:
        for kind, chosen in ((True, held), (False, ~held)):
            if chosen.any():
                shown = {"showlegend": panel == 0 and (kind or not held.any())}
                rest = {k: np.asarray(v)[chosen].tolist() for k, v in more.items()}
                out.append(
                    points(
                        look, name, x[chosen], y[chosen], held=kind, panel=panel, **shown, **rest
                    )
                )
    return out


def figure(
    name: str, title: str, says: str, traces: Sequence[dict[str, Any]], layout: dict[str, Any],
    height: int = 340,
) -> Figure:  # fmt: skip
    """A chart with its words."""
    return Figure(name, title, says, tuple(traces), layout, height)
