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

from minimax_cal.ground.files import json_text, plain, write_whole
from minimax_cal.ground.tables import Table
from minimax_cal.reporting.plots.figures import save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parent.parent
CODE = ("minimax_cal", "qp_backends", "experiments", "tests/fuzz")  # what decides a figure
PACKAGES = ("minimax-cal", "numpy", "scipy", "qpsolvers")


def environment(packages: Iterable[str] = ()) -> Table:
    """The machine and the versions that a table was made with."""
    rows = [
        ("system", platform.platform(terse=True)),
        ("processor", processor()),
        ("cores", str(os.cpu_count())),
        ("threads", os.environ.get("OMP_NUM_THREADS", "as the libraries choose")),
        ("python", platform.python_version()),
        *([("commit", commit())] if commit() else []),
    ]
    for package in (*PACKAGES, *packages):
        try:
            rows.append((package, version(package)))
        except PackageNotFoundError:
            continue
    return Table.made("made on", rows, "what | value")


@functools.cache
def commit() -> str:
    """The version of the code that computes, with -dirty if it differs; nothing without git.

    What studies write (figures of the pages, pictures) does not count as a difference.
    """
    try:
        head = git("rev-parse", "--short=8", "HEAD")
        changed = git("status", "--porcelain", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return head + ("-dirty" if changed else "")


def git(*words: str) -> str:
    """What git says of this checkout.  Raises OSError, CalledProcessError."""
    command = ("git", "-C", str(ROOT), *words)
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def processor() -> str:
    """The processor's name where the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def interval(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a share [Clopper and Pearson 1934], all of it where n is 0."""
    low = beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return float(low), float(high)


def rate(hits: int, n: int) -> tuple[float, float, float]:
    """A share and its 95 % interval [%]; NaN of none."""
    low, high = interval(hits, n)
    return 100.0 * hits / n if n else float("nan"), 100.0 * low, 100.0 * high


def save_tables(folder: Path, name: str, tables: Sequence[Table]) -> None:
    """Write tables as name.md, name.tex, name.html and one CSV each, and show them."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / f"{name}.md", "\n".join(table.markdown() for table in tables))
    write_whole(folder / f"{name}.html", "\n".join(table.html() for table in tables))
    write_whole(folder / f"{name}.tex", "\n".join(table.latex() for table in tables))
    for number, table in enumerate(tables, start=1):
        write_whole(folder / f"{name}_{number}.csv", table.csv())
        click.echo(table.text(165) + "\n")


def canvas(wide: float, high: float) -> Figure:
    """An empty figure of so many inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(wide, high), layout="constrained")


def save_figure(folder: Path, name: str, figure: Figure) -> None:
    """Write a figure as PNG and SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in ("png", "svg"):
        save(figure, folder / f"{name}.{suffix}")


def save_json(path: Path, content: Mapping[str, object]) -> None:
    """Write the figures of a study for other programs: null for what is not known (NaN)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json_text({"schema": 1, **plain(content)}))


def run_record(command: str, packages: Iterable[str] = ()) -> dict[str, str]:
    """What a run was: its command, the day, and the machine and versions of `environment`."""
    made = {str(name): str(value) for name, value in environment(packages).rows}
    return {"command": command, "date": datetime.now(UTC).date().isoformat(), **made}


def table_record(table: Table) -> dict[str, Any]:
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


def read_table(record: Mapping[str, Any]) -> Table:
    """The table that `table_record` wrote."""
    columns = [
        f"{name} {spec}".rstrip()
        for name, spec in zip(record["header"], record["formats"], strict=True)
    ]
    return Table.made(record["title"], record["rows"], *columns)
