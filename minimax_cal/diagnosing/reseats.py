"""Reflectors that were re-seated at rows of a file that tells no visits: which one, and how far.

Distances between targets show the row.  Which of two targets it was, and how far it went across the
line between them, the geometry tells: without the points after it an arm fits the others better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults import mended, spoilt
from minimax_cal.measuring.faults.fault import Fault
from minimax_cal.measuring.faults.nests import RESEAT
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell


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
    error = cell.error(data)[target, rows]
    flange = cell.robot.pose(data.q[rows])[:, :3, :3]
    along = np.einsum("mji,mj->mi", flange, error @ cell.base[:3, :3])
    size = float(np.linalg.norm(np.median(along, axis=0)))
    first, *others = fault.parameters
    return replace(fault, parameters=(replace(first, value=size, sigma=error_of(along)), *others))


def error_of(along: Array) -> float:
    """Standard error of the median of moves (m, 3) on the flange [m]."""
    return float(1.2533 * np.std(along, axis=0).max() / np.sqrt(len(along)))
