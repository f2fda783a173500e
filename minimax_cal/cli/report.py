"""The command `minimax-cal report`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH_TYPE,
    QUIET_AND_PROGRESS_OPTIONS,
    STEP_OPTION,
    CommandOutput,
    define_command,
    options_from_dataclass,
    pass_output_to_command,
    print_tables,
)
from minimax_cal.cli.stderr_events import report_error
from minimax_cal.reporting.report_file import ReportOptions, write_report


@define_command
@click.argument("results", nargs=-1, required=True, type=PATH_TYPE)
@click.option(
    "-o", "--output", "path", type=PATH_TYPE, default="report.html", show_default=True,
    help="Write the report to this file: .html, .pdf, or .png of its first page.",
)  # fmt: skip
@options_from_dataclass(ReportOptions)
@STEP_OPTION
@click.option("--pdf", type=PATH_TYPE, metavar="FILE", help="Print it to this PDF as well.")
@QUIET_AND_PROGRESS_OPTIONS
@pass_output_to_command()
def report_command(
    results: Sequence[Path], path: Path, pdf: Path | None, to: CommandOutput, **chosen: Any
) -> int:
    """Four pages, one to sign, of RESULTS: a calibration, a diagnosis, or both.

    RESULTS are of the same measurements, as `calibrate`, `diagnose` or `relative` wrote them with
    -o; that of `gap -o` may come with them; that of `torques -o` stands alone.  They need no
    network; PDF and PNG need an installed Chromium, Chrome or Edge.  Not passed ends with code 1.
    """
    found = write_report(results, path, ReportOptions(**chosen), pdf, to.print_notices)
    for line in found.list_terminal_lines():
        click.echo(line)
    click.echo()
    print_tables(*found.tables())
    to.report_written_files(path, pdf, looks=found.verdict_style)
    return report_error(found.failed_requirements) if found.failed_requirements else 0
