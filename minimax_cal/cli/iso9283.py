"""The command `iso9283`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from minimax_cal.cli.options import (
    FIT,
    RUNG,
    SOME_DATA,
    Output,
    command,
    options_of,
    plain_option,
    result_options,
)
from minimax_cal.ground.options import Option, numbers
from minimax_cal.judging.standard import iso9283

WHAT = "What is judged"


def point_of(text: str) -> str | Sequence[float]:
    """The TCP: a name as it is, or X,Y,Z in mm [m].  Raises OptionError."""
    if "," not in text:
        return text
    return [1e-3 * part for part in numbers(text, "tcp", "centroid, a target, or X,Y,Z in mm")]


@command
@FIT
@SOME_DATA
@options_of(
    iso9283,
    WHAT,
    nominal=Option("The robot before calibration, file or name [default: of the fit]."),
    tcp=Option(
        "The tool centre point: centroid of the targets, one target (smr1), or X,Y,Z in mm in the "
        "last frame.",
        metavar="POINT",
        read=point_of,
    ),
)
@plain_option(WHAT, "--poses", is_flag=True, help="Print a row for every pose, too.")
@RUNG
@result_options("the values (JSON)")
def iso9283_command(fit: Path, data: Path | None, poses: bool, to: Output, **chosen: Any) -> int:
    """Pose and distance accuracy of FIT by the formulas of ISO 9283, before and after.

    FIT is what `calibrate`, `diagnose` or `relative` wrote with -o, DATA the measurements [default:
    those of the fit].  Held-out poses stand apart from training poses.  Poses that were visited
    again give repeatability.
    """
    found = iso9283(fit, data, **chosen)
    return to.finish(found, tables=lambda: found.tables(poses=poses))
