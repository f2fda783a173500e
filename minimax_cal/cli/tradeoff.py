"""The command `minimax-cal tradeoff`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.judging.tradeoff import STEPS, tradeoff
from minimax_cal.reporting.plots.figures import PICTURES
from minimax_cal.reporting.plots.tradeoff import save_tradeoff


@click.command(name="tradeoff")
@options.ROBOT
@options.DATA
@click.option(
    "--steps",
    type=int,
    default=STEPS,
    show_default=True,
    help="Compromises between least squares and the worst point.",
)
@click.option("--qp", default="daqp", show_default=True, help="QP backend of minimax.")
@options.HOLDOUT
@options.SEED
@options.figure_option("the curve, training and held out,")
@options.JSON
@options.output("the result (JSON)")
@options.QUIET
def tradeoff_command(
    robot: str,
    data: Path,
    steps: int,
    qp: str,
    holdout: float,
    seed: int,
    figure: Path | None,
    as_json: bool,
    output: Path | None,
    quiet: bool,
) -> int:
    """Small RMS or small largest error: what ROBOT could have, by the measurements in DATA."""
    options.writable(output)
    options.writable(figure, kinds=PICTURES)
    with options.stages(quiet=quiet) as progress:
        found = tradeoff(robot, data, steps, qp, holdout, seed, progress)
    options.notify(found.notices, quiet=quiet)
    if figure:
        save_tradeoff(found, figure)
    if options.deliver(found.json() if output or as_json else "", output, as_json=as_json):
        options.show(found.table())
        click.echo(f"\n{found.headline()}")
    return options.exit_code(found.status)
