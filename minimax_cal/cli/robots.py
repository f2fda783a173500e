"""The command `minimax-cal robots`."""

from __future__ import annotations

import click

from minimax_cal.cli import options
from minimax_cal.cli.schemas import schema_of, schema_option
from minimax_cal.ground.tables import Table
from minimax_cal.ground.units import turned_for_people
from minimax_cal.robots.kinematics import MDH_NAMES
from minimax_cal.robots.robot import Robot, builtin_robots, load_robot

LENGTHS = ("a", "d")


@options.command
@click.argument("robot", required=False)
@options.JSON
@schema_option
def robots_command(robot: str | None, as_json: bool, schema: str | None) -> int:
    """The robots that come with the package.

    With ROBOT, a file or one of their names: its links, in mm and degrees.
    """
    if schema:
        return options.looked_up(True, schema_of(schema))
    if robot:
        arm = load_robot(robot)
        return options.looked_up(as_json, arm, links_table(arm))
    names = {name: load_robot(name) for name in builtin_robots()}
    rows = ((name, arm.name, arm.joints, arm.reach()) for name, arm in names.items())
    columns = "name | robot | joints d | links in all m .2f"
    table = Table.made("built-in robots", rows, columns)
    return options.looked_up(as_json, {"schema": 1, "robots": names}, table)


def links_table(robot: Robot) -> Table:
    """Links and limits in millimetres and degrees, in the convention of the robot's file."""
    units = [turned_for_people("m" if name in LENGTHS else "rad") for name in MDH_NAMES]
    own, _ = robot.notation.written(robot.mdh, robot.prismatic)
    rows = (
        (f"J{i + 1}", *(size * part for (size, _), part in zip(units, link, strict=True)),
         scale * robot.lower[i], scale * robot.upper[i], unit)
        for i, link in enumerate(own)
        for scale, unit in [turned_for_people("m" if robot.prismatic[i] else "rad")]
    )  # fmt: skip
    heads = (f"{name} {unit} .3f" for name, (_, unit) in zip(MDH_NAMES, units, strict=True))
    craig = " (modified DH)" if robot.notation.modified else ""
    title = f"{robot.name}: links and limits{craig}"
    return Table.made(title, rows, "joint", *heads, "from .1f", "to .1f", "in")
