"""The commands `minimax-cal diagnose` and `minimax-cal effects`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    CAMPAIGNS,
    JSON,
    ROBOT,
    ROWS,
    SOME_DATA,
    InGroups,
    Output,
    options_from,
    options_of,
    result_options,
    workers,
)
from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.options import Options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text
from minimax_cal.ground.options import Option
from minimax_cal.measuring.history import with_history
from minimax_cal.reporting.plots.diagnosis import save_diagnosis
from minimax_cal.reporting.tables import effects_list, effects_table, remainder_table, where_tables


@click.command(name="diagnose", cls=InGroups)
@ROBOT
@CAMPAIGNS
@options_from(Options, "holdout", "seed", "holdout_by", "instrument")
@options_of(
    diagnose,
    exclude=Option(
        "Do not consider this effect; `minimax-cal effects` lists them.",
        metavar="EFFECT",
        flag="--without",
        many=tuple,
        group="What is sought",
    ),
    quick=Option(
        "Leave no parts of the poses out in turn: no claim outside the measured poses.",
        group="What is sought",
    ),
)
@workers(1, "1")
@ROWS
@result_options("the diagnosis (JSON)", figure="the gap and where it lies")
def diagnose_command(
    robot: str, data: tuple[Path, ...], in_rows: bool, to: Output, **chosen: Any
) -> int:
    """Say why ROBOT still misses once calibrated, as far as the measurements in DATA can tell."""
    with to.stages() as progress:
        found = diagnose(robot, options.measured(data, in_rows), progress=progress, **chosen)
    to.notice(*found.notices)
    if to.deliver(found.json, found.status):
        options.terminal().print(found.headline() + "\n", markup=False)
        left = remainder_table(found)
        options.show(*found.tables(), *([left] if left.rows else []), *where_tables(found.where))
    to.draw(save_diagnosis, found)
    return options.exit_code(found.status)


@click.command(name="effects", cls=InGroups)
@click.argument("robot", required=False)
@SOME_DATA
@ROWS
@JSON
def effects_command(robot: str | None, data: Path | None, in_rows: bool, as_json: bool) -> int:
    """The library of effects; with ROBOT and DATA, where these measurements can test them."""
    scene = None
    if robot is not None:
        if data is None:
            raise OptionError("effects needs both ROBOT and DATA, or neither")
        measured = with_history(options.measured([data], in_rows))
        fit = calibrate(robot, measured, objective="sum", holdout=0.0)
        scene = fit.cell.scene(measured)
    entries = effects_list(scene)
    if as_json:
        click.echo(json_text({"schema": 1, "effects": entries}), nl=False)
    else:
        options.show(effects_table(entries))
    return 0
