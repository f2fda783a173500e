"""What no fit of a diagnosis counts: set aside before it, or faults of the data that it found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.diagnosing.budget_steps import select_rows_by_line
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.set_aside_points import accuracy_with_set_aside, set_aside_errors
from minimax_cal.measuring.faults.data_fault import DataFault
from minimax_cal.measuring.faults.target_steps import TARGET_RESEAT_EFFECT
from minimax_cal.measuring.measurements import SET_ASIDE_BY_TOOL, Measurements, SetAsidePoint
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.measuring.set_aside_points import set_points_aside
from minimax_cal.modelling.cell import Cell

SET_ASIDE_REASONS = {
    "outliers": "is elsewhere, by its distances to the others or by the fit",
    TARGET_RESEAT_EFFECT: "the reflector was re-seated: the longest part of the file counts",
}
ROW_WITHOUT_POSE_REASON = "its row holds the points of no pose"


def accuracy_with_set_aside_points(
    measurements: Measurements,
    clean_measurements: Measurements,
    left_out_faults: Sequence[DataFault],
    heldout_measurements: Measurements,
    cell: Cell,
) -> tuple[tuple[SetAsidePoint, ...], Accuracy | None]:
    """The points that no fit counts, and the accuracy with them; None where there are none.

    measurements: as asked.  clean_measurements: what the fits count.  left_out_faults: what was
    found, by lines of the file.  heldout_measurements: all held-out points, those that stand out
    among them.  cell: of the last step.
    """
    gone = measurements.seen & ~select_rows_by_line(
        measurements.line, clean_measurements.line, clean_measurements.seen
    )
    why = np.full(gone.shape, ROW_WITHOUT_POSE_REASON, dtype=object)
    for fault in left_out_faults:
        targets = np.broadcast_to(fault.targets, fault.rows.shape)
        for line, target in zip(fault.rows, targets, strict=True):
            why[measurements.line == line, target] = SET_ASIDE_REASONS[fault.effect]
    without = measurements
    for reason in dict.fromkeys(why[gone].tolist()):
        some = (gone & (why == reason))[np.isin(measurements.line, without.line)]
        without = set_points_aside(without, some, reason, SET_ASIDE_BY_TOOL)
    aside = without.aside
    if aside is None:
        return without.set_aside, None
    judges = select_rows_by_line(aside.line, heldout_measurements.line, heldout_measurements.seen)
    error = np.where(judges[..., None], np.nan, set_aside_errors(cell, without))
    error = error[np.isfinite(error).any(axis=(1, 2))]
    group = np.unique(cluster_poses(heldout_measurements), return_inverse=True)[1].reshape(-1)
    share = float(heldout_measurements.seen.sum() / measurements.seen.sum())
    found = accuracy_with_set_aside(cell.error(heldout_measurements), group, error, share)
    return without.set_aside, found
