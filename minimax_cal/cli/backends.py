"""The command `minimax-cal backends`."""

from __future__ import annotations

import click

import qp_backends
from minimax_cal.cli import options
from minimax_cal.ground.files import json_text
from minimax_cal.ground.tables import Table


@click.command(name="backends", cls=options.InGroups)
@options.JSON
def backends_command(as_json: bool) -> int:
    """The QP backends that are installed, with their versions."""
    found = qp_backends.available()
    if as_json:
        click.echo(json_text({"schema": 1, "backends": found}), nl=False)
        return 0
    missing = [name for name in qp_backends.names() if name not in found]
    rows = (*found.items(), *((name, "not installed") for name in missing))
    options.show(Table.made("QP backends", rows, "name | version"))
    return 0
