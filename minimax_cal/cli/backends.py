"""The command `minimax-cal backends`."""

from __future__ import annotations

import qp_backends
from minimax_cal.cli import options
from minimax_cal.core.tables import Table


@options.define_command
@options.JSON_OPTION
def backends_command(as_json: bool) -> int:
    """The QP backends that are installed, with their versions."""
    found = qp_backends.available()
    every = dict.fromkeys(qp_backends.names(), "not installed")
    rows = (found | every | found).items()  # those installed first
    table = Table.from_rows("QP backends", rows, "name | version")
    return options.print_json_or_tables(as_json, {"schema": 1, "backends": found}, table)
