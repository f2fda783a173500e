"""The command `minimax-cal compare`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli.options import DETAILS, PATH, InGroups, Output, keep, present, result_options
from minimax_cal.judging.watching.comparison import compare


@click.command(name="compare", cls=InGroups)
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@DETAILS
@result_options("the comparison (JSON)")
def compare_command(a: Path, b: Path, details: bool, to: Output) -> int:
    """What differs between two calibrations A and B: before and after a repair, say.

    Both are what `calibrate` or `check` wrote with -o, the earlier first.  Base and reflectors may
    have moved; parameters that look the same as such a move are shown as nominal.
    """
    found = compare(a, b)
    to.notice(*found.notices)
    if to.deliver(found.json):
        present(details, [found.headline()], [found.first_table()], found.tables,
                keep(to.path, "compared.json"))  # fmt: skip
    return 0
