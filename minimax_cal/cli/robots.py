"""The command `minimax-cal robots`."""

from __future__ import annotations

import click
import numpy as np

from minimax_cal.cli import options
from minimax_cal.cli.schemas import schema_of, schema_option
from minimax_cal.ground.tables import Cell, Table
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
    rows = tuple((name, arm.name, arm.joints, arm.reach()) for name, arm in names.items())
    header = ("name", "robot", "joints", "links in all m")
    table = Table("built-in robots", header, rows, ("", "", "d", ".2f"))
    return options.looked_up(as_json, {"schema": 1, "robots": names}, table)


def links_table(robot: Robot) -> Table:
    """Links and limits in millimetres and degrees, in the convention of the robot's file."""
    (length, mm), (angle, deg) = turned_for_people("m"), turned_for_people("rad")
    scale = np.array([length if name in LENGTHS else angle for name in MDH_NAMES])
    rows: list[tuple[Cell, ...]] = []
    own, _ = robot.notation.written(robot.mdh, robot.prismatic)
    for i, (link, slides) in enumerate(zip(own, robot.prismatic, strict=True)):
        ends = (length if slides else angle) * np.array([robot.lower[i], robot.upper[i]])
        numbers = [*(scale * link).tolist(), *ends.tolist()]
        rows.append((f"J{i + 1}", *numbers, mm if slides else deg))
    units = (f"{name} {mm if name in LENGTHS else deg}" for name in MDH_NAMES)
    header = ("joint", *units, "from", "to", "in")
    formats = ("", *[".3f"] * 5, *[".1f"] * 2, "")
    craig = " (modified DH)" if robot.notation.modified else ""
    return Table(f"{robot.name}: links and limits{craig}", header, tuple(rows), formats)
