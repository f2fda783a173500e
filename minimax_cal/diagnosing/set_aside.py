"""What no fit of a diagnosis counts: set aside before it, or faults of the data that it found.

Distances between targets show the row.  Which of two targets it was, and how far it went across the
line between them, the geometry tells: without the points after it an arm fits the others better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.diagnosing.gap import of_lines
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.set_aside import errors_of, with_them
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults import mended, spoilt
from minimax_cal.measuring.faults.fault import Fault
from minimax_cal.measuring.faults.nests import RESEAT
from minimax_cal.measuring.grouping import clusters
from minimax_cal.measuring.measurements import TOOL, Measurements, SetAside
from minimax_cal.measuring.set_aside import set_aside
from minimax_cal.modelling.cell import Cell

WHY = {
    "outliers": "is elsewhere, by its distances to the others or by the fit",
    RESEAT: "the reflector was re-seated: the longest part of the file counts",
}
NO_POSE = "its row holds the points of no pose"


def judged_with(
    data: Measurements,
    clean: Measurements,
    left: Sequence[Fault],
    held: Measurements,
    cell: Cell,
) -> tuple[tuple[SetAside, ...], Accuracy | None]:
    """The points that no fit counts, and the accuracy with them; None where there are none.

    data: as asked.  clean: what the fits count.  left: what was found, by lines of the file.  held:
    all held-out points, those that stand out among them.  cell: of the last step.
    """
    without = without_faults(data, clean, left)
    aside = without.aside
    if aside is None:
        return without.set_aside, None
    judges = of_lines(aside.line, held.line, held.seen)
    error = np.where(judges[..., None], np.nan, errors_of(cell, without))
    error = error[np.isfinite(error).any(axis=(1, 2))]
    group = np.unique(clusters(held), return_inverse=True)[1].reshape(-1)
    share = float(held.seen.sum() / data.seen.sum())
    found = with_them(cell.error(held), group, error, share)
    return without.set_aside, found


def without_faults(data: Measurements, clean: Measurements, left: Sequence[Fault]) -> Measurements:
    """The measurements with those that no fit counts set aside, each with its reason."""
    gone = data.seen & ~of_lines(data.line, clean.line, clean.seen)
    why = np.full(gone.shape, NO_POSE, dtype=object)
    for fault in left:
        for line, target in points_of(fault):
            why[data.line == line, target] = WHY[fault.effect]
    lines, found = data.line, data
    for reason in dict.fromkeys(why[gone].tolist()):
        found = set_aside(found, (gone & (why == reason))[np.isin(lines, found.line)], reason, TOOL)
    return found


def points_of(fault: Fault) -> list[tuple[int, int]]:
    """Line and target of the points of a fault."""
    targets = np.broadcast_to(fault.targets, fault.rows.shape)
    return list(zip(fault.rows.tolist(), targets.tolist(), strict=True))


# ---- reflectors that were re-seated --------------------------------------------------------------


def with_targets(
    found: Sequence[Fault], data: Measurements, fitted: Callable[[Measurements], Cell]
) -> tuple[Fault, ...]:
    """The faults, each re-seat at the one target without whose points an arm fits best.

    fitted: the calibrated geometry of the training poses among some.
    """
    out = list(found)
    for i, fault in enumerate(found):
        if fault.effect != RESEAT or len(fault.targets) == 1:
            continue
        trials = [
            replace(fault, place=data.target_names[target], targets=np.array([target]))
            for target in fault.targets
        ]
        left = []
        for trial in trials:
            some = mended(data, (*out[:i], trial, *out[i + 1 :]))
            left.append(float(np.nanmean(fitted(some).error(some) ** 2)))
        out[i] = trials[int(np.argmin(left))]
    return tuple(out)


def sized(fault: Fault, cell: Cell, data: Measurements) -> Fault:
    """A re-seat with how far the target moved on the flange, where it was seated anew once.

    cell: fitted without the points of the shorter part.  data: with them.
    """
    if fault.effect != RESEAT:
        return fault
    (rows, target), *_ = spoilt(data, [fault])
    error = cell.error(data)[rows, target]
    flange = cell.robot.pose(data.q[rows])[:, :3, :3]
    along = np.einsum("mji,mj->mi", flange, error @ cell.base[:3, :3])
    size = float(np.linalg.norm(np.median(along, axis=0)))
    first, *others = fault.parameters
    return replace(fault, parameters=(replace(first, value=size, sigma=error_of(along)), *others))


def error_of(along: Array) -> float:
    """Standard error of the median of moves (m, 3) on the flange [m]."""
    return float(1.2533 * np.std(along, axis=0).max() / np.sqrt(len(along)))
