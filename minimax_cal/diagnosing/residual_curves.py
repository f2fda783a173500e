"""What a diagnosis leaves, drawn against its cause and by visit order: numbers, no picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.record_parsing import parse_array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import (
    add_history_columns,
    has_order_numbers,
    rows_in_visit_order,
)
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.curve_axes import curve_axis_of_effect, joint_value_axis
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import EFFECTS, Fitted, Term

RESIDUAL_VIEW_NAMES = ("geometry alone", "with effects", "the first effect taken out")
MIN_RELATIVE_VARIATION = 1e-6  # of its size: what varies less does not vary


@dataclass(frozen=True, eq=False)
class ResidualCurve:
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
        views = zip(RESIDUAL_VIEW_NAMES, self.y, strict=False)
        return {
            "title": self.title,
            "x": {"label": self.xlabel, "values": convert_to_plain_json(self.x)},
            "y": {"label": self.ylabel},
            "views": [{"name": name, "values": convert_to_plain_json(y)} for name, y in views],
        }

    @staticmethod
    def from_dict(content: Any, at: str) -> ResidualCurve:
        """From `to_dict`.  Raises ValueError."""
        x = parse_array(content["x"]["values"], f"{at}.x")
        y = tuple(parse_array(view["values"], f"{at}.views") for view in content["views"])
        if not (x.size and y) or any(part.shape != x.shape for part in y):
            raise ValueError(f"{at} has no values, or some that differ in length")
        title, xlabel = str(content["title"]), str(content["x"].get("label", ""))
        return ResidualCurve(title, xlabel, str(content["y"].get("label", "")), x, y)


@dataclass(frozen=True, eq=False)
class ResidualViews:
    """What geometry leaves, then what the effects leave.

    data: with its history.  holdout_mask: (m,) True where held out.  noise: of a coordinate [m].
    effects: as fitted. errors: (m, k, 3) of the first views in base axes, NaN where not measured
    [m]. errors_without_first_effect: as errors, of the fit with effects once the first effect is
    taken out; None without one. measured_points: (m, k, 3) measured, in base axes [m].  term: the
    first effect that was fitted, if any.
    """

    data: Measurements
    holdout_mask: Array
    noise: float
    effects: Fitted
    scene: PosedArm
    errors: tuple[Array, ...]
    errors_without_first_effect: Array | None
    measured_points: Array
    term: Term | None

    @staticmethod
    def from_cells(
        data: Measurements,
        holdout_mask: Array,
        noise: float,
        cells: Sequence[Cell],
        found_terms: Sequence[Term],
    ) -> ResidualViews:
        """From the first and the last of the cells.  found_terms: effects, the largest first."""
        data = add_history_columns(data)
        first, last = cells[0], cells[-1]
        cells = (first, last) if last.effects.terms else (first,)
        axes, origin = first.base[:3, :3], first.base[:3, 3]
        known = {term.label for term in last.effects.terms}
        term = next((term for term in found_terms if term.label in known), None)
        bare = replace(last, effects=drop_effect(last.effects, term)) if term else None
        return ResidualViews(
            data=data,
            holdout_mask=holdout_mask,
            noise=noise,
            effects=last.effects,
            scene=first.pose_arm(data),
            errors=tuple(cell.error(data) @ axes for cell in cells),
            errors_without_first_effect=bare.error(data) @ axes if bare else None,
            measured_points=(data.y - origin) @ axes,
            term=term,
        )

    @property
    def errors_by_view(self) -> tuple[Array, ...]:
        """Errors of VIEWS, or of the first ones."""
        return (
            self.errors
            if self.errors_without_first_effect is None
            else (*self.errors, self.errors_without_first_effect)
        )

    def error_distances(self) -> list[Array]:
        """(m, k) sizes of the errors of each view [mm]."""
        return [1e3 * np.linalg.norm(error, axis=-1) for error in self.errors]


def drop_effect(effects: Fitted, term: Term) -> Fitted:
    """Fitted effects less one, all its lines."""
    return effects.select_terms(lambda other: other.label != term.label)


# ---- the residual map --------------------------------------------------------------------------


def equivalent_joint_rotations(residual_views: ResidualViews) -> list[Array]:
    """(m, n) what each joint would have to turn to explain the errors of each view [rad, m].

    Of all views at once, so that one ridge serves them all and they compare.
    """
    count = len(residual_views.errors_by_view)
    jacobian = np.concatenate([residual_views.scene.jacobian] * count, axis=-1)
    together = np.concatenate(residual_views.errors_by_view, axis=0)
    return np.split(
        fit_equivalent_rotations(together, jacobian, residual_views.noise), count, axis=0
    )


def fit_equivalent_rotations(error: Array, jacobian: Array, noise: float) -> Array:
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


def select_shown_joint(residual_views: ResidualViews, joint_rotations: list[Array]) -> int:
    """Index of the joint to show: the effect's own, else the one whose part shrinks most.

    Without an effect, the one that moves the targets most.
    """
    follows, place = (
        (driver_of_term(residual_views.term), residual_views.term.place)
        if residual_views.term
        else ("", "")
    )
    if place[:1] == "J":
        return int(place[1:]) - 1
    lever = np.sqrt(np.nanmean((residual_views.scene.jacobian**2).sum(axis=2), axis=(1, 2)))
    fell = (joint_rotations[0] ** 2).mean(axis=0) - (
        (joint_rotations[1] ** 2).mean(axis=0) if len(joint_rotations) > 1 else 0.0
    )
    size = fell * lever**2
    if follows == "load":
        torque = residual_views.scene.gravity
        size = np.where(
            np.ptp(torque, axis=1) > MIN_RELATIVE_VARIATION * np.abs(torque).max(), size, -np.inf
        )
    elif follows in ("approach", "move"):
        moved = [
            residual_views.scene.column_varies(f"{follows}{j + 1}")
            for j in range(residual_views.scene.joints)
        ]
        size = np.where(moved, size, -np.inf)
    return int(np.argmax(size))


def driver_of_term(term: Term) -> str:
    """What drives an effect, '' for a fault of the data."""
    return EFFECTS[term.effect].follows if term.effect in EFFECTS else ""


def build_curve_along_motion(residual_views: ResidualViews, term: Term) -> ResidualCurve:
    """What is left of the targets along the motion that an effect gives them."""
    scene, names = residual_views.scene, residual_views.scene.data.target_names
    chosen = [names.index(term.place)] if term.place in names else list(range(len(names)))
    sight = (
        np.moveaxis(residual_views.measured_points, 0, -1) - scene.instrument[:, None]
    )  # (k, 3, m)
    if driver_of_term(term) == "sight":
        motion, words = sight, "along the line of sight"
        xlabel, x = "distance from the instrument (m)", np.linalg.norm(sight, axis=1)
    else:
        motion, words = (
            fitted_effect_motion(residual_views, term),
            f"along its {term.effect.partition('_')[2]}",
        )
        xlabel, time = curve_axis_of_effect(scene, term, 0)
        x = np.broadcast_to(time, (len(names), len(time)))
    along = motion / np.maximum(np.linalg.norm(motion, axis=1, keepdims=True), 1e-12)
    y = tuple(
        1e3 * np.einsum("mka,kam->km", error, along)[chosen]
        for error in residual_views.errors_by_view
    )
    whose = names[chosen[0]] if len(chosen) == 1 else "all targets"
    title = f"error of {whose}, for {format_effect(term.effect, term.place)}"
    return ResidualCurve(title, xlabel, f"error {words} (mm)", x[chosen], y)


def fitted_effect_motion(residual_views: ResidualViews, term: Term) -> Array:
    """(k, 3, m) how an effect moves the targets, as fitted; a nest as if it had always sat so."""
    fitted = residual_views.effects
    value = fitted.values[[other.label for other in fitted.terms].index(term.label)]
    always = {"since": -1.0} if "since" in term.choice else {}
    columns = replace(term, choice={**term.choice, **always}).columns(residual_views.scene)
    return np.asarray(np.tensordot(value, columns.target_displacements(residual_views.scene), 1))


def build_residual_curve(residual_views: ResidualViews) -> ResidualCurve:
    """The errors as turns of the guilty joint, against what its effect depends on."""
    scene, term = residual_views.scene, residual_views.term
    if term and driver_of_term(term) in ("sight", "time"):
        return build_curve_along_motion(residual_views, term)
    turn = equivalent_joint_rotations(residual_views)
    joint = select_shown_joint(residual_views, turn)
    xlabel, x = (
        curve_axis_of_effect(scene, term, joint) if term else joint_value_axis(scene, joint, {})
    )
    what, unit = ("travel", "mm") if scene.robot.prismatic[joint] else ("turn", "mrad")
    title = f"errors as a {what} of joint {joint + 1}"
    if term:
        title += f", for {format_effect(term.effect, term.place)}"
    if (
        term and term.effect in EFFECTS and EFFECTS[term.effect].linear
    ):  # a constant turn is geometry: leave it out
        turn[-1] = turn[-1] - turn[-1].mean(axis=0)
    ylabel = f"equivalent {what} of joint {joint + 1} ({unit})"
    return ResidualCurve(title, xlabel, ylabel, x, tuple(1e3 * part[:, joint] for part in turn))


def build_visit_order_curve(residual_views: ResidualViews) -> ResidualCurve:
    """The error of each pose as it was visited."""
    data = residual_views.data
    place = np.empty(data.poses)
    place[rows_in_visit_order(data)] = np.arange(1, data.poses + 1)
    told = has_order_numbers(data)
    rms = tuple(
        np.sqrt(np.nansum(d**2, axis=1) / np.maximum(np.isfinite(d).sum(axis=1), 1))
        for d in residual_views.error_distances()
    )
    title = "error by visit order" if told else "error by row (the file tells no order)"
    label = "visit (first to last)" if told else "row of the data"
    return ResidualCurve(title, label, "error of a pose, RMS of its targets (mm)", place, rms)
