"""The command `minimax-cal gap`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.motion_options import motion_options, paired, read
from minimax_cal.cli.options import (
    DETAILS,
    PATH,
    InGroups,
    Output,
    options_from,
    options_of,
    plain_option,
    result_options,
)
from minimax_cal.dynamics.logs import are_logs
from minimax_cal.fitting.options import Options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import Option
from minimax_cal.reporting.plots.motion import save_motion_gap
from minimax_cal.reporting.plots.simulator import save_simulator_gap
from minimax_cal.simulators.ladder import simulator_gap
from minimax_cal.simulators.motion.ladder import motion_gap

ARM, LOGS = "The arm", "Logs of motion"
OF_LOGS = ("holdout_run", "payload", "drive_gain", "ratio", "gains", "friction")


@click.command(name="gap", cls=InGroups)
@click.argument("model", type=PATH)
@click.argument("data", type=PATH, nargs=-1, required=True)
@plain_option(
    ARM, "--fit", type=PATH, metavar="FIT", help="Correct by this calibration of the arm."
)
@plain_option(
    ARM, "--diagnosis", type=PATH, metavar="D", help="Correct by this diagnosis of the arm."
)
@click.option("--write", type=PATH, metavar="XML", help="Write the corrected model to this MJCF.")
@options_of(
    motion_gap,
    tip=Option("The last body of the arm, where there are several.", metavar="BODY", group=ARM),
    holdout_run=Option(
        "Judge on this run alone, which no fit sees.", metavar="NAME", many=tuple, group=LOGS
    ),
    friction=Option(
        "What holds friction of joints at rest beside `frictionloss`: dcmotor.",
        metavar="ELEMENT",
        group=LOGS,
    ),
)
@motion_options(LOGS)
@plain_option(
    LOGS,
    "--gains",
    metavar="KP:KD,...",
    callback=read(paired),
    help="Gains of the drives that move the model, of all joints or of each.",
)
@options_from(Options, "holdout", "seed")
@DETAILS
@result_options("the gap (JSON)", figure="the ladder")
def gap_command(
    model: Path, data: tuple[Path, ...], details: bool, to: Output, **chosen: Any
) -> int:
    """How far the simulated arm of MODEL (MJCF or URDF) misses the real one in DATA, and why.

    DATA of poses: the model is driven with the measured commands in MuJoCo, as given and then
    corrected step by step; only base and targets are fitted.  Without --fit or --diagnosis a
    diagnosis is made.  DATA of logs, each a trajectory: the model is moved along runs that no fit
    saw, and friction, masses, rotor inertias and what else makes a difference is corrected.
    """
    if are_logs(data):
        return gap_of_logs(model, data, to, chosen, details=details)
    if len(data) > 1:
        raise OptionError(f"{data[1]}: poses come in one file; logs need t_s, q1_rad, ..., tau1_Nm")
    for name in OF_LOGS:
        if chosen.pop(name):
            raise OptionError(f"{name}: is for logs of motion, {data[0]} holds poses; leave it")
    with to.stages() as progress:
        found = simulator_gap(model, data[0], progress=progress, **chosen)
    to.wrote(chosen["write"])
    to.notice(*found.notices)
    if to.deliver(found.json):
        first = found.table().brief("model", "RMS mm", "max mm", "fit says mm")
        advice = options.keep(to.path, "gap.json")
        options.present(details, [found.headline()], [first], found.tables, advice)
    to.draw(save_simulator_gap, found)
    return options.exit_code(found.status) or int(not found.holds)


def gap_of_logs(
    model: Path, data: tuple[Path, ...], to: Output, chosen: dict[str, Any], *, details: bool
) -> int:
    """The same along trajectories."""
    del chosen["seed"]
    with to.stages() as progress:
        found = motion_gap(model, list(data), progress=progress, **chosen)
    to.wrote(chosen["write"], Path(found.module) if found.module else None)
    to.notice(*found.notices, *found.sentences())
    if to.deliver(found.json):
        advice = options.keep(to.path, "gap.json")
        options.present(details, [found.headline()], [found.table().brief()], found.tables, advice)
    to.draw(save_motion_gap, found)
    return 0
