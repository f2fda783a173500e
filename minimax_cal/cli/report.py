"""The command `minimax-cal report`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import PATH, QUIET, Output, options_of, with_output
from minimax_cal.ground.options import Option
from minimax_cal.reporting.report import report


@click.command(name="report")
@click.argument("results", nargs=-1, required=True, type=PATH)
@click.option(
    "-o", "--output", "path", type=PATH, default="report.html", show_default=True,
    help="Write the report to this HTML file.",
)  # fmt: skip
@options_of(
    report,
    title=Option("Title [default: of the robot]."),
    customer=Option("Who accepts the report.", metavar="NAME"),
    author=Option("Who measured and evaluated.", metavar="NAME"),
    date=Option("Date of the report [default: SOURCE_DATE_EPOCH, or today].", metavar="YYYY-MM-DD"),
)
@click.option(
    "--pdf", type=PATH, metavar="FILE",
    help="Print it to this PDF as well, with an installed Chromium, Chrome or Edge.",
)  # fmt: skip
@QUIET
@with_output
def report_command(results: Sequence[Path], path: Path, to: Output, **chosen: Any) -> int:
    """One HTML page of RESULTS: a calibration, a diagnosis, or both of the same measurements.

    RESULTS are files that `calibrate -o` and `diagnose -o` wrote; that of `gap -o` may come with
    them.  The page needs no network.
    """
    report(results, path, notify=to.notice, **chosen)
    return 0
