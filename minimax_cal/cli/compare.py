"""The command `minimax-cal compare`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli.options import PATH, Output, command, result_options
from minimax_cal.judging.watching.comparison import compare


@command
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@result_options("the comparison (JSON)", keep="compared.json")
def compare_command(a: Path, b: Path, to: Output) -> int:
    """What differs between two calibrations, A and B.

    They are from before and after a repair, say.  Both are what `calibrate` or `check` wrote with
    -o, the earlier first.  Base and reflectors may have moved; parameters that look the same as
    such a move are shown as nominal.
    """
    return to.finish(compare(a, b))
