"""Whole flange poses as virtual reflectors.

Four reflectors at the corners of a regular tetrahedron say exactly what a pose says: their sum of
squared errors is 4 (|e|^2 + lever^2 |w|^2) for an error e of its position and a small turn w.  The
lever is the ratio of the instrument's linear and angular noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.transforms import nearest_rotation, transform

LEVER = 0.1  # where nothing tells the ratio of the noises [m]
TOOL = ("tool_x", "tool_y", "tool_z", "tool_rx", "tool_ry", "tool_rz")
CORNERS = {  # of unit distance from their centre
    3: np.stack([[np.cos(a), np.sin(a), 0.0] for a in 2.0 * np.pi * np.arange(3) / 3.0]),
    4: np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0),
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


def poses_as_targets(data: RelativeData, lever: float = LEVER, count: int = 4) -> Measurements:
    """The poses as virtual reflectors smr1 ..., for `calibrate`.  lever: [m].  count: 3 or 4."""
    turned = np.einsum("mij,kj->mki", data.pose[:, :3, :3], spots_of(lever, count))
    names = tuple(f"smr{i + 1}" for i in range(count))
    return replace(data.at, y=turned + data.pose[:, None, :3, 3], target_names=names)


def lever_of(data: RelativeData, lever: float | None) -> tuple[float, str]:
    """The lever and where it comes from.  lever: asked for [m], None where not."""
    if lever is not None:
        return lever, "as given"
    columns = data.at.columns
    if {"u95", "rotation_u95"} <= set(columns):
        ratio = np.nanmedian(columns["u95"] / columns["rotation_u95"])
        if np.isfinite(ratio) and ratio > 0.0:
            return float(ratio), "typical u95_mm over rotation_u95_rad"
    return LEVER, "by default; give the lever, the ratio of linear and angular noise"


def posed(points: Array, spots: Array) -> Array:
    """Poses (..., 4, 4) of a frame nearest to its reflectors (..., k, 3) [m]; spots: (k, 3) in it.

    The spots are about its origin.
    """
    centre = points.mean(axis=-2)
    return transform(nearest_rotation(np.swapaxes(points - centre[..., None, :], -1, -2) @ spots),
                     centre)  # fmt: skip


def pose_errors(pose: Array, data: RelativeData) -> tuple[Array, Array]:
    """Measured minus predicted positions (m, 3) [m], and angles between orientations (m,) [rad].

    pose: (m, 4, 4) predicted.
    """
    turn = np.swapaxes(pose[:, :3, :3], 1, 2) @ data.pose[:, :3, :3]
    return data.pose[:, :3, 3] - pose[:, :3, 3], np.asarray(Rotation.from_matrix(turn).magnitude())
