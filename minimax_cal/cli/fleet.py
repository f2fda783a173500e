"""The command `minimax-cal fleet`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli import FAILED
from minimax_cal.cli.options import PATH, InGroups, Output, result_options, show, workers
from minimax_cal.cli.stderr import tell
from minimax_cal.reporting.fleet.overview import fleet


@click.command(name="fleet", cls=InGroups)
@click.argument("cells", type=PATH)
@click.option("--out", type=PATH, metavar="FOLDER", help="Write each cell's calibration there.")
@click.option("--page", "path", type=PATH, metavar="HTML", help="Write one overview page of all.")
@workers(-1, "one a core")
@result_options("all rows (JSON)")
def fleet_command(
    cells: Path, out: Path | None, path: Path | None, jobs: int, cluster: str, to: Output
) -> int:
    """Calibrate or check every cell of CELLS (TOML) in one go, with one overview of all.

    Ends with 1 where a cell failed; the others are done all the same.
    """
    with to.stages() as progress:
        found = fleet(cells, out=out, page=path, processes=jobs, cluster=cluster, progress=progress)
    to.notice(*(f"{row.cell}: {text}" for row in found.rows for text in row.notices))
    to.wrote(path)
    if to.deliver(found.json):
        show(found.table(), headline=found.headline())
    if found.failed:
        names = ", ".join(row.cell for row in found.failed)
        tell("error", f"{len(found.failed)} cells failed: {names}", exit_code=FAILED)
    return FAILED if found.failed else 0
