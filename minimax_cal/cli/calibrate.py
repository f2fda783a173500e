"""The command `minimax-cal calibrate`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    DETAILS,
    ROBOT,
    ROWS,
    SOME_CAMPAIGNS,
    InGroups,
    Output,
    keep,
    options_from,
    plain_option,
    result_options,
)
from minimax_cal.cli.pixel_files import PIXEL_FILES, PixelFiles
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text
from minimax_cal.reporting.plots.figures import save_errors
from minimax_cal.robots.kernels.choice import work
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from minimax_cal.judging.bootstrap import Bootstrap

BRIEF = 1000  # poses that one fit needs no compiled kernels for


@click.command(name="calibrate", cls=InGroups)
@ROBOT
@SOME_CAMPAIGNS
@options_from(Options)
@PIXEL_FILES
@options_from(PixelOptions, "drawn_prior")
@ROWS
@plain_option(
    "What is known",
    "--bootstrap",
    "replicates",
    type=int,
    metavar="N",
    help="Calibrate N resampled sets of poses for bootstrap intervals (500 are enough).",
)
@click.option(
    "--no-poses",
    "without",
    is_flag=True,
    help="Leave the poses out of the JSON, which of very many poses are nearly all of it.",
)
@DETAILS
@result_options("the result (JSON)", figure="the errors before and after")
def calibrate_command(
    robot: str,
    data: tuple[Path, ...],
    replicates: int | None,
    in_rows: bool,
    without: bool,
    pixels: Path | None,
    joints: Path | None,
    camera: Sequence[str],
    board: Path | None,
    camera_on: str,
    fix_camera: bool,
    camera_prior: str,
    drawn_prior: bool,
    details: bool,
    to: Output,
    **chosen: Any,
) -> int:
    """Calibrate ROBOT (a file or a built-in name) from the measurements in DATA.

    Or from what cameras saw, with --pixels, --joints and --camera in place of DATA.
    """
    files = PixelFiles(pixels, joints, tuple(camera), board)
    if files.given:
        lens = {
            "camera_on": camera_on,
            "fix_camera": fix_camera,
            "camera_prior": camera_prior,
            "drawn_prior": drawn_prior,
        }
        return by_cameras(robot, data, files, to, lens, chosen, details=details)
    if not data:
        raise click.UsageError(
            "Missing argument 'DATA...', or --pixels with --joints and --camera."
        )
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
        intervals = [found.table() for found in more]
        first = (*fit.first_tables(), *intervals)
        said = (*fit.sentences(), *([fit.solution()] if details else ()))
        options.present(
            details, said, first, lambda: (*fit.tables(), *intervals),
            advice(fit, robot, data, to.path),
        )  # fmt: skip
    to.draw(save_errors, fit)
    return options.exit_code(fit.status, fit.reason)


def by_cameras(
    robot: str,
    data: tuple[Path, ...],
    files: PixelFiles,
    to: Output,
    lens: dict[str, Any],
    chosen: dict[str, Any],
    *,
    details: bool,
) -> int:
    """Calibrate from pixels.  Raises OptionError for what they do not know."""
    from minimax_cal.fitting.instruments.pixel_calibration import calibrate_pixels

    if data:
        raise OptionError(
            f"{data[0]}: DATA and pixels are one fit in minimax-cal relative; give one of them here"
        )
    at = click.get_current_context()
    given = [
        name for name in chosen if at.get_parameter_source(name) is ParameterSource.COMMANDLINE
    ]
    for name in sorted(set(given) - {field.name for field in fields(PixelOptions)}):
        raise OptionError(f"{name}= is not for pixels: leave it out")
    own = {name: chosen[name] for name in given}
    pixels, joints, cameras, board = files.paths()
    with to.stages() as progress:
        fit = calibrate_pixels(robot, pixels, joints, cameras, board, progress, **lens, **own)
    to.notice(*fit.notices)
    if to.deliver(fit.json, fit.status):
        first = [fit.accuracy_table().brief()]
        options.present(details, [fit.headline()], first, fit.tables, keep(to.path, "fit.json"))
    return options.exit_code(fit.status, fit.reason)


def advice(
    fit: Fit, robot: str, data: tuple[Path, ...], written: Path | None
) -> Iterator[tuple[str, str]]:
    """What to do next, and its command.  written: where the result went."""
    if not fit.cell.effects.terms:
        left = f"{fit.within.after.rms_mm:.3f} mm"
        diagnose = f"minimax-cal diagnose {robot} {' '.join(map(str, data))}"
        yield f"Next, to find the cause of the remaining {left}", diagnose
    if written and fit.status is Status.CONVERGED:
        alone = "" if fit.cell.effects.terms else " by geometry alone"
        correct = f"minimax-cal compensate {written} targets.csv -o corrected.csv"
        yield f"To correct joint targets, or a program, for the controller{alone}", correct
        write = f"minimax-cal export {written} --to mjcf -o arm.xml"
        yield f"To write a file for MuJoCo, or --to urdf, dh-csv and others{alone}", write
        yield "To see every parameter and table", "add --details"
    else:
        yield "To keep the result, and to see every table", "add -o fit.json --details"


def text_of(fit: Fit, *more: Bootstrap, poses: bool = True) -> str:
    """The JSON of a calibration, with its bootstrap where there was one.  poses: as `to_dict`."""
    content = fit.to_dict(poses=poses)
    for found in more:
        content["bootstrap"] = found.to_dict()
    return json_text(content)
