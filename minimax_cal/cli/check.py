"""The command `minimax-cal check`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from minimax_cal.cli.options import (
    DATA,
    FIT,
    Output,
    command,
    options_of,
    result_options,
)
from minimax_cal.cli.stderr import complain
from minimax_cal.ground.files import json_text
from minimax_cal.ground.options import Option
from minimax_cal.judging.watching.health import check


@command
@FIT
@DATA
@options_of(
    check,
    "What is asked",
    tolerance=Option('What is required in mm, as "rms 0.2, max 0.5".'),
    known=Option(
        "What is where it was at the calibration: frame (the instrument), targets (the "
        "reflectors).",
        metavar="NAMES",
        many=tuple,
    ),
    seed=Option("The seed of samples behind the intervals."),
    simulated=Option(
        "The points are of a simulation and may be exact; a file with a column simulated says "
        "so itself.",
    ),
)
@result_options("the calibration with what moved refitted (JSON)", keep="checked.json")
def check_command(fit: Path, data: Path, to: Output, **chosen: Any) -> int:
    """Check with a few poses in DATA whether FIT is still valid.

    FIT is a calibration; what moved since then is said, too.  Instrument and reflectors may have
    moved.  The exit code is 0 if it is valid, else 1.
    """
    found = check(fit, data, **chosen)
    to.finish(found, file=lambda: json_text(found.fit_dict()))
    return 0 if found.valid else complain(found.headline())
