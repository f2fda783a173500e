"""The command `minimax-cal check`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli import FAILED
from minimax_cal.cli.options import (
    DATA,
    DETAILS,
    FIT,
    InGroups,
    Output,
    keep,
    options_of,
    plain_option,
    present,
    result_options,
)
from minimax_cal.cli.stderr import tell
from minimax_cal.ground.options import Option
from minimax_cal.judging.watching.health import check

ASKED = "What is asked"


@click.command(name="check", cls=InGroups)
@FIT
@DATA
@plain_option(
    ASKED, "--tolerance", required=True, help='What is required in mm, as "rms 0.2, max 0.5".'
)
@options_of(
    check,
    known=Option(
        "What is where it was at the calibration: frame (the instrument), targets (the "
        "reflectors).",
        metavar="NAMES",
        many=tuple,
        group=ASKED,
    ),
    seed=Option("The seed of samples behind the intervals.", group=ASKED),
    simulated=Option(
        "The points are of a simulation and may be exact; a file that begins with # simulated says "
        "so itself.",
        group=ASKED,
    ),
)
@DETAILS
@result_options("the calibration with what moved refitted (JSON)")
def check_command(
    fit: Path,
    data: Path,
    tolerance: str,
    known: tuple[str, ...],
    seed: int,
    simulated: bool,
    details: bool,
    to: Output,
) -> int:
    """Check with a few poses in DATA whether the calibration FIT is still valid, and what moved.

    Instrument and reflectors may have moved.  The exit code is 0 if it is valid, else 1.
    """
    found = check(fit, data, tolerance, known=known, seed=seed, simulated=simulated)
    to.notice(*found.notices)
    if to.path:
        found.save(to.path)
        to.wrote(to.path)
    if to.as_json:
        click.echo(found.json(), nl=False)
    else:
        present(details, [found.headline()], [found.first_table()], found.tables,
                keep(to.path, "checked.json"))  # fmt: skip
    if not found.valid:
        tell("error", found.headline(), exit_code=FAILED)
    return 0 if found.valid else FAILED
