"""The command `minimax-cal relative`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    CAMPAIGNS,
    DETAILS,
    ROBOT,
    InGroups,
    Output,
    options_from,
    result_options,
)
from minimax_cal.cli.pixel_files import PIXEL_FILES, PixelFiles
from minimax_cal.fitting.instruments import RelativeOptions, relative
from minimax_cal.fitting.instruments.kinds import Given
from minimax_cal.fitting.options import Options


@click.command(name="relative", cls=InGroups)
@ROBOT
@CAMPAIGNS
@options_from(Options, "holdout", "seed", "fix", "free", "priors", "effects")
@options_from(RelativeOptions)
@PIXEL_FILES
@options_from(Options, "method")
@DETAILS
@result_options("the result (JSON)")
def relative_command(
    robot: str,
    data: tuple[Path, ...],
    details: bool,
    to: Output,
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
    """
    files, every = PixelFiles(pixels, joints, tuple(camera), board), list[Given](data)
    if files.given:
        from minimax_cal.fitting.instruments.cameras import detected

        every.append(detected(*files.paths()))
    with to.stages() as progress:
        fit = relative(robot, every, progress, **chosen)
    to.notice(*fit.notices)
    if to.deliver(fit.json, fit.status):
        advice = options.keep(to.path, "relative.json")
        options.present(details, [fit.headline()], fit.first_tables(), fit.tables, advice)
    return options.exit_code(fit.status)
