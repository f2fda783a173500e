"""The command `minimax-cal backends`."""

from __future__ import annotations

import qp_backends
from minimax_cal.cli import options
from minimax_cal.ground.tables import Table


@options.command
@options.JSON
def backends_command(as_json: bool) -> int:
    """The QP backends that are installed, with their versions."""
    found = qp_backends.available()
    every = dict.fromkeys(qp_backends.names(), "not installed")
    rows = (found | every | found).items()  # those installed first
    table = Table.made("QP backends", rows, "name | version")
    return options.looked_up(as_json, {"schema": 1, "backends": found}, table)
