"""What a calibration prints first: accuracy in at most six rows, and the frames."""

from __future__ import annotations

import math
from collections.abc import Iterator

from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.intervals import UNKNOWN, Interval
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.accuracy import Accuracy

FRAMES = ("base", "tool")


def accuracy_rows(fit: Fit) -> Iterator[tuple[Cell, ...]]:
    """New poses, inside and outside the measured region, then those of the fit."""
    inside, crossed = fit.within, bool(fit.error_crossed.size)
    if crossed or fit.accuracy["holdout"].poses:
        drawn = UNKNOWN if crossed else fit.intervals["nominal"][0]
        yield row_of("new poses, nominal", inside.before, drawn)
        yield row_of("new poses, calibrated", inside.after, inside.rms)
    if fit.beyond.worst:
        most = max(fold.max_mm for fold in fit.beyond.folds)
        yield "outside, calibrated", "", fit.beyond.typical_mm, math.nan, math.nan, most
    for key, name in (("nominal_train", "nominal"), ("train", "calibrated")):
        yield row_of(f"training poses, {name}", fit.accuracy[key])


def row_of(name: str, of: Accuracy, ends: Interval = UNKNOWN) -> tuple[Cell, ...]:
    """A row; ends: 95 % interval of the RMS [m]."""
    return name, of.poses, of.rms_mm, 1e3 * ends.low, 1e3 * ends.high, of.max_mm


def first_table(fit: Fit) -> Table:
    """Position accuracy before and after; rows without poses are left out."""
    rows = tuple(row for row in accuracy_rows(fit) if row[1] != 0)
    return Table(
        f"position error, objective {fit.objective}",
        ("error at", "poses", "RMS mm", "95 % low", "95 % high", "max mm"),
        rows,
        ("", "d", *[".3f"] * 4),
    )


def frames_table(fit: Fit) -> Table:
    """Base in the tracker's frame, tool in the flange's."""
    known = fit.frames
    rows = tuple(
        (name, *known[name].xyz_mm, *known[name].abc_deg) for name in FRAMES if name in known
    )
    return Table(
        "base in the instrument's frame, tool in the flange's; Rz(A) Ry(B) Rx(C)",
        ("frame", "X mm", "Y mm", "Z mm", "A deg", "B deg", "C deg"),
        rows,
        ("", *[".3f"] * 3, *[".4f"] * 3),
    )
