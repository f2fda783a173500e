"""Reports of coordinate measuring machines: a row for each coordinate of a point."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.errors import DataError
from minimax_cal.measuring.importers.column_tables import (
    POINTS_FORMAT,
    ImportedTable,
    ImportOptions,
    interpret_columns,
)
from minimax_cal.reading.column_words import (
    COORDINATE_NAME_PATTERN,
    MEASURED_NAME_PATTERN,
    fold_case_and_accents,
    split_name_and_unit,
    standard_unit_name,
)
from minimax_cal.reading.text_sheet import Sheet, detect_decimal_sign

# DIM LOC1= LOCATION OF POINT P1_1  UNITS=MM, then AX NOMINAL MEAS ..., then X, Y, Z
CMM_BLOCK_PATTERN = re.compile(
    r"^[ \t]*\w+[ \t]+\S+[ \t]*=[^\r\n]*?(\S+)[ \t]+(?:UNITS|EINHEITEN|UNITES|UNIDADES)[ \t]*="
    r"[ \t]*(\w+)[^\r\n]*$",
    re.MULTILINE,
)
CMM_COLUMNS_PATTERN = re.compile(
    r"^[ \t]*(?:AX|AXIS|ACHSE|AXE|EJE)[ \t]+(\S[^\r\n]*)$", re.MULTILINE | re.I
)
CMM_ROW_PATTERN = re.compile(r"^[ \t]*([XYZ])[ \t]+(\S[^\r\n]*)$", re.MULTILINE)
MIN_COORDINATE_ROW_SHARE = 0.5  # share of rows that may be of other characteristics: a diameter


@dataclass(frozen=True)
class CmmCoordinate:
    """One coordinate.  point: the name.  axis: x, y or z."""

    line: int
    point: str
    axis: str
    value: str
    unit: str


def parse_cmm_text(sheet: Sheet) -> list[CmmCoordinate]:
    """The coordinates of a report in blocks, as PC-DMIS writes it.  Raises DataError."""
    out, text = [], sheet.text
    blocks = list(CMM_BLOCK_PATTERN.finditer(text))
    ends = [*(block.start() for block in blocks), len(text)][1:]
    for here, end in zip(blocks, ends, strict=False):
        head = CMM_COLUMNS_PATTERN.search(text, here.end(), end)
        names = [fold_case_and_accents(name) for name in head[1].split()] if head else []
        at = next((i for i, name in enumerate(names) if MEASURED_NAME_PATTERN.fullmatch(name)), -1)
        for row in CMM_ROW_PATTERN.finditer(text, here.end(), end) if at >= 0 else ():
            cells, line = row[2].split(), text.count("\n", 0, row.start(1)) + 1
            if len(cells) < len(names):
                raise DataError(
                    f"{sheet.path}:{line}: point {here[1]}: {len(cells)} values, but {len(names)} "
                    "columns; complete the row or delete the point"
                )
            unit = standard_unit_name(here[2].lower())
            out.append(CmmCoordinate(line, here[1], row[1].lower(), cells[at], unit))
    return out


def parse_cmm_table(sheet: Sheet) -> list[CmmCoordinate]:
    """The coordinates of a table with columns of the point's name, the axis and the value."""
    measured = [
        i
        for i, h in enumerate(sheet.header)
        if MEASURED_NAME_PATTERN.fullmatch(fold_case_and_accents(split_name_and_unit(h)[0]))
    ]
    columns = list(zip(*sheet.cells, strict=True))
    if len(measured) != 1 or not columns:
        return []
    found = [
        [COORDINATE_NAME_PATTERN.fullmatch(fold_case_and_accents(cell)) for cell in column]
        for column in columns
    ]
    axes = [[(axis[1] or "") if axis else "" for axis in column] for column in found]
    filled = [sum(map(bool, column)) for column in axes]
    at = int(np.argmax(filled))
    if not 0 < len(sheet.cells) <= filled[at] / MIN_COORDINATE_ROW_SHARE:
        return []
    rows = [i for i, axis in enumerate(axes[at]) if axis]
    units = [
        i
        for i, column in enumerate(columns)
        if all(standard_unit_name(column[row]) for row in rows)
    ]
    for column in columns:
        names = fill_empty_names_down(column)
        if has_mostly_whole_points([(names[row], axes[at][row]) for row in rows]):
            unit = split_name_and_unit(sheet.header[measured[0]])[1]
            return [
                CmmCoordinate(
                    int(sheet.line[row]),
                    names[row],
                    axes[at][row],
                    columns[measured[0]][row],
                    unit or (standard_unit_name(columns[units[0]][row]) if units else ""),
                )
                for row in rows
            ]
    return []


def fill_empty_names_down(cells: Sequence[str]) -> list[str]:
    """A column of names in which an empty cell is as the one above."""
    out: list[str] = []
    for cell in cells:
        out.append(cell or (out[-1] if out else ""))
    return out


def has_mostly_whole_points(name_axis_pairs: Sequence[tuple[str, str]]) -> bool:
    """Whether most points, by their names, have one row for each of x, y and z."""
    count = Counter(name_axis_pairs)
    points = {name for name, _ in name_axis_pairs if name}
    good = [name for name in points if all(count[name, axis] == 1 for axis in "xyz")]
    return (
        bool(good) and 2 * len(good) > len(points) and 3 * len(points) <= 2 * len(name_axis_pairs)
    )


def import_cmm_report(
    sheet: Sheet, options: ImportOptions, holds_joints: bool
) -> ImportedTable | None:
    """A row a point; None unless there is a row for each coordinate.

    Raises DataError for a coordinate that is there twice.
    """
    ways = (parse_cmm_text, parse_cmm_table)  # of a text, of a table that is cut
    found = [] if holds_joints else ways[bool(sheet.delimiter)](sheet)
    if not found:
        return None
    points: dict[str, dict[str, CmmCoordinate]] = {}
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
    sign = options.decimal or sheet.decimal or detect_decimal_sign(sheet.path, header, line, cells)
    others = sorted({*sheet.line.tolist()} - {one.line for one in found})
    table = replace(sheet, header=header, line=line, cells=cells, decimal=sign)
    reading = replace(interpret_columns(table, POINTS_FORMAT), format="a row for each coordinate")
    lines = ", ".join(map(str, others))
    return (
        reading.with_notices(f"no coordinates, and left out: line {lines}") if others else reading
    )
