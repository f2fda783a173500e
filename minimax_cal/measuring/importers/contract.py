"""The project's own CSV, in other units, with another delimiter or decimal sign."""

from __future__ import annotations

import re

from minimax_cal.measuring.importers.reading import (
    POINT_NAME,
    WORDS,
    Reading,
    Told,
    named_reading,
    stems,
)
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "minimax-cal CSV"
JOINT = re.compile(r"q(\d+)")
OPTIONAL = re.compile(r"payload(?:_[xyz])?|tau\d+|approach\d+|qread\d+|base\d+_[xyz]")
KEPT = "kept as it is"


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether there are columns q1 ... or smr1_x ... ."""
    names = set(stems(sheet))
    return bool({"q1", "smr1_x"} & names) and "q0" not in names  # q0 to q3: a quaternion


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a pose; columns without a meaning are kept."""
    remarks = dict.fromkeys(stems(sheet), KEPT)
    return named_reading(TITLE, sheet, meaning, remarks=remarks)


def meaning(stem: str) -> str:
    """Of a column's name."""
    known = JOINT.fullmatch(stem) or POINT_NAME.fullmatch(stem) or OPTIONAL.fullmatch(stem)
    return stem if known or stem in WORDS else ""
