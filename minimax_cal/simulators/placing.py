"""Base and targets that suit given flange poses best: all that a judge of a simulator may fit."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.kinematics import hat, rotation

ROUNDS = 30
CLOSE = 1e-12  # a smaller step is none [m, rad]


def placed_error(
    poses: Array, data: Measurements, train: Array, start: tuple[Array, Array]
) -> Array:
    """Measured minus predicted (k, m, 3), NaN where not measured [m].

    poses: (m, 4, 4) of the flange in some base frame [m].  train: (m,) mask of the poses that place
    base and targets.  start: base (4, 4) in the measurement frame and targets (k, 3) in the flange.
    """
    turn, origin = start[0][:3, :3], start[0][:3, 3]
    spots = start[1]
    for _ in range(ROUNDS):
        error, columns = linear(poses[train], data.y[train], turn, origin, spots)
        seen = np.isfinite(error).all(axis=-1)
        step = np.linalg.lstsq(
            columns[seen].reshape(-1, columns.shape[-1]), error[seen].reshape(-1), rcond=1e-10
        )[0]
        origin = origin + turn @ step[:3]
        turn = turn @ rotation(step[3:6])
        spots = spots + step[6:].reshape(-1, 3)
        if np.abs(step).max() < CLOSE:
            break
    error, _ = linear(poses, data.y, turn, origin, spots)
    return np.moveaxis(error, 1, 0)


def linear(poses: Array, y: Array, turn: Array, origin: Array, spots: Array) -> tuple[Array, Array]:
    """Errors (m, k, 3) and their columns (m, k, 3, 6 + 3 k): shift, turn of the base; targets."""
    inside = np.einsum("mij,kj->mki", poses[:, :3, :3], spots) + poses[:, None, :3, 3]
    error = y - inside @ turn.T - origin
    m, k = inside.shape[:2]
    columns = np.zeros((m, k, 3, 6 + 3 * k))
    columns[..., :3] = turn
    columns[..., 3:6] = -turn @ hat(inside)
    for i in range(k):
        columns[:, i, :, 6 + 3 * i : 9 + 3 * i] = turn @ poses[:, :3, :3]
    return error, columns
