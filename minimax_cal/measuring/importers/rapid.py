"""ABB RAPID text with `jointtarget` declarations: joints in degrees, by definition."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import blanked
from minimax_cal.measuring.importers.reading import Column, Reading, Told
from minimax_cal.measuring.importers.sheet import POINT, Sheet

TITLE = "RAPID jointtargets"
ASIDE = re.compile(r'"[^"\r\n]*"|![^\r\n]*')  # strings and comments
DECLARED = re.compile(r"\bjointtarget\s+(\w+)", re.IGNORECASE)
VALUES = re.compile(r"[\[{]\s*+([^\[\]{}]++)[\]}]")
ROBOT_AXES = 6
UNUSED = 9e9  # how RAPID writes an external axis that is not there


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether the text declares jointtargets."""
    return bool(DECLARED.search(blanked(sheet.text, ASIDE)))


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a jointtarget, its name the key.  Raises DataError."""
    bare = blanked(sheet.text, ASIDE)
    found = list(DECLARED.finditer(bare))
    names: list[str] = []
    lines: list[int] = []
    rows: list[list[str]] = []
    for here, after in zip(found, [*found[1:], None], strict=True):
        line = bare.count("\n", 0, here.start()) + 1
        body = bare[here.end() : after.start() if after else len(bare)]
        values = VALUES.search(body.split(";")[0])
        cells = [c.strip() for c in values[1].strip().strip(" ,").split(",")] if values else []
        where = f"{sheet.path}:{line}: jointtarget {here[1]}"
        if len(cells) < 2:
            raise DataError(f"{where} has no joint values; write it as [[0,0,0,0,30,0],[9E9,...]]")
        if bad := next((c for c in cells if not POINT.fullmatch(c)), None):
            raise DataError(f"{where}: {bad!r} is not a number; mend it or delete the line")
        if here[1] in names:
            raise DataError(f"{where} is declared twice; rename or delete one")
        if rows and len(cells) != len(rows[0]):
            raise DataError(
                f"{where} has {len(cells)} joint values, the one before {len(rows[0])}; "
                "complete it or delete the line"
            )
        names.append(here[1])
        lines.append(line)
        rows.append(cells)
    columns = [Column("name", "pose", "", tuple(names))]
    for i, values_i in enumerate(zip(*rows, strict=True)):
        empty = i >= ROBOT_AXES and {float(v) for v in values_i} <= {0.0, UNUSED}
        column = Column(f"axis {i + 1}", f"q{i + 1}", "deg", values_i, "format")
        if empty:
            column = replace(column, meaning="", remark="an axis that does not move")
        columns.append(column)
    text = replace(sheet, delimiter="", decimal=".", header=(), cells=())
    return Reading(TITLE, text, tuple(columns), np.array(lines))
