"""Errors and motions as blocks of rows, one for each pose: (m, 3k), 0 where not measured."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array


def flat_of(rows: Array) -> Array:
    """Blocks (m, 3k, p) as (3km, p)."""
    return rows.reshape(rows.shape[0] * rows.shape[1], rows.shape[2])


def blocks(error: Array) -> tuple[Array, Array]:
    """Errors (k, m, 3, ...) as blocks (m, 3k, ...), 0 where not measured, and where they were."""
    k, m, _, *more = error.shape
    rows = np.moveaxis(error, 0, 1).reshape(m, 3 * k, *more)
    seen = np.isfinite(rows)
    return np.where(seen, rows, 0.0), seen


def joint_rows(jacobian: Array, seen: Array) -> Array:
    """Slopes (n, k, 3, m) as blocks (m, 3k, n), 0 where not measured."""
    n, k, _, m = jacobian.shape
    return np.where(seen[..., None], jacobian.transpose(3, 1, 2, 0).reshape(m, 3 * k, n), 0.0)


def base_rows(point: Array, up: Array, seen: Array) -> Array:
    """Motions of the targets with the base, and with a growth of radius and height: (m, 3k, 8).

    Three shifts, three turns about the middle of the points, away from the axis, along it.
    point: (k, m, 3) in base axes [m].
    """
    centred = point - np.nanmean(point, axis=(0, 1))
    size = max(float(np.sqrt(np.nanmean(centred**2))), 1e-9)
    axes = np.broadcast_to(np.eye(3), (*point.shape[:2], 3, 3))
    turns = np.stack([np.cross(axis, centred / size) for axis in np.eye(3)], axis=-1)
    axis = up / np.linalg.norm(up)
    height = (centred @ axis)[..., None] * axis / size
    growth = np.stack([centred / size - height, height], axis=-1)
    rows, _ = blocks(np.concatenate([axes, turns, growth], axis=-1))
    return np.where(seen[..., None], rows, 0.0)


def summed(rows: Array, group: Array) -> Array:
    """Sums of rows (m, ...) over each group."""
    _, place = np.unique(group, return_inverse=True)
    out = np.zeros((place.max() + 1, *rows.shape[1:]))
    np.add.at(out, place, rows)
    return out
