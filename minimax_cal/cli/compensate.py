"""The command `compensate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import FAILED
from minimax_cal.cli.options import (
    FIT,
    PATH,
    RUNG,
    SAFE_CELLS,
    WIDTH,
    InGroups,
    Output,
    options_of,
    plain_option,
    result_options,
)
from minimax_cal.correcting.compensate import compensate
from minimax_cal.correcting.target_file import read_targets
from minimax_cal.ground.files import json_text
from minimax_cal.ground.options import Option
from minimax_cal.ground.words import visible
from minimax_cal.robots.robot import load_robot

HOW = "How targets are corrected"


@click.command(name="compensate", cls=InGroups)
@FIT
@click.argument("targets", type=PATH)
@plain_option(
    HOW,
    "--robot",
    help="The nominal robot of the controller, file or name [default: that of the fit].",
)
@options_of(
    compensate,
    frame=Option(
        "Where the nominal arm stands: best-fit (base and reflectors as the calibration placed "
        "them), flange (the base so, the flange as drawn), own (on the calibrated base).",
        group=HOW,
    ),
    tolerance=Option("What may remain of a target that counts as reached.", "mm", group=HOW),
    most_change=Option(
        "The most that a joint may change (a slide 8.7 mm per degree).",
        "deg",
        flag="--max-change",
        group=HOW,
    ),
    lever=Option("What a radian counts as [default: the targets' own].", "mm", group=HOW),
    clock=Option(
        "Take effects of time as at this moment of the calibration's session, 0 to 1.", group=HOW
    ),
)
@SAFE_CELLS
@RUNG
@result_options("the targets (CSV)")
def compensate_command(
    fit: Path, targets: Path, robot: str | None, safe_cells: bool, to: Output, **chosen: Any
) -> int:
    """Correct the joint TARGETS (CSV) so that the robot of FIT goes where it is drawn to go.

    FIT is what `calibrate -o` wrote.  Without -o the corrected file goes to stdout, its summary to
    stderr.
    """
    given = read_targets(targets)
    nominal = None if robot is None else load_robot(robot)
    found = compensate(fit, given.data, nominal, **chosen)
    to.notice(*found.notices)
    text = to.cells(given.corrected(found), safe_cells)
    to.write_rows(lambda: text, lambda: json_text(found.to_dict()))
    if to.as_json:
        click.echo(json_text(found.to_dict()), nl=False)
    elif to.path:
        click.echo(found.summary(WIDTH))
    else:
        click.echo(on_terminal(text) if sys.stdout.isatty() else text, nl=False)
        if not to.quiet:
            click.echo(found.summary(WIDTH), err=True)
    if found.failed.any():
        click.echo(f"error: {found.complaint()}", err=True)
        return FAILED
    return 0


def on_terminal(text: str) -> str:
    """A file for people to look at: its cells may hold codes that move a cursor."""
    return "".join(f"{visible(line)}\n" for line in text.splitlines())
