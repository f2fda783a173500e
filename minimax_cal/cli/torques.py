"""The command `minimax-cal torques`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH,
    Output,
    command,
    options_from,
    options_of,
    record_of,
    result_options,
)
from minimax_cal.dynamics.diagnose import diagnose_motion
from minimax_cal.dynamics.given import MotionKnown, read_logs, runs_of
from minimax_cal.dynamics.logs import Run
from minimax_cal.ground.files import check_writable, json_text
from minimax_cal.ground.options import Option
from minimax_cal.reporting.plots.motion import save_motion
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.urdf import MODELS


def model_of(name: str, runs: Sequence[Run]) -> Robot | str:
    """The arm of a model: a robot file or URDF as it is, an MJCF through MuJoCo."""
    if Path(name).suffix.lower() not in MODELS:
        return name
    from minimax_cal.robots.mjcf import read_model
    from minimax_cal.simulators.chain import chain_of

    return chain_of(read_model(name).compiled(), runs[0].joints, name).robot


@command
@click.argument("model")
@click.argument("logs", type=PATH, nargs=-1, required=True)
@options_from(MotionKnown)
@options_of(
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
    type=PATH,
    metavar="XML",
    help="Write the arm with these masses, friction and rotor inertias to this MJCF.",
)
@result_options(
    "the diagnosis (JSON)", keep="torques.json", figure="torques, friction curves and the budget"
)
def torques_command(
    model: str, logs: tuple[Path, ...], write: Path | None, to: Output, **chosen: Any
) -> int:
    """Say why joint torques (or currents) in LOGs differ from those of MODEL, and by how much.

    MODEL is a URDF, an MJCF or a robot file with masses.  One LOG is one trajectory: time, joint
    values and torques or currents, as CSV of this project, RTDE, ROS or LeRobot.
    """
    if write is not None:
        check_writable(write, MODELS)
    known, runs = record_of(MotionKnown, dict(chosen)), read_logs(model, logs)
    arm = model_of(model, runs)
    if write is not None:  # before what takes long
        drawn = load_robot(arm)
        known.torque_gains(drawn, runs_of(arm, drawn, runs))
    with to.stages() as progress:
        found, made = diagnose_motion(arm, runs, progress=progress, **chosen), None
        if write:
            from minimax_cal.simulators.motion.ladder import motion_gap

            made = motion_gap(model, runs, diagnosis=found, write=write, driven=False,
                              progress=progress, **vars(known))  # fmt: skip
    to.notice(*found.notices)
    if made:
        to.wrote(write)
    return to.finish(
        found,
        notices=[f"{made.written}: {text}" for text in made.sentences()] if made else (),
        json=lambda: json_text(found.to_dict() | (made.short() if made else {})),
        sentences=found.sentences(),
        advice=advice(model, logs, write, to),
        draw=save_motion,
    )


def advice(
    model: str, logs: tuple[Path, ...], write: Path | None, to: Output
) -> Iterator[tuple[str, str]]:
    """What to do next, and its command.  write: the MJCF."""
    if Path(model).suffix.lower() in MODELS and not write:
        files = " ".join(map(str, logs))
        fix = f"minimax-cal torques {model} {files} --write corrected.xml"
        yield "Next, to write a model with these masses and friction", fix
    yield from to.kept()
