"""The command `plan`."""

from __future__ import annotations

from dataclasses import fields, replace
from inspect import signature
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH,
    ROBOT,
    Output,
    command,
    on_command_line,
    options_from,
    options_of,
    plain_option,
    result_options,
    writable,
)
from minimax_cal.fitting.pixels.options import cameras_of
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import write_whole
from minimax_cal.ground.options import Option
from minimax_cal.planning.camera_options import FOR_CAMERAS, CameraOptions
from minimax_cal.planning.camera_options import GROUP as CAMERAS
from minimax_cal.planning.motion_plan import GROUP, MotionOptions, plan_motion
from minimax_cal.planning.options import PlanOptions, limits_of
from minimax_cal.planning.plan import plan
from minimax_cal.planning.result import Plan
from minimax_cal.planning.route import ANGLES
from minimax_cal.reporting.plots.plan import save_plan
from minimax_cal.robots.robot import Robot, load_robot

SEES = ("camera", "board", *(field.name for field in fields(CameraOptions)))
ALLOWED = {  # what is planned, and the options that are about it
    "motion": {*signature(plan_motion).parameters, "waypoints"},
    "poses": {*signature(plan).parameters, "figure"},
    "cameras": {*SEES, *FOR_CAMERAS, "robot", "poses", "fit", "figure"},
}
OTHERS = {"motion": "a motion; add motion=", "cameras": "cameras; add camera= and board="}


@command
@ROBOT
@plain_option(
    "What the poses are for", "--poses", type=int, metavar="N", help="How many poses to measure."
)
@plain_option(
    GROUP, "--motion", is_flag=True,
    help="Plan a motion instead, whose torques tell masses and friction.",
)  # fmt: skip
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
@options_of(
    plan,
    "What is known",
    fit=Option("A calibration (JSON): robot, base, targets, and its poses.", read=Path),
    data=Option("Existing measurements (CSV); the plan adds to them.", read=Path),
)
@options_from(PlanOptions)
@click.option(
    "--unit",
    default="deg",
    show_default=True,
    help=f"The unit of joints in the file: {' or '.join(ANGLES)}.",
)
@result_options(
    "the poses (CSV)", keep="poses.csv", figure="the poses and how accuracy grows with their number"
)
def plan_command(
    robot: str,
    unit: str,
    to: Output,
    *,
    poses: int | None,
    motion: bool,
    waypoints: Path | None,
    **chosen: Any,
) -> int:
    """Which poses of ROBOT to measure next, for which accuracy.

    The poses come in the order in which to measure them, with the accuracy to expect.  With
    --camera, poses at which cameras see a board; with --motion, a motion to drive while torques or
    currents are logged.
    """
    if unit not in ANGLES:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
    kind = "motion" if motion else "cameras" if chosen["camera"] or chosen["board"] else "poses"
    check_given(kind)
    arm = load_robot(robot)
    chosen["joints"] = limits_of(chosen["joints"], arm)
    asked = {name: value for name, value in chosen.items() if name in ALLOWED[kind]}
    if motion:
        writable(waypoints)
        moved = to.work(plan_motion, arm, **asked)
        code = replace(to, keep="motion.csv").finish(moved, rows=lambda: moved.csv(unit))
        if waypoints:
            write_whole(waypoints, moved.waypoints(unit))
            to.wrote(waypoints)
        return code
    if poses is None:
        raise OptionError("give the number of poses=, or motion= for a motion")
    found = poses_of(arm, poses, kind, asked, to)
    return to.finish(
        found,
        rows=lambda: found.csv(unit),
        tables=lambda: (*found.tables(), *[found.pose_table(unit)] * (to.output is None)),
        draw=save_plan,
    )


def poses_of(arm: Robot, poses: int, kind: str, asked: dict[str, Any], to: Output) -> Plan:
    """The poses for a tracker, or for cameras.  Raises OptionError."""
    if kind == "poses":
        return to.work(plan, arm, poses, **asked)
    cameras = cameras_of(asked.pop("camera"))
    if not cameras or asked["board"] is None:
        raise OptionError("images need both camera='NAME=FILE' and board=")
    from minimax_cal.planning.cameras import plan_cameras

    return to.work(plan_cameras, arm, poses, cameras, **asked)


def check_given(kind: str) -> None:
    """Raise OptionError for options that are not about what is planned.  kind: of ALLOWED."""
    known = set().union(*ALLOWED.values()) - ALLOWED[kind]
    for name in sorted(on_command_line() & known):
        about = next(each for each, names in ALLOWED.items() if name in names)
        what = OTHERS.get(about) or f"poses, not about {OTHERS[kind].partition(';')[0]}"
        raise OptionError(f"{name}= is about {what}")
