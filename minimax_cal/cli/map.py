"""The command `map`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    FIT,
    JSON,
    PATH,
    QUIET,
    RUNG,
    SOME_DATA,
    Output,
    command,
    options_from,
    plain_option,
    with_output,
)
from minimax_cal.fitting.uncertainty import FRAMES
from minimax_cal.judging.maps import Grid, Predict, predictor, unknown, workspace_map
from minimax_cal.judging.saved import AFTER, Saved, open_saved
from minimax_cal.reporting.plots.map import save_map


def predicted(saved: Saved, frame: str, source: str) -> tuple[Predict, Predict, tuple[str, ...]]:
    """What the covariance of a saved fit predicts of the centroid, and of a measurement of it.

    With a notice where it holds none.
    """
    known, cell = saved.uncertainty, saved.cells[AFTER]
    if known is None:
        return unknown, unknown, (f"{source}: holds no covariance, so nothing is predicted",)
    return predictor(cell, known, frame), predictor(cell, known, measured=True), ()


@command
@FIT
@SOME_DATA
@options_from(Grid, "height", "slab")
@plain_option(
    "The sections",
    "--frame",
    type=click.Choice(FRAMES),
    default=FRAMES[0],
    show_default=True,
    help="The frame in which positions are predicted; base leaves out where the base stands.",
)
@options_from(Grid, "samples", "bins", "seed")
@RUNG
@JSON
@click.option(
    "-o", "--output", "figure", type=PATH,
    help="Draw to this PNG, SVG or PDF, or write the numbers to a .json.",
)  # fmt: skip
@QUIET
@with_output()
def map_command(
    fit: Path, data: Path | None, frame: str, rung: int | None, to: Output, **chosen: Any
) -> int:
    """Where FIT is sure of a position, and where the arm missed, over the workspace.

    FIT is what `calibrate`, `diagnose` or `relative` wrote with -o, DATA the measurements [default:
    those of the fit].
    """
    saved = open_saved(fit, data or "", rung=rung)
    predict, measured, said = predicted(saved, frame, str(fit))
    found = workspace_map(saved, predict, Grid(**chosen), measured)
    notices = (*saved.notices, *said, *found.notices)
    return to.finish(found, notices=notices, draw=save_map)
