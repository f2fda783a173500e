"""The command `minimax-cal relative`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from minimax_cal.cli.options import (
    CAMPAIGNS,
    ROBOT,
    Output,
    command,
    options_from,
    plain_option,
    record_of,
    refuse,
    result_options,
)
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import PixelFiles, PixelOptions
from minimax_cal.fitting.several import RelativeOptions, relative
from minimax_cal.fitting.several.kinds import Given
from minimax_cal.ground.errors import OptionError

SOUGHT = "What is sought"
CAMERAS = ("camera_on", "fix_camera", "camera_prior")


@command
@ROBOT
@CAMPAIGNS
@options_from(Options, "holdout", "seed", "fix", "free", "priors", "effects")
@options_from(RelativeOptions)
@options_from(PixelFiles)
@options_from(PixelOptions, *CAMERAS)
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
@result_options("the result (JSON)", keep="relative.json")
def relative_command(
    robot: str,
    data: tuple[Path, ...],
    diagnose: bool,
    exclude: tuple[str, ...],
    to: Output,
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
    files, every = record_of(PixelFiles, chosen), list[Given](data)
    if files.given:
        from minimax_cal.fitting.several.cameras import detected

        every.append(detected(*files.paths()))
    else:
        refuse(CAMERAS, "is about what cameras see, with pixels=, joints= and camera=")
    if exclude and not diagnose:
        raise OptionError("--without is of --diagnose; give both, or neither")
    verb: Callable[..., Any] = relative
    if diagnose:
        from minimax_cal.diagnosing.instruments import diagnose_relative

        verb = partial(diagnose_relative, exclude=exclude)
    found = to.work(verb, robot, every, **chosen)
    return to.finish(found, status=found.status)
