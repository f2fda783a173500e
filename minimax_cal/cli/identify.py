"""The command `minimax-cal identify`."""

from __future__ import annotations

from pathlib import Path

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    DATA_ARGUMENT,
    CommandOutput,
    build_result_options,
    define_command,
    group_option,
    options_from_parameters,
)
from minimax_cal.core.files import format_json
from minimax_cal.core.option_fields import Option
from minimax_cal.fitting.unknown_arm import identify_arm
from minimax_cal.robots.transforms import build_links_table

KNOWN_OPTION_GROUP = "What is known"


@define_command
@DATA_ARGUMENT
@options_from_parameters(
    identify_arm,
    KNOWN_OPTION_GROUP,
    joints=Option(
        "The type of each joint from the base on, as revolute,revolute,prismatic.",
        metavar="TYPES",
    ),
)
@group_option(
    KNOWN_OPTION_GROUP, "--name", default="identified arm", help="What the robot is called."
)
@build_result_options("the robot file (JSON)")
def identify_command(data: Path, joints: str, name: str, to: CommandOutput) -> int:
    """Make a robot file where nothing is drawn, from the measurements in DATA.

    Best with sweeps: rows in which one joint alone moves, five or more over 20 degrees, of each.
    """
    found = to.call_with_progress(
        identify_arm, options.read_measured_points([data], False), joints, name
    )
    return to.write_and_print_result(
        found.fit,
        status=found.status,
        reason=found.fit.reason,
        json=lambda: format_json(found.robot.to_dict()),
        show=lambda: options.print_tables(
            build_links_table(found.robot), headline=found.headline()
        ),
    )
