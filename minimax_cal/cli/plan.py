"""The command `plan`."""

from __future__ import annotations

from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import PATH, ROBOT, InGroups, Output, options_from, result_options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import write_whole
from minimax_cal.planning.options import PlanOptions, limits_of
from minimax_cal.planning.plan import plan
from minimax_cal.planning.stops import ANGLES
from minimax_cal.reporting.plots.plan import save_plan
from minimax_cal.robots.robot import load_robot


@click.command(name="plan", cls=InGroups)
@ROBOT
@click.option("--poses", type=int, required=True, metavar="N", help="How many to measure.")
@click.option("--fit", type=PATH, help="Calibration (JSON): robot, base, targets, its poses.")
@click.option("--data", type=PATH, help="Measurements at hand (CSV); they count as known.")
@options_from(PlanOptions)
@click.option(
    "--unit",
    default="deg",
    show_default=True,
    help=f"Of joints in the file: {' or '.join(ANGLES)}.",
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
    if to.path:
        write_whole(to.path, found.csv(unit))
        to.wrote(to.path)
    to.draw(save_plan, found)
    if to.as_json:
        click.echo(found.json(), nl=False)
        return 0
    options.terminal().print(found.headline() + "\n", markup=False)
    options.show(*found.tables(), *(() if to.path else (found.pose_table(unit),)))
    return 0
