"""The command `minimax-cal export`."""

from __future__ import annotations

from typing import Any

import click

from minimax_cal.cli.options import (
    JSON,
    QUIET,
    RUNG,
    Output,
    command,
    options_from,
    output,
    plain_option,
    with_output,
)
from minimax_cal.correcting.export import FORMAT, ExportOptions, exported, written
from minimax_cal.correcting.exporters.table import FORMATS
from minimax_cal.ground.files import json_text


@command
@click.argument("fit")
@plain_option(
    FORMAT,
    "--to",
    "kind",
    required=True,
    metavar="FORMAT",
    help=f"The format: {', '.join(FORMATS)}.",
)
@options_from(ExportOptions)
@RUNG
@JSON
@output("the robot")
@QUIET
@with_output(rows=True)
def export_command(fit: str, kind: str, to: Output, **chosen: Any) -> int:
    """Write the robot of FIT as a file that others can load.

    FIT is a saved result or a robot.  The geometry is fitted again for exactly the effects that the
    format carries.  With --json its own accuracy goes to stdout, and the file to -o alone.
    """
    made = exported(fit, kind, to.output, ExportOptions(**chosen))
    if to.output or not to.as_json:
        written(made.file, to.output)
    own = [made.delivered.sentence()] if made.delivered else []
    to.notice(*made.file.notices, *own)
    to.wrote(to.output, accuracy="".join(own))
    if to.as_json:
        click.echo(json_text(made.to_dict()), nl=False)
    elif not to.output:
        click.echo(made.file.content, nl=False)
    return 0
