"""Joints read back before the arm had settled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.faults.data_fault import MIN_DISTANCE_COUNT, DataFault, FaultAmount
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import follows_previous_pose, joint_moves

MAX_SETTLED_DIFFERENCE = 1e-5  # read-back joints nearer than that have settled [rad, m]


@dataclass(frozen=True, eq=False)
class MoveLag:
    """How errors lie along the last moves.

    fraction: (r,) of the last move that was still to go, one for all joints of a row.
    explained: share of the squared errors along the own move; chance: along another row's.
    p: of the own move explaining more than the next row's so often by chance.
    """

    fraction: Array
    explained: float
    by_others: float
    p: float


def fit_move_lag(errors: Array, move_displacements: Array) -> MoveLag:
    """The fraction of its last move that each row lacks [measured: irb120, 98 % explained].

    Joints of a coordinated move arrive together: all lack the same fraction when one reads them too
    early, but another one in each row.  errors: (r, f), of joints or of points; move_displacements:
    (r, f) the move in the same coordinates (for points: Jacobian times move).
    """
    if len(errors) < MIN_DISTANCE_COUNT:
        return MoveLag(np.zeros(len(errors)), 0.0, 0.0, 1.0)
    total = np.maximum((errors**2).sum(axis=1), 1e-300)
    along, other = (
        (errors * p).sum(axis=1)
        for p in (move_displacements, np.roll(move_displacements, 1, axis=0))
    )
    length = np.maximum((move_displacements**2).sum(axis=1), 1e-300)
    own, strange = along**2 / length, other**2 / np.roll(length, 1)
    wins = int((own > strange).sum())
    return MoveLag(
        along / length,
        float(own.sum() / total.sum()),
        float(strange.sum() / total.sum()),
        float(scipy.stats.binomtest(wins, len(errors), 0.5, alternative="greater").pvalue),
    )


def read_back_joint_values(data: Measurements) -> Array:
    """(m, n) the `qread` columns, or of length 0 without them [rad, m]."""
    names = [f"qread{j + 1}" for j in range(data.q.shape[1])]
    if any(name not in data.columns for name in names):
        return np.zeros((0, data.q.shape[1]))
    return np.stack([data.columns[name].astype(float) for name in names], axis=1)


def find_read_back_lag(data: Measurements) -> tuple[DataFault, ...]:
    """Joints read back before they had settled, where commanded and read ones are given.

    A notice if `qread` lags behind `q`, which then is right; a fault if q lags behind `qread`.
    """
    read = read_back_joint_values(data)
    if not len(read):
        return ()
    apart = data.q - read
    known = np.isfinite(apart).all(axis=1)
    size = float(np.sqrt((apart[known] ** 2).mean())) if known.any() else 0.0
    if size < MAX_SETTLED_DIFFERENCE:
        return ()
    rows = np.flatnonzero(known & follows_previous_pose(data) & joint_moves(data).any(axis=1))
    found = fit_move_lag(apart[rows], joint_moves(data)[rows])
    many = data.q.shape[1] > 1
    lagging = many and found.p < 1e-3 and found.explained > max(0.3, 1.5 * found.by_others)
    middle = float(np.median(found.fraction)) if lagging else 0.0
    says = f"read-back joints differ from the given ones by {1e3 * size:.3g} mrad RMS"
    if lagging:
        who = "qread was read" if middle > 0.0 else "q looks read"
        says += f"; {who} before the arm had settled ({100 * found.explained:.0f} % lies along the "
        says += f"last move, {100.0 * abs(middle):.2g} % of it)"
    says += "; q is used as commanded" if middle >= 0.0 else "; give the commanded joints as q"
    return (
        DataFault(
            "readback",
            "all",
            says,
            np.flatnonzero(known),
            parameters=(
                FaultAmount("rms", size, "rad"),
                FaultAmount("fraction", middle),
                FaultAmount("explained", found.explained),
            ),
        ),
    )


def find_lag_in_point_errors(
    data: Measurements, point_errors: Array, displacements_per_joint: Array
) -> tuple[DataFault, ...]:
    """Whether the given joints themselves look read back too early, without others to compare.

    Errors of points then lie along each row's last move, by a fraction of its own; with backlash
    they lie better along the signs of the moves [irb120 read back: 77 % against 68 %; simulated
    backlash: 49 % against 62 %]. point_errors: (m, k, 3) of a fit [m].  displacements_per_joint:
    (m, k, 3, n) displacement of each target per joint [m/rad], in the same axes.
    """
    move, sign_of = joint_moves(data), np.sign(joint_moves(data))
    rows = np.flatnonzero(follows_previous_pose(data) & move.any(axis=1))
    seen = np.asarray(np.isfinite(point_errors).all(axis=-1))[..., None]
    flat = np.where(seen, point_errors, 0.0).reshape(data.poses, -1)[rows]
    matrix = np.where(seen[..., None], displacements_per_joint, 0.0)
    matrix = matrix.reshape(data.poses, flat.shape[1], -1)[rows]
    own, sign = (
        fit_move_lag(flat, (matrix @ way[rows][:, :, None])[..., 0]) for way in (move, sign_of)
    )
    if own.p > 1e-3 or own.explained < max(sign.explained, 0.5) + 0.02:
        return ()
    middle = float(np.median(own.fraction))
    return (
        DataFault(
            "readback",
            "all",
            "the joints look read back before the arm had settled: "
            f"{100 * own.explained:.0f} % of the errors lie along each pose's last move, by a "
            "fraction of its own; give the commanded joints",
            rows,
            parameters=(
                FaultAmount("fraction", middle),
                FaultAmount("explained", own.explained),
                FaultAmount("explained_by_sign", sign.explained),
            ),
        ),
    )
