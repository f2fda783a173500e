"""The picture of a diagnosis (needs matplotlib: pip install minimax-cal[plot])."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.diagnosis import Diagnosis
from minimax_cal.effects.scene import Scene
from minimax_cal.effects.table import Fitted, Term
from minimax_cal.errors import OptionError
from minimax_cal.figures import AFTER, BEFORE, save
from minimax_cal.history import numbered, visits, with_history
from minimax_cal.kinematics import Array
from minimax_cal.where import joint_equivalent

BY_WEIGHT = ("joint_compliance", "link_bending", "base_flex")
LINEAR = ("encoder_gain", "joint_coupling")
BY_MOVE = {"backlash": "approach", "settling": "move"}
BY_TIME = ("thermal_growth", "frame_drift", "target_shift")
VIEWS = {  # what is drawn: name, colour
    "geometry alone": BEFORE,
    "with effects": AFTER,
    "the first effect taken out": "#999999",
}
FLAT = 1e-6  # of its size: what varies less does not vary


@dataclass(frozen=True, eq=False)
class Curve:
    """Something against something.

    x: (m,) or (k, m).  y: of each of VIEWS, or of the first ones, the shape of x.
    """

    title: str
    xlabel: str
    ylabel: str
    x: Array
    y: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Leftover:
    """What geometry leaves, then what the effects leave.

    errors: (k, m, 3) of the first views in base axes, NaN where not measured [m].
    law: as errors, of the fit with effects once the first effect is taken out; none without one.
    points: (k, m, 3) measured, in base axes [m].  term: the first effect that was fitted, if any.
    """

    diagnosis: Diagnosis
    scene: Scene
    errors: tuple[Array, ...]
    law: tuple[Array, ...]
    points: Array
    term: tuple[Term, ...]

    @staticmethod
    def of(diagnosis: Diagnosis) -> Leftover:
        """From the first and the last cell of a diagnosis."""
        data = with_history(diagnosis.data)
        first, last = diagnosis.cells[0], diagnosis.cells[-1]
        cells = (first, last) if last.effects.terms else (first,)
        axes, origin = first.base[:3, :3], first.base[:3, 3]
        known = {term.label for term in last.effects.terms}
        term = tuple(f.term for f in diagnosis.findings if f.term.label in known)[:1]
        law = tuple(replace(last, effects=without(last.effects, one)) for one in term)
        return Leftover(
            diagnosis=diagnosis,
            scene=first.scene(data),
            errors=tuple(cell.error(data) @ axes for cell in cells),
            law=tuple(cell.error(data) @ axes for cell in law),
            points=np.moveaxis((data.y - origin) @ axes, 1, 0),
            term=term,
        )

    def distances(self) -> list[Array]:
        """(k, m) sizes of the errors of each view [mm]."""
        return [1e3 * np.linalg.norm(error, axis=-1) for error in self.errors]


def without(effects: Fitted, term: Term) -> Fitted:
    """Fitted effects less one, all its lines."""
    kept = [i for i, other in enumerate(effects.terms) if other.label != term.label]
    return Fitted(tuple(effects.terms[i] for i in kept), tuple(effects.values[i] for i in kept))


# ---- the residual map --------------------------------------------------------------------------


def turns(left: Leftover) -> list[Array]:
    """(m, n) what each joint would have to turn to explain the errors of each view [rad, m].

    Of all views at once, so that one ridge serves them all and they compare.
    """
    views = (*left.errors, *left.law)
    slope = np.concatenate([left.scene.slope] * len(views), axis=-1)
    together = np.concatenate(views, axis=1)
    return np.split(joint_equivalent(together, slope, left.diagnosis.noise), len(views), axis=0)


def guilty(left: Leftover, turn: list[Array]) -> int:
    """Index of the joint to show: the effect's own, else the one whose part shrinks most.

    Without an effect, the one that moves the targets most.
    """
    place = left.term[0].place if left.term else ""
    if place[:1] == "J":
        return int(place[1:]) - 1
    lever = np.sqrt(np.nanmean((left.scene.slope**2).sum(axis=2), axis=(1, 2)))
    fell = (turn[0] ** 2).mean(axis=0) - ((turn[1] ** 2).mean(axis=0) if len(turn) > 1 else 0.0)
    size = fell * lever**2
    effect = left.term[0].effect if left.term else ""
    if effect in BY_WEIGHT:
        torque = left.scene.gravity
        size = np.where(np.ptp(torque, axis=1) > FLAT * np.abs(torque).max(), size, -np.inf)
    elif effect in BY_MOVE:
        moved = [left.scene.has(f"{BY_MOVE[effect]}{j + 1}") for j in range(left.scene.joints)]
        size = np.where(moved, size, -np.inf)
    return int(np.argmax(size))


def value_of(scene: Scene, joint: int) -> tuple[str, Array]:
    """A joint's own value, as people read it."""
    if scene.robot.prismatic[joint]:
        return f"joint {joint + 1} (mm)", 1e3 * scene.data.q[:, joint]
    return f"joint {joint + 1} (deg)", np.degrees(scene.data.q[:, joint])


def against(scene: Scene, term: Term, joint: int) -> tuple[str, Array]:
    """(m,) what the law of an effect looks at, for people, with its unit."""
    name, stem = term.effect, BY_MOVE.get(term.effect, "")
    if name == "gear_ripple":
        period = 360.0 / term.choice["turns"]
        return f"joint {joint + 1} within a wave of {period:.3g}° (deg)", np.mod(
            np.degrees(scene.q[joint]), period
        )
    if name == "joint_coupling":
        return value_of(scene, int(term.choice["source"]) - 1)
    if name in BY_WEIGHT:
        return f"static torque of joint {joint + 1} (N m)", scene.gravity[joint]
    if stem and scene.has(f"move{joint + 1}"):
        sliding = bool(scene.robot.prismatic[joint])
        move = scene.column(f"move{joint + 1}")
        unit, scale = ("mm", 1e3) if sliding else ("deg", 180.0 / np.pi)
        return f"last move of joint {joint + 1} ({unit})", scale * move
    if stem:
        return f"side that joint {joint + 1} came from (-1 or 1)", scene.column(
            f"{stem}{joint + 1}"
        )
    if name == "tool_flex":
        tilt = np.clip((scene.links.axes[2] * scene.robot.up[:, None]).sum(axis=0), -1.0, 1.0)
        return "flange axis from the vertical (deg)", np.degrees(np.arccos(tilt))
    if name in BY_TIME and "temperature" in term.choice:
        return "temperature (°C)", scene.data.columns["temperature"].astype(float)
    if name in BY_TIME:
        return "time in the session (0 first, 1 last)", scene.column("clock")
    return value_of(scene, joint)


def along_motion(left: Leftover, term: Term) -> Curve:
    """What is left of the targets along the motion that an effect gives them."""
    scene, names = left.scene, left.scene.data.targets
    chosen = [names.index(term.place)] if term.place in names else list(range(len(names)))
    sight = np.moveaxis(left.points, -1, 1) - scene.instrument[:, None]  # (k, 3, m)
    if term.effect == "target_offset":
        motion, words = sight, "along the line of sight"
        xlabel, x = "distance from the instrument (m)", np.linalg.norm(sight, axis=1)
    else:
        motion, words = motion_of(left, term), f"along its {term.effect.partition('_')[2]}"
        xlabel, time = against(scene, term, 0)
        x = np.broadcast_to(time, (len(names), len(time)))
    along = motion / np.maximum(np.linalg.norm(motion, axis=1, keepdims=True), 1e-12)
    views = (*left.errors, *left.law)
    y = tuple(1e3 * np.einsum("kma,kam->km", error, along)[chosen] for error in views)
    whose = names[chosen[0]] if len(chosen) == 1 else "all targets"
    title = f"error of {whose}, for {term.effect} {term.place}"
    return Curve(title, xlabel, f"error {words} (mm)", x[chosen], y)


def motion_of(left: Leftover, term: Term) -> Array:
    """(k, 3, m) how an effect moves the targets, as fitted; a nest as if it had always sat so."""
    fitted = left.diagnosis.cells[-1].effects
    value = fitted.values[[other.label for other in fitted.terms].index(term.label)]
    always = {"since": -1.0} if "since" in term.choice else {}
    columns = replace(term, choice={**term.choice, **always}).columns(left.scene)
    return np.asarray(np.tensordot(value, columns.displacement(left.scene), 1))


def residual_curve(left: Leftover) -> Curve:
    """The errors as turns of the guilty joint, against what its effect depends on."""
    if left.term and left.term[0].effect in ("target_offset", *BY_TIME):
        return along_motion(left, left.term[0])
    turn = turns(left)
    joint = guilty(left, turn)
    xlabel, x = (
        against(left.scene, left.term[0], joint) if left.term else value_of(left.scene, joint)
    )
    unit = "mm" if left.scene.robot.prismatic[joint] else "mrad"
    what = "travel" if unit == "mm" else "turn"
    title = f"errors as a {what} of joint {joint + 1}"
    if left.term:
        title += f", for {left.term[0].effect} {left.term[0].place}"
    if left.term and left.term[0].effect in LINEAR:  # a constant turn is geometry: leave it out
        turn[-1] = turn[-1] - turn[-1].mean(axis=0)
    return Curve(
        title,
        xlabel,
        f"equivalent {what} of joint {joint + 1} ({unit})",
        x,
        tuple(1e3 * part[:, joint] for part in turn),
    )


def order_curve(left: Leftover) -> Curve:
    """The error of each pose as it was visited."""
    data = left.diagnosis.data
    place = np.empty(data.poses)
    place[visits(data)] = np.arange(1, data.poses + 1)
    told = numbered(data)
    rms = tuple(
        np.sqrt(np.nansum(d**2, axis=0) / np.maximum(np.isfinite(d).sum(axis=0), 1))
        for d in left.distances()
    )
    title = "error by visit order" if told else "error by row (the file tells no order)"
    label = "visit (first to last)" if told else "row of the data"
    return Curve(title, label, "error of a pose, RMS of its targets (mm)", place, rms)


# ---- drawing -----------------------------------------------------------------------------------


def draw_ladder(axes: Any, diagnosis: Diagnosis) -> None:
    """The gap as a waterfall, from the nominal robot down to the noise."""
    steps = diagnosis.ladder
    held = np.array([step.holdout.rms_mm for step in steps])
    train = np.array([step.train.rms_mm for step in steps])
    worst = np.array([step.holdout.max_mm for step in steps])
    at = np.arange(len(steps))
    low, high = np.minimum(held[1:], held[:-1]), np.maximum(held[1:], held[:-1])
    colours = [AFTER if fell else BEFORE for fell in held[1:] <= held[:-1]]
    axes.barh(at[1:], high - low, left=low, height=0.5, color=colours, alpha=0.25)
    axes.plot(held, at, "o", color="black", label="held-out RMS")
    axes.plot(train, at, "o", color="black", mfc="none", ms=9, label="training RMS")
    axes.plot(worst, at, "|", color="black", ms=11, mew=2, label="largest, held out")
    if diagnosis.floor > 0.0:
        axes.axvline(diagnosis.floor, color="grey", ls="--", label="noise floor")
    numbers = np.concatenate([held, train, worst, [diagnosis.floor]])
    numbers = numbers[np.isfinite(numbers)]
    if numbers.min() > 0.0 and numbers.max() > 10.0 * numbers.min():
        axes.set_xscale("log")
        plain_ticks(axes.xaxis, numbers)
    else:
        axes.set_xlim(left=0.0)
    axes.set_yticks(at, [textwrap.fill(step.name, 24) for step in steps])
    axes.set_ylim(len(steps) - 0.5, -0.5)
    right = axes.secondary_yaxis("right")
    right.set_yticks(at, [f"{value:.3f}" for value in held])
    right.tick_params(length=0)
    axes.set_xlabel("error (mm); on the right: held-out RMS")
    axes.grid(visible=True, axis="x", alpha=0.3)
    outside(axes, 4)


def plain_ticks(axis: Any, values: Array) -> None:
    """Labels 0.1 0.2 0.5 1 on a logarithmic axis; the powers of ten alone where those are many."""
    from matplotlib.ticker import LogLocator, NullFormatter

    many = np.nanmax(values) > 200.0 * np.nanmin(values)
    axis.set_major_locator(LogLocator(subs=(1.0,) if many else (1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def outside(axes: Any, columns: int) -> None:
    """The legend above the axes, where no point can lie under it."""
    axes.legend(
        frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, fontsize="small",
        handletextpad=0.2, columnspacing=1.0, borderaxespad=0.1,
    )  # fmt: skip


def draw_curve(axes: Any, left: Leftover, curve: Curve, *, log: bool = False) -> None:
    """Points of training poses small and pale, of held-out poses large."""
    held = np.broadcast_to(left.diagnosis.held, curve.x.shape)
    for number, (y, (name, colour)) in enumerate(zip(curve.y, VIEWS.items(), strict=False)):
        depth = 2.0 + number % 2  # the last view lies under the others
        axes.plot(curve.x[~held], y[~held], ".", color=colour, ms=4, alpha=0.5, zorder=depth)
        axes.plot(curve.x[held], y[held], "o", color=colour, ms=5, label=name, zorder=depth)
    axes.plot([], [], ".", color="black", ms=4, label="small: fitted")
    if log and all(np.nanmin(y) > 0.0 for y in curve.y):
        axes.set_yscale("log")
        plain_ticks(axes.yaxis, np.concatenate(curve.y))
    elif not log:
        axes.axhline(0.0, color="grey", lw=0.8)
    axes.set(xlabel=curve.xlabel, ylabel=curve.ylabel)
    axes.grid(visible=True, alpha=0.3)
    outside(axes, 4)


def room(values: Array, widest: float) -> tuple[float, float]:
    """Limits of an axis that hold the values, a third as wide as the widest at least."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    half = 0.55 * max(high - low, widest / 3.0)
    return (low + high) / 2.0 - half, (low + high) / 2.0 + half


def draw_maps(part: Any, left: Leftover) -> None:
    """The errors over the workspace from above and from the side, all on one colour scale."""
    from matplotlib.colors import LogNorm

    sizes = left.distances()
    seen = np.concatenate([size[np.isfinite(size)] for size in sizes])
    seen = seen[seen > 0.0] if (seen > 0.0).any() else np.ones(1)
    low, high = float(np.quantile(seen, 0.05)), float(seen.max())
    scale = LogNorm(low, max(high, 1.5 * low))
    up = left.scene.robot.up
    tall = int(np.argmax(np.abs(up)))
    first, second = (axis for axis in range(3) if axis != tall)
    height = left.points @ up
    views = (("top", left.points[..., second], f"{'xyz'[second]} (m)"),
             ("side", height, "height (m)"))  # fmt: skip
    spans = [np.nanmax(p) - np.nanmin(p) for p in
             (left.points[..., first], left.points[..., second], height)]  # fmt: skip
    widest = float(max(spans))
    wide = len(sizes) > 1  # one view stands beside the other; two above each other
    grid = part.subplots(
        len(sizes), 2, squeeze=False, sharex=True, sharey="row" if wide else "none"
    )
    panels = [(view, *each) for view in views for each in zip(sizes, VIEWS, strict=False)]
    for axes, ((view, down, label), size, name) in zip(grid.flat, panels, strict=True):
        order = np.argsort(np.nan_to_num(size), axis=None)  # the worst on top
        shown = axes.scatter(
            left.points[..., first].ravel()[order], down.ravel()[order],
            c=size.ravel()[order], norm=scale, cmap="cividis_r", s=9,
        )  # fmt: skip
        axes.set_aspect("equal", adjustable="box")
        axes.set(xlim=room(left.points[..., first], widest), ylim=room(down, widest))
        axes.set_title(f"{name}, {view}", fontsize="medium")
        axes.grid(visible=True, alpha=0.3)
        if axes in grid[:, 0] or not wide:
            axes.set_ylabel(label)
        if axes in grid[-1]:
            axes.set_xlabel(f"{'xyz'[first]} (m)")
    place = "right" if wide else "bottom"
    bar = part.colorbar(
        shown, ax=grid, label="error of a point (mm)", extend="min", location=place, shrink=0.8
    )
    plain_ticks(bar.ax.yaxis if wide else bar.ax.xaxis, np.array([low, high]))


def verdict_of(diagnosis: Diagnosis) -> str:
    """The verdict in a few words."""
    names = [f"{f.term.effect} {f.term.place}" for f in diagnosis.findings]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    found = ", ".join(names[:3]) + more
    return {
        "none": "nothing beyond geometry and noise was found",
        "named": found,
        "one_of": f"{found} (or what looks like it)",
        "unknown": f"cause not known; best guess {found}" if found else "cause not known",
        "not_repeatable": "does not return to the same place",
    }[diagnosis.verdict]


def save_diagnosis(diagnosis: Diagnosis, path: Path | str) -> None:
    """The gap step by step, what is left against its cause, by visit order, and in the workspace.

    path: its suffix, one of `figures.PICTURES`, chooses the format.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise OptionError("a picture needs matplotlib: pip install minimax-cal[plot]") from error
    mpl.rcParams["svg.hashsalt"] = "minimax-cal"  # the same picture gives the same file
    left = Leftover.of(diagnosis)
    residual, order = residual_curve(left), order_curve(left)
    figure = Figure(figsize=(12.5, 10), layout="constrained")
    title = textwrap.fill(f"{diagnosis.robot}: {verdict_of(diagnosis)}", 110)
    figure.suptitle(title, fontweight="bold")
    parts: Any = figure.subfigures(2, 2, height_ratios=(4, 5), wspace=0.03, hspace=0.03)
    titles = ("a  the gap, step by step", f"b  {residual.title}", f"c  {order.title}",
              "d  errors over the workspace (base frame)")  # fmt: skip
    for part, title in zip(parts.flat, titles, strict=True):
        part.suptitle(title, x=0.01, ha="left")
    draw_ladder(parts[0, 0].subplots(), diagnosis)
    draw_curve(parts[0, 1].subplots(), left, residual)
    draw_curve(parts[1, 0].subplots(), left, order, log=True)
    draw_maps(parts[1, 1], left)
    save(figure, Path(path))
