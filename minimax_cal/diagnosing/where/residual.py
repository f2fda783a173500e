"""Errors as blocks of rows, one for each pose; what a fit leaves over, and could not have taken."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.evidence.evened import evened
from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array

NO_FIT: Array = np.zeros((0, 0, 0, 0))


@dataclass(frozen=True, eq=False)
class Residual:
    """What a fit leaves over, in blocks of rows.

    rows: (m, 3k) residual with what the fit could still take removed, 0 where not measured [m].
    even: the same, made larger where the fit has followed a pose: covariance as before the fit.
    basis: (m, 3k, p) orthonormal columns that span what was fitted.  seen: (m, 3k).
    group: (m,) number of the pose, shared by revisits.
    """

    rows: Array
    even: Array
    basis: Array
    seen: Array
    group: Array

    @property
    def fitted(self) -> int:
        """Number of directions that the fit has taken."""
        return int(self.basis.shape[2])

    def without_fit(self, features: Array) -> Array:
        """Features (m, 3k, r) with what the fit spans removed."""
        flat, basis = features.reshape(-1, features.shape[2]), flat_of(self.basis)
        return np.asarray((flat - basis @ (basis.T @ flat)).reshape(features.shape))


def residual_of(
    error: Array, fitted: Array, group: Array, jacobian: Array = NO_FIT, noise: float = math.nan
) -> Residual:
    """Errors (k, m, 3) of a fit with derivatives (k, m, 3, p), NaN where not measured.

    jacobian, noise: as `where`; they tell how a jitter of the joints would spread, for `evened`.
    """
    rows, seen = blocks(error)
    m, wide = rows.shape
    if not fitted.size:
        return Residual(rows, rows, np.zeros((m, wide, 0)), seen, group)
    columns, _ = blocks(np.nan_to_num(fitted))
    basis = orthonormal(flat_of(np.where(seen[..., None], columns, 0.0))).reshape(m, wide, -1)
    bare = Residual(rows, rows, basis, seen, group)
    rows = bare.without_fit(rows[..., None])[..., 0]
    spread = np.broadcast_to(np.eye(wide), (m, wide, wide))
    if jacobian.size and math.isfinite(noise):
        motion = joint_rows(jacobian, seen)
        energy, free = float((rows**2).sum()), float(seen.sum() - basis.shape[2])
        level = max(noise**2, 1e-4 * energy / max(free, 1.0))
        jitter = max(0.0, energy / max(level, 1e-300) - free) / max(
            float((motion**2).sum()), 1e-300
        )
        spread = spread + jitter * motion @ np.swapaxes(motion, 1, 2)
    return replace(bare, rows=rows, even=evened(rows, basis, spread, group))


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
