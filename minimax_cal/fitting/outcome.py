"""How a calibration ended: impossible, no better than the drawn arm, or neither."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.fitting.checks import MIN_STRAY_OF_REACH, exchanged, too_changed
from minimax_cal.fitting.claims import contradiction
from minimax_cal.fitting.improvement import Improvement, improvement
from minimax_cal.fitting.minimax_problem import MIN_TRUSTED_WEIGHT
from minimax_cal.fitting.options import Options, objective_of
from minimax_cal.fitting.same_arm import computed, least_noise, residual
from minimax_cal.fitting.solve import Solved
from minimax_cal.fitting.suspects import Suspect
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import grouped
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.robot import Robot


def exchanged_rows(robot: Robot, data: Measurements, before: Array) -> Array:
    """(b,) rows whose points belong to other rows.  before: (k, m, 3) errors as drawn [m]."""
    far = np.nanmax(np.linalg.norm(before, axis=-1), initial=0.0)
    return (
        exchanged(robot, data)
        if far > MIN_STRAY_OF_REACH * robot.reach()
        else np.zeros(0, dtype=int)
    )


def said_of_exchanged(data: Measurements, rows: Array) -> str:
    """That rows hold each other's points, by their names or lines."""
    return (
        f"{data.source}: rows hold each other's points: {data.list_rows(rows)}; put their joint "
        "values and points right, or delete them"
    )


def impossible(
    robot: Robot,
    options: Options,
    solved: Solved,
    data: Measurements,
    held: Array,
    before: Array,
    after: Array,
    swapped: Array,
    suspects: Sequence[Suspect],
) -> str:
    """Why this is no calibration of this arm; empty where it is one.

    held: (m,).  before, after: (k, m, 3) errors as drawn and as calibrated [m].  swapped: rows
    whose points belong to other rows.
    """
    active, links = solved.identification.active, 5 * robot.joints
    noise, train = least_noise(data, robot.repeatability), np.flatnonzero(~held)
    pulling = np.isin(swapped, train[(solved.robust.weights > MIN_TRUSTED_WEIGHT).any(axis=0)])
    if pulling.any():
        return said_of_exchanged(data, swapped)
    changed = ""
    if not options.allow_large_changes:
        changed = too_changed(robot, robot.with_mdh(solved.state.mdh), active[:links])
    placed = float(active[links:].sum())
    return (
        contradiction(robot, data, after, held, suspects)
        or changed
        or computed(data, residual(before, placed), noise, "the drawn arm")
        or computed(data, residual(after, float(active.sum())), noise, "the calibrated arm")
    )


def compared(
    options: Options,
    solved: Solved,
    data: Measurements,
    unseen: tuple[Array, Array],
    suspects: Sequence[Suspect],
) -> Improvement | None:
    """Drawn and calibrated arm on poses that neither has seen; None where there are none, or where
    the calibrated arm is the drawn one.

    unseen: (k, m, 3) errors of both, NaN at poses that were seen [m].
    """  # fmt: skip
    fixed = not solved.identification.active[: solved.state.mdh.size].any()
    if (fixed and not solved.effects.terms) or not np.isfinite(unseen[1]).any():
        return None
    if (target := objective_of(options.objective, data)) >= 0:  # the other targets follow
        unseen = hidden(*unseen, np.arange(len(data.target_names))[:, None] != target)
    return improvement(*unseen, grouped(data, options.holdout_by), data, suspects)


def hidden(drawn: Array, calibrated: Array, which: Array) -> tuple[Array, Array]:
    """Errors (k, m, 3) of two arms without some points.  which: (k, m), or what broadcasts."""
    gone = np.broadcast_to(which, drawn.shape[:2])[..., None]
    return np.where(gone, np.nan, drawn), np.where(gone, np.nan, calibrated)
