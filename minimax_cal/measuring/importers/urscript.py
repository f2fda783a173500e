"""URScript: joint lists of `movej([...])`, of variables, or one list a line; radians."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import blanked
from minimax_cal.measuring.importers.reading import Column, Reading, Told
from minimax_cal.measuring.importers.sheet import Sheet

TITLE = "URScript joint lists"
ASIDE = re.compile(r'"[^"\r\n]*"|#[^\r\n]*')
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
LIST = re.compile(
    r"(?:\b(?:global\s+)?(\w+)\s*=\s*|\bmovej\s*\(\s*|^[ \t]*)"
    rf"\[\s*({NUMBER}(?:\s*,\s*{NUMBER})+)\s*\]",
    re.MULTILINE,
)
LEAST_LISTS = 2


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether the text holds lists of joint values."""
    found = LIST.findall(blanked(sheet.text, ASIDE))
    return len(found) >= LEAST_LISTS and len({text.count(",") for _, text in found}) == 1


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a list; where all are variables, their names are the key.  Raises DataError."""
    bare = blanked(sheet.text, ASIDE)
    found = list(LIST.finditer(bare))
    names = tuple(one[1] or "" for one in found)
    lines = [bare.count("\n", 0, one.start(2)) + 1 for one in found]
    named = all(names)
    if named and len(set(names)) < len(names):
        again = next(i for i, name in enumerate(names) if name in names[:i])
        raise DataError(f"{sheet.path}:{lines[again]}: {names[again]} is set twice; delete one")
    rows = [[cell.strip() for cell in one[2].split(",")] for one in found]
    columns = [Column("name", "pose", "", names)] if named else []
    columns += [
        Column(f"joint {i + 1}", f"q{i + 1}", "rad", cells, "format")
        for i, cells in enumerate(zip(*rows, strict=True))
    ]
    text = replace(sheet, delimiter="", decimal=".", header=(), cells=())
    return Reading(TITLE, text, tuple(columns), np.array(lines))
