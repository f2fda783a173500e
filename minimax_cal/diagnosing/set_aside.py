"""What no fit of a diagnosis counts: set aside before it, or faults of the data that it found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.diagnosing.gap import of_lines
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.set_aside import errors_of, with_them
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
    gone = data.seen & ~of_lines(data.line, clean.line, clean.seen)
    why = np.full(gone.shape, NO_POSE, dtype=object)
    for fault in left:
        targets = np.broadcast_to(fault.targets, fault.rows.shape)
        for line, target in zip(fault.rows, targets, strict=True):
            why[data.line == line, target] = WHY[fault.effect]
    without = data
    for reason in dict.fromkeys(why[gone].tolist()):
        some = (gone & (why == reason))[np.isin(data.line, without.line)]
        without = set_aside(without, some, reason, TOOL)
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
