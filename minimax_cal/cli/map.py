"""The command `map`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli.options import JSON, QUIET, notify, show, writable
from minimax_cal.fitting.uncertainty import FRAMES
from minimax_cal.ground.files import json_text
from minimax_cal.judging.maps import Grid, Predict, predictor, unknown, workspace_map
from minimax_cal.judging.saved import Saved, open_fit
from minimax_cal.reporting.plots.figures import PICTURES
from minimax_cal.reporting.plots.map import save_map

DEFAULTS = Grid()


def predicted(saved: Saved, frame: str, source: str) -> tuple[Predict, tuple[str, ...]]:
    """What the covariance of a saved fit predicts, and a notice where it holds none."""
    if saved.fit.uncertainty is None:
        return unknown, (f"{source}: holds no covariance, so nothing is predicted",)
    return predictor(saved.fit.cell, saved.fit.uncertainty, frame), ()


@click.command(name="map")
@click.argument("fit", type=click.Path(path_type=Path))
@click.argument("data", type=click.Path(path_type=Path), required=False)
@click.option(
    "--height", type=float, metavar="MM", help="Of the horizontal section [default: the median]."
)
@click.option(
    "--slab", type=float, metavar="MM", help="Its thickness [default: a fifth of the reach]."
)
@click.option(
    "--frame",
    type=click.Choice(FRAMES),
    default=FRAMES[0],
    show_default=True,
    help="In which positions are predicted; base leaves out where the base stands.",
)
@click.option("--samples", type=int, default=DEFAULTS.samples, show_default=True)
@click.option(
    "--bins",
    type=int,
    default=DEFAULTS.bins,
    show_default=True,
    help="Along the wider side of a section.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the samples.")
@JSON
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Draw to this PNG, SVG or PDF."
)
@QUIET
def map_command(
    fit: Path,
    data: Path | None,
    height: float | None,
    slab: float | None,
    frame: str,
    samples: int,
    bins: int,
    seed: int,
    as_json: bool,
    output: Path | None,
    quiet: bool,
) -> int:
    """Where FIT is sure of a position, and where the arm missed, over the workspace.

    FIT is what `calibrate -o` wrote, DATA the measurements [default: those of the fit].
    """
    writable(output, kinds=PICTURES)
    saved = open_fit(fit, data or "")
    nan = float("nan")
    grid = Grid(
        samples=samples,
        bins=bins,
        height=nan if height is None else 1e-3 * height,
        slab=nan if slab is None else 1e-3 * slab,
        seed=seed,
    )
    predict, said = predicted(saved, frame, str(fit))
    found = workspace_map(saved, predict, grid)
    notify((*saved.notices, *said, *found.notices), quiet=quiet)
    if output:
        save_map(found, output)
    if as_json:
        click.echo(json_text(found.to_dict()), nl=False)
    else:
        show(found.table())
    return 0
