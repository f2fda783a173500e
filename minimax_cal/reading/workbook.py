"""Workbooks (.xlsx, .xls, .ods) as text with tabs, by python-calamine in a process of its own."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from minimax_cal.core.display_text import clean_and_shorten_to_one_line
from minimax_cal.core.errors import DataError
from minimax_cal.core.files import MAX_FILE_BYTES
from minimax_cal.core.optional_packages import install_command

WORKBOOK_SUFFIXES = (".xlsx", ".xlsm", ".xls", ".ods")
WORKBOOK_LIBRARY = "python_calamine"
MAX_WORKBOOK_BYTES = MAX_FILE_BYTES >> 3  # bytes of a workbook, which are packed


def is_workbook_path(path: Path | str) -> bool:
    """Whether a file's name is that of a workbook."""
    return Path(path).suffix.lower() in WORKBOOK_SUFFIXES


def read_workbook_as_text(path: Path) -> str:
    """The first sheet with numbers, a line a row, cells with a tab between.  Raises DataError."""
    import subprocess  # few tables are workbooks

    if find_spec(WORKBOOK_LIBRARY) is None:
        raise DataError(
            f"{path}: a workbook needs {WORKBOOK_LIBRARY}: "
            f"{install_command('minimax-cal[xlsx]')}; or save "
            "it as CSV"
        )
    if not path.is_file():
        raise DataError(f"{path}: cannot be read (No such file or directory)")
    if path.stat().st_size > MAX_WORKBOOK_BYTES:
        raise DataError(f"{path}: is larger than {MAX_WORKBOOK_BYTES >> 20} MiB; save it as CSV")
    program = Path(__file__).with_name("isolated.py")
    done = subprocess.run([sys.executable, "-P", program, path], capture_output=True, check=False)
    if done.returncode:
        told = (
            clean_and_shorten_to_one_line(done.stderr.decode(errors="replace"))
            if done.returncode == 1
            else ""
        )
        raise DataError(f"{path}: {told or 'asks for more memory than any table; save it as CSV'}")
    return done.stdout.decode()
