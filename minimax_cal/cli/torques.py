"""The command `minimax-cal torques`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.motion_options import motion_options
from minimax_cal.cli.options import DETAILS, PATH, InGroups, Output, options_of, result_options
from minimax_cal.dynamics.diagnose import diagnose_motion
from minimax_cal.dynamics.given import read_logs, runs_of, torque_gains
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.dynamics.run import Run
from minimax_cal.ground.files import check_writable, json_text
from minimax_cal.ground.options import Option
from minimax_cal.ground.stages import Progress
from minimax_cal.reporting.plots.motion import save_motion
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.urdf import MODELS

if TYPE_CHECKING:
    from minimax_cal.simulators.motion.result import MotionGap

ARM = "The arm"
JUDGED = "What judges"


def model_of(name: str, runs: Sequence[Run]) -> Robot | str:
    """The arm of a model: a robot file or URDF as it is, an MJCF through MuJoCo."""
    if Path(name).suffix.lower() not in MODELS:
        return name
    from minimax_cal.simulators.chain import chain_of
    from minimax_cal.simulators.given import read_model

    return chain_of(read_model(name).compiled(), runs[0].joints, name).robot


def written(
    model: str,
    runs: Sequence[Run],
    path: Path,
    found: MotionDiagnosis,
    chosen: Mapping[str, Any],
    progress: Progress,
) -> MotionGap:
    """Write a model by a diagnosis of it.  Raises CalibrationError."""
    from minimax_cal.simulators.motion.ladder import motion_gap

    names = ("holdout", "holdout_run", "payload", "drive_gain", "ratio")
    known = {name: chosen[name] for name in names}
    return motion_gap(model, runs, diagnosis=found, write=path, driven=False,
                      progress=progress, **known)  # fmt: skip


@click.command(name="torques", cls=InGroups)
@click.argument("model")
@click.argument("logs", type=PATH, nargs=-1, required=True)
@motion_options(ARM)
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
@click.option(
    "--write",
    type=PATH,
    metavar="XML",
    help="Write the arm with these masses, friction and rotor inertias to this MJCF.",
)
@DETAILS
@result_options("the diagnosis (JSON)", figure="torques, friction curves and the budget")
def torques_command(
    model: str, logs: tuple[Path, ...], write: Path | None, details: bool, to: Output, **chosen: Any
) -> int:
    """Say why joint torques (or currents) in LOGs differ from those of MODEL, and by how much.

    MODEL is a URDF, an MJCF or a robot file with masses.  One LOG is one trajectory: time, joint
    values and torques or currents, as CSV of this project, RTDE, ROS or LeRobot.
    """
    if write is not None:
        check_writable(write, MODELS)
    runs = read_logs(model, logs)
    arm = model_of(model, runs)
    if write is not None:  # before what takes long
        drawn = arm if isinstance(arm, Robot) else load_robot(arm)
        torque_gains(drawn, runs_of(arm, drawn, runs), chosen["drive_gain"])
    with to.stages() as progress:
        found = diagnose_motion(arm, runs, progress=progress, **chosen)
        made = written(model, runs, write, found, chosen, progress) if write else None
    to.notice(*found.notices)
    if made is not None:
        to.wrote(write, Path(made.module) if made.module else None)
        to.notice(*(f"{made.written}: {text}" for text in made.sentences()))
    if to.deliver(lambda: json_text(found.to_dict() | (made.short() if made else {}))):
        options.present(
            details, found.sentences(), [found.budget_table().brief()], found.tables,
            advice(model, logs, write, to.path),
        )  # fmt: skip
    to.draw(save_motion, found)
    return 0


def advice(
    model: str, logs: tuple[Path, ...], write: Path | None, written_to: Path | None
) -> Iterator[tuple[str, str]]:
    """What to do next, and its command.  write: the MJCF; written_to: where the diagnosis went."""
    if Path(model).suffix.lower() in MODELS and not write:
        files = " ".join(map(str, logs))
        fix = f"minimax-cal torques {model} {files} --write corrected.xml"
        yield "Next, to write a model with these masses and friction", fix
    yield from options.keep(written_to, "torques.json")
