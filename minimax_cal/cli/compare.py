"""The command `minimax-cal compare`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli.options import PATH_TYPE, CommandOutput, build_result_options, define_command
from minimax_cal.validation.monitoring.comparison import compare


@define_command
@click.argument("a", type=PATH_TYPE)
@click.argument("b", type=PATH_TYPE)
@build_result_options("the comparison (JSON)", suggested_file_name="compared.json")
def compare_command(a: Path, b: Path, to: CommandOutput) -> int:
    """What differs between two calibrations, A and B.

    They are from before and after a repair, say.  Both are what `calibrate` or `check` wrote with
    -o, the earlier first.  Base and reflectors may have moved; parameters that look the same as
    such a move are shown as nominal.
    """
    return to.write_and_print_result(compare(a, b))
