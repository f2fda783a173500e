"""What every study leaves behind: tables, figures, and what they were made on."""

from __future__ import annotations

import functools
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from scipy.stats import beta

from minimax_cal.core.files import convert_to_plain_json, format_json, write_file_atomically
from minimax_cal.core.tables import Table
from minimax_cal.reporting.plots.error_figure import write_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHECKOUT_ROOT = Path(__file__).resolve().parent.parent
CODE_FOLDERS = ("minimax_cal", "qp_backends", "experiments", "tests/fuzz")  # what decides a figure
RECORDED_PACKAGES = ("minimax-cal", "numpy", "scipy", "qpsolvers")


def build_environment_table(packages: Iterable[str] = ()) -> Table:
    """The machine and the versions that a table was made with."""
    rows = [
        ("system", platform.platform(terse=True)),
        ("processor", processor_name()),
        ("cores", str(os.cpu_count())),
        ("threads", os.environ.get("OMP_NUM_THREADS", "as the libraries choose")),
        ("python", platform.python_version()),
        *([("commit", current_commit())] if current_commit() else []),
    ]
    for package in (*RECORDED_PACKAGES, *packages):
        try:
            rows.append((package, version(package)))
        except PackageNotFoundError:
            continue
    return Table.from_rows("made on", rows, "what | value")


@functools.cache
def current_commit() -> str:
    """The version of the code that computes, with -dirty if it differs; nothing without git.

    What studies write (figures of the pages, pictures) does not count as a difference.
    """
    try:
        head = run_git("rev-parse", "--short=8", "HEAD")
        changed = run_git("status", "--porcelain", "--", *CODE_FOLDERS)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return head + ("-dirty" if changed else "")


def run_git(*words: str) -> str:
    """What git says of this checkout.  Raises OSError, CalledProcessError."""
    command = ("git", "-C", str(CHECKOUT_ROOT), *words)
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def processor_name() -> str:
    """The processor's name where the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def clopper_pearson_interval(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a share [Clopper and Pearson 1934], all of it where n is 0."""
    low = beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return float(low), float(high)


def percentage_with_interval(hits: int, n: int) -> tuple[float, float, float]:
    """A share and its 95 % interval [%]; NaN of none."""
    low, high = clopper_pearson_interval(hits, n)
    return 100.0 * hits / n if n else float("nan"), 100.0 * low, 100.0 * high


def write_tables(folder: Path, name: str, tables: Sequence[Table]) -> None:
    """Write tables as name.md, name.tex, name.html and one CSV each, and show them."""
    folder.mkdir(parents=True, exist_ok=True)
    write_file_atomically(folder / f"{name}.md", "\n".join(table.markdown() for table in tables))
    write_file_atomically(folder / f"{name}.html", "\n".join(table.html() for table in tables))
    write_file_atomically(folder / f"{name}.tex", "\n".join(table.latex() for table in tables))
    for number, table in enumerate(tables, start=1):
        write_file_atomically(folder / f"{name}_{number}.csv", table.csv())
        click.echo(table.text(165) + "\n")


def new_figure(wide: float, high: float) -> Figure:
    """An empty figure of so many inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(wide, high), layout="constrained")


def write_figure_files(folder: Path, name: str, figure: Figure) -> None:
    """Write a figure as PNG and SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in ("png", "svg"):
        write_figure(figure, folder / f"{name}.{suffix}")


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write the figures of a study for other programs: null for what is not known (NaN)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file_atomically(path, format_json({"schema": 1, **convert_to_plain_json(content)}))


def build_run_record(command: str, packages: Iterable[str] = ()) -> dict[str, str]:
    """What a run was: its command, the day, and the machine and versions of
    `build_environment_table`.
    """
    made = {str(name): str(value) for name, value in build_environment_table(packages).rows}
    return {"command": command, "date": datetime.now(UTC).date().isoformat(), **made}


def table_to_json(table: Table) -> dict[str, Any]:
    """A table for JSON: its title, header, format of each column and rows; null for NaN."""
    rows = [
        [str(cell) if isinstance(cell, float) and math.isinf(cell) else cell for cell in row]
        for row in table.rows
    ]
    return {
        "title": table.title,
        "header": table.header,
        "formats": table.formats or [""] * len(table.header),
        "rows": rows,
    }


def table_from_json(record: Mapping[str, Any]) -> Table:
    """The table that `table_to_json` wrote."""
    columns = [
        f"{name} {spec}".rstrip()
        for name, spec in zip(record["header"], record["formats"], strict=True)
    ]
    return Table.from_rows(record["title"], record["rows"], *columns)
