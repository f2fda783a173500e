"""Joints read back before the arm had settled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.fault import FEWEST, Amount, Fault
from minimax_cal.measuring.history import followed, moves
from minimax_cal.measuring.measurements import Measurements

UNSETTLED = 1e-5  # read-back joints nearer than that have settled [rad, m]


@dataclass(frozen=True, eq=False)
class Lag:
    """How errors lie along the last moves.

    fraction: (r,) of the last move that was still to go, one for all joints of a row.
    explained: share of the squared errors along the own move; chance: along another row's.
    p: of the own move explaining more than the next row's so often by chance.
    """

    fraction: Array
    explained: float
    by_others: float
    p: float


def lag(error: Array, path: Array) -> Lag:
    """The fraction of its last move that each row lacks [measured: irb120, 98 % explained].

    Joints of a coordinated move arrive together: all lack the same fraction when one reads them too
    early, but another one in each row.  error: (r, f), of joints or of points; path: (r, f) the
    move in the same coordinates (for points: Jacobian times move).
    """
    if len(error) < FEWEST:
        return Lag(np.zeros(len(error)), 0.0, 0.0, 1.0)
    total = np.maximum((error**2).sum(axis=1), 1e-300)
    along, other = ((error * p).sum(axis=1) for p in (path, np.roll(path, 1, axis=0)))
    length = np.maximum((path**2).sum(axis=1), 1e-300)
    own, strange = along**2 / length, other**2 / np.roll(length, 1)
    wins = int((own > strange).sum())
    return Lag(
        along / length,
        float(own.sum() / total.sum()),
        float(strange.sum() / total.sum()),
        float(scipy.stats.binomtest(wins, len(error), 0.5, alternative="greater").pvalue),
    )


def read_back(data: Measurements) -> Array:
    """(m, n) the `qread` columns, or of length 0 without them [rad, m]."""
    names = [f"qread{j + 1}" for j in range(data.q.shape[1])]
    if any(name not in data.columns for name in names):
        return np.zeros((0, data.q.shape[1]))
    return np.stack([data.columns[name].astype(float) for name in names], axis=1)


def unsettled(data: Measurements) -> tuple[Fault, ...]:
    """Joints read back before they had settled, where commanded and read ones are given.

    A notice if `qread` lags behind `q`, which then is right; a fault if q lags behind `qread`.
    """
    read = read_back(data)
    if not len(read):
        return ()
    apart = data.q - read
    known = np.isfinite(apart).all(axis=1)
    size = float(np.sqrt((apart[known] ** 2).mean())) if known.any() else 0.0
    if size < UNSETTLED:
        return ()
    rows = np.flatnonzero(known & followed(data) & moves(data).any(axis=1))
    found = lag(apart[rows], moves(data)[rows])
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
        Fault(
            "readback",
            "all",
            says,
            np.flatnonzero(known),
            parameters=(
                Amount("rms", size, "rad"),
                Amount("fraction", middle),
                Amount("explained", found.explained),
            ),
        ),
    )


def looks_read_back(data: Measurements, error: Array, push: Array) -> tuple[Fault, ...]:
    """Whether the given joints themselves look read back too early, without others to compare.

    Errors of points then lie along each row's last move, by a fraction of its own; with backlash
    they lie better along the signs of the moves [irb120 read back: 77 % against 68 %; simulated
    backlash: 49 % against 62 %].
    error: (m, k, 3) of a fit [m].  push: (m, k, 3, n) displacement of each target per joint
    [m/rad], in the same axes.
    """
    move, sign_of = moves(data), np.sign(moves(data))
    rows = np.flatnonzero(followed(data) & move.any(axis=1))
    seen = np.asarray(np.isfinite(error).all(axis=-1))[..., None]
    flat = np.where(seen, error, 0.0).reshape(data.poses, -1)[rows]
    matrix = np.where(seen[..., None], push, 0.0)
    matrix = matrix.reshape(data.poses, flat.shape[1], -1)[rows]
    own, sign = (lag(flat, (matrix @ way[rows][:, :, None])[..., 0]) for way in (move, sign_of))
    if own.p > 1e-3 or own.explained < max(sign.explained, 0.5) + 0.02:
        return ()
    middle = float(np.median(own.fraction))
    return (
        Fault(
            "readback",
            "all",
            "the joints look read back before the arm had settled: "
            f"{100 * own.explained:.0f} % of the errors lie along each pose's last move, by a "
            "fraction of its own; give the commanded joints",
            rows,
            parameters=(
                Amount("fraction", middle),
                Amount("explained", own.explained),
                Amount("explained_by_sign", sign.explained),
            ),
        ),
    )
