"""The command `minimax-cal identify`."""

from __future__ import annotations

from pathlib import Path

from minimax_cal.cli import options
from minimax_cal.cli.options import DATA, Output, command, options_of, plain_option, result_options
from minimax_cal.fitting.unknown_arm import identify_arm
from minimax_cal.ground.files import json_text
from minimax_cal.ground.options import Option
from minimax_cal.robots.transforms import links_table

KNOWN = "What is known"


@command
@DATA
@options_of(
    identify_arm,
    KNOWN,
    joints=Option(
        "The type of each joint from the base on, as revolute,revolute,prismatic.",
        metavar="TYPES",
    ),
)
@plain_option(KNOWN, "--name", default="identified arm", help="What the robot is called.")
@result_options("the robot file (JSON)")
def identify_command(data: Path, joints: str, name: str, to: Output) -> int:
    """Make a robot file where nothing is drawn, from the measurements in DATA.

    Best with sweeps: rows in which one joint alone moves, five or more over 20 degrees, of each.
    """
    found = to.work(identify_arm, options.measured([data], False), joints, name)
    return to.finish(
        found.fit,
        status=found.status,
        reason=found.fit.reason,
        json=lambda: json_text(found.robot.to_dict()),
        show=lambda: options.show(links_table(found.robot), headline=found.headline()),
    )
