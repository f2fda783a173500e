"""The command `minimax-cal simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH_TYPE,
    ROBOT_ARGUMENT,
    CommandOutput,
    check_writable_paths,
    define_command,
    options_from_dataclass,
    options_from_parameters,
    output_option,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import format_json, write_file_atomically
from minimax_cal.core.option_fields import Option
from minimax_cal.measuring.measurements import write_measurements
from minimax_cal.modelling.simulate import Truth, simulate


@define_command
@ROBOT_ARGUMENT
@options_from_parameters(
    simulate,
    "The session",
    poses=Option("The number of poses."),
    targets=Option("The number of reflectors on the flange."),
    seed=Option("The seed of all that is random."),
)
@options_from_dataclass(Truth)
@click.option(
    "--truth", type=PATH_TYPE, help="Write the true robot, base and targets to this file (JSON)."
)
@output_option("the measurements (CSV)")
def simulate_command(
    robot: str,
    poses: int,
    targets: int,
    seed: int,
    truth: Path | None,
    output: Path | None,
    **chosen: Any,
) -> int:
    """Measurements of an imperfect copy of ROBOT, from a tracker at a random place."""
    if output is None:
        raise OptionError("simulate needs -o FILE for the measurements")
    if output.suffix.lower() == ".json":
        raise OptionError(f"{output}: the measurements are a CSV; write a .csv")
    check_writable_paths(output, truth)
    made = simulate(robot, poses, targets, seed, Truth(**chosen))
    write_measurements(output, made.data)
    if truth:
        content = {"robot": made.cell.robot.to_dict(), **made.cell.to_dict()}
        write_file_atomically(truth, format_json(content))
    CommandOutput().report_written_files(output, truth)
    return 0
