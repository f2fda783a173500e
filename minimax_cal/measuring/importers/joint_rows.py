"""Joint values only: a header J1, J2 ..., or (told to be joints) no header at all."""

from __future__ import annotations

from minimax_cal.measuring.importers.reading import (
    Column,
    Reading,
    Told,
    checked,
    joint_names,
    joint_number,
    named_reading,
    plain,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet, is_number

TITLE = "joint values"
QUATERNION = "q0"  # a tracker's q0 to q3 turn the target, not the arm


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether the header names joints, or the user said that these are joints."""
    if not sheet.header:
        return joints and sheet.width > 1
    names = stems(sheet)
    if QUATERNION in names:
        return False
    named = any(joint_number(name) or name.endswith("_joint") for name in names)
    return named and (joints or not {"x", "y", "z"} <= set(names))


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a pose.  A first column of words is the key."""
    if sheet.header:
        named = joint_names(sheet)

        def meaning(stem: str) -> str:
            if stem in named:
                return f"q{named.index(stem) + 1}"
            return f"q{number}" if (number := joint_number(stem)) else plain(stem)

        return named_reading(TITLE, sheet, meaning)
    keyed = bool(sheet.cells) and not any(is_number(row[0]) for row in sheet.cells)
    columns = []
    for i in range(sheet.width):
        what = "pose" if keyed and i == 0 else f"q{i + 1 - keyed}"
        columns.append(Column(f"column {i + 1}", what, "", tuple(row[i] for row in sheet.cells)))
    return checked(Reading(TITLE, sheet, tuple(columns), sheet.line))
