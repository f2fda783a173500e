"""Reports of coordinate measuring machines: a row for each coordinate of a point."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.tables import POINTS, Given, Reading, understood
from minimax_cal.reading.sheet import Sheet, decimal_of
from minimax_cal.reading.words import AXIS, MEASURED, folded, split_unit, unit_name

# DIM LOC1= LOCATION OF POINT P1_1  UNITS=MM, then AX NOMINAL MEAS ..., then X, Y, Z
BLOCK = re.compile(
    r"^[ \t]*\w+[ \t]+\S+[ \t]*=[^\r\n]*?(\S+)[ \t]+(?:UNITS|EINHEITEN|UNITES|UNIDADES)[ \t]*="
    r"[ \t]*(\w+)[^\r\n]*$",
    re.MULTILINE,
)
COLUMNS = re.compile(r"^[ \t]*(?:AX|AXIS|ACHSE|AXE|EJE)[ \t]+(\S[^\r\n]*)$", re.MULTILINE | re.I)
ROW = re.compile(r"^[ \t]*([XYZ])[ \t]+(\S[^\r\n]*)$", re.MULTILINE)
MOST_OTHERS = 0.5  # share of rows that may be of other characteristics: a diameter


@dataclass(frozen=True)
class Coordinate:
    """One coordinate.  point: the name.  axis: x, y or z."""

    line: int
    point: str
    axis: str
    value: str
    unit: str


def text_rows(sheet: Sheet) -> list[Coordinate]:
    """The coordinates of a report in blocks, as PC-DMIS writes it.  Raises DataError."""
    out, text = [], sheet.text
    blocks = list(BLOCK.finditer(text))
    ends = [*(block.start() for block in blocks), len(text)][1:]
    for here, end in zip(blocks, ends, strict=False):
        head = COLUMNS.search(text, here.end(), end)
        names = [folded(name) for name in head[1].split()] if head else []
        at = next((i for i, name in enumerate(names) if MEASURED.fullmatch(name)), -1)
        for row in ROW.finditer(text, here.end(), end) if at >= 0 else ():
            cells, line = row[2].split(), text.count("\n", 0, row.start(1)) + 1
            if len(cells) < len(names):
                raise DataError(
                    f"{sheet.path}:{line}: point {here[1]}: {len(cells)} values, but {len(names)} "
                    "columns; complete the row or delete the point"
                )
            unit = unit_name(here[2].lower())
            out.append(Coordinate(line, here[1], row[1].lower(), cells[at], unit))
    return out


def table_rows(sheet: Sheet) -> list[Coordinate]:
    """The coordinates of a table with columns of the point's name, the axis and the value."""
    measured = [
        i for i, h in enumerate(sheet.header) if MEASURED.fullmatch(folded(split_unit(h)[0]))
    ]
    columns = list(zip(*sheet.cells, strict=True))
    if len(measured) != 1 or not columns:
        return []
    found = [[AXIS.fullmatch(folded(cell)) for cell in column] for column in columns]
    axes = [[(axis[1] or "") if axis else "" for axis in column] for column in found]
    filled = [sum(map(bool, column)) for column in axes]
    at = int(np.argmax(filled))
    if not 0 < len(sheet.cells) <= filled[at] / MOST_OTHERS:
        return []
    rows = [i for i, axis in enumerate(axes[at]) if axis]
    units = [i for i, column in enumerate(columns) if all(unit_name(column[row]) for row in rows)]
    for column in columns:
        names = carried(column)
        if whole([(names[row], axes[at][row]) for row in rows]):
            unit = split_unit(sheet.header[measured[0]])[1]
            return [
                Coordinate(
                    int(sheet.line[row]),
                    names[row],
                    axes[at][row],
                    columns[measured[0]][row],
                    unit or (unit_name(columns[units[0]][row]) if units else ""),
                )
                for row in rows
            ]
    return []


def carried(cells: Sequence[str]) -> list[str]:
    """A column of names in which an empty cell is as the one above."""
    out: list[str] = []
    for cell in cells:
        out.append(cell or (out[-1] if out else ""))
    return out


def whole(pairs: Sequence[tuple[str, str]]) -> bool:
    """Whether most points, by their names, have one row for each of x, y and z."""
    count = Counter(pairs)
    points = {name for name, _ in pairs if name}
    good = [name for name in points if all(count[name, axis] == 1 for axis in "xyz")]
    return bool(good) and 2 * len(good) > len(points) and 3 * len(points) <= 2 * len(pairs)


def read(sheet: Sheet, given: Given, joints: bool) -> Reading | None:
    """A row a point; None unless there is a row for each coordinate.

    Raises DataError for a coordinate that is there twice.
    """
    ways = (text_rows, table_rows)  # of a text, of a table that is cut
    found = [] if joints else ways[bool(sheet.delimiter)](sheet)
    if not found:
        return None
    points: dict[str, dict[str, Coordinate]] = {}
    for one in found:
        first = points.setdefault(one.point, {}).setdefault(one.axis, one)
        if first is not one:
            raise DataError(
                f"{sheet.path}:{one.line}: a second {one.axis} of point {one.point}, as in line "
                f"{first.line}; delete one, or name the point otherwise"
            )
    units = {one.unit for one in found}
    unit = f" [{units.pop()}]" if len(units) == 1 and units != {""} else ""
    header = ("point", *(f"{axis}{unit}" for axis in "XYZ"))
    line = np.array([min(one.line for one in axes.values()) for axes in points.values()])
    cells = tuple(
        (name, *(axes[axis].value if axis in axes else "" for axis in "xyz"))
        for name, axes in points.items()
    )
    sign = given.decimal or sheet.decimal or decimal_of(sheet.path, header, line, cells)
    others = sorted({*sheet.line.tolist()} - {one.line for one in found})
    table = replace(sheet, header=header, line=line, cells=cells, decimal=sign)
    reading = replace(understood(table, POINTS), format="a row for each coordinate")
    lines = ", ".join(map(str, others))
    return reading.saying(f"no coordinates, and left out: line {lines}") if others else reading
