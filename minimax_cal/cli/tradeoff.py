"""The command `minimax-cal tradeoff`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    DATA,
    ROBOT,
    InGroups,
    Output,
    options_from,
    options_of,
    result_options,
)
from minimax_cal.fitting.options import Options
from minimax_cal.ground.options import Option
from minimax_cal.judging.tradeoff import tradeoff
from minimax_cal.reporting.plots.tradeoff import save_tradeoff


@click.command(name="tradeoff", cls=InGroups)
@ROBOT
@DATA
@options_of(
    tradeoff,
    steps=Option(
        "The number of compromises between least squares and the worst point.",
        group="How it is solved",
    ),
)
@options_from(Options, "qp", "holdout", "seed")
@result_options("the result (JSON)", figure="the curve, training and held out,")
def tradeoff_command(robot: str, data: Path, to: Output, **chosen: Any) -> int:
    """Small RMS or small largest error: what ROBOT could have, by the measurements in DATA."""
    with to.stages() as progress:
        found = tradeoff(robot, data, progress=progress, **chosen)
    to.notice(*found.notices)
    if to.deliver(found.json):
        options.show(found.table(), headline=found.headline())
    to.draw(save_tradeoff, found)
    return options.exit_code(found.status)
