"""The commands `minimax-cal diagnose` and `minimax-cal effects`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    CAMPAIGNS,
    DETAILS,
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
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.options import Options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text
from minimax_cal.ground.options import Option
from minimax_cal.ground.tables import Table, filled
from minimax_cal.measuring.history import with_history
from minimax_cal.reporting.plots.diagnosis import save_diagnosis
from minimax_cal.reporting.tables import effects_list, effects_table, remainder_table, where_tables
from minimax_cal.solvers.status import Status


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
        "Hold out no parts of the poses in turn: no claim outside the measured region.",
        group="What is sought",
    ),
)
@workers(1, "1")
@ROWS
@DETAILS
@result_options("the diagnosis (JSON)", figure="the gap and where it lies")
def diagnose_command(
    robot: str, data: tuple[Path, ...], in_rows: bool, details: bool, to: Output, **chosen: Any
) -> int:
    """Say why ROBOT still misses once calibrated, as far as the measurements in DATA can tell."""
    with to.stages() as progress:
        found = diagnose(robot, options.measured(data, in_rows), progress=progress, **chosen)
    to.notice(*found.notices)
    if to.deliver(found.json, found.status):
        every = partial(every_table, found)
        options.present(
            details, found.said, found.first_tables(), every, advice(found, robot, data, to.path)
        )
    to.draw(save_diagnosis, found)
    return options.exit_code(found.status)


def every_table(found: Diagnosis) -> Iterator[Table]:
    """Those of the result, and of where its errors lie."""
    yield from (*found.tables(), *filled(remainder_table(found)))
    yield from where_tables(found.where)


def advice(
    found: Diagnosis, robot: str, data: tuple[Path, ...], written: Path | None
) -> Iterator[tuple[str, str]]:
    """What to do next, and its command.  written: where the diagnosis went."""
    if written and found.main and found.status is Status.CONVERGED:
        files = " ".join(map(str, data))
        fit = f"minimax-cal calibrate {robot} {files} --effects {written} -o fit_effects.json"
        yield "Next, to calibrate with the confirmed causes", fit
        correct = "minimax-cal compensate fit_effects.json targets.csv -o corrected.csv"
        yield "Then, to correct joint targets, or a program, for the controller", correct
    keep = "" if written else "-o diagnosis.json "
    what = "To see" if written else "To keep the result, and to see"
    yield f"{what} every effect, parameter and table", f"add {keep}--details"


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
