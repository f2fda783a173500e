"""New measurements beside a calibration: what is open, and what the calibration's own poses say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.fitting.fit import Fit
from minimax_cal.measuring.measurement_checks import check_and_complete_joints
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import cluster_joint_regions
from minimax_cal.measuring.session_frames import session_labels
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.validation.monitoring.monitored_arm import MonitoredArm

MIN_FOOT_REFLECTORS = 3  # that place the foot
NO_REFLECTORS = np.zeros((0, 3))  # no reflector on the foot
MIN_NOISE_OF_COORDINATE = 1e-9  # of a coordinate: data that were computed, not measured [m]


class OpenedArm(NamedTuple):
    """New measurements beside their calibration, and notices on what was left out."""

    arm: MonitoredArm
    notices: tuple[str, ...]


def open_monitored_arm(fit: Fit, data: Measurements, known_parts: Sequence[str]) -> OpenedArm:
    """The new measurements beside the calibration; what was left out.  Raises CalibrationError."""
    data = check_and_complete_joints(fit.cell.robot, data)
    if len(np.unique(session_labels(data))) > 1:
        raise DataError(f"{data.source}: holds several sessions; check them one by one")
    cell, frame, tool = fit.cell, "frame" in known_parts, "targets" in known_parts
    data = (add_history_columns(data) if cell.effects.terms else data).keep(
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
    foot, foot_now, scatter = NO_REFLECTORS, NO_REFLECTORS, 0.0
    if not frame:
        foot, foot_now, scatter = measure_foot_motion(fit, data)
    place = dict(zip(cell.target_names, cell.target_positions, strict=True))
    kept = cell.effects.select_terms(
        lambda term: (
            not EFFECTS[term.effect].ends_with_session
            and (term.place not in cell.target_names or term.place in data.target_names)
        )
    )
    gone = [format_effect(*term.key) for term in cell.effects.terms if term not in kept.terms]
    variance, u95 = fit.uncertainty.noise.variance, []
    for part in (data, fit.data):
        column = part.columns.get("u95", np.zeros(0))
        u95.append(float(np.nanmedian(column)) if np.isfinite(column).any() else math.nan)
    if math.isfinite(ratio := u95[0] / u95[1]):  # the instrument may be another
        variance *= ratio**2
    variance = max(variance, MIN_NOISE_OF_COORDINATE**2)
    watched = MonitoredArm(
        cell=replace(
            cell,
            target_names=data.target_names,
            target_positions=np.array([place.get(t, np.zeros(3)) for t in data.target_names]),
            effects=kept,
            sessions=cell.sessions if frame else replace(cell.sessions, frames={}),
        ),
        data=cell.align_to_first_session(data) if frame else data,
        known=fit.uncertainty.covariance_root,
        names_old=fit.uncertainty.names,
        variance=variance,
        fit=fit,
        frame=frame,
        tool=tool,
        foot=foot,
        foot_now=foot_now,
        foot_variance=2.0 * variance + scatter,
    )
    if not gone:
        return OpenedArm(watched, ())
    return OpenedArm(
        watched, (f"left out: {', '.join(gone)}; they ended with the calibration's session",)
    )


class FootMotion(NamedTuple):
    """Reflectors (f, 3) on the foot as calibrated and as seen now [m], and their variance [m^2]."""

    before: Array
    now: Array
    variance: float


def measure_foot_motion(fit: Fit, data: Measurements) -> FootMotion:
    """Reflectors on the foot that both saw: where they stood, where they stand, their scatter.

    Returns (f, 3) in the base as calibrated, (f, 3) as seen now [m], none where they are too few to
    place the foot; and the variance of a coordinate between means of then and now [m^2].  What
    stands still scatters by the noise; a foot that is compliant, from region to region too.
    """
    then, now = read_foot_reflectors(fit.data), read_foot_reflectors(data)
    both = [name for name in now if name in then]
    if len(both) < MIN_FOOT_REFLECTORS:
        return FootMotion(NO_REFLECTORS, NO_REFLECTORS, 0.0)
    base, label = np.linalg.inv(fit.cell.base), cluster_joint_regions(fit.data)
    means = {name: np.nanmean(then[name], axis=0) for name in both}
    old = np.array([base[:3, :3] @ means[name] + base[:3, 3] for name in both])
    deviation = np.stack([then[name] - means[name] for name in both])
    regional = [np.nanmean(deviation[:, label == one], axis=1) ** 2 for one in np.unique(label)]
    within = float(np.nanmean(deviation**2)) / data.poses
    return FootMotion(
        old,
        np.array([np.nanmean(now[name], axis=0) for name in both]),
        max(float(np.nanmean(regional)), within),
    )


def read_foot_reflectors(data: Measurements) -> dict[str, Array]:
    """Where each reflector on the foot stood at each pose: (m, 3) by name, NaN unseen [m]."""
    stems = [name[:-2] for name in data.columns if name.startswith("base") and name.endswith("_x")]
    out = {}
    for stem in stems:
        names = [f"{stem}_{axis}" for axis in "xyz"]
        three = [data.columns[name] for name in names if name in data.columns]
        if len(three) == 3 and all(np.isfinite(column).any() for column in three):
            out[stem] = np.stack(three, axis=1)
    return out


def match_flags_by_name(fit: Fit, watched: MonitoredArm, flags: Array) -> Array:
    """(p,) flags by the names of the calibration as flags by those of now."""
    old = dict(zip(fit.uncertainty.names.all_names, flags, strict=True))
    return np.array([bool(old.get(name, False)) for name in watched.names.all_names])
