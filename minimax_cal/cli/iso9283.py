"""The command `iso9283`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from minimax_cal.cli.options import (
    FIT_ARGUMENT,
    OPTIONAL_DATA_ARGUMENT,
    STEP_OPTION,
    CommandOutput,
    build_result_options,
    define_command,
    group_option,
    options_from_parameters,
)
from minimax_cal.core.option_fields import Option, parse_finite_numbers
from minimax_cal.validation.iso9283_of_result import iso9283

ISO9283_OPTION_GROUP = "What is judged"


def parse_tool_centre_point(text: str) -> str | Sequence[float]:
    """The TCP: a name as it is, or X,Y,Z in mm [m].  Raises OptionError."""
    if "," not in text:
        return text
    return [
        1e-3 * part
        for part in parse_finite_numbers(text, "tcp", "centroid, a target, or X,Y,Z in mm")
    ]


@define_command
@FIT_ARGUMENT
@OPTIONAL_DATA_ARGUMENT
@options_from_parameters(
    iso9283,
    ISO9283_OPTION_GROUP,
    nominal=Option("The robot before calibration, file or name [default: of the fit]."),
    tcp=Option(
        "The tool centre point: centroid of the targets, one target (smr1), or X,Y,Z in mm in the "
        "last frame.",
        metavar="POINT",
        read=parse_tool_centre_point,
    ),
)
@group_option(
    ISO9283_OPTION_GROUP, "--poses", is_flag=True, help="Print a row for every pose, too."
)
@STEP_OPTION
@build_result_options("the values (JSON)")
def iso9283_command(
    fit: Path, data: Path | None, poses: bool, to: CommandOutput, **chosen: Any
) -> int:
    """Pose and distance accuracy of FIT by the formulas of ISO 9283, before and after.

    FIT is what `calibrate`, `diagnose` or `relative` wrote with -o, DATA the measurements [default:
    those of the fit].  Held-out poses stand apart from training poses.  Poses that were visited
    again give repeatability.
    """
    found = iso9283(fit, data, **chosen)
    return to.write_and_print_result(found, tables=lambda: found.tables(poses=poses))
