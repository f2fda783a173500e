"""Leica tracker CSV: one row a measured point, units in the header."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.reading import (
    Column,
    Reading,
    Told,
    joint_number,
    named_reading,
    plain,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "Leica tracker CSV"
MARKS = ("delete", "deleted", "gel\N{LATIN SMALL LETTER O WITH DIAERESIS}scht")
SIGNS = {"u(95)", "time stamp", "image rms", "otg applied", "target", *MARKS}
YES = {"true", "yes", "1", "x", "y", "wahr", "ja", "j", "vrai", "oui", *MARKS}
NO = {"", "false", "no", "0", "-", "n", "falsch", "nein", "faux", "non"}


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether there are x, y, z and columns only a tracker writes."""
    names = set(stems(sheet))
    joints_too = sum(map(bool, map(joint_number, names))) > 1
    return {"x", "y", "z"} <= names and bool(SIGNS & names) and not joints_too


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a point, those that are marked deleted among them."""
    reading = named_reading(
        TITLE, sheet, lambda stem: f"smr1_{stem}" if stem in ("x", "y", "z") else plain(stem)
    )
    deleted = np.zeros(len(reading.line), dtype=bool)
    for mark in reading.columns:
        if mark.name.lower() in MARKS:
            deleted |= marked(reading, mark)
    return replace(reading, deleted=tuple(np.flatnonzero(deleted).tolist()))


def marked(reading: Reading, mark: Column) -> Array:
    """(m,) True for points that a column says are deleted.  Raises DataError."""
    cells = [cell.lower() for cell in mark.cells]
    for line, cell in zip(reading.line, cells, strict=True):
        if cell not in YES | NO:
            raise DataError(
                f"{reading.sheet.path}:{line}: column {mark.name}: {cell!r} does not say whether "
                "the point is deleted; write true or false"
            )
    return np.array([cell in YES for cell in cells])
