"""The command `minimax-cal simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH,
    ROBOT,
    Output,
    command,
    options_from,
    options_of,
    output,
    writable,
)
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text, write_whole
from minimax_cal.ground.options import Option
from minimax_cal.measuring.measurements import write_measurements
from minimax_cal.modelling.simulate import Truth, simulate


@command
@ROBOT
@options_of(
    simulate,
    "The session",
    poses=Option("The number of poses."),
    targets=Option("The number of reflectors on the flange."),
    seed=Option("The seed of all that is random."),
)
@options_from(Truth)
@click.option(
    "--truth", type=PATH, help="Write the true robot, base and targets to this file (JSON)."
)
@output("the measurements (CSV)")
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
    writable(output, truth)
    made = simulate(robot, poses, targets, seed, Truth(**chosen))
    write_measurements(output, made.data)
    if truth:
        content = {"robot": made.cell.robot.to_dict(), **made.cell.to_dict()}
        write_whole(truth, json_text(content))
    Output().wrote(output, truth)
    return 0
