"""The command `minimax-cal report`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH,
    QUIET,
    RUNG,
    Output,
    command,
    options_from,
    show,
    with_output,
)
from minimax_cal.cli.stderr import complain
from minimax_cal.reporting.report import Chosen, signed


@command
@click.argument("results", nargs=-1, required=True, type=PATH)
@click.option(
    "-o", "--output", "path", type=PATH, default="report.html", show_default=True,
    help="Write the report to this file: .html, .pdf, or .png of its first page.",
)  # fmt: skip
@options_from(Chosen)
@RUNG
@click.option("--pdf", type=PATH, metavar="FILE", help="Print it to this PDF as well.")
@QUIET
@with_output()
def report_command(
    results: Sequence[Path], path: Path, pdf: Path | None, to: Output, **chosen: Any
) -> int:
    """Four pages, one to sign, of RESULTS: a calibration, a diagnosis, or both.

    RESULTS are of the same measurements, as `calibrate`, `diagnose` or `relative` wrote them with
    -o; that of `gap -o` may come with them; that of `torques -o` stands alone.  They need no
    network; PDF and PNG need an installed Chromium, Chrome or Edge.  Not passed ends with code 1.
    """
    found = signed(results, path, Chosen(**chosen), pdf, to.notice)
    for line in found.lines():
        click.echo(line)
    click.echo()
    show(*found.tables())
    to.wrote(path, pdf, looks=found.look)
    return complain(found.complaint) if found.complaint else 0
