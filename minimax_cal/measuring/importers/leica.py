"""Leica tracker CSV: one row a measured point, units in the header."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.measuring.importers.reading import Reading, Told, named_reading, plain, stems
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "Leica tracker CSV"
SIGNS = {"u(95)", "time stamp", "image rms", "otg applied", "target"}
YES = {"true", "yes", "1", "x"}


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether there are x, y, z and columns only a tracker writes."""
    names = set(stems(sheet))
    return {"x", "y", "z"} <= names and bool(SIGNS & names)


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a point; points marked deleted are left out."""
    reading = named_reading(
        TITLE, sheet, lambda stem: f"smr1_{stem}" if stem in ("x", "y", "z") else plain(stem)
    )
    mark = next((c for c in reading.columns if c.name.lower() == "delete"), None)
    deleted = np.array([mark is not None and mark.cells[i].lower() in YES for i in rows(sheet)])
    if not deleted.any():
        return reading
    kept = np.flatnonzero(~deleted)
    columns = tuple(
        replace(column, cells=tuple(column.cells[i] for i in kept)) for column in reading.columns
    )
    notice = f"{sheet.path}: {deleted.sum()} points are marked deleted and left out"
    return replace(reading, columns=columns, line=reading.line[kept], notices=(notice,))


def rows(sheet: Sheet) -> range:
    """Row numbers."""
    return range(len(sheet.cells))
