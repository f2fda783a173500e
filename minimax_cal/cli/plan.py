"""The command `plan`."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from minimax_cal.cli import options
from minimax_cal.cli.options import (
    DETAILS,
    PATH,
    ROBOT,
    InGroups,
    Output,
    keep,
    options_from,
    plain_option,
    result_options,
    writable,
)
from minimax_cal.fitting.pixels.options import cameras_of
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import write_whole
from minimax_cal.ground.stages import Progress
from minimax_cal.planning.camera_options import GROUP as CAMERAS
from minimax_cal.planning.camera_options import CameraOptions
from minimax_cal.planning.motion_plan import GROUP, MotionOptions, plan_motion
from minimax_cal.planning.options import PlanOptions, limits_of
from minimax_cal.planning.plan import plan
from minimax_cal.planning.result import Plan
from minimax_cal.planning.stops import ANGLES
from minimax_cal.reporting.plots.plan import save_plan
from minimax_cal.robots.robot import Robot, load_robot

MOTION = tuple(field.name for field in fields(MotionOptions))  # options of motions alone
SHARED = ("joints", "volume", "floor", "body", "seed")  # of poses and motions
IMAGES = ("criterion", "jitter", "revisit", "approach", "candidates", *SHARED)  # of poses too
SEES = ("camera", "board", *(field.name for field in fields(CameraOptions)))
ALLOWED = {  # what is planned, and the options that are about it
    "motion": {*MOTION, "waypoints", *SHARED},
    "poses": {*(one.name for one in fields(PlanOptions)), "poses", "fit", "data", "figure"},
    "cameras": {*SEES, *IMAGES, "poses", "fit", "figure"},
}
OTHERWISE = {  # what an option is about that is not about what is planned
    "motion": "a motion; add motion=", "cameras": "cameras; add camera= and board=",
    "poses": "poses, not about",
}  # fmt: skip
NAMED = {"motion": "a motion", "cameras": "cameras"}


@click.command(name="plan", cls=InGroups)
@ROBOT
@plain_option(
    "What the poses are for",
    "--poses",
    type=int,
    metavar="N",
    help="How many poses to measure.",
)
@plain_option(
    GROUP,
    "--motion",
    is_flag=True,
    help="Plan a motion instead, whose torques tell masses and friction.",
)
@options_from(MotionOptions)
@plain_option(
    GROUP, "--waypoints", type=PATH, help="Write points and speeds at 10 Hz to this CSV file too."
)
@plain_option(
    CAMERAS,
    "--camera",
    multiple=True,
    metavar="NAME=FILE",
    help="The K, D and image size of a camera (YAML); images of a board are planned then.",
)
@plain_option(
    CAMERAS,
    "--board",
    type=PATH,
    metavar="FILE",
    help="The places of the board's corners (CSV): target, x_mm, y_mm, z_mm.",
)
@options_from(CameraOptions)
@plain_option(
    "What is known",
    "--fit",
    type=PATH,
    help="A calibration (JSON): robot, base, targets, and its poses.",
)
@plain_option(
    "What is known", "--data", type=PATH, help="Existing measurements (CSV); the plan adds to them."
)
@options_from(PlanOptions)
@click.option(
    "--unit",
    default="deg",
    show_default=True,
    help=f"The unit of joints in the file: {' or '.join(ANGLES)}.",
)
@DETAILS
@result_options("the poses (CSV)", figure="the poses and how accuracy grows with their number")
def plan_command(
    robot: str,
    unit: str,
    to: Output,
    *,
    poses: int | None,
    motion: bool,
    waypoints: Path | None,
    details: bool,
    **chosen: Any,
) -> int:
    """Which poses of ROBOT to measure next, in which order, and how accurate they will make it.

    With --camera, poses at which cameras see a board; with --motion, a motion to drive while
    torques or currents are logged.
    """
    if unit not in ANGLES:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
    kind = "motion" if motion else "cameras" if chosen["camera"] or chosen["board"] else "poses"
    check_given(kind)
    arm = load_robot(robot)
    chosen["joints"] = limits_of(chosen["joints"], arm)
    if motion:
        writable(waypoints)
        return show_motion(arm, unit, to, waypoints, chosen, details=details)
    if poses is None:
        raise OptionError("give the number of poses=, or motion= for a motion")
    with to.stages() as progress:
        found = poses_of(arm, poses, kind, chosen, progress)
    to.notice(*found.notices)
    if to.deliver(found.json, rows=lambda: found.csv(unit)):
        options.present(
            details, [found.headline()], [found.criterion_table().brief()],
            lambda: (*found.tables(), *(() if to.path else (found.pose_table(unit),))),
            keep(to.path, "poses.csv"),
        )  # fmt: skip
    to.draw(save_plan, found)
    return 0


def poses_of(arm: Robot, poses: int, kind: str, chosen: dict[str, Any], progress: Progress) -> Plan:
    """The poses for a tracker, or for cameras.  Raises OptionError."""
    cameras = cameras_of(chosen["camera"])
    own = {name: value for name, value in chosen.items() if name in ALLOWED[kind]}
    if kind == "poses":
        return plan(arm, poses, progress=progress, **own)
    if not cameras or chosen["board"] is None:
        raise OptionError("images need both camera='NAME=FILE' and board=")
    from minimax_cal.planning.cameras import plan_cameras

    return plan_cameras(arm, poses, progress=progress, **{**own, "camera": cameras})


def check_given(kind: str) -> None:
    """Raise OptionError for options that are not about what is planned.  kind: of ALLOWED."""
    at = click.get_current_context()
    for name in sorted(set().union(*ALLOWED.values()) - ALLOWED[kind]):
        if at.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            about = next(each for each, names in ALLOWED.items() if name in names)
            what = OTHERWISE[about] + (f" {NAMED[kind]}" if about == "poses" else "")
            raise OptionError(f"{name}= is about {what}")


def show_motion(
    arm: Robot,
    unit: str,
    to: Output,
    waypoints: Path | None,
    chosen: dict[str, Any],
    *,
    details: bool,
) -> int:
    """Plan a motion, write and show it."""
    wanted = {name: chosen[name] for name in (*MOTION, *SHARED)}
    with to.stages() as progress:
        found = plan_motion(arm, progress=progress, **wanted)
    to.notice(*found.notices)
    if to.deliver(found.json, rows=lambda: found.csv(unit)):
        options.present(
            details, [found.headline()], [found.told_table().brief()],
            found.tables, keep(to.path, "motion.csv"),
        )  # fmt: skip
    if waypoints:
        write_whole(waypoints, found.waypoints(unit))
        to.wrote(waypoints)
    return 0
