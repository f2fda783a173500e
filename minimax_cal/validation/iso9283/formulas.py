"""The formulas of ISO 9283, 7.2 and 7.3, as functions of arrays; rotations that targets show."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import pdist

from minimax_cal.core.arrays import Array
from minimax_cal.robots.transforms import nearest_rotations

MAX_COLLINEAR_RATIO = (
    0.02  # targets whose triangle is flatter than this are on a line, as in `has_collinear_targets`
)


def group_means(values: Array, group: Array, count: int) -> Array:
    """Mean over the members of each group, NaN left out: (count, ...), NaN where none is left.

    values: (v, ...).  group: (v,) whole numbers from 0 to count - 1.
    """
    known = np.isfinite(values)
    total, number = np.zeros((2, count, *values.shape[1:]))
    np.add.at(total, group, np.where(known, values, 0.0))
    np.add.at(number, group, known)
    return np.where(number > 0, total / np.maximum(number, 1.0), np.nan)


def group_standard_deviations(values: Array, group: Array, count: int) -> Array:
    """Sample standard deviation in each group: (count, ...), NaN with fewer than two members."""
    off = values - group_means(values, group, count)[group]
    number = np.zeros((count, *values.shape[1:]))
    np.add.at(number, group, np.isfinite(off))
    square = group_means(off**2, group, count) * number / np.maximum(number - 1.0, 1.0)
    return np.where(number > 1, np.sqrt(square), np.nan)


def position_repeatability(points: Array, pose: Array, count: int) -> Array:
    """RP = mean l + 3 S_l of each pose, l_j the distance from the barycentre [ISO 9283, 7.2].

    points: (v, 3) attained [m].  pose: (v,) number of the pose.  Returns (count,) [m].
    """
    off = np.linalg.norm(points - group_means(points, pose, count)[pose], axis=-1)
    return group_means(off, pose, count) + 3.0 * group_standard_deviations(off, pose, count)


def multidirectional_variation(points: Array, pose: Array, way: Array, count: int) -> Array:
    """vAP: largest distance between the barycentres of a pose by direction [ISO 9283, 7.2].

    points: (v, 3) [m].  way: (v,) number of the direction of approach, -1 unknown.  Returns
    (count,) [m], NaN where fewer than two directions are known.
    """
    out = np.full(count, np.nan)
    known = (way >= 0) & np.isfinite(points[:, 0])
    pairs, member = np.unique(np.stack([pose, way])[:, known], axis=1, return_inverse=True)
    centre = group_means(points[known], member.reshape(-1), pairs.shape[1])
    several = np.flatnonzero(np.bincount(pairs[0].astype(int), minlength=count) > 1)
    for one in several:
        out[one] = pdist(centre[pairs[0] == one]).max()
    return out


def fit_rotations(shape: Array, points: Array) -> Array:
    """Rotations (v, 3, 3) that bring a rigid set of targets nearest to points [Kabsch 1976].

    shape: (k, 3) in a frame of its own.  points: (v, k, 3) [m].  NaN where a point is missing, and
    everywhere if there are not three points off a line.
    """
    out = np.full((len(points), 3, 3), np.nan)
    own = shape - shape.mean(axis=0)
    size = np.linalg.svd(own, compute_uv=False)
    whole = np.isfinite(points).all(axis=(1, 2))
    if len(shape) < 3 or size[1] <= MAX_COLLINEAR_RATIO * size[0] or not whole.any():
        return out
    centred = points[whole] - points[whole].mean(axis=1, keepdims=True)
    out[whole] = nearest_rotations(np.einsum("vka,kb->vab", centred, own))
    return out


def euler_angles(turn: Array) -> Array:
    """Angles a, b, c about x, y, z of R = Rz(c) Ry(b) Rx(a): (..., 3) [rad].  turn: (..., 3, 3)."""
    r = np.moveaxis(turn, (-2, -1), (0, 1))
    level = np.hypot(r[0, 0], r[1, 0])
    angles = np.arctan2([r[2, 1], -r[2, 0], r[1, 0]], [r[2, 2], level, r[0, 0]])
    return np.moveaxis(angles, 0, -1)


def euler_deviation(measured: Array, computed: Array) -> Array:
    """AO_a, AO_b, AO_c: angles measured minus computed, within half a turn [paper M, eq. 4].

    measured, computed: (..., 3, 3).  Returns (..., 3) [rad].  Near b = +-90 deg (gimbal lock) a and
    c may differ by any amount though the orientations agree.
    """
    off = euler_angles(measured) - euler_angles(computed)
    return np.asarray((off + np.pi) % (2.0 * np.pi) - np.pi)


def orientation_error(measured: Array, computed: Array) -> Array:
    """AO' = |log(R_m' R_c)|, the angle between orientations: (...) [rad; paper M, eq. 5]."""
    turn = np.swapaxes(measured, -1, -2) @ computed
    skew = turn - np.swapaxes(turn, -1, -2)
    sine = 0.5 * np.linalg.norm([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=0)
    return np.asarray(np.arctan2(sine, 0.5 * (np.trace(turn, axis1=-2, axis2=-1) - 1.0)))


def mean_rotations(turn: Array, group: Array, count: int) -> Array:
    """The rotation nearest to those of each group: (count, 3, 3), NaN where none is known."""
    total = group_means(turn, group, count)
    known = np.isfinite(total[:, 0, 0])
    total[known] = nearest_rotations(total[known])
    return total


def distance_accuracy(attained: Array, commanded: Array) -> Array:
    """AD of every pair: distance attained minus distance commanded [ISO 9283, 7.3].

    attained, commanded: (P, 3) [m].  Returns (P (P - 1) / 2,) [m].
    """
    return np.asarray(pdist(attained) - pdist(commanded))


def distance_accuracy_and_repeatability(
    attained: Array, commanded: Array, pose: Array
) -> tuple[Array, Array]:
    """AD and RD of every pair of poses that were both visited twice or more [ISO 9283, 7.3].

    A cycle takes the j-th visits of both: D_j attained, D_c commanded.  AD = mean D_j - D_c,
    RD = 3 S_D.  attained, commanded: (v, 3) in the order of visits [m].  Returns (N,) each [m].
    """
    known = np.isfinite(attained[:, 0])
    numbers, often = np.unique(pose[known], return_counts=True)
    numbers = numbers[often > 1]
    cycles = int(often.max(initial=0))
    table = np.full((2, len(numbers), cycles, 3), np.nan)
    for at, number in enumerate(numbers):
        rows = np.flatnonzero(known & (pose == number))
        table[:, at, : len(rows)] = attained[rows], commanded[rows]
    accuracy, scatter = [np.zeros(0)], [np.zeros(0)]
    for at in range(len(numbers) - 1):
        real, told = np.linalg.norm(table[:, at, None] - table[:, at + 1 :], axis=-1)
        pair = np.broadcast_to(np.arange(len(real))[:, None], real.shape).reshape(-1)
        accuracy.append(group_means((real - told).reshape(-1), pair, len(real)))
        scatter.append(3.0 * group_standard_deviations((real - told).reshape(-1), pair, len(real)))
    return np.concatenate(accuracy), np.concatenate(scatter)
