"""The command `minimax-cal report`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import UTC, date, datetime
from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import write_whole
from minimax_cal.reporting.html import (
    Wording,
    compose,
    find_browser,
    print_pdf,
    read_sources,
    render,
)

PAGES, PAPERS = (".html", ".htm"), (".pdf",)


def date_of(given: str) -> str:
    """The date of a report: as given, else of SOURCE_DATE_EPOCH, else today (UTC)."""
    try:
        if given:
            return date.fromisoformat(given).isoformat()
    except ValueError:
        raise OptionError(f"--date {given!r}: write it as 2026-01-31") from None
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    try:
        now = datetime.fromtimestamp(int(epoch), UTC) if epoch else datetime.now(UTC)
    except (ValueError, OverflowError, OSError):
        raise OptionError(f"SOURCE_DATE_EPOCH={epoch!r}: is not a number of seconds") from None
    return now.date().isoformat()


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
    options.writable(output, kinds=PAGES)
    options.writable(pdf, kinds=PAPERS)
    browser = find_browser() if pdf else ""
    sources = read_sources(results)
    report = compose(sources, Wording(date_of(day), title, customer, author))
    page = render(report)
    write_whole(output, page)
    if pdf:
        print_pdf(render(report, paper=True), pdf, browser)
    options.notify(sources.notices, quiet=quiet)
    return 0
