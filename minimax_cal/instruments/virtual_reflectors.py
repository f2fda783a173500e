"""Whole poses as virtual reflectors.

Four reflectors at the corners of a regular tetrahedron say exactly what a pose says: their sum of
squared errors is 4 (|e|^2 + lever^2 |w|^2) for an error e of its position and a small turn w.  The
lever is the ratio of the instrument's linear and angular noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.instruments.protocol import UNIT_TETRAHEDRON
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.transforms import build_transform, nearest_rotations

DEFAULT_ROTATION_LEVER = 0.1  # where nothing tells the ratio of the noises [m]
UNIT_CORNERS_BY_COUNT = {  # of unit distance from their centre
    3: np.stack([[np.cos(a), np.sin(a), 0.0] for a in 2.0 * np.pi * np.arange(3) / 3.0]),
    4: UNIT_TETRAHEDRON,
}


def virtual_reflector_positions(rotation_lever: float, reflector_count: int = 4) -> Array:
    """Virtual reflectors in the frame of the pose: (count, 3) [m]; their centre is its origin.

    Their RMS distance from it is sqrt(3/2) lever.  Three lie in the plane z = 0 and weigh a turn
    about its normal twice as much as one in the plane; four weigh all turns alike.
    """
    if reflector_count not in UNIT_CORNERS_BY_COUNT:
        raise OptionError(f"{reflector_count} virtual reflectors: choose 3 or 4")
    if not (np.isfinite(rotation_lever) and rotation_lever > 0.0):
        raise OptionError(f"lever {rotation_lever:g} m: must be positive and finite")
    return np.asarray(np.sqrt(1.5) * rotation_lever * UNIT_CORNERS_BY_COUNT[reflector_count])


def build_virtual_reflectors(
    measurements: Measurements,
    poses: Array,
    rotation_lever: float = DEFAULT_ROTATION_LEVER,
    reflector_count: int = 4,
) -> Measurements:
    """Poses (m, 4, 4) as virtual reflectors smr1 ... [m].  rotation_lever: [m].  reflector_count: 3
    or 4.
    """
    turned = np.einsum(
        "mij,kj->mki",
        poses[:, :3, :3],
        virtual_reflector_positions(rotation_lever, reflector_count),
    )
    names = tuple(f"smr{i + 1}" for i in range(reflector_count))
    return replace(measurements, y=turned + poses[:, None, :3, 3], target_names=names)


def fit_poses_to_points(points: Array, points_in_frame: Array) -> Array:
    """Poses (..., 4, 4) of a frame nearest to its reflectors (..., k, 3) [m]; points_in_frame: (k,
    3) in it.

    The spots are about its origin.
    """
    centre = points.mean(axis=-2)
    turn = nearest_rotations(np.swapaxes(points - centre[..., None, :], -1, -2) @ points_in_frame)
    return build_transform(turn, centre)
