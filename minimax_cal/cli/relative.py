"""The command `minimax-cal relative`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from minimax_cal.cli.options import (
    OPTIONAL_DATA_ARGUMENTS,
    ROBOT_ARGUMENT,
    CommandOutput,
    build_result_options,
    define_command,
    group_option,
    options_from_dataclass,
    run_on_any_instruments,
    split_camera_files,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.diagnosing.diagnose import DiagnosisOptions
from minimax_cal.fitting.multi_instrument.options import RelativeOptions
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import PixelFiles


@define_command
@ROBOT_ARGUMENT
@OPTIONAL_DATA_ARGUMENTS
@options_from_dataclass(
    Options, "holdout", "seed", "fix", "free", "priors", "effects", "allow_large_changes"
)
@options_from_dataclass(RelativeOptions)
@options_from_dataclass(PixelFiles)
@options_from_dataclass(Options, "qp", "method", "loss")
@group_option(
    "What is sought",
    "--diagnose",
    is_flag=True,
    help="Look for effects of the arm that explain what geometry leaves.",
)
@options_from_dataclass(
    DiagnosisOptions,
    "exclude",
    help="With --diagnose: do not consider this effect; `minimax-cal effects` lists them.",
)
@build_result_options("the result (JSON)", suggested_file_name="relative.json")
def relative_command(
    robot: str,
    data: tuple[Path, ...],
    diagnose: bool,
    exclude: tuple[str, ...],
    to: CommandOutput,
    **chosen: Any,
) -> int:
    """Calibrate ROBOT by DATA, as `calibrate` takes it, of any instruments but a tracker alone.

    With --diagnose the file holds the diagnosis as well, and the arm with the effects found.
    """
    if exclude and not diagnose:
        raise OptionError("--without is of --diagnose; give both, or neither")
    verb: Callable[..., Any] = relative
    if diagnose:
        from minimax_cal.diagnosing.diagnose_instruments import diagnose_relative

        if chosen["objective"] != "sum":
            raise OptionError("a diagnosis is by objective=sum: leave --objective out")
        verb = partial(diagnose_relative, exclude=exclude)
    files, rest = split_camera_files(data, chosen)
    return run_on_any_instruments(verb, robot, rest, files, to, chosen)
