"""The command `minimax-cal check`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from minimax_cal.cli.options import (
    DATA_ARGUMENT,
    FIT_ARGUMENT,
    CommandOutput,
    build_result_options,
    define_command,
    options_from_parameters,
)
from minimax_cal.cli.stderr_events import report_error
from minimax_cal.core.files import format_json
from minimax_cal.core.option_fields import Option
from minimax_cal.validation.monitoring.calibration_check import check


@define_command
@FIT_ARGUMENT
@DATA_ARGUMENT
@options_from_parameters(
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
@build_result_options(
    "the calibration with what moved refitted (JSON)", suggested_file_name="checked.json"
)
def check_command(fit: Path, data: Path, to: CommandOutput, **chosen: Any) -> int:
    """Check with a few poses in DATA whether FIT is still valid.

    FIT is a calibration; what moved since then is said, too.  Instrument and reflectors may have
    moved.  The exit code is 0 if it is valid, else 1.
    """
    found = check(fit, data, **chosen)
    to.write_and_print_result(found, file=lambda: format_json(found.fit_dict()))
    return 0 if found.valid else report_error(found.headline())
