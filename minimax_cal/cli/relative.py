"""The command `minimax-cal relative`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    CAMPAIGNS,
    DETAILS,
    ROBOT,
    InGroups,
    Output,
    options_from,
    plain_option,
    result_options,
)
from minimax_cal.cli.pixel_files import PIXEL_FILES, PixelFiles
from minimax_cal.fitting.instruments import RelativeOptions, relative
from minimax_cal.fitting.instruments.kinds import Given
from minimax_cal.fitting.instruments.result import RelativeCalibration
from minimax_cal.fitting.options import Options
from minimax_cal.ground.errors import OptionError

if TYPE_CHECKING:
    from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis

SOUGHT = "What is sought"


@click.command(name="relative", cls=InGroups)
@ROBOT
@CAMPAIGNS
@options_from(Options, "holdout", "seed", "fix", "free", "priors", "effects")
@options_from(RelativeOptions)
@PIXEL_FILES
@options_from(Options, "method")
@plain_option(
    SOUGHT,
    "--diagnose",
    is_flag=True,
    help="Look for effects of the arm that explain what geometry leaves.",
)
@plain_option(
    SOUGHT,
    "--without",
    "exclude",
    multiple=True,
    metavar="EFFECT",
    help="With --diagnose: do not consider this effect; `minimax-cal effects` lists them.",
)
@DETAILS
@result_options("the result (JSON)")
def relative_command(
    robot: str,
    data: tuple[Path, ...],
    details: bool,
    to: Output,
    diagnose: bool,
    exclude: tuple[str, ...],
    pixels: Path | None,
    joints: Path | None,
    camera: Sequence[str],
    board: Path | None,
    **chosen: Any,
) -> int:
    """Calibrate ROBOT without coordinates, by lengths, closures, contacts or poses in DATA.

    DATA has joint columns and one of: wire1_mm ... (lengths from unknown fixed points to a target
    on the flange); socket (rows with the same label held the flange's ball in the same socket);
    surface with kind, plane or sphere (what a probe's ball touched; where known radius_mm,
    ball_radius_mm, and normal_x, normal_y, normal_z, offset_mm of a body's faces);
    flange_x_mm, flange_y_mm, flange_z_mm with flange_rx_rad ... or flange_qw ... (whole poses).

    Several files, of any kinds, are one fit: all share the arm, each counts by its own noise.  A
    tracker's measurements (smr1_x_mm ...) may be among them, and what cameras saw (--pixels).

    With --diagnose the file holds the diagnosis as well, and the arm with the effects found.
    """
    files, every = PixelFiles(pixels, joints, tuple(camera), board), list[Given](data)
    if files.given:
        from minimax_cal.fitting.instruments.cameras import detected

        every.append(detected(*files.paths()))
    if exclude and not diagnose:
        raise OptionError("--without is of --diagnose; give both, or neither")
    with to.stages() as progress:
        found: RelativeCalibration | RelativeDiagnosis
        if diagnose:
            from minimax_cal.diagnosing.instruments import diagnose_relative

            found = diagnose_relative(robot, every, exclude=exclude, progress=progress, **chosen)
        else:
            found = relative(robot, every, progress, **chosen)
    to.notice(*found.notices)
    if to.deliver(found.json, found.status):
        advice = options.keep(to.path, "relative.json")
        options.present(details, [found.headline()], found.first_tables(), found.tables, advice)
    return options.exit_code(found.status)
