"""A program of its own: the first sheet of a workbook with numbers, on stdout as text with tabs.

A workbook of a few bytes can ask for any memory; what aborts then is this process.
"""

import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import date, datetime, time

MAX_MEMORY_BYTES = 900 << 20  # bytes of memory; a sheet of 100 MB takes a third
MAX_CPU_SECONDS = 120  # of the processor


def limit_process_resources() -> None:
    """Take no more than MOST and SECONDS, where the system lets that be limited.

    macOS refuses limits of address space; where one that is set already is lower, it stays.
    """
    try:
        import resource
    except ImportError:  # Windows
        return
    for kind, most in (
        (resource.RLIMIT_AS, MAX_MEMORY_BYTES),
        (resource.RLIMIT_CPU, MAX_CPU_SECONDS),
    ):
        with suppress(ValueError, OSError):
            resource.setrlimit(kind, (most, most))


def count_number_cells(table: Sequence[Sequence[object]]) -> int:
    """How many cells are numbers."""
    return sum(isinstance(cell, int | float) for row in table for cell in row)


def format_workbook_cell(cell: object) -> str:
    """A cell as text that reads back as the same value."""
    if isinstance(cell, bool):
        return str(cell).lower()
    if isinstance(cell, float):
        return repr(int(cell)) if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    if isinstance(cell, datetime):
        return cell.strftime("%Y-%m-%d %H:%M:%S.%f")
    if isinstance(cell, date | time):
        return cell.isoformat()
    return " ".join(str(cell).split())


def print_workbook_sheet(path: str) -> int:
    """Print the sheet; 1 with what is wrong on stderr."""
    limit_process_resources()
    import python_calamine as calamine

    try:
        book = calamine.CalamineWorkbook.from_path(path)
        sheets = [book.get_sheet_by_name(name).to_python() for name in book.sheet_names]
    except Exception as error:  # the reader has no common class for what is no workbook
        print(f"is no workbook that can be read ({error})", file=sys.stderr)
        return 1
    table = max(sheets, key=count_number_cells) if sheets else []
    if not count_number_cells(table):
        print("no sheet of the workbook holds numbers", file=sys.stderr)
        return 1
    for row in table:
        sys.stdout.buffer.write(("\t".join(map(format_workbook_cell, row)) + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(print_workbook_sheet(sys.argv[1]))
