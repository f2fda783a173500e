"""Sessions that differ: other units, or a base that stands elsewhere."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import stats

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.distances import FAINT, FEWEST
from minimax_cal.measuring.faults.fault import NO_ERROR, Amount, Fault
from minimax_cal.measuring.faults.limits import FALSE_ALARM
from minimax_cal.measuring.history import sessions
from minimax_cal.measuring.measurements import Measurements


def mixed_units(data: Measurements) -> tuple[Fault, ...]:
    """Sessions whose numbers are a unit apart from those of the first."""
    session = sessions(data)
    return tuple(
        Fault(
            "mixed_units",
            "all",
            f"{what} from line {data.line[np.argmax(session == other)]} on ({word}) are about "
            f"{ratio:.3g} times those of the first session: another unit?",
            np.flatnonzero(session == other),
            parameters=(Amount("ratio", ratio),),
        )
        for other in range(1, int(session.max()) + 1)
        for what, word, ratio in strange_ratios(data, session == 0, session == other)
    )


def strange_ratios(
    data: Measurements, first: Array, other: Array
) -> Iterator[tuple[str, str, float]]:
    """What two sessions give in different units, and how far apart."""
    size = [float(np.nanmedian(np.linalg.norm(data.y[s], axis=-1))) for s in (first, other)]
    ratio = size[1] / max(size[0], FAINT)
    for factor, word in ((1e3, "metres and millimetres"), (25.4, "inches and millimetres")):
        for f in (factor, 1.0 / factor):
            if abs(np.log(ratio / f)) < 0.5:
                yield "points", word, ratio
    turning = ~data.sliding
    if turning.any():
        wide = [float(np.median(np.ptp(data.q[s][:, turning], axis=0))) for s in (first, other)]
        if max(wide) > 4.0 * np.pi and min(wide) > 0.0:
            ratio = wide[1] / wide[0]
            if min(ratio, 1.0 / ratio) < 0.1:
                yield "joint values", "radians and degrees", ratio


def session_jumps(data: Measurements, error: Array = NO_ERROR) -> tuple[Fault, ...]:
    """A notice if the residual of a fit moves as a whole from session to session.

    The mean error of each pose's targets is explained by one small displacement (6) for all poses
    or one for each session (F-test).
    """
    session = sessions(data)
    if not len(error) or session.max() == 0:
        return ()
    count = np.maximum(np.isfinite(error[..., 0]).sum(axis=0), 1)[:, None]
    mean = np.nansum(error, axis=0) / count
    place = np.nansum(np.where(np.isfinite(error), np.moveaxis(data.y, 1, 0), np.nan), axis=0)
    known = np.isfinite(error[..., 0]).any(axis=0)
    rows, label = np.flatnonzero(known), session[known]
    many = np.bincount(label)
    if len(many) < 2 or many[many > 0].min() < FEWEST:
        return ()
    place = (place / count)[rows]
    place = place - place.mean(axis=0)
    lever = max(float(np.sqrt((place**2).mean())), FAINT)
    turn = np.cross(np.eye(3)[None], place[:, None] / lever)  # a turn about each axis, in levers
    design = np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn], axis=1)
    design = np.swapaxes(design, 1, 2)
    value = mean[rows].reshape(-1)
    one = design.reshape(-1, 6)
    each = np.concatenate(
        [np.where((label == s)[:, None, None], design, 0.0) for s in np.unique(label)], axis=2
    ).reshape(len(value), -1)
    left = [float(((value - a @ np.linalg.lstsq(a, value)[0]) ** 2).sum()) for a in (one, each)]
    dof, more = len(value) - each.shape[1], each.shape[1] - 6
    ratio = (left[0] - left[1]) / more / max(left[1] / dof, 1e-30)
    if stats.f.sf(ratio, more, dof) > 0.1 * FALSE_ALARM or left[0] < 1.1 * left[1]:
        return ()
    jump = float(np.sqrt(max(left[0] - left[1], 0.0) / len(rows)))
    return (
        Fault(
            "session_jump",
            "frame",
            "the whole robot stands elsewhere from session to session (about "
            f"{1e3 * jump:.3g} mm): was the instrument or the base moved, or is the workspace "
            "another one?",
            rows[label > label[0]],
            parameters=(Amount("size", jump, "m"),),
        ),
    )
