"""The command `minimax-cal export`."""

from __future__ import annotations

from typing import Any

import click

from minimax_cal.cli.options import (
    JSON_OPTION,
    QUIET_AND_PROGRESS_OPTIONS,
    STEP_OPTION,
    CommandOutput,
    define_command,
    group_option,
    options_from_dataclass,
    output_option,
    pass_output_to_command,
)
from minimax_cal.compensation.exporters.export_formats import DOCUMENTED_EXPORT_FORMATS
from minimax_cal.compensation.robot_export import (
    EXPORT_OPTION_GROUP,
    ExportOptions,
    build_export,
    write_exported_files,
)
from minimax_cal.core.files import format_json


@define_command
@click.argument("fit")
@group_option(
    EXPORT_OPTION_GROUP,
    "--to",
    "kind",
    required=True,
    metavar="FORMAT",
    help=f"The format: {', '.join(DOCUMENTED_EXPORT_FORMATS)}.",
)
@options_from_dataclass(ExportOptions)
@STEP_OPTION
@JSON_OPTION
@output_option("the robot")
@QUIET_AND_PROGRESS_OPTIONS
@pass_output_to_command(can_write_csv=True)
def export_command(fit: str, kind: str, to: CommandOutput, **chosen: Any) -> int:
    """Write the robot of FIT as a file that others can load.

    FIT is a saved result or a robot.  The geometry is fitted again for exactly the effects that the
    format carries.  With --json its own accuracy goes to stdout, and the file to -o alone.
    """
    made = build_export(fit, kind, to.output, ExportOptions(**chosen))
    if to.output or not to.as_json:
        write_exported_files(made.file, to.output)
    own = [made.delivered.sentence()] if made.delivered else []
    to.print_notices(*made.file.notices, *own)
    to.report_written_files(to.output, accuracy="".join(own))
    if to.as_json:
        click.echo(format_json(made.to_dict()), nl=False)
    elif not to.output:
        click.echo(made.file.content, nl=False)
    return 0
