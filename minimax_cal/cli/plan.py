"""The command `plan`."""

from __future__ import annotations

from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH,
    ROBOT,
    Output,
    command,
    options_from,
    options_of,
    plain_option,
    refuse,
    result_options,
    writable,
)
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import write_whole
from minimax_cal.ground.options import Option
from minimax_cal.planning.motion_plan import GROUP, MotionOptions, plan_motion
from minimax_cal.planning.options import PlanOptions, limits_of
from minimax_cal.planning.plan import plan
from minimax_cal.planning.route import ANGLES
from minimax_cal.reporting.plots.plan import save_plan
from minimax_cal.robots.robot import load_robot

OF_MOTION = {*signature(plan_motion).parameters, "waypoints"}
OF_POSES = {*signature(plan).parameters, "figure"}


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
    --motion, a motion to drive while torques or currents are logged.
    """
    if unit not in ANGLES:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
    if motion:
        refuse(OF_POSES - OF_MOTION, "is about poses, not about a motion")
    else:
        refuse(OF_MOTION - OF_POSES, "is about a motion, with motion=")
    arm = load_robot(robot)
    chosen["joints"] = limits_of(chosen["joints"], arm)
    used = OF_MOTION if motion else OF_POSES
    asked = {name: value for name, value in chosen.items() if name in used}
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
    found = to.work(plan, arm, poses, **asked)
    return to.finish(
        found,
        rows=lambda: found.csv(unit),
        tables=lambda: (*found.tables(), *[found.pose_table(unit)] * (to.output is None)),
        draw=save_plan,
    )
