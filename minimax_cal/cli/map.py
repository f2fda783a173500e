"""The command `map`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import click

from minimax_cal.cli.options import (
    FIT_ARGUMENT,
    JSON_OPTION,
    OPTIONAL_DATA_ARGUMENT,
    PATH_TYPE,
    QUIET_AND_PROGRESS_OPTIONS,
    STEP_OPTION,
    CommandOutput,
    define_command,
    group_option,
    options_from_dataclass,
    pass_output_to_command,
)
from minimax_cal.fitting.uncertainty import POSITION_FRAMES
from minimax_cal.reporting.plots.map_figure import save_map
from minimax_cal.validation.evaluation import AFTER, SavedResult, open_saved_result
from minimax_cal.validation.workspace_maps import (
    MapGrid,
    Predict,
    build_radius_predictor,
    build_workspace_map,
    predict_nan_radius,
)


class PositionPredictors(NamedTuple):
    """Predicted 95 % radii of the centroid and of a measurement of it; notices where unknown."""

    of_centroid: Predict
    of_measurement: Predict
    notices: tuple[str, ...]


def build_predictors(saved: SavedResult, frame: str, source: str) -> PositionPredictors:
    """What the covariance of a saved fit predicts of the centroid, and of a measurement of it.

    With a notice where it holds none.
    """
    known, cell = saved.uncertainty, saved.cells[AFTER]
    if known is None:
        return PositionPredictors(
            predict_nan_radius,
            predict_nan_radius,
            (f"{source}: holds no covariance, so nothing is predicted",),
        )
    return PositionPredictors(
        build_radius_predictor(cell, known, frame),
        build_radius_predictor(cell, known, measured=True),
        (),
    )


@define_command
@FIT_ARGUMENT
@OPTIONAL_DATA_ARGUMENT
@options_from_dataclass(MapGrid, "height", "slab")
@group_option(
    "The sections",
    "--frame",
    type=click.Choice(POSITION_FRAMES),
    default=POSITION_FRAMES[0],
    show_default=True,
    help="The frame in which positions are predicted; base leaves out where the base stands.",
)
@options_from_dataclass(MapGrid, "samples", "bins", "seed")
@STEP_OPTION
@JSON_OPTION
@click.option(
    "-o", "--output", "figure", type=PATH_TYPE,
    help="Draw to this PNG, SVG or PDF, or write the numbers to a .json.",
)  # fmt: skip
@QUIET_AND_PROGRESS_OPTIONS
@pass_output_to_command()
def map_command(
    fit: Path, data: Path | None, frame: str, rung: int | None, to: CommandOutput, **chosen: Any
) -> int:
    """Where FIT is sure of a position, and where the arm missed, over the workspace.

    FIT is what `calibrate`, `diagnose` or `relative` wrote with -o, DATA the measurements [default:
    those of the fit].
    """
    saved = open_saved_result(fit, data or "", rung=rung)
    predict, measured, said = build_predictors(saved, frame, str(fit))
    found = build_workspace_map(saved, predict, MapGrid(**chosen), measured)
    notices = (*saved.notices, *said, *found.notices)
    return to.write_and_print_result(found, notices=notices, draw=save_map)
