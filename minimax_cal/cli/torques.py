"""The command `minimax-cal torques`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH_TYPE,
    CommandOutput,
    SuggestedCommand,
    build_result_options,
    define_command,
    options_from_dataclass,
    options_from_parameters,
    take_option_record,
)
from minimax_cal.core.files import check_output_path, format_json
from minimax_cal.core.option_fields import Option
from minimax_cal.dynamics.diagnose import diagnose_motion
from minimax_cal.dynamics.known_inputs import MotionKnown, read_checked_runs, read_runs_of_robot
from minimax_cal.dynamics.logs import Run
from minimax_cal.reporting.plots.motion_figure import write_motion_figure
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.urdf_robot import MJCF_SUFFIXES


def load_torque_robot(model_path: str, runs: Sequence[Run]) -> Robot | str:
    """The arm of a model: a robot file or URDF as it is, an MJCF through MuJoCo."""
    if Path(model_path).suffix.lower() not in MJCF_SUFFIXES:
        return model_path
    from minimax_cal.robots.mjcf_import import read_mujoco_model
    from minimax_cal.simulators.chain import find_model_arm

    return find_model_arm(
        read_mujoco_model(model_path).compile_model(), runs[0].joints, model_path
    ).robot


@define_command
@click.argument("model")
@click.argument("logs", type=PATH_TYPE, nargs=-1, required=True)
@options_from_dataclass(MotionKnown)
@options_from_parameters(
    diagnose_motion,
    "What is sought",
    exclude=Option(
        "Do not consider this effect.",
        metavar="EFFECT",
        flag="--without",
        many=tuple,
    ),
)
@click.option(
    "--write",
    type=PATH_TYPE,
    metavar="XML",
    help="Write the arm with these masses, friction and rotor inertias to this MJCF.",
)
@build_result_options(
    "the diagnosis (JSON)",
    suggested_file_name="torques.json",
    drawn_content="torques, friction curves and the budget",
)
def torques_command(
    model: str, logs: tuple[Path, ...], write: Path | None, to: CommandOutput, **chosen: Any
) -> int:
    """Say why joint torques (or currents) in LOGs differ from those of MODEL, and by how much.

    MODEL is a URDF, an MJCF or a robot file with masses.  One LOG is one trajectory: time, joint
    values and torques or currents, as CSV of this project, RTDE, ROS or LeRobot.
    """
    if write is not None:
        check_output_path(write, MJCF_SUFFIXES)
    known, runs = take_option_record(MotionKnown, dict(chosen)), read_runs_of_robot(model, logs)
    arm = load_torque_robot(model, runs)
    if write is not None:  # before what takes long
        drawn = load_robot(arm)
        known.require_drive_gains(drawn, read_checked_runs(arm, drawn, runs))
    with to.open_stage_callback() as progress:
        found, made = diagnose_motion(arm, runs, progress=progress, **chosen), None
        if write:
            from minimax_cal.simulators.motion.gap import motion_gap

            made = motion_gap(model, runs, diagnosis=found, write=write, driven=False,
                              progress=progress, **vars(known))  # fmt: skip
    to.print_notices(*found.notices)
    if made:
        to.report_written_files(write)
    return to.write_and_print_result(
        found,
        notices=[f"{made.written}: {text}" for text in made.sentences()] if made else (),
        json=lambda: format_json(found.to_dict() | (made.summarise_file() if made else {})),
        sentences=found.sentences(),
        advice=suggest_next_commands(model, logs, write, to),
        draw=write_motion_figure,
    )


def suggest_next_commands(
    model: str, logs: tuple[Path, ...], written_model: Path | None, output: CommandOutput
) -> Iterator[SuggestedCommand]:
    """What to do next, and its command.  written_model: the MJCF."""
    if Path(model).suffix.lower() in MJCF_SUFFIXES and not written_model:
        files = " ".join(map(str, logs))
        fix = f"minimax-cal torques {model} {files} --write corrected.xml"
        yield SuggestedCommand("Next, to write a model with these masses and friction", fix)
    yield from output.suggest_keeping_result()
