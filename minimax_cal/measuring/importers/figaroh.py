"""FIGAROH CSV: x1, y1, z1 (phix1 ...), then a column for each joint by name; metres, radians."""

from __future__ import annotations

import re

from minimax_cal.measuring.importers.reading import (
    Reading,
    Told,
    along_arm,
    named_reading,
    plain,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "FIGAROH CSV"
UNITS = {"q": "rad", "smr": "m"}
MARKER = re.compile(r"([xyz])(\d+)")
TURNED = re.compile(r"phi[xyz]\d+")


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether the header starts with x1, y1, z1 and goes on."""
    names = stems(sheet)
    return names[:3] == ("x1", "y1", "z1") and len(names) > 4


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a pose; every column that is neither marker nor known is a joint, in file order, or
    along the arm where the names tell.
    """
    names = along_arm(
        [
            name
            for name in stems(sheet)
            if not (MARKER.fullmatch(name) or TURNED.fullmatch(name) or plain(name))
        ]
    )

    def meaning(stem: str) -> str:
        if found := MARKER.fullmatch(stem):
            return f"smr{found[2]}_{found[1]}"
        return f"q{names.index(stem) + 1}" if stem in names else plain(stem)

    return named_reading(TITLE, sheet, meaning, UNITS)
