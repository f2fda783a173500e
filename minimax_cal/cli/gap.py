"""The command `minimax-cal gap`."""

from __future__ import annotations

import math
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import click

from minimax_cal.cli.options import (
    DATA_ARGUMENTS,
    PATH_TYPE,
    RESULT_OPTION_GROUP,
    CommandOutput,
    build_result_options,
    define_command,
    options_from_dataclass,
    options_from_parameters,
    refuse_given_options,
    report_status_as_exit_code,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import Option, parse_number_or_nan
from minimax_cal.dynamics.known_inputs import ARM_OPTION_GROUP, MotionKnown
from minimax_cal.dynamics.logs import are_logs
from minimax_cal.fitting.options import Options
from minimax_cal.reporting.plots.motion_figure import write_motion_gap_figure
from minimax_cal.reporting.plots.simulator_figure import write_simulator_gap_figure
from minimax_cal.simulators.gap import simulator_gap
from minimax_cal.simulators.motion.gap import motion_gap

LOG_OPTION_GROUP = "Logs of motion"
LOG_ONLY_OPTION_NAMES = {*signature(motion_gap).parameters} - {*signature(simulator_gap).parameters}


class GainPairs(NamedTuple):
    """Gains of the drives, one each of every joint or one for all [N m/rad, N m s/rad]."""

    position: tuple[float, ...]
    velocity: tuple[float, ...]


def parse_gain_pairs(text: str) -> GainPairs:
    """KP:KD of each joint, separated by commas, or one for all.  Raises OptionError."""
    pairs = [part.partition(":") for part in text.split(",")]
    both = tuple(tuple(parse_number_or_nan(pair[k]) for pair in pairs) for k in (0, 2))
    if not all(value >= 0.0 and math.isfinite(value) for side in both for value in side):
        raise OptionError(
            f"gains={text!r}: give KP:KD of each joint in N m/rad and N m s/rad, as 2000:200"
        )
    return GainPairs(*both)


@define_command
@click.argument("model", type=PATH_TYPE)
@DATA_ARGUMENTS
@options_from_parameters(
    motion_gap,
    ARM_OPTION_GROUP,
    fit=Option("Correct by this calibration of the arm.", metavar="FIT", read=Path),
    diagnosis=Option("Correct by this diagnosis of the arm.", metavar="D", read=Path),
    write=Option(
        "Write the corrected model to this MJCF.",
        metavar="XML",
        read=Path,
        group=RESULT_OPTION_GROUP,
    ),
    tip=Option("The last body of the arm, where there are several.", metavar="BODY"),
    holdout_run=Option(
        "Judge on this run alone, which no fit sees.",
        metavar="NAME",
        many=tuple,
        group=LOG_OPTION_GROUP,
    ),
    plain=Option("Write only what other simulators read as well.", group=LOG_OPTION_GROUP),
    actuators=Option(
        "Write the actuators of the corrected model for Isaac Lab, or as JSON, too.",
        metavar="isaac|json FILE",
        values=2,
        read=tuple,
        group=LOG_OPTION_GROUP,
    ),
    randomize=Option(
        "Write mean, covariance and spread between runs of what was fitted (JSON).",
        metavar="FILE",
        read=Path,
        group=LOG_OPTION_GROUP,
    ),
)
@options_from_dataclass(MotionKnown, "payload", "drive_gain", "ratio", group=LOG_OPTION_GROUP)
@options_from_parameters(
    motion_gap,
    LOG_OPTION_GROUP,
    gains=Option(
        "Gains of the drives that move the model, of all joints or of each.",
        metavar="KP:KD,...",
        read=parse_gain_pairs,
    ),
)
@options_from_dataclass(Options, "holdout", "seed")
@build_result_options("the gap (JSON)", suggested_file_name="gap.json", drawn_content="the ladder")
def gap_command(model: Path, data: tuple[Path, ...], to: CommandOutput, **chosen: Any) -> int:
    """How far a simulated MODEL misses the real arm in DATA, and why.

    MODEL is an MJCF or URDF. DATA of poses: the model is driven with the measured commands in
    MuJoCo, as given and then corrected step by step; only base and targets are fitted.  Without
    --fit or --diagnosis a diagnosis is made.  DATA of logs, each a trajectory: the model is moved
    along runs that no fit saw, and friction, masses, rotor inertias and what else makes a
    difference is corrected.
    """
    if are_logs(data):
        del chosen["seed"]
        moved = to.call_with_progress(motion_gap, model, data, **chosen)
        beside = ((chosen["actuators"] or ("", None))[1], chosen["randomize"])
        to.report_written_files(moved.written, *(path for path in beside if moved.has_corrections))
        said = (*moved.notices, *moved.sentences())
        return to.write_and_print_result(moved, notices=said, draw=write_motion_gap_figure)
    if len(data) > 1:
        raise OptionError(f"{data[1]}: poses come in one file; logs need t_s, q1_rad, ..., tau1_Nm")
    refuse_given_options(LOG_ONLY_OPTION_NAMES, f"is for logs of motion, {data[0]} holds poses")
    known = {name: chosen[name] for name in chosen.keys() - LOG_ONLY_OPTION_NAMES}
    found = to.call_with_progress(simulator_gap, model, data[0], **known)
    to.report_written_files(chosen["write"])
    to.write_and_print_result(found, draw=write_simulator_gap_figure)
    return report_status_as_exit_code(found.status) or int(not found.holds)
