"""Whether points that stand out are wrong, or the noise has heavy tails."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from minimax_cal.evidence.limits import HEAVY, MAX_GAUSSIAN
from minimax_cal.fitting.suspects import Scores, Spread, spread_of
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.fault import Fault, between
from minimax_cal.measuring.faults.points import far_off
from minimax_cal.measuring.history import visits
from minimax_cal.measuring.measurements import Measurements


def wrong_rows(data: Measurements, error: Array) -> Array:
    """(m,) True where a point is farther off than the tails of all others allow.

    Judged by the errors of a fit, and by the distances between targets, each against Student's t
    with as heavy tails as the other points show.  Where the errors' tails are heavy no point is
    wrong for being far off.  error: (k, m, 3) of all points [m].
    """
    out = np.zeros(data.poses, dtype=bool)
    spread, far = judged(np.linalg.norm(error, axis=-1), 3)
    if spread.dof <= HEAVY:
        return out
    off = np.abs(between(data).off)
    return np.asarray(far | judged(off, 1)[1] if off.size else far)


def unpulled(error: Array, again: Callable[[], Array], data: Measurements) -> tuple[Fault, ...]:
    """Points that are wrong where so many are that they pull the fit.

    error: (k, m, 3) of a plain fit [m].  again: that of one which wrong points do not pull, asked
    where an error is larger than those of Gaussian noise are.  Its heavy tails are no wrong points,
    nor are poses that were visited one after the other.
    """
    size = np.linalg.norm(error, axis=-1)
    if not np.nanmax(size, initial=0.0) > MAX_GAUSSIAN * np.nanmedian(size):
        return ()
    robust = again()
    spread, far = judged(np.linalg.norm(robust, axis=-1), 3)
    return far_off(data, robust, far) if spread.dof > HEAVY and scattered(data, far) else ()


def scattered(data: Measurements, far: Array) -> bool:
    """Whether poses (m,) are single ones among the visits: most that follow each other moved."""
    begins = np.diff(far[visits(data)].astype(int), prepend=0) == 1
    return 2 * int(begins.sum()) > int(far.sum())


def judged(size: Array, directions: int) -> tuple[Spread, Array]:
    """How sizes (s, m) scatter, and (m,) True where one stands out.  NaN is unknown."""
    seen = np.isfinite(size)
    scores = Scores(np.where(seen, size, 0.0) ** 2, directions * seen)
    spread = spread_of(scores, float(directions * seen.sum()))
    return spread, np.asarray(spread.far(scores).any(axis=0))


def are_wrong(fault: Fault, rows: Array, line: Array) -> bool:
    """Whether rows of a fault, as lines of the file, are among those that are wrong."""
    return bool(np.isin(fault.rows, line[rows]).any())
