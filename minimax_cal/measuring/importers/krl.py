"""KUKA KRL text with joint targets, `{A1 ..., A2 ...}` in degrees: declarations or motions."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import blanked
from minimax_cal.measuring.importers.reading import Column, Reading, Told
from minimax_cal.measuring.importers.sheet import POINT, Sheet

TITLE = "KRL joint targets"
ASIDE = re.compile(r'"[^"\r\n]*"|;[^\r\n]*')  # strings and comments
TARGET = re.compile(
    r"(?:\b(\w++)\s*+=\s*+)?\{\s*+(?:(?:E6AXIS|AXIS)\s*+:)?\s*+(A1\s[^{}]*+)\}", re.IGNORECASE
)
AXIS = re.compile(r"\b([AE])(\d)\s+([^\s,{}]+)", re.IGNORECASE)


def fits(sheet: Sheet, joints: bool) -> bool:
    """Whether the text holds joint targets."""
    return bool(TARGET.search(blanked(sheet.text, ASIDE)))


def read(sheet: Sheet, told: Told) -> Reading:
    """One row a target; its name without the editor's leading X is the key.  Raises DataError."""
    bare = blanked(sheet.text, ASIDE)
    names, lines, rows = list[str](), list[int](), list[dict[str, str]]()
    for found in TARGET.finditer(bare):
        line = bare.count("\n", 0, found.start(2)) + 1
        row = {f"{kind.upper()}{number}": v for kind, number, v in AXIS.findall(found[2])}
        for axis, value in row.items():
            if not POINT.fullmatch(value):
                raise DataError(
                    f"{sheet.path}:{line}: {axis} {value!r} is not a number; mend it or delete "
                    "the line"
                )
        if rows and row.keys() != rows[0].keys():
            raise DataError(
                f"{sheet.path}:{line}: has axes {', '.join(row)}, the target before "
                f"{', '.join(rows[0])}; complete it or delete the line"
            )
        name = found[1] or ""
        names.append(name[1:] if re.fullmatch(r"[Xx][A-Za-z_]\w*", name) else name)
        lines.append(line)
        rows.append(row)
    if twice := {name for name in names if name and names.count(name) > 1}:
        at = lines[max(i for i, name in enumerate(names) if name in twice)]
        raise DataError(f"{sheet.path}:{at}: {names[lines.index(at)]} is set twice; delete one")
    columns = [Column("name", "pose", "", tuple(names))] if all(names) else []
    number = 0
    for axis in rows[0]:
        cells = tuple(row[axis] for row in rows)
        if axis[0] == "E" and {float(cell) for cell in cells} == {0.0}:
            columns.append(Column(axis, "", "", cells, "", "an axis that does not move"))
            continue
        number += 1
        unit, known = ("deg", "format") if axis[0] == "A" else ("", "")
        columns.append(Column(axis, f"q{number}", unit, cells, known))
    text = replace(sheet, delimiter="", decimal=".", header=(), cells=())
    return Reading(TITLE, text, tuple(columns), np.array(lines))
