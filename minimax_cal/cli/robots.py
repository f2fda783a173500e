"""The command `minimax-cal robots`."""

from __future__ import annotations

import click

from minimax_cal.cli import options
from minimax_cal.cli.schemas import build_file_schema, schema_option
from minimax_cal.core.tables import Table
from minimax_cal.robots.robot import builtin_robots, load_robot
from minimax_cal.robots.transforms import build_links_table


@options.define_command
@click.argument("robot", required=False)
@options.JSON_OPTION
@schema_option
def robots_command(robot: str | None, as_json: bool, schema: str | None) -> int:
    """The robots that come with the package.

    With ROBOT, a file or one of their names: its links, in mm and degrees.
    """
    if schema:
        return options.print_json_or_tables(True, build_file_schema(schema))
    if robot:
        arm = load_robot(robot)
        return options.print_json_or_tables(as_json, arm, build_links_table(arm))
    names = {name: load_robot(name) for name in builtin_robots()}
    rows = ((name, arm.name, arm.joints, arm.reach()) for name, arm in names.items())
    columns = "name | robot | joints d | links in all m .2f"
    table = Table.from_rows("built-in robots", rows, columns)
    return options.print_json_or_tables(as_json, {"schema": 1, "robots": names}, table)
