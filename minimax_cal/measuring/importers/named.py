"""One table of joints and points under plain names in several languages: Achse 1, X, Punkt."""

from __future__ import annotations

from minimax_cal.measuring.importers.reading import (
    Reading,
    Told,
    joint_number,
    named_reading,
    plain,
    points_of,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "table of joints and points"
LEAST_JOINTS = 2


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether the header names joints and points."""
    names = stems(sheet)
    count = len({joint_number(name) for name in names} - {0})
    return not joints and "q0" not in names and count >= LEAST_JOINTS and bool(points_of(names))


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a pose."""
    points = points_of(stems(sheet))

    def meaning(stem: str) -> str:
        if stem in points:
            return points[stem]
        return f"q{number}" if (number := joint_number(stem)) else plain(stem)

    return named_reading(TITLE, sheet, meaning)
