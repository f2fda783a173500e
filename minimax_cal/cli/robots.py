"""The command `minimax-cal robots`."""

from __future__ import annotations

import click

from minimax_cal.cli import options
from minimax_cal.cli.schemas import print_schema, schema_option
from minimax_cal.ground.files import json_text
from minimax_cal.ground.tables import Table
from minimax_cal.robots.robot import builtin_robots, load_robot


@click.command(name="robots", cls=options.InGroups)
@options.JSON
@schema_option
def robots_command(as_json: bool, schema: str | None) -> int:
    """The robots that come with the package."""
    if schema:
        print_schema(schema)
        return 0
    names = {name: load_robot(name) for name in builtin_robots()}
    if as_json:
        content = {name: robot.to_dict() for name, robot in names.items()}
        click.echo(json_text({"schema": 1, "robots": content}), nl=False)
        return 0
    rows = tuple((name, robot.name, robot.joints, robot.reach()) for name, robot in names.items())
    header = ("name", "robot", "joints", "links in all m")
    options.show(Table("built-in robots", header, rows, ("", "", "d", ".2f")))
    return 0
