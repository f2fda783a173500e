"""Where the errors of a geometric fit lie."""

from __future__ import annotations

import math

import numpy as np

from minimax_cal.diagnosing.where.answer import Where
from minimax_cal.diagnosing.where.cuts import by_direction, by_region, by_target
from minimax_cal.diagnosing.where.mean_squares import noise_of, triage
from minimax_cal.diagnosing.where.residual import NO_FIT, base_rows, joint_rows, residual_of
from minimax_cal.diagnosing.where.smooth import (
    by_joint,
    clock,
    joint_equivalent,
    trend,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import stood

UP: Array = np.array([0.0, 0.0, 1.0])


def where(
    data: Measurements,
    error: Array,
    jacobian: Array,
    base: Array,
    noise: float,
    *,
    fitted: Array = NO_FIT,
    up: Array = UP,
    dof: float = math.inf,
) -> Where:
    """Where the errors of a geometric fit lie.

    error: (k, m, 3) measured minus predicted in base axes, NaN where not measured [m].
    jacobian: (n, k, 3, m) motion of each target with each joint, base axes [m/rad, or 1].
    base: (4, 4) pose of the base in the measurement frame, at whose
    origin the instrument stands, or stood first.
    noise: of the instrument per coordinate [m]; NaN to estimate it, see `noise_of`.
    fitted: (k, m, 3, p) derivative of the points by all that was fitted to these rows (as
    `Model.jacobian`); what the fit has taken is then not looked for.  Empty for held-out rows.
    up: (3,) vertical in base axes.  dof: degrees of freedom that `noise` was estimated from.
    """
    point = (data.y - base[:3, 3]) @ base[:3, :3]
    seen = data.y - stood(data)[:, None]
    sight = seen / np.linalg.norm(seen, axis=-1, keepdims=True) @ base[:3, :3]
    point, sight = np.moveaxis(point, 1, 0), np.moveaxis(sight, 1, 0)
    known = noise if math.isfinite(noise) else noise_of(data)
    rest = residual_of(error, fitted, groups(data), jacobian, known)
    turn = joint_equivalent(error, jacobian, known)
    motion = joint_rows(jacobian, rest.seen)
    shared = base_rows(point, up, rest.seen)
    hot = data.columns.get("temperature", np.full(data.poses, np.nan))
    return Where(
        by_target=by_target(data.target_names, error, sight),
        by_joint=by_joint(data, rest, motion, turn),
        by_direction=by_direction(error, point, sight, up),
        by_region=by_region(error, point, up),
        order=trend(rest, shared, clock(data)),
        temperature=trend(rest, shared, hot),
        triage=triage(data, rest, noise, known, dof),
        noise=known,
        turn=turn,
    )
