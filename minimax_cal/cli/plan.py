"""The command `plan`."""

from __future__ import annotations

from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    PATH,
    ROBOT,
    InGroups,
    Output,
    options_from,
    plain_option,
    result_options,
)
from minimax_cal.ground.errors import OptionError
from minimax_cal.planning.options import PlanOptions, limits_of
from minimax_cal.planning.plan import plan
from minimax_cal.planning.stops import ANGLES
from minimax_cal.reporting.plots.plan import save_plan
from minimax_cal.robots.robot import load_robot


@click.command(name="plan", cls=InGroups)
@ROBOT
@plain_option(
    "What the poses are for",
    "--poses",
    type=int,
    required=True,
    metavar="N",
    help="How many poses to measure.",
)
@plain_option(
    "What is known",
    "--fit",
    type=PATH,
    help="A calibration (JSON): robot, base, targets, and its poses.",
)
@plain_option(
    "What is known", "--data", type=PATH, help="Measurements at hand (CSV); they count as known."
)
@options_from(PlanOptions)
@click.option(
    "--unit",
    default="deg",
    show_default=True,
    help=f"The unit of joints in the file: {' or '.join(ANGLES)}.",
)
@result_options("the poses (CSV)", figure="the poses and how accuracy grows with their number")
def plan_command(robot: str, unit: str, to: Output, **chosen: Any) -> int:
    """Which poses of ROBOT to measure next, in which order, and how accurate they will make it."""
    if unit not in ANGLES:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
    arm = load_robot(robot)
    chosen["joints"] = limits_of(chosen["joints"], arm)
    with to.stages() as progress:
        found = plan(arm, progress=progress, **chosen)
    to.notice(*found.notices)
    to.write_rows(lambda: found.csv(unit), found.json)
    to.draw(save_plan, found)
    if to.as_json:
        click.echo(found.json(), nl=False)
        return 0
    options.terminal().print(found.headline() + "\n", markup=False)
    options.show(*found.tables(), *(() if to.path else (found.pose_table(unit),)))
    return 0
