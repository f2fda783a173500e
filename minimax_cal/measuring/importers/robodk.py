"""RoboDK validation CSV: J1..Jn, then x, y, z, w, p, r and the tool."""

from __future__ import annotations

from dataclasses import replace

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

TITLE = "RoboDK CSV"
UNITS = {"q": "deg", "smr": "mm"}


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether joints J1, J2 ... stand beside x, y, z."""
    names = set(stems(sheet))
    return {"j1", "j2", "x", "y", "z"} <= names


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a pose; a tool that differs between rows is another target."""
    reading = named_reading(TITLE, sheet, meaning, UNITS)
    tools = [i for i, stem in enumerate(stems(sheet)) if stem.startswith("tool")]
    notice = (
        f"{sheet.path}: x, y, z are taken as measured points; if they are the controller's own "
        "pose there is nothing to calibrate from"
    )
    reading = replace(reading, notices=(notice,))
    labels = tuple(" ".join(row[i] for i in tools) for row in sheet.cells)
    if reading.find("target") or len(set(labels)) < 2:
        return reading
    extra = Column("tool", "target", "", labels)
    return replace(reading, columns=(*reading.columns, extra))


def meaning(stem: str) -> str:
    """Of a column's name."""
    if number := joint_number(stem):
        return f"q{number}"
    return f"smr1_{stem}" if stem in ("x", "y", "z") else plain(stem)
