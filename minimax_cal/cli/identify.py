"""The command `minimax-cal identify`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import DATA, InGroups, Output, plain_option, result_options
from minimax_cal.cli.robots import links_table
from minimax_cal.fitting.unknown_arm import identify_arm
from minimax_cal.ground.files import json_text
from minimax_cal.robots.kernels.choice import work

KNOWN = "What is known"


@click.command(name="identify", cls=InGroups)
@DATA
@plain_option(
    KNOWN,
    "--joints",
    required=True,
    metavar="TYPES",
    help="The type of each joint from the base on, as revolute,revolute,prismatic.",
)
@plain_option(KNOWN, "--name", default="identified arm", help="What the robot is called.")
@result_options("the robot file (JSON)")
def identify_command(data: Path, joints: str, name: str, to: Output) -> int:
    """Make a robot file where nothing is drawn, from the measurements in DATA.

    Best with sweeps: rows in which one joint alone moves, five or more over 20 degrees, of each.
    """
    with work(brief=True), to.stages() as progress:
        found = identify_arm(options.measured([data], False), joints, name, progress)
    to.notice(*(notice for notice in found.fit.notices if notice != found.fit.reason))
    if to.deliver(lambda: json_text(found.robot.to_dict()), found.status):
        options.show(links_table(found.robot), headline=found.headline())
    return options.exit_code(found.status, found.fit.reason)
