"""Whole poses as virtual reflectors.

Four reflectors at the corners of a regular tetrahedron say exactly what a pose says: their sum of
squared errors is 4 (|e|^2 + lever^2 |w|^2) for an error e of its position and a small turn w.  The
lever is the ratio of the instrument's linear and angular noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.instruments.protocol import TETRAHEDRON
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.transforms import nearest_rotation, transform

LEVER = 0.1  # where nothing tells the ratio of the noises [m]
CORNERS = {  # of unit distance from their centre
    3: np.stack([[np.cos(a), np.sin(a), 0.0] for a in 2.0 * np.pi * np.arange(3) / 3.0]),
    4: TETRAHEDRON,
}


def spots_of(lever: float, count: int = 4) -> Array:
    """Virtual reflectors in the frame of the pose: (count, 3) [m]; their centre is its origin.

    Their RMS distance from it is sqrt(3/2) lever.  Three lie in the plane z = 0 and weigh a turn
    about its normal twice as much as one in the plane; four weigh all turns alike.
    """
    if count not in CORNERS:
        raise OptionError(f"{count} virtual reflectors: choose 3 or 4")
    if not (np.isfinite(lever) and lever > 0.0):
        raise OptionError(f"lever {lever:g} m: must be positive and finite")
    return np.asarray(np.sqrt(1.5) * lever * CORNERS[count])


def reflectors(at: Measurements, pose: Array, lever: float = LEVER, count: int = 4) -> Measurements:
    """Poses (m, 4, 4) as virtual reflectors smr1 ... [m].  lever: [m].  count: 3 or 4."""
    turned = np.einsum("mij,kj->mki", pose[:, :3, :3], spots_of(lever, count))
    names = tuple(f"smr{i + 1}" for i in range(count))
    return replace(at, y=turned + pose[:, None, :3, 3], target_names=names)


def posed(points: Array, spots: Array) -> Array:
    """Poses (..., 4, 4) of a frame nearest to its reflectors (..., k, 3) [m]; spots: (k, 3) in it.

    The spots are about its origin.
    """
    centre = points.mean(axis=-2)
    turn = nearest_rotation(np.swapaxes(points - centre[..., None, :], -1, -2) @ spots)
    return transform(turn, centre)
