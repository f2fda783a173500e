"""Points of one target: three columns x, y, z, with or without a header; one file an SMR."""

from __future__ import annotations

from dataclasses import replace

from minimax_cal.measuring.importers.reading import (
    Column,
    Reading,
    Told,
    named_reading,
    plain,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "points of one target"
NAMES = {"x": "x", "y": "y", "z": "z"} | {f"{a}{t}": a for a in "xyz" for t in (" pos", "_pos")}


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether there are x, y, z and no joints."""
    if joints:
        return False
    if not sheet.header:
        return sheet.width == 3
    return sorted(NAMES[s] for s in stems(sheet) if s in NAMES) == ["x", "y", "z"]


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a point."""
    if not sheet.header:
        named = replace(sheet, header=("x", "y", "z"))
        reading = named_reading(TITLE, named, lambda stem: f"smr1_{stem}")
        columns = tuple(
            Column(f"column {i + 1}", c.meaning, "", c.cells) for i, c in enumerate(reading.columns)
        )
        return replace(reading, sheet=sheet, columns=columns)
    return named_reading(
        TITLE, sheet, lambda stem: f"smr1_{NAMES[stem]}" if stem in NAMES else plain(stem)
    )
