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
from minimax_cal.cli.stderr import AS_JSON, tell
from minimax_cal.correcting.compensate import Compensation, compensate
from minimax_cal.correcting.programs.program import LANGUAGES, is_program, read_program
from minimax_cal.correcting.target_file import read_targets
from minimax_cal.fitting.opened import open_result
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.options import Option
from minimax_cal.ground.words import visible
from minimax_cal.robots.robot import Robot, load_robot

HOW = "How targets are corrected"


@click.command(name="compensate", cls=InGroups)
@FIT
@click.argument("targets", type=PATH)
@plain_option(
    HOW,
    "--robot",
    "nominal",
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
        "Correct what follows the session's time too, as at this moment of it, 0 to 1 [default: "
        "not at all].",
        group=HOW,
    ),
)
@options_of(
    compensate,
    keep_anyway=Option("Also where the calibrated arm is no better than the drawn one.", group=HOW),
)
@plain_option(
    HOW,
    "--tool",
    default="",
    metavar="FRAME",
    help="The tool of a program: x,y,z,q1,q2,q3,q4 in mm, or one that it declares.",
)
@plain_option(
    HOW,
    "--wobj",
    default="",
    metavar="FRAME",
    help="The work object of a program, in the same way.",
)
@SAFE_CELLS
@RUNG
@result_options("the targets (CSV, or the program)")
def compensate_command(
    fit: Path,
    targets: Path,
    nominal: str | None,
    tool: str,
    wobj: str,
    safe_cells: bool,
    to: Output,
    **chosen: Any,
) -> int:
    """Correct the joint TARGETS (CSV) so that the robot of FIT goes where it is drawn to go.

    FIT is what `calibrate -o` wrote.  TARGETS may be a whole program too: a RAPID module (.mod) or
    KRL (.src, .dat), whose points alone are changed.  Without -o the corrected file goes to stdout,
    its summary to stderr.
    """
    check_alike(targets, to.path)
    robot = None if nominal is None else load_robot(nominal)
    if is_program(targets):
        drawn = robot or nominal_of(fit, chosen["rung"])
        program = read_program(targets, drawn, tool, wobj)
        found = compensate(fit, program.data, robot, **chosen)
        text: str | bytes = program.corrected(found)
    else:
        if tool or wobj:
            raise OptionError("--tool and --wobj go with a program (.mod, .src, .dat)")
        given = read_targets(targets)
        found = compensate(fit, given.data, robot, **chosen)
        text = to.cells(given.corrected(found), safe_cells)
    to.notice(*found.notices)
    if to.deliver(found.json, rows=lambda: text):
        show_corrected(found, text, to)
    if found.failed.any():
        tell("error", found.complaint(), exit_code=FAILED)
        return FAILED
    return 0


def show_corrected(found: Compensation, text: str | bytes, to: Output) -> None:
    """The summary where the targets went to a file; else the targets, and the summary beside."""
    if to.path:
        click.echo(found.summary(WIDTH))
        return
    if sys.stdout.isatty():
        text = on_terminal(text if isinstance(text, str) else text.decode("latin-1"))
    click.echo(text, nl=False)
    if AS_JSON.get() and not to.quiet:
        tell("summary", found.headline())
    elif not to.quiet:
        click.echo(found.summary(WIDTH), err=True)


def check_alike(targets: Path, out: Path | None) -> None:
    """Raise OptionError for a program into a file that other endings name, or CSV into one."""
    if out is None:
        return
    own = LANGUAGES.get(targets.suffix.lower())
    other = LANGUAGES.get(out.suffix.lower())
    if other is not own and (other or out.suffix.lower() == ".csv"):
        end = targets.suffix.lower() if own else ".csv"
        raise OptionError(
            f"{out}: {targets} is corrected into a file of its own kind; end it {end}"
        )


def nominal_of(fit: Path, rung: int | None) -> Robot:
    """The arm that the controller believes in.  Raises CalibrationError."""
    nominal = open_result(fit, rung).nominal
    if nominal is None:
        raise CalibrationError(f"{fit}: does not tell its nominal robot; give --robot")
    return nominal.robot


def on_terminal(text: str) -> str:
    """A file for people to look at: its cells may hold codes that move a cursor."""
    return "".join(f"{visible(line)}\n" for line in text.splitlines())
