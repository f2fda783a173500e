"""The command `minimax-cal fleet`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import PATH, Output, command, result_options, show, workers
from minimax_cal.cli.stderr import complain
from minimax_cal.reporting.fleet.overview import fleet


@command
@click.argument("cells", type=PATH)
@click.option("--out", type=PATH, metavar="FOLDER", help="Write each cell's calibration there.")
@click.option("--page", "path", type=PATH, metavar="HTML", help="Write one overview page of all.")
@workers(-1, "one a core")
@result_options("all rows (JSON)")
def fleet_command(cells: Path, path: Path | None, jobs: int, to: Output, **chosen: Any) -> int:
    """Calibrate or check every cell of CELLS (TOML) in one go, with one overview of all.

    Ends with 1 where a cell failed; the others are done all the same.
    """
    found = to.work(fleet, cells, page=path, processes=jobs, **chosen)
    to.notice(*(f"{row.cell}: {text}" for row in found.rows for text in row.notices))
    to.wrote(path)
    to.finish(found, notices=(), show=lambda: show(found.table(), headline=found.headline()))
    names = ", ".join(row.cell for row in found.failed)
    return complain(f"{len(found.failed)} cells failed: {names}") if names else 0
