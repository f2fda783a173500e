"""The commands `minimax-cal diagnose` and `minimax-cal effects`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import read_measurements
from minimax_cal.reporting.plots.diagnosis import save_diagnosis
from minimax_cal.reporting.plots.figures import PICTURES
from minimax_cal.reporting.tables import effects_list, effects_table, where_tables


@click.command(name="diagnose")
@options.ROBOT
@options.DATA
@options.HOLDOUT
@options.SEED
@click.option(
    "--without",
    multiple=True,
    metavar="EFFECT",
    help="Do not consider this effect; `minimax-cal effects` lists them.",
)
@options.figure_option("the gap and where it lies")
@options.JSON
@options.output("the diagnosis (JSON)")
@options.QUIET
def diagnose_command(
    robot: str,
    data: Path,
    holdout: float,
    seed: int,
    without: Sequence[str],
    figure: Path | None,
    as_json: bool,
    output: Path | None,
    quiet: bool,
) -> int:
    """Say why ROBOT still misses once calibrated, as far as the measurements in DATA can tell."""
    options.writable(output)
    options.writable(figure, kinds=PICTURES)
    with options.stages(quiet=quiet) as progress:
        found = diagnose(
            robot,
            data,
            seed=seed,
            holdout=holdout,
            exclude=options.names_of(without),
            progress=progress,
        )
    options.notify(found.notices, quiet=quiet)
    if figure:
        save_diagnosis(found, figure)
    if options.deliver(found.json() if output or as_json else "", output, as_json=as_json):
        options.terminal().print(found.headline() + "\n", markup=False)
        options.show(*found.tables(), *where_tables(found.where))
    return options.exit_code(found.status)


@click.command(name="effects")
@click.argument("robot", required=False)
@click.argument("data", type=click.Path(path_type=Path), required=False)
@options.JSON
def effects_command(robot: str | None, data: Path | None, as_json: bool) -> int:
    """The library of effects; with ROBOT and DATA, where these measurements can test them."""
    scene = None
    if robot is not None:
        if data is None:
            raise OptionError("effects needs both ROBOT and DATA, or neither")
        measured = with_history(read_measurements(data))
        fit = calibrate(robot, measured, objective="sum", holdout=0.0)
        scene = fit.cell.scene(measured)
    entries = effects_list(scene)
    if as_json:
        click.echo(json_text({"schema": 1, "effects": entries}), nl=False)
    else:
        options.show(effects_table(entries))
    return 0
