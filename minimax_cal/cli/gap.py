"""The command `minimax-cal gap`."""

from __future__ import annotations

import math
from inspect import signature
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    CAMPAIGNS,
    PATH,
    RESULT,
    Output,
    command,
    exit_code,
    options_from,
    options_of,
    refuse,
    result_options,
)
from minimax_cal.dynamics.given import ARM, MotionKnown
from minimax_cal.dynamics.logs import are_logs
from minimax_cal.fitting.options import Options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import Option, number
from minimax_cal.reporting.plots.motion import save_motion_gap
from minimax_cal.reporting.plots.simulator import save_simulator_gap
from minimax_cal.simulators.ladder import simulator_gap
from minimax_cal.simulators.motion.ladder import motion_gap

LOGS = "Logs of motion"
OF_LOGS = {*signature(motion_gap).parameters} - {*signature(simulator_gap).parameters}


def paired(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """KP:KD of each joint, separated by commas, or one for all.  Raises OptionError."""
    pairs = [part.partition(":") for part in text.split(",")]
    both = tuple(tuple(number(pair[k]) for pair in pairs) for k in (0, 2))
    if not all(value >= 0.0 and math.isfinite(value) for side in both for value in side):
        raise OptionError(
            f"gains={text!r}: give KP:KD of each joint in N m/rad and N m s/rad, as 2000:200"
        )
    return both[0], both[1]


@command
@click.argument("model", type=PATH)
@CAMPAIGNS
@options_of(
    motion_gap,
    ARM,
    fit=Option("Correct by this calibration of the arm.", metavar="FIT", read=Path),
    diagnosis=Option("Correct by this diagnosis of the arm.", metavar="D", read=Path),
    write=Option("Write the corrected model to this MJCF.", metavar="XML", read=Path, group=RESULT),
    tip=Option("The last body of the arm, where there are several.", metavar="BODY"),
    holdout_run=Option(
        "Judge on this run alone, which no fit sees.", metavar="NAME", many=tuple, group=LOGS
    ),
    plain=Option("Write only what other simulators read as well.", group=LOGS),
    actuators=Option(
        "Write the actuators of the corrected model for Isaac Lab, or as JSON, too.",
        metavar="isaac|json FILE",
        values=2,
        read=tuple,
        group=LOGS,
    ),
    randomize=Option(
        "Write mean, covariance and spread between runs of what was fitted (JSON).",
        metavar="FILE",
        read=Path,
        group=LOGS,
    ),
)
@options_from(MotionKnown, "payload", "drive_gain", "ratio", group=LOGS)
@options_of(
    motion_gap,
    LOGS,
    gains=Option(
        "Gains of the drives that move the model, of all joints or of each.",
        metavar="KP:KD,...",
        read=paired,
    ),
)
@options_from(Options, "holdout", "seed")
@result_options("the gap (JSON)", keep="gap.json", figure="the ladder")
def gap_command(model: Path, data: tuple[Path, ...], to: Output, **chosen: Any) -> int:
    """How far a simulated MODEL misses the real arm in DATA, and why.

    MODEL is an MJCF or URDF. DATA of poses: the model is driven with the measured commands in
    MuJoCo, as given and then corrected step by step; only base and targets are fitted.  Without
    --fit or --diagnosis a diagnosis is made.  DATA of logs, each a trajectory: the model is moved
    along runs that no fit saw, and friction, masses, rotor inertias and what else makes a
    difference is corrected.
    """
    if are_logs(data):
        del chosen["seed"]
        moved = to.work(motion_gap, model, data, **chosen)
        beside = ((chosen["actuators"] or ("", None))[1], chosen["randomize"])
        to.wrote(moved.written, *(path for path in beside if moved.kept))
        said = (*moved.notices, *moved.sentences())
        return to.finish(moved, notices=said, draw=save_motion_gap)
    if len(data) > 1:
        raise OptionError(f"{data[1]}: poses come in one file; logs need t_s, q1_rad, ..., tau1_Nm")
    refuse(OF_LOGS, f"is for logs of motion, {data[0]} holds poses")
    known = {name: chosen[name] for name in chosen.keys() - OF_LOGS}
    found = to.work(simulator_gap, model, data[0], **known)
    to.wrote(chosen["write"])
    to.finish(found, draw=save_simulator_gap)
    return exit_code(found.status) or int(not found.holds)
