"""Columns of the calibration's own poses and of new ones, side by side."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.judging.watching.both import FOOT, KNOWN, NEW, OLD, Both, Part
from minimax_cal.judging.watching.old import Old
from minimax_cal.judging.watching.rows import Rows
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.grouping import regions
from minimax_cal.measuring.history import clock, is_timed
from minimax_cal.modelling.lack import WAVES, by_pose, by_time


def joined(watched: Watched, rows: Rows, column: Array) -> Both:
    """New rows beside those of the calibration.  column: (c,) parameters that may have moved."""
    random, component = lacking(watched, rows)
    old = watched.old
    component = np.concatenate([np.full(watched.held.shape[1], KNOWN), component])
    new = tuple(new_parts(watched, rows, random, column))
    before = tuple(old_parts(watched, old, len(column))) if old else ()
    free = free_columns(watched, rows).shape[1]
    zero = np.isin(column, watched.zeros)
    near = old.factor if old else np.ones(0)
    return Both((*before, *new), free, len(component), component, column, zero, near)


def new_parts(watched: Watched, rows: Rows, random: Array, column: Array) -> Iterator[Part]:
    """Products of the new rows, region by region, and of each reflector on the foot."""
    kept = -rows.jacobian @ watched.held
    if rows.foot and watched.old is None:
        kept[rows.pose < 0] = rows.latent[rows.pose < 0]
    whole = np.concatenate(
        [free_columns(watched, rows), kept, random, rows.jacobian[:, column], rows.error[:, None]],
        axis=1,
    )
    region = regions(watched.data)
    label = np.append(region, -1)[rows.pose]
    label[rows.pose < 0] = -1 - np.arange(rows.foot) // 3
    seen = (~np.isnan(watched.data.y)).sum(axis=(1, 2))
    for one in np.unique(label):
        part = whole[label == one]
        if one < 0:
            yield Part(part.T @ part, len(part), FOOT)
        else:
            yield Part(part.T @ part, int(seen[region == one].sum()), NEW)


def old_parts(watched: Watched, old: Old, candidates: int) -> Iterator[Part]:
    """Products of the calibration's rows, region by region."""
    m, r, _ = old.jacobian.shape
    drift, _ = drifts(watched, old.links, old.arm, old.when, OLD)
    by_angle, _ = by_pose(watched.cell.robot, old.q, old.arm)
    random = np.concatenate([old.latent, by_angle, drift], axis=2)
    elsewhere = np.zeros((m, r, int(watched.open.sum())))
    nowhere = np.zeros((m, r, candidates))
    whole = np.concatenate([old.jacobian, elsewhere, random, nowhere, old.error[..., None]], axis=2)
    return old.parts(whole)


def free_columns(watched: Watched, rows: Rows) -> Array:
    """(N, f) new rows by what the calibration fitted, where it is still so, and by what is open."""
    names, open_ = watched.names.all, watched.open
    now = rows.jacobian[:, open_]
    if watched.old is None:
        return now
    place = {name: i for i, name in enumerate(names)}
    at = np.array([place.get(name, -1) for name in watched.old.names])
    still = (at >= 0) & ~open_[at]
    before = np.where(still, rows.jacobian[:, at], 0.0)
    if rows.foot:  # where the foot stands now is measured from where it stood
        foot, base = rows.pose < 0, np.arange(watched.base.start, watched.base.stop)
        of_base = np.isin(at, base)
        before[np.ix_(foot, of_base)] = -rows.jacobian[np.ix_(foot, at[of_base])]
    return np.concatenate([before, now], axis=1)


def lacking(watched: Watched, rows: Rows) -> tuple[Array, Array]:
    """(N, l) new rows by what the model lacks, and (l,) which factors share a variance."""
    robot, (m, r, n) = watched.cell.robot, rows.arm.shape
    by_angle, turned = by_pose(robot, robot.turned(watched.data.q), rows.arm)
    links = rows.jacobian[: m * r, : 5 * n].reshape(m, r, 5 * n)
    drift, kind = drifts(watched, links, rows.arm, when_of(watched), NEW)
    columns = np.concatenate([by_angle, drift], axis=2).reshape(m * r, -1)
    return np.pad(columns, ((0, rows.foot), (0, 0))), np.append(turned[:, 0], n + kind)


def when_of(watched: Watched) -> Array | None:
    """(m,) place of new poses in their session, 0 to 1; None where nothing tells it."""
    return clock(watched.data) if is_timed(watched.data) else None


def drifts(
    watched: Watched, links: Array, arm: Array, when: Array | None, source: int
) -> tuple[Array, Array]:
    """(m, r, d) motion by what drifts in either session and between them, and (d,) the kind.

    links: (m, r, 5n) by the link parameters.  The columns are waves of the old session, what is
    between the two, waves of the new one; what drifts by so much in a session does so between two.
    """
    robot, old = watched.cell.robot, watched.old
    n, (m, r, _) = robot.joints, arm.shape
    if when_of(watched) is None and (old is None or old.when is None):
        return np.zeros((m, r, 0)), np.zeros(0, dtype=int)
    growth = links[..., : 2 * n] @ robot.mdh[:, :2].T.reshape(-1)
    moved, kind = by_time(robot, np.zeros(m) if when is None else when, arm, growth)
    waves = np.concatenate(list(moved[1:] if when is not None else 0.0 * moved[1:]), axis=2)
    none, apart = 0.0 * waves, moved[0]
    blocks = [none, apart, waves] if source == NEW else [waves, 0.0 * apart, none]
    return np.concatenate(blocks, axis=2), np.tile(kind, 1 + 2 * WAVES)
