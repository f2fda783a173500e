"""The command `compensate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    FIT_ARGUMENT,
    PATH_TYPE,
    PIPED_OUTPUT_WIDTH,
    SAFE_CELLS_OPTION,
    STEP_OPTION,
    CommandOutput,
    build_result_options,
    define_command,
    options_from_dataclass,
    options_from_parameters,
)
from minimax_cal.cli.stderr_events import IS_JSON_PROGRESS, report_error, report_event
from minimax_cal.compensation.joint_compensation import (
    COMPENSATION_OPTION_GROUP,
    CompensateOptions,
    Compensation,
    compensate,
)
from minimax_cal.compensation.programs.robot_program import (
    LANGUAGE_BY_FILE_ENDING,
    RobotProgram,
    is_robot_program_file,
    read_robot_program,
)
from minimax_cal.compensation.target_file import TargetFile, read_target_file
from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.option_fields import Option
from minimax_cal.fitting.opened_results import open_result
from minimax_cal.robots.robot import Robot, load_robot


@define_command
@FIT_ARGUMENT
@click.argument("targets", type=PATH_TYPE)
@options_from_parameters(
    compensate,
    COMPENSATION_OPTION_GROUP,
    nominal=Option(
        "The nominal robot of the controller, file or name [default: that of the fit].",
        flag="--robot",
    ),
)
@options_from_dataclass(CompensateOptions)
@options_from_parameters(
    read_robot_program,
    COMPENSATION_OPTION_GROUP,
    tool=Option(
        "The tool of a program: x,y,z,q1,q2,q3,q4 in mm, or one that it declares.", metavar="FRAME"
    ),
    wobj=Option("The work object of a program, in the same way.", metavar="FRAME"),
)
@SAFE_CELLS_OPTION
@STEP_OPTION
@build_result_options("the targets (CSV, or the program)")
def compensate_command(
    fit: Path,
    targets: Path,
    nominal: str | None,
    tool: str,
    wobj: str,
    safe_cells: bool,
    to: CommandOutput,
    **chosen: Any,
) -> int:
    """Correct joint TARGETS, or a whole program, for the robot of FIT.

    It then goes where it is drawn to go.  FIT is what `calibrate -o` wrote.  TARGETS are a CSV, or
    a whole program: a RAPID module (.mod) or KRL (.src, .dat), whose points alone are changed.
    Without -o the corrected file goes to stdout, its summary to stderr.
    """
    check_same_file_kind(targets, to.output)
    robot = None if nominal is None else load_robot(nominal)
    given: RobotProgram | TargetFile
    if is_robot_program_file(targets):
        given = read_robot_program(
            targets, robot or load_nominal_robot(fit, chosen["rung"]), tool, wobj
        )
    elif tool or wobj:
        raise OptionError("--tool and --wobj go with a program (.mod, .src, .dat)")
    else:
        given = read_target_file(targets)
    found = compensate(fit, given.data, robot, **chosen)
    text = given.format_corrected(found)
    text = to.escape_formula_cells(text, safe_cells) if isinstance(text, str) else text
    to.write_and_print_result(
        found, rows=lambda: text, show=lambda: print_corrected_targets(found, text, to)
    )
    return report_error(found.complaint()) if found.missed else 0


def print_corrected_targets(
    compensation: Compensation, corrected_text: str | bytes, output: CommandOutput
) -> None:
    """The summary where the targets went to a file; else the targets, and the summary beside."""
    if output.output:
        click.echo(compensation.summary(PIPED_OUTPUT_WIDTH))
        return
    if sys.stdout.isatty():
        corrected_text = replace_control_characters_in_lines(
            corrected_text if isinstance(corrected_text, str) else corrected_text.decode("latin-1")
        )
    click.echo(corrected_text, nl=False)
    if IS_JSON_PROGRESS.get() and not output.quiet:
        report_event("summary", compensation.headline())
    elif not output.quiet:
        click.echo(compensation.summary(PIPED_OUTPUT_WIDTH), err=True)


def check_same_file_kind(targets_path: Path, output_path: Path | None) -> None:
    """Raise OptionError for a program into a file that other endings name, or CSV into one."""
    if output_path is None:
        return
    own = LANGUAGE_BY_FILE_ENDING.get(targets_path.suffix.lower())
    other = LANGUAGE_BY_FILE_ENDING.get(output_path.suffix.lower())
    if other is not own and (other or output_path.suffix.lower() == ".csv"):
        end = targets_path.suffix.lower() if own else ".csv"
        raise OptionError(
            f"{output_path}: {targets_path} is corrected into a file of its own kind; end it {end}"
        )


def load_nominal_robot(fit_path: Path, step_number: int | None) -> Robot:
    """The arm that the controller believes in.  Raises CalibrationError."""
    nominal = open_result(fit_path, step_number).nominal
    if nominal is None:
        raise CalibrationError(f"{fit_path}: does not tell its nominal robot; give --robot")
    return nominal.robot


def replace_control_characters_in_lines(text: str) -> str:
    """A file for people to look at: its cells may hold codes that move a cursor."""
    return "".join(f"{replace_invisible_and_bidi_characters(line)}\n" for line in text.splitlines())
