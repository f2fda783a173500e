"""The command `minimax-cal report`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.reporting.report import report


@click.command(name="report")
@click.argument("results", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default="report.html", show_default=True,
    help="Write the report to this HTML file.",
)  # fmt: skip
@click.option("--title", default="", metavar="TEXT", help="Title [default: of the robot].")
@click.option("--customer", default="", metavar="NAME", help="Who accepts the report.")
@click.option("--author", default="", metavar="NAME", help="Who measured and evaluated.")
@click.option(
    "--date", "day", default="", metavar="YYYY-MM-DD",
    help="Date of the report [default: SOURCE_DATE_EPOCH, or today].",
)  # fmt: skip
@click.option(
    "--pdf", type=click.Path(path_type=Path), metavar="FILE",
    help="Print it to this PDF as well, with an installed Chromium, Chrome or Edge.",
)  # fmt: skip
@options.QUIET
def report_command(
    results: Sequence[Path],
    output: Path,
    title: str,
    customer: str,
    author: str,
    day: str,
    pdf: Path | None,
    quiet: bool,
) -> int:
    """One HTML page of RESULTS: a calibration, a diagnosis, or both of the same measurements.

    RESULTS are files that `calibrate -o` and `diagnose -o` wrote.  The page needs no network.
    """
    report(
        results,
        output,
        title=title,
        customer=customer,
        author=author,
        date=day,
        pdf=pdf,
        notify=partial(options.notice, quiet=quiet),
    )
    return 0
