"""Workbooks (.xlsx, .xls, .ods) as text with tabs, by python-calamine in a process of its own."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import LARGEST
from minimax_cal.ground.optional import install_command
from minimax_cal.ground.words import one_line

SUFFIXES = (".xlsx", ".xlsm", ".xls", ".ods")
LIBRARY = "python_calamine"
MOST = LARGEST >> 3  # bytes of a workbook, which are packed


def is_workbook(path: Path | str) -> bool:
    """Whether a file's name is that of a workbook."""
    return Path(path).suffix.lower() in SUFFIXES


def text_of_workbook(path: Path) -> str:
    """The first sheet with numbers, a line a row, cells with a tab between.  Raises DataError."""
    import subprocess  # few tables are workbooks

    if find_spec(LIBRARY) is None:
        raise DataError(
            f"{path}: a workbook needs {LIBRARY}: {install_command('minimax-cal[xlsx]')}; or save "
            "it as CSV"
        )
    if not path.is_file():
        raise DataError(f"{path}: cannot be read (No such file or directory)")
    if path.stat().st_size > MOST:
        raise DataError(f"{path}: is larger than {MOST >> 20} MiB; save it as CSV")
    program = Path(__file__).with_name("isolated.py")
    done = subprocess.run([sys.executable, "-P", program, path], capture_output=True, check=False)
    if done.returncode:
        told = one_line(done.stderr.decode(errors="replace")) if done.returncode == 1 else ""
        raise DataError(f"{path}: {told or 'asks for more memory than any table; save it as CSV'}")
    return done.stdout.decode()
