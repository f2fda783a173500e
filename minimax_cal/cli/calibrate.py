"""The command `minimax-cal calibrate`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minimax_cal.cli.options import (
    ROBOT,
    ROWS,
    SOME_CAMPAIGNS,
    Output,
    among,
    command,
    flag,
    of_any,
    on_command_line,
    options_from,
    plain_option,
    refuse,
    result_options,
    together,
)
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.opened import listed_effects
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import FIELDS, OF_CAMERAS, PixelFiles, PixelOptions
from minimax_cal.fitting.several.options import RelativeOptions
from minimax_cal.ground.files import json_text, plain
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.reporting.plots.figures import save_errors
from minimax_cal.robots.kernels.choice import work
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from minimax_cal.judging.bootstrap import Bootstrap

OPTIONS = {f.name for kind in (Options, RelativeOptions) for f in fields(kind)}
BRIEF = 1000  # poses that one fit needs no compiled kernels for


@command
@ROBOT
@SOME_CAMPAIGNS
@options_from(Options)
@options_from(RelativeOptions, "offset", "known_distances", "noises")
@options_from(PixelFiles)
@options_from(PixelOptions, *OF_CAMERAS)
@ROWS
@plain_option(
    "What is known",
    "--bootstrap",
    "replicates",
    type=int,
    metavar="N",
    help="Calibrate N resampled sets of poses for bootstrap intervals (500 are enough).",
)
@flag(
    "--no-poses",
    "without",
    help="Leave the poses out of the JSON, which of very many poses are nearly all of it.",
)
@result_options("the result (JSON)", keep="fit.json", figure="the errors before and after")
def calibrate_command(
    robot: str,
    data: tuple[Path, ...],
    replicates: int | None,
    in_rows: bool,
    without: bool,
    to: Output,
    **chosen: Any,
) -> int:
    """Calibrate ROBOT from the measurements in DATA.

    ROBOT is a file or a built-in name.  DATA has joint columns, and the points of a tracker
    (smr1_x_mm ...), or those of another instrument: wire1_mm ... (lengths from unknown fixed points
    to a target on the flange); socket (rows with the same label held the flange's ball in the same
    socket); surface with kind, plane or sphere (what a probe's ball touched; where known radius_mm,
    ball_radius_mm, and normal_x, normal_y, normal_z, offset_mm of a body's faces); flange_x_mm,
    flange_y_mm, flange_z_mm with flange_rx_rad ... or flange_qw ... (whole poses).

    Files of several instruments are one fit: all share the arm, each counts by its own noise.  What
    cameras saw is given with --pixels, --joints and --camera, alone or beside DATA.
    """
    files, rest = among(data, chosen)
    to.notice(*unconfirmed(chosen["effects"]))
    if not rest and "effects" not in on_command_line():
        return by_cameras(robot, files, to, chosen)
    asked = {name: chosen[name] for name in chosen if name in OPTIONS}
    given = of_any(rest, in_rows, to) if rest else []
    if files.given or not isinstance(given, Measurements):
        refuse(("replicates", "in_rows", "without"), "is for points of a tracker")
        refuse({"drawn_prior"}, "is for pixels alone, without effects")
        if asked["objective"] != "sum":
            what = "is for points of a tracker, or pixels alone; minimax-cal relative has one, too"
            refuse(("objective",), what)
        every = given if isinstance(given, list) else [given]
        return together(calibrate, robot, every, files, to, asked)
    with work(brief=replicates is None and given.poses <= BRIEF), to.stages() as progress:
        fit = calibrate(robot, given, progress=progress, **asked)
        more: dict[str, Bootstrap] = {}
        if replicates is not None:
            from minimax_cal.judging.bootstrap import bootstrap

            more["bootstrap"] = bootstrap(fit, replicates, asked["seed"], progress)
    return to.finish(
        fit,
        status=fit.status,
        reason=fit.reason,
        json=lambda: json_text(fit.to_dict(poses=not without) | plain(more)),
        sentences=(*fit.sentences(), *[fit.solution()] * to.details),
        more=[found.table() for found in more.values()],
        advice=advice(fit, robot, data, to.output),
        draw=save_errors,
    )


def by_cameras(robot: str, files: PixelFiles, to: Output, chosen: dict[str, Any]) -> int:
    """Calibrate from pixels.  Raises OptionError for what they do not know."""
    from minimax_cal.fitting.pixels.calibrate import calibrate_pixels

    refuse({*chosen, "replicates", "in_rows", "without"} - {*FIELDS}, "is not for pixels")
    own = {name: chosen[name] for name in on_command_line() & {*FIELDS}}
    fit = to.work(calibrate_pixels, robot, *files.paths(), **own)
    return to.finish(fit, status=fit.status, reason=fit.reason)


def unconfirmed(effects: Sequence[str]) -> Iterator[str]:
    """What is said of diagnoses among `--effects` that confirm nothing."""
    for name in effects:
        if name.endswith(".json") and not listed_effects(name):
            yield f"{name}: the diagnosis confirms no effect; nothing of it is fitted"


def advice(
    fit: Fit, robot: str, data: tuple[Path, ...], written: Path | None
) -> Iterator[tuple[str, str]]:
    """What to do next, and its command.  written: where the result went."""
    from minimax_cal.robots.urdf import ends_of, has_links, is_urdf  # not before it has calibrated

    has_effects = fit.cell.effects.terms or "effects" in on_command_line()
    if not has_effects and not fit.status.keeps_drawn:
        left = f"{fit.within.after.rms_mm:.3f} mm"
        diagnose = f"minimax-cal diagnose {robot} {' '.join(map(str, data))}"
        yield f"Next, to find the cause of the remaining {left}", diagnose
    if written and fit.status is Status.CONVERGED:
        part = " (it tells what it holds of the effects, and how well that does)"
        alone = part if fit.cell.effects.terms else " by geometry alone"
        correct = f"minimax-cal compensate {written} targets.csv -o corrected.csv"
        yield f"To correct joint targets, or a program, for the controller{alone}", correct
        write, file = "To write a file for MuJoCo, or --to urdf, dh-csv and others", "--to mjcf"
        out = "arm.xml"
        if has_links(robot):
            name, tip = ends_of(robot)
            kind = "urdf" if is_urdf(robot) else "mjcf"
            write, out = f"To correct a copy of {name}", f"calibrated{Path(name).suffix}"
            file = f"--to {kind} --{kind} {name}" + f" --tip {tip}" * bool(tip)
        yield f"{write}{alone}", f"minimax-cal export {written} {file} -o {out}"
        yield "To see every parameter and table", "add --details"
    else:
        yield "To keep the result, and to see every table", "add -o fit.json --details"
