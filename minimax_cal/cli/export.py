"""The command `minimax-cal export`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.correcting.export import exported
from minimax_cal.correcting.exporters.table import EXPORTERS
from minimax_cal.ground.files import write_whole


@click.command(name="export")
@click.argument("fit")
@click.option("--to", required=True, metavar="FORMAT", help=", ".join(EXPORTERS) + ".")
@click.option(
    "--urdf",
    "original",
    type=click.Path(path_type=Path),
    metavar="ORIGINAL",
    help="Correct the joint origins of this URDF; all else stays, byte for byte.",
)
@click.option("--tip", default="", metavar="LINK", help="Last link of the chain in that URDF.")
@click.option(
    "--experimental",
    is_flag=True,
    help="Agree to a format whose frames its maker does not document (moc).",
)
@options.output("the robot")
@options.QUIET
def export_command(
    fit: str,
    to: str,
    original: Path | None,
    tip: str,
    experimental: bool,
    output: Path | None,
    quiet: bool,
) -> int:
    """Write the robot of FIT (a saved calibration or a robot) as a file others can load."""
    options.writable(output)
    made = exported(fit, to, urdf=original, tip=tip, experimental=experimental)
    options.notify(made.notices, quiet=quiet)
    if output:
        write_whole(output, made.content)
    else:
        click.echo(made.content, nl=False)
    return 0
