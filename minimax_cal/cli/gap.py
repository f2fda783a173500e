"""The command `minimax-cal gap`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    DATA,
    PATH,
    InGroups,
    Output,
    options_from,
    options_of,
    plain_option,
    result_options,
)
from minimax_cal.fitting.options import Options
from minimax_cal.ground.options import Option
from minimax_cal.reporting.plots.simulator import save_simulator_gap
from minimax_cal.simulators.ladder import simulator_gap

ARM = "The arm"


@click.command(name="gap", cls=InGroups)
@click.argument("model", type=PATH)
@DATA
@plain_option(
    ARM, "--fit", type=PATH, metavar="FIT", help="Correct by this calibration of the arm."
)
@plain_option(
    ARM, "--diagnosis", type=PATH, metavar="D", help="Correct by this diagnosis of the arm."
)
@click.option("--write", type=PATH, metavar="XML", help="Write the corrected model to this MJCF.")
@options_of(
    simulator_gap,
    tip=Option("The last body of the arm, where there are several.", metavar="BODY", group=ARM),
)
@options_from(Options, "holdout", "seed")
@result_options("the gap (JSON)", figure="the ladder")
def gap_command(model: Path, data: Path, to: Output, **chosen: Any) -> int:
    """How far the simulated arm of MODEL (MJCF or URDF) misses the real one in DATA, and why.

    The model is driven with the measured commands in MuJoCo, as given and then corrected step by
    step; only base and targets are fitted.  Without --fit or --diagnosis a diagnosis is made.
    """
    with to.stages() as progress:
        found = simulator_gap(model, data, progress=progress, **chosen)
    to.wrote(chosen["write"])
    to.notice(*found.notices)
    if to.deliver(found.json):
        options.show(found.table(), headline=found.headline())
    to.draw(save_simulator_gap, found)
    return options.exit_code(found.status) or int(not found.holds)
