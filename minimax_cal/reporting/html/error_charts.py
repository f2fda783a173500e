"""How the errors are distributed, and what they go with: before and after, held out or not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.reporting.html.charts import (
    LOOKS,
    axis,
    figure,
    frame,
    heading,
    key,
    line,
    log_axis,
    long_key,
    span,
    two_looks,
)
from minimax_cal.reporting.html.content import Figure, label, plain, some
from minimax_cal.reporting.html.sources import Poses

LEVELS = 400  # steps of a distribution that are drawn
TREND = 12  # bins of a running median
FEWEST = 5  # poses of a bin of it
COLUMNS = 3
FAR = 100.0  # ratio of the largest to the smallest error that asks for a logarithmic axis
FINE = 1e-7  # errors below are rounding [mm]

Names = tuple[str, str]
Draw = Callable[[str, str, Array, int], dict[str, Any]]  # look, name, sizes (m, k), panel
SIZE = "position error (mm)"
HELD, TRAIN = "held-out poses", "training poses"


def distances(error: Array) -> Array:
    """(m, k) sizes of errors (m, k, 3), NaN where not measured."""
    return np.asarray(np.linalg.norm(error, axis=-1))


def of_poses(error: Array) -> Array:
    """(m,) RMS of the targets of each pose."""
    square = distances(error) ** 2
    seen = np.isfinite(square)
    return np.asarray(np.sqrt(np.nansum(square, axis=1) / np.maximum(seen.sum(axis=1), 1)))


def groups(poses: Poses) -> list[tuple[str, Array, Array]]:
    """Held-out and training poses, those that there are, each with sizes before and after."""
    before, after = distances(poses.before), distances(poses.after)
    parts = ((HELD, poses.held), (TRAIN, ~poses.held))
    seen = np.isfinite(after).any(axis=1)
    return [(name, before[rows], after[rows]) for name, rows in parts if (rows & seen).any()]


def known(values: Array) -> Array:
    """The numbers among values, rounding lifted to `FINE` so that a logarithm exists."""
    return np.asarray(np.maximum(values[np.isfinite(values)], FINE))


def every_size(poses: Poses) -> Array:
    """All sizes of errors, before and after."""
    return np.concatenate([known(values) for _, *pair in groups(poses) for values in pair])


def panels(
    poses: Poses, names: Names, draw: Draw, x: dict[str, Any], y: dict[str, Any], **more: Any
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Traces and layout of held-out and training poses side by side, on axes x and y."""
    found = groups(poses)
    traces: list[dict[str, Any]] = []
    titles = [heading(name, i, len(found)) for i, (name, *_) in enumerate(found)]
    layout = frame(annotations=titles, **more)
    for i, (_, *pair) in enumerate(found):
        looks = zip(LOOKS, names, pair, strict=False)
        traces += [draw(look, name, values, i) for look, name, values in looks]
        layout |= panel_axes(i, len(found), x, y if i == 0 else {**y, "title": {"text": ""}})
    return traces, layout


def panel_axes(number: int, of: int, x: dict[str, Any], y: dict[str, Any]) -> dict[str, Any]:
    """The axes of one panel beside others."""
    x, y = {**x, "domain": span(number, of)}, {**y}
    if number:
        x["anchor"], y["anchor"] = key("y", number), key("x", number)
        y["matches"] = "y"
    return {long_key("x", number): x, long_key("y", number): y}


def within(poses: Poses, names: Names, share: str, percent: float) -> str:
    """Percentiles in words."""
    return " ".join(
        f"On {name}, {share} of the points lie within {np.percentile(known(one), percent):.3f} mm "
        f"({names[0]}) and {np.percentile(known(other), percent):.3f} mm ({names[1]})."
        for name, one, other in groups(poses)
    )


def cumulative(poses: Poses, names: Names) -> Figure:
    """Which share of the points has less error than x."""

    def steps(look: str, name: str, values: Array, panel: int) -> dict[str, Any]:
        size = np.sort(known(values))
        at = np.unique(np.linspace(0, len(size) - 1, min(len(size), LEVELS)).astype(int))
        share = 100.0 * (at + 1) / len(size)
        return line(look, name, size[at], share, panel=panel, step=True, showlegend=panel == 0)

    axes = (log_axis(SIZE, every_size(poses), ratio=FAR), axis("points with less error (%)"))
    says = f"Cumulative distribution of the position error. {within(poses, names, '95 %', 95.0)}"
    return figure("cumulative", "Which share of the points is better than a limit", says,
                  *panels(poses, names, steps, *axes), 260)  # fmt: skip


def boxes(poses: Poses, names: Names) -> Figure:
    """Quartiles and extremes of each target."""
    targets = [label(name) for name in poses.data.target_names]

    def quartiles(look: str, name: str, values: Array, panel: int) -> dict[str, Any]:
        return box(look, name, targets, values, panel=panel)

    axes = (axis("") | {"type": "category"}, log_axis(SIZE, every_size(poses)))
    says = (
        f"Box charts of the position error of each target, {names[0]} and {names[1]}: median, "
        "quartiles, smallest and largest error."
    )
    return figure("boxes", "Target by target", says,
                  *panels(poses, names, quartiles, *axes, boxmode="group"))  # fmt: skip


def box(look: str, name: str, targets: list[str], values: Array, *, panel: int) -> dict[str, Any]:
    """Boxes of one look: quartiles, and whiskers to the extremes; none where nothing was seen."""
    seen = np.flatnonzero(np.isfinite(values).any(axis=0)).tolist()
    at = np.array([np.percentile(known(values[:, i]), [0, 25, 50, 75, 100]) for i in seen])
    low, q1, median, q3, high = at.reshape(-1, 5).T
    colour, symbol, _, soft = LOOKS[look]
    fill = "back" if symbol.endswith("open") else soft
    return {
        "type": "box", "name": label(name), "legendgroup": name, "offsetgroup": name,
        "x": [targets[i] for i in seen], "lowerfence": plain(low), "q1": plain(q1),
        "median": plain(median), "q3": plain(q3), "upperfence": plain(high),
        "line": {"color": colour, "width": 2}, "fillcolor": fill, "showlegend": panel == 0,
        "xaxis": key("x", panel), "yaxis": key("y", panel),
    }  # fmt: skip


def shown(poses: Poses) -> tuple[Array, str]:
    """Indices of the poses drawn one by one, and what to say if these are not all."""
    chosen = some(of_poses(poses.after))
    all_of_them = len(chosen) == len(poses.held)
    return chosen, "" if all_of_them else (
        f"{len(chosen)} of {len(poses.held)} poses are drawn: the worst, and an even choice of the "
        "others; lines are of all."
    )


def hover(poses: Poses, chosen: Array) -> Array:
    """What each pose is called."""
    return np.array([poses.data.called(poses.data.line[i]) for i in chosen])


def trend(x: Array, y: Array) -> tuple[Array, Array]:
    """Running median of y in bins of x that hold equally many poses."""
    order = np.argsort(x, kind="stable")
    bins = np.array_split(order, min(TREND, max(len(x) // FEWEST, 1)))
    return (np.array([np.median(x[b]) for b in bins]), np.array([np.median(y[b]) for b in bins]))


def joint_names(poses: Poses) -> list[str]:
    """Joints with the unit in which people read them."""
    return [f"joint {j + 1} ({'mm' if s else 'deg'})" for j, s in enumerate(poses.data.sliding)]


def joint_values(poses: Poses) -> Array:
    """(m, n) joint values as people read them."""
    return np.asarray(poses.data.q * np.where(poses.data.sliding, 1e3, 180.0 / np.pi))


def sizes_of(poses: Poses) -> list[Array]:
    """(m,) RMS of each pose before and after, rounding lifted [mm]."""
    return [np.maximum(of_poses(error), FINE) for error in (poses.before, poses.after)]


def cloud(poses: Poses, names: Names, x: Array, chosen: Array, panel: int = 0) -> list[Any]:
    """The chosen poses against x (m,), and running medians of all."""
    views = list(zip(LOOKS, names, sizes_of(poses), strict=False))
    seen = np.isfinite(x)
    lines = [
        line(look, f"{name}, median", *trend(x[seen], size[seen]), panel=panel,
             showlegend=panel == 0)
        for look, name, size in views
    ]  # fmt: skip
    drawn = [(look, name, size[chosen]) for look, name, size in views]
    text = hover(poses, chosen)
    return two_looks(x[chosen], drawn, poses.held[chosen], panel=panel, text=text) + lines


def against_joints(poses: Poses, names: Names) -> Figure:
    """The error of each pose against each joint."""
    chosen, cut = shown(poses)
    q, titles = joint_values(poses), joint_names(poses)
    columns = min(len(titles), COLUMNS)
    rows = -(-len(titles) // columns)
    traces: list[dict[str, Any]] = []
    layout = frame(grid={"rows": rows, "columns": columns, "pattern": "independent",
                         "xgap": 0.16, "ygap": 0.36})  # fmt: skip
    for j, title in enumerate(titles):
        traces += cloud(poses, names, q[:, j], chosen, j)
        more: dict[str, Any] = {"matches": "y"} if j else {}
        layout[long_key("x", j)] = axis(title, nticks=5)
        layout[long_key("y", j)] = log_axis(
            "error (mm)" if j % columns == 0 else "", *sizes_of(poses), **more
        )
    says = (
        "The error of each pose (RMS of its targets) against each joint; a line that rises or "
        f"waves speaks of a cause in that joint. Lines are running medians. {cut}"
    ).strip()
    return figure("joints", "Error against each joint", says, traces, layout, 90 + 230 * rows)


def against(poses: Poses, names: Names, what: tuple[str, str, str], x: Array) -> Figure:
    """The error of each pose against something else.  what: name, title, label of the axis."""
    name, title, xlabel = what
    chosen, cut = shown(poses)
    layout = frame(xaxis=axis(xlabel), yaxis=log_axis("error of a pose (mm)", *sizes_of(poses)))
    says = (
        f"The error of each pose (RMS of its targets) against {xlabel}. Lines are running "
        f"medians. {cut}"
    ).strip()
    return figure(name, title, says, cloud(poses, names, x, chosen), layout)


def over_time(poses: Poses, names: Names) -> tuple[Figure, ...]:
    """Against visit order, and against time, temperature and load where these were written down."""
    told = ("Error by visit order", "visit (first to last)") if poses.told else (
        "Error by row", "row of the file (it tells no visit order)")  # fmt: skip
    out = [against(poses, names, ("order", *told), poses.visit)]
    for column, name, title, xlabel in (
        ("time", "time", "Error over time", "time (s)"),
        ("temperature", "temperature", "Error against temperature", "temperature (°C)"),
        ("payload", "payload", "Error against payload", "payload (kg)"),
    ):
        values = poses.data.columns.get(column, np.zeros(0))
        if np.isfinite(values).any() and np.ptp(values[np.isfinite(values)]) > 0.0:
            out.append(against(poses, names, (name, title, xlabel), values))
    return tuple(out)
