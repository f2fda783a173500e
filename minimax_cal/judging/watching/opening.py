"""New measurements beside a calibration: what is open, and what the calibration's own poses say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.grouping import regions
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import labels
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.effects.words import name_effect

LEAST_FOOT = 3  # reflectors on the foot tell where it stands
NOBODY = np.zeros((0, 3))  # no reflector on the foot
LEAST_NOISE = 1e-9  # of a coordinate: data that were computed, not measured [m]


def watched_of(
    fit: Fit, data: Measurements, known: Sequence[str]
) -> tuple[Watched, tuple[str, ...]]:
    """The new measurements beside the calibration; what was left out.  Raises CalibrationError."""
    known_by = fit.uncertainty
    data = check_joints(fit.cell.robot, data)
    if len(np.unique(labels(data))) > 1:
        raise DataError(f"{data.source}: holds several sessions; check them one by one")
    cell, frame, tool = fit.cell, "frame" in known, "targets" in known
    data = (with_history(data) if cell.effects.terms else data).keep(
        np.asarray(data.seen.any(axis=0))
    )
    if not data.poses:
        raise DataError(f"{data.source}: no target was measured")
    strange = [name for name in data.target_names if name not in cell.target_names]
    if tool and strange:
        raise DataError(
            f"{data.source}: target {strange[0]} is not one of the calibration's; leave targets "
            "out of known"
        )
    foot, foot_now = (NOBODY, NOBODY) if frame else feet(fit, data)
    place = dict(zip(cell.target_names, cell.target_positions, strict=True))
    kept = cell.effects.where(
        lambda term: (
            not EFFECTS[term.effect].of_session
            and (term.place not in cell.target_names or term.place in data.target_names)
        )
    )
    gone = [name_effect(*term.key) for term in cell.effects.terms if term not in kept.terms]
    said = (f"left out: {', '.join(gone)}; they ended with the calibration's session",)
    ratio = usual_u95(data) / usual_u95(fit.data)
    variance = known_by.noise.variance * (ratio**2 if math.isfinite(ratio) else 1.0)
    variance = max(variance, LEAST_NOISE**2)
    watched = Watched(
        cell=replace(
            cell,
            target_names=data.target_names,
            target_positions=np.array([place.get(t, np.zeros(3)) for t in data.target_names]),
            effects=kept,
            sessions=cell.sessions if frame else replace(cell.sessions, frames={}),
        ),
        data=cell.placed(data) if frame else data,
        known=known_by.root,
        names_old=known_by.names,
        variance=variance,
        fit=fit,
        frame=frame,
        tool=tool,
        foot=foot,
        foot_now=foot_now,
        foot_variance=2.0 * variance + (foot_scatter(fit, data) if len(foot) else 0.0),
    )
    return watched, said if gone else ()


def feet(fit: Fit, data: Measurements) -> tuple[Array, Array]:
    """Reflectors on the foot that both saw: (f, 3) in the base as calibrated, and as seen now [m].

    None where they are too few to tell where the foot stands.
    """
    now, then = foot_of(data), foot_of(fit.data)
    both = names_of_foot(fit, data)
    if len(both) < LEAST_FOOT:
        return NOBODY, NOBODY
    base = np.linalg.inv(fit.cell.base)
    old = np.array([base[:3, :3] @ usual(then[name]) + base[:3, 3] for name in both])
    return old, np.array([usual(now[name]) for name in both])


def names_of_foot(fit: Fit, data: Measurements) -> list[str]:
    """Reflectors on the foot that both saw."""
    then = foot_of(fit.data)
    return [name for name in foot_of(data) if name in then]


def usual(place: Array) -> Array:
    """(3,) where a reflector (m, 3) stood on the mean [m]."""
    return np.asarray(np.nanmean(place, axis=0))


def usual_u95(data: Measurements) -> float:
    """The typical u95 of the points; NaN where the data do not tell it."""
    column = data.columns.get("u95", np.zeros(0))
    return float(np.nanmedian(column)) if np.isfinite(column).any() else math.nan


def foot_of(data: Measurements) -> dict[str, Array]:
    """Where each reflector on the foot stood at each pose: (m, 3) by name, NaN unseen [m]."""
    stems = [name[:-2] for name in data.columns if name.startswith("base") and name.endswith("_x")]
    out = {}
    for stem in stems:
        names = [f"{stem}_{axis}" for axis in "xyz"]
        three = [data.columns[name] for name in names if name in data.columns]
        if len(three) == 3 and all(np.isfinite(column).any() for column in three):
            out[stem] = np.stack(three, axis=1)
    return out


def foot_scatter(fit: Fit, data: Measurements) -> float:
    """Variance of a coordinate of the foot's reflectors, between means of then and now [m^2].

    What stands still scatters by the noise; a foot that gives way, from region to region too.
    """
    seen, label = foot_of(fit.data), regions(fit.data)
    both = names_of_foot(fit, data)
    off = np.stack([seen[name] - usual(seen[name]) for name in both])
    means = [off[:, label == one] for one in np.unique(label)]
    between = float(np.nanmean([np.nanmean(part, axis=1) ** 2 for part in means]))
    return max(between, float(np.nanmean(off**2)) / data.poses)


def in_names(fit: Fit, watched: Watched, flags: Array) -> Array:
    """(p,) flags by the names of the calibration as flags by those of now."""
    old = dict(zip(fit.uncertainty.names.all, flags, strict=True))
    return np.array([bool(old.get(name, False)) for name in watched.names.all])
