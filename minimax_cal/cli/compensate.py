"""The command `compensate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    FIT,
    PATH,
    RUNG,
    SAFE_CELLS,
    WIDTH,
    Output,
    command,
    options_from,
    options_of,
    result_options,
)
from minimax_cal.cli.stderr import AS_JSON, complain, tell
from minimax_cal.correcting.compensate import HOW, CompensateOptions, Compensation, compensate
from minimax_cal.correcting.programs.program import LANGUAGES, Program, is_program, read_program
from minimax_cal.correcting.target_file import TargetFile, read_targets
from minimax_cal.fitting.opened import open_result
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.options import Option
from minimax_cal.ground.words import visible
from minimax_cal.robots.robot import Robot, load_robot


@command
@FIT
@click.argument("targets", type=PATH)
@options_of(
    compensate,
    HOW,
    nominal=Option(
        "The nominal robot of the controller, file or name [default: that of the fit].",
        flag="--robot",
    ),
)
@options_from(CompensateOptions)
@options_of(
    read_program,
    HOW,
    tool=Option(
        "The tool of a program: x,y,z,q1,q2,q3,q4 in mm, or one that it declares.", metavar="FRAME"
    ),
    wobj=Option("The work object of a program, in the same way.", metavar="FRAME"),
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
    """Correct joint TARGETS, or a whole program, for the robot of FIT.

    It then goes where it is drawn to go.  FIT is what `calibrate -o` wrote.  TARGETS are a CSV, or
    a whole program: a RAPID module (.mod) or KRL (.src, .dat), whose points alone are changed.
    Without -o the corrected file goes to stdout, its summary to stderr.
    """
    check_alike(targets, to.output)
    robot = None if nominal is None else load_robot(nominal)
    given: Program | TargetFile
    if is_program(targets):
        given = read_program(targets, robot or nominal_of(fit, chosen["rung"]), tool, wobj)
    elif tool or wobj:
        raise OptionError("--tool and --wobj go with a program (.mod, .src, .dat)")
    else:
        given = read_targets(targets)
    found = compensate(fit, given.data, robot, **chosen)
    text = given.corrected(found)
    text = to.cells(text, safe_cells) if isinstance(text, str) else text
    to.finish(found, rows=lambda: text, show=lambda: show_corrected(found, text, to))
    return complain(found.complaint()) if found.missed else 0


def show_corrected(found: Compensation, text: str | bytes, to: Output) -> None:
    """The summary where the targets went to a file; else the targets, and the summary beside."""
    if to.output:
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
