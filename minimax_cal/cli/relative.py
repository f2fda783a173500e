"""The command `minimax-cal relative`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from minimax_cal.cli.options import (
    ROBOT,
    SOME_CAMPAIGNS,
    Output,
    among,
    command,
    options_from,
    plain_option,
    result_options,
    together,
)
from minimax_cal.diagnosing.diagnose import DiagnosisOptions
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import PixelFiles
from minimax_cal.fitting.several.kinds import relative
from minimax_cal.fitting.several.options import RelativeOptions
from minimax_cal.ground.errors import OptionError


@command
@ROBOT
@SOME_CAMPAIGNS
@options_from(Options, "holdout", "seed", "fix", "free", "priors", "effects", "allow_large_changes")
@options_from(RelativeOptions)
@options_from(PixelFiles)
@options_from(Options, "qp", "method", "loss")
@plain_option(
    "What is sought",
    "--diagnose",
    is_flag=True,
    help="Look for effects of the arm that explain what geometry leaves.",
)
@options_from(
    DiagnosisOptions,
    "exclude",
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
    """Calibrate ROBOT by DATA, as `calibrate` takes it, of any instruments but a tracker alone.

    With --diagnose the file holds the diagnosis as well, and the arm with the effects found.
    """
    if exclude and not diagnose:
        raise OptionError("--without is of --diagnose; give both, or neither")
    verb: Callable[..., Any] = relative
    if diagnose:
        from minimax_cal.diagnosing.instruments import diagnose_relative

        if chosen["objective"] != "sum":
            raise OptionError("a diagnosis is by objective=sum: leave --objective out")
        verb = partial(diagnose_relative, exclude=exclude)
    files, rest = among(data, chosen)
    return together(verb, robot, rest, files, to, chosen)
