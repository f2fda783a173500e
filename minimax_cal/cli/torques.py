"""The command `minimax-cal torques`."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.options import PATH, InGroups, Output, options_of, plain_option, result_options
from minimax_cal.dynamics.diagnose import diagnose_motion
from minimax_cal.dynamics.given import Payload
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import Option, number
from minimax_cal.reporting.plots.motion import save_motion
from minimax_cal.robots.robot import Robot

ARM = "The arm"
JUDGED = "What judges"
MODELS = (".xml", ".mjcf")  # of MuJoCo


def listed(text: str, name: str) -> tuple[float, ...]:
    """Numbers separated by commas.  Raises OptionError."""
    found = tuple(number(part) for part in text.split(","))
    if not all(map(math.isfinite, found)):
        raise OptionError(f"{name}={text!r}: give numbers separated by commas")
    return found


def carried(text: str) -> Payload:
    """KG@x,y,z in kg and m.  Raises OptionError."""
    mass, mark, at = text.partition("@")
    parts = [number(part) for part in at.split(",")] if mark else [0.0, 0.0, 0.0]
    if not number(mass) > 0.0 or len(parts) != 3 or not all(map(math.isfinite, parts)):
        raise OptionError(f"payload={text!r}: give KG@x,y,z in kg and m, as 2@0,0,0.05")
    return number(mass), (parts[0], parts[1], parts[2])


def model_of(name: str, logs: tuple[Path, ...]) -> Robot | str:
    """The arm of a model: a robot file or URDF as it is, an MJCF through MuJoCo."""
    if Path(name).suffix.lower() not in MODELS:
        return name
    from minimax_cal.dynamics.logs import read_runs
    from minimax_cal.simulators.chain import chain_of
    from minimax_cal.simulators.given import read_model

    joints = read_runs(logs[:1])[0].joints
    return chain_of(read_model(name).compiled(), joints, name).robot


def read(reader: Callable[[str], Any]) -> Callable[..., Any]:
    """What click calls with an option that may not be given."""
    return lambda context, option, text: None if text is None else reader(text)


@click.command(name="torques", cls=InGroups)
@click.argument("model")
@click.argument("logs", type=PATH, nargs=-1, required=True)
@plain_option(
    ARM,
    "--payload",
    metavar="KG@X,Y,Z",
    callback=read(carried),
    help="What the flange is known to carry: kg, and its centre in the last frame in m.",
)
@plain_option(
    ARM,
    "--drive-gain",
    metavar="LIST",
    callback=read(partial(listed, name="drive_gain")),
    help="Torque for one ampere of each joint, N m per A.",
)
@plain_option(
    ARM,
    "--ratio",
    metavar="LIST",
    callback=read(partial(listed, name="ratio")),
    help="Gear ratio of all joints, or of each.",
)
@options_of(
    diagnose_motion,
    holdout=Option("Share of the runs that is left out in turn to judge.", group=JUDGED),
    holdout_run=Option(
        "Judge on this run alone, which no fit and no search sees.",
        metavar="NAME",
        many=tuple,
        group=JUDGED,
    ),
    exclude=Option(
        "Do not consider this effect.",
        metavar="EFFECT",
        flag="--without",
        many=tuple,
        group="What is sought",
    ),
)
@result_options("the diagnosis (JSON)", figure="torques, friction curves and the budget")
def torques_command(model: str, logs: tuple[Path, ...], to: Output, **chosen: Any) -> int:
    """Say why joint torques (or currents) in LOGs differ from those of MODEL, and by how much.

    MODEL is a URDF, an MJCF or a robot file with masses.  One LOG is one trajectory: time, joint
    values and torques or currents, as CSV of this project, RTDE, ROS or LeRobot.
    """
    with to.stages() as progress:
        found = diagnose_motion(model_of(model, logs), list(logs), progress=progress, **chosen)
    to.notice(*found.notices)
    if to.deliver(found.json):
        shown = [found.summary(), found.effects_table()]
        shown += [found.unexplained_table()] if found.unexplained else []
        options.show(*shown, headline=found.headline())
    to.draw(save_motion, found)
    return 0
