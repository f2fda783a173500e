"""The command `minimax-cal export`."""

from __future__ import annotations

from typing import Any

import click

from minimax_cal.cli.options import (
    JSON,
    PATH,
    QUIET,
    RUNG,
    InGroups,
    Output,
    can,
    options_of,
    output,
    plain_option,
    with_output,
)
from minimax_cal.correcting.export import exported, written
from minimax_cal.correcting.exporters.table import FORMATS
from minimax_cal.ground.files import json_text
from minimax_cal.ground.options import Option

FORMAT = "The format"


@click.command(name="export", cls=InGroups)
@click.argument("fit")
@plain_option(
    FORMAT,
    "--to",
    "kind",
    required=True,
    metavar="FORMAT",
    help=f"The format: {', '.join(FORMATS)}.",
)
@plain_option(
    FORMAT,
    "--urdf",
    type=PATH,
    metavar="ORIGINAL",
    help="Correct the joint origins of this URDF; all else stays, byte for byte.",
)
@plain_option(
    FORMAT,
    "--mjcf",
    type=PATH,
    metavar="ORIGINAL",
    help="Correct the bodies, gains and springs of this MJCF; all else stays.",
)
@options_of(
    exported,
    tip=Option("The last link of the chain in that file.", metavar="LINK", group=FORMAT),
    keep_anyway=Option(
        "Also where the calibrated arm is no better than the drawn one.", group=FORMAT
    ),
)
@plain_option(
    FORMAT,
    "--experimental",
    is_flag=True,
    hidden=True,
    help="Agree to moc.",
)
@RUNG
@JSON
@output("the robot")
@QUIET
@with_output
@can("rows")
def export_command(fit: str, kind: str, to: Output, **chosen: Any) -> int:
    """Write the robot of FIT (a saved result or a robot) as a file others can load.

    The geometry is fitted again for exactly the effects that the format carries.  With --json its
    own accuracy goes to stdout, and the file to -o alone.
    """
    made = exported(fit, kind, to.path, **chosen)
    if to.path or not to.as_json:
        written(made.file, to.path)
    to.notice(*made.file.notices, *([made.delivered.sentence()] if made.delivered else []))
    to.wrote(to.path)
    if to.as_json:
        click.echo(json_text(made.to_dict()), nl=False)
    elif not to.path:
        click.echo(made.file.content, nl=False)
    return 0
