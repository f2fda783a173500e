"""What a diagnosis leaves, drawn against its cause and by visit order: numbers, no picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.ground.records import array
from minimax_cal.measuring.history import numbered, visits, with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.drivers import axis_of, own_value
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, Fitted, Term
from minimax_cal.modelling.effects.words import name_effect

VIEWS = ("geometry alone", "with effects", "the first effect taken out")
FLAT = 1e-6  # of its size: what varies less does not vary


@dataclass(frozen=True, eq=False)
class Curve:
    """Something against something.

    x: (m,), or (k, m) a line a target, as files hold it.  y: of each of VIEWS, or of the first
    ones, the shape of x.
    """

    title: str
    xlabel: str
    ylabel: str
    x: Array
    y: tuple[Array, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON; null where not measured."""
        views = zip(VIEWS, self.y, strict=False)
        return {
            "title": self.title,
            "x": {"label": self.xlabel, "values": plain(self.x)},
            "y": {"label": self.ylabel},
            "views": [{"name": name, "values": plain(y)} for name, y in views],
        }

    @staticmethod
    def from_dict(content: Any, at: str) -> Curve:
        """From `to_dict`.  Raises ValueError."""
        x = array(content["x"]["values"], f"{at}.x")
        y = tuple(array(view["values"], f"{at}.views") for view in content["views"])
        if not (x.size and y) or any(part.shape != x.shape for part in y):
            raise ValueError(f"{at} has no values, or some that differ in length")
        title, xlabel = str(content["title"]), str(content["x"].get("label", ""))
        return Curve(title, xlabel, str(content["y"].get("label", "")), x, y)


@dataclass(frozen=True, eq=False)
class Leftover:
    """What geometry leaves, then what the effects leave.

    data: with its history.  held: (m,) True where held out.  noise: of a coordinate [m].
    effects: as fitted.
    errors: (m, k, 3) of the first views in base axes, NaN where not measured [m].
    law: as errors, of the fit with effects once the first effect is taken out; None without one.
    points: (m, k, 3) measured, in base axes [m].  term: the first effect that was fitted, if any.
    """

    data: Measurements
    held: Array
    noise: float
    effects: Fitted
    scene: Scene
    errors: tuple[Array, ...]
    law: Array | None
    points: Array
    term: Term | None

    @staticmethod
    def of(
        data: Measurements, held: Array, noise: float, cells: Sequence[Cell], found: Sequence[Term]
    ) -> Leftover:
        """From the first and the last of the cells.  found: effects, the largest first."""
        data = with_history(data)
        first, last = cells[0], cells[-1]
        cells = (first, last) if last.effects.terms else (first,)
        axes, origin = first.base[:3, :3], first.base[:3, 3]
        known = {term.label for term in last.effects.terms}
        term = next((term for term in found if term.label in known), None)
        bare = replace(last, effects=without(last.effects, term)) if term else None
        return Leftover(
            data=data,
            held=held,
            noise=noise,
            effects=last.effects,
            scene=first.scene(data),
            errors=tuple(cell.error(data) @ axes for cell in cells),
            law=bare.error(data) @ axes if bare else None,
            points=(data.y - origin) @ axes,
            term=term,
        )

    @property
    def views(self) -> tuple[Array, ...]:
        """Errors of VIEWS, or of the first ones."""
        return self.errors if self.law is None else (*self.errors, self.law)

    def distances(self) -> list[Array]:
        """(m, k) sizes of the errors of each view [mm]."""
        return [1e3 * np.linalg.norm(error, axis=-1) for error in self.errors]


def without(effects: Fitted, term: Term) -> Fitted:
    """Fitted effects less one, all its lines."""
    return effects.where(lambda other: other.label != term.label)


# ---- the residual map --------------------------------------------------------------------------


def turns(left: Leftover) -> list[Array]:
    """(m, n) what each joint would have to turn to explain the errors of each view [rad, m].

    Of all views at once, so that one ridge serves them all and they compare.
    """
    count = len(left.views)
    jacobian = np.concatenate([left.scene.jacobian] * count, axis=-1)
    together = np.concatenate(left.views, axis=0)
    return np.split(joint_equivalent(together, jacobian, left.noise), count, axis=0)


def joint_equivalent(error: Array, jacobian: Array, noise: float) -> Array:
    """Turns of the joints that would make the errors of each pose: (m, n) [rad, m].

    Ridge least squares, min |e - S dq|^2 + lambda |dq|^2 with lambda = noise^2 / turn^2, where turn
    is the RMS turn that would make all of the error if every joint had its part.  Without ridge a
    wrist in line, or a single target, would ask for endless turns.

    error: (m, k, 3), NaN where not measured [m].  jacobian: (n, k, 3, m) by the joints.  noise: of
    a coordinate, NaN unknown [m].
    """
    n, k, _, m = jacobian.shape
    rows = error.reshape(m, 3 * k)
    seen = np.isfinite(rows)
    rows = np.where(seen, rows, 0.0)
    motion = jacobian.transpose(3, 1, 2, 0).reshape(m, 3 * k, n) * seen[..., None]
    gram = np.swapaxes(motion, 1, 2) @ motion
    size = np.trace(gram, axis1=1, axis2=2).mean()
    square = (rows**2).sum(1).mean()
    if not (size > 0.0 and square > 0.0):
        return np.zeros((m, n))
    floor = max(noise**2 if np.isfinite(noise) else 0.0, 1e-4 * square / seen.sum(1).mean())
    ridge = floor * size / square
    gradient = np.swapaxes(motion, 1, 2) @ rows[..., None]
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(n), gradient)[..., 0])


def guilty(left: Leftover, turn: list[Array]) -> int:
    """Index of the joint to show: the effect's own, else the one whose part shrinks most.

    Without an effect, the one that moves the targets most.
    """
    follows, place = (follows_of(left.term), left.term.place) if left.term else ("", "")
    if place[:1] == "J":
        return int(place[1:]) - 1
    lever = np.sqrt(np.nanmean((left.scene.jacobian**2).sum(axis=2), axis=(1, 2)))
    fell = (turn[0] ** 2).mean(axis=0) - ((turn[1] ** 2).mean(axis=0) if len(turn) > 1 else 0.0)
    size = fell * lever**2
    if follows == "load":
        torque = left.scene.gravity
        size = np.where(np.ptp(torque, axis=1) > FLAT * np.abs(torque).max(), size, -np.inf)
    elif follows in ("approach", "move"):
        moved = [left.scene.has(f"{follows}{j + 1}") for j in range(left.scene.joints)]
        size = np.where(moved, size, -np.inf)
    return int(np.argmax(size))


def follows_of(term: Term) -> str:
    """What drives an effect, '' for a fault of the data."""
    return EFFECTS[term.effect].follows if term.effect in EFFECTS else ""


def along_motion(left: Leftover, term: Term) -> Curve:
    """What is left of the targets along the motion that an effect gives them."""
    scene, names = left.scene, left.scene.data.target_names
    chosen = [names.index(term.place)] if term.place in names else list(range(len(names)))
    sight = np.moveaxis(left.points, 0, -1) - scene.instrument[:, None]  # (k, 3, m)
    if follows_of(term) == "sight":
        motion, words = sight, "along the line of sight"
        xlabel, x = "distance from the instrument (m)", np.linalg.norm(sight, axis=1)
    else:
        motion, words = motion_of(left, term), f"along its {term.effect.partition('_')[2]}"
        xlabel, time = axis_of(scene, term, 0)
        x = np.broadcast_to(time, (len(names), len(time)))
    along = motion / np.maximum(np.linalg.norm(motion, axis=1, keepdims=True), 1e-12)
    y = tuple(1e3 * np.einsum("mka,kam->km", error, along)[chosen] for error in left.views)
    whose = names[chosen[0]] if len(chosen) == 1 else "all targets"
    title = f"error of {whose}, for {name_effect(term.effect, term.place)}"
    return Curve(title, xlabel, f"error {words} (mm)", x[chosen], y)


def motion_of(left: Leftover, term: Term) -> Array:
    """(k, 3, m) how an effect moves the targets, as fitted; a nest as if it had always sat so."""
    fitted = left.effects
    value = fitted.values[[other.label for other in fitted.terms].index(term.label)]
    always = {"since": -1.0} if "since" in term.choice else {}
    columns = replace(term, choice={**term.choice, **always}).columns(left.scene)
    return np.asarray(np.tensordot(value, columns.displacement(left.scene), 1))


def residual_curve(left: Leftover) -> Curve:
    """The errors as turns of the guilty joint, against what its effect depends on."""
    scene, term = left.scene, left.term
    if term and follows_of(term) in ("sight", "time"):
        return along_motion(left, term)
    turn = turns(left)
    joint = guilty(left, turn)
    xlabel, x = axis_of(scene, term, joint) if term else own_value(scene, joint, {})
    what, unit = ("travel", "mm") if scene.robot.prismatic[joint] else ("turn", "mrad")
    title = f"errors as a {what} of joint {joint + 1}"
    if term:
        title += f", for {name_effect(term.effect, term.place)}"
    if (
        term and term.effect in EFFECTS and EFFECTS[term.effect].linear
    ):  # a constant turn is geometry: leave it out
        turn[-1] = turn[-1] - turn[-1].mean(axis=0)
    ylabel = f"equivalent {what} of joint {joint + 1} ({unit})"
    return Curve(title, xlabel, ylabel, x, tuple(1e3 * part[:, joint] for part in turn))


def order_curve(left: Leftover) -> Curve:
    """The error of each pose as it was visited."""
    data = left.data
    place = np.empty(data.poses)
    place[visits(data)] = np.arange(1, data.poses + 1)
    told = numbered(data)
    rms = tuple(
        np.sqrt(np.nansum(d**2, axis=1) / np.maximum(np.isfinite(d).sum(axis=1), 1))
        for d in left.distances()
    )
    title = "error by visit order" if told else "error by row (the file tells no order)"
    label = "visit (first to last)" if told else "row of the data"
    return Curve(title, label, "error of a pose, RMS of its targets (mm)", place, rms)
