"""The command `minimax-cal report`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import PATH, QUIET, RUNG, InGroups, Output, options_of, with_output
from minimax_cal.ground.options import Option
from minimax_cal.reporting.report import Chosen, report, signed

ASKED, SAID = "What is required", "What the page says"


@click.command(name="report", cls=InGroups)
@click.argument("results", nargs=-1, required=True, type=PATH)
@click.option(
    "-o", "--output", "path", type=PATH, default="report.html", show_default=True,
    help="Write the report to this file: .html, .pdf, or .png of its first page.",
)  # fmt: skip
@options_of(
    report,
    tolerance=Option(
        'What is required, in mm, as "rms 0.2, max 0.5".', metavar="LIMITS", group=ASKED
    ),
    tolerance_for=Option(
        "Judge poses inside or outside the measured region.",
        metavar="CLAIM",
        group=ASKED,
    ),
    deliver=Option(
        "Judge by what this reaches: a format of export, or compensate; may be given several "
        "times [default: corrected targets, where the result holds effects].",
        metavar="FORMAT",
        many=tuple,
        group=ASKED,
    ),
    facts=Option(
        "A TOML file with serial_number, controller, tool, payload, temperature, instrument, "
        "certificate, place, validity.",
        metavar="FILE",
        group=SAID,
    ),
    title=Option("The title of the report [default: of the robot].", group=SAID),
    customer=Option("Who accepts the report.", metavar="NAME", group=SAID),
    author=Option("Who measured and evaluated.", metavar="NAME", group=SAID),
    date=Option(
        "The date of the report [default: SOURCE_DATE_EPOCH, or today].",
        metavar="YYYY-MM-DD",
        group=SAID,
    ),
)
@RUNG
@click.option("--pdf", type=PATH, metavar="FILE", help="Print it to this PDF as well.")
@QUIET
@with_output
def report_command(
    results: Sequence[Path], path: Path, pdf: Path | None, to: Output, **chosen: Any
) -> int:
    """A page to sign of RESULTS: a calibration, a diagnosis, or both of the same measurements.

    RESULTS are files that `calibrate`, `diagnose` or `relative` wrote with -o; that of `gap -o` may
    come with them; that of `torques -o` stands alone.  The page needs no network; PDF and PNG need
    an installed Chromium, Chrome or Edge.
    """
    found = signed(results, path, Chosen(**chosen), pdf, to.notice)
    for line in found.lines():
        click.echo(line)
    to.wrote(path, pdf)
    return 0
