"""The command `minimax-cal calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    CAMPAIGNS,
    ROBOT,
    ROWS,
    InGroups,
    Output,
    options_from,
    plain_option,
    result_options,
)
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import Options
from minimax_cal.ground.files import json_text
from minimax_cal.reporting.plots.figures import save_errors
from minimax_cal.robots.kernels.choice import work

if TYPE_CHECKING:
    from minimax_cal.judging.bootstrap import Bootstrap

BRIEF = 1000  # poses that one fit needs no compiled kernels for


@click.command(name="calibrate", cls=InGroups)
@ROBOT
@CAMPAIGNS
@options_from(Options)
@ROWS
@plain_option(
    "What is known",
    "--bootstrap",
    "replicates",
    type=int,
    metavar="N",
    help="Calibrate N times more, on poses drawn anew, for intervals by percentiles (500 serve).",
)
@click.option(
    "--no-poses",
    "without",
    is_flag=True,
    help="Leave the poses out of the JSON, which of very many poses are nearly all of it.",
)
@result_options("the result (JSON)", figure="the errors before and after")
def calibrate_command(
    robot: str,
    data: tuple[Path, ...],
    replicates: int | None,
    in_rows: bool,
    without: bool,
    to: Output,
    **chosen: Any,
) -> int:
    """Calibrate ROBOT (a file or a built-in name) from the measurements in DATA."""
    measured = options.measured(data, in_rows)
    brief = replicates is None and measured.poses <= BRIEF
    with work(brief=brief), to.stages() as progress:
        fit = calibrate(robot, measured, progress=progress, **chosen)
        more: tuple[Bootstrap, ...] = ()
        if replicates is not None:
            from minimax_cal.judging.bootstrap import bootstrap

            more = (bootstrap(fit, replicates, chosen["seed"], progress),)
    to.notice(*(notice for notice in fit.notices if notice != fit.reason))
    if to.deliver(lambda: text_of(fit, *more, poses=not without), fit.status):
        tables = (*fit.tables(), *(found.table() for found in more))
        options.show(*tables, headline=fit.headline())
    to.draw(save_errors, fit)
    return options.exit_code(fit.status, fit.reason)


def text_of(fit: Fit, *more: Bootstrap, poses: bool = True) -> str:
    """The JSON of a calibration, with its bootstrap where there was one.  poses: as `to_dict`."""
    content = fit.to_dict(poses=poses)
    for found in more:
        content["bootstrap"] = found.to_dict()
    return json_text(content)
