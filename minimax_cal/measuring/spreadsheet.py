"""Workbooks (.xlsx, .xls, .ods) as text with tabs, by python-calamine."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, datetime, time
from pathlib import Path

from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import csv_text

SUFFIXES = (".xlsx", ".xlsm", ".xls", ".ods")


def is_workbook(path: Path | str) -> bool:
    """Whether a file's name is that of a workbook."""
    return Path(path).suffix.lower() in SUFFIXES


def text_of_workbook(path: Path | str, mark: str = "\t") -> str:
    """The first sheet with numbers, a line a row, cells with a mark between.  Raises DataError."""
    try:
        import python_calamine as calamine
    except ModuleNotFoundError as error:
        raise DataError(
            f'{path}: workbooks need "{error.name}": pip install minimax-cal[xlsx]; or save it as '
            "CSV"
        ) from error
    if not Path(path).is_file():
        raise DataError(f"{path}: cannot be read (No such file or directory)")
    try:
        book = calamine.CalamineWorkbook.from_path(str(path))
        sheets = [book.get_sheet_by_name(name).to_python() for name in book.sheet_names]
    except Exception as error:  # the reader has no common class for what is no workbook
        raise DataError(f"{path}: is no workbook that can be read ({error})") from error
    table = max(sheets, key=numbers_in) if sheets else []
    if not numbers_in(table):
        raise DataError(f"{path}: no sheet of the workbook holds numbers")
    return "\n".join(mark.join(text_of(cell, mark) for cell in row) for row in table) + "\n"


def csv_of_workbook(path: Path | str) -> str:
    """The same as CSV."""
    return csv_text(line.split("\t") for line in text_of_workbook(path).splitlines())


def numbers_in(table: Sequence[Sequence[object]]) -> int:
    """How many cells are numbers."""
    return sum(isinstance(cell, int | float) for row in table for cell in row)


def text_of(cell: object, mark: str) -> str:
    """A cell as text that reads back as the same value."""
    if isinstance(cell, bool):
        return str(cell).lower()
    if isinstance(cell, float):
        return repr(int(cell)) if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    if isinstance(cell, datetime):
        return cell.strftime("%Y-%m-%d %H:%M:%S.%f")
    if isinstance(cell, date | time):
        return cell.isoformat()
    return " ".join(str(cell).replace(mark, " ").split())
