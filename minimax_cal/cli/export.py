"""The command `minimax-cal export`."""

from __future__ import annotations

from typing import Any

import click

from minimax_cal.cli.options import (
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
from minimax_cal.correcting.exporters.table import EXPORTERS
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
    help="The format: " + ", ".join(EXPORTERS) + ".",
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
    experimental=Option(
        "Agree to a format whose frames its maker does not document (moc).", group=FORMAT
    ),
)
@RUNG
@output("the robot")
@QUIET
@with_output
@can("rows")
def export_command(fit: str, kind: str, to: Output, **chosen: Any) -> int:
    """Write the robot of FIT (a saved result or a robot) as a file others can load."""
    made = exported(fit, kind, to.path, **chosen)
    written(made, to.path)
    to.notice(*made.notices)
    to.wrote(to.path)
    if not to.path:
        click.echo(made.content, nl=False)
    return 0
