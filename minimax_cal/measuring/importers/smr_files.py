"""Points alone: columns x, y, z of a target, or of several; without a header of one."""

from __future__ import annotations

from dataclasses import replace

from minimax_cal.measuring.importers.reading import (
    Column,
    Reading,
    Told,
    named_reading,
    plain,
    points_of,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "points"


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether there are x, y, z and no joints."""
    if joints:
        return False
    if not sheet.header:
        return sheet.width == 3
    return bool(points_of(stems(sheet)))


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a point."""
    if not sheet.header:
        named = replace(sheet, header=("x", "y", "z"))
        reading = named_reading(TITLE, named, lambda stem: f"smr1_{stem}")
        columns = tuple(
            Column(f"column {i + 1}", c.meaning, "", c.cells) for i, c in enumerate(reading.columns)
        )
        return replace(reading, sheet=sheet, columns=columns)
    points = points_of(stems(sheet))
    return named_reading(TITLE, sheet, lambda stem: points.get(stem) or plain(stem))
