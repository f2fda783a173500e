"""The command `plan`."""

from __future__ import annotations

from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    PATH_TYPE,
    ROBOT_ARGUMENT,
    CommandOutput,
    build_result_options,
    check_writable_paths,
    define_command,
    group_option,
    options_from_dataclass,
    options_from_parameters,
    refuse_given_options,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.option_fields import Option
from minimax_cal.planning.motion_plan import MOTION_OPTION_GROUP, MotionOptions, plan_motion
from minimax_cal.planning.plan import plan
from minimax_cal.planning.plan_options import PlanOptions, parse_joint_limits
from minimax_cal.planning.visit_route import RADIANS_TO_ANGLE_UNIT
from minimax_cal.reporting.plots.plan_figure import save_plan
from minimax_cal.robots.robot import load_robot

MOTION_PLAN_OPTION_NAMES = {*signature(plan_motion).parameters, "waypoints"}
POSE_PLAN_OPTION_NAMES = {*signature(plan).parameters, "figure"}


@define_command
@ROBOT_ARGUMENT
@group_option(
    "What the poses are for", "--poses", type=int, metavar="N", help="How many poses to measure."
)
@group_option(
    MOTION_OPTION_GROUP, "--motion", is_flag=True,
    help="Plan a motion instead, whose torques tell masses and friction.",
)  # fmt: skip
@options_from_dataclass(MotionOptions)
@group_option(
    MOTION_OPTION_GROUP,
    "--waypoints",
    type=PATH_TYPE,
    help="Write points and speeds at 10 Hz to this CSV file too.",
)
@options_from_parameters(
    plan,
    "What is known",
    fit=Option("A calibration (JSON): robot, base, targets, and its poses.", read=Path),
    data=Option("Existing measurements (CSV); the plan adds to them.", read=Path),
)
@options_from_dataclass(PlanOptions)
@click.option(
    "--unit",
    default="deg",
    show_default=True,
    help=f"The unit of joints in the file: {' or '.join(RADIANS_TO_ANGLE_UNIT)}.",
)
@build_result_options(
    "the poses (CSV)",
    suggested_file_name="poses.csv",
    drawn_content="the poses and how accuracy grows with their number",
)
def plan_command(
    robot: str,
    unit: str,
    to: CommandOutput,
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
    if unit not in RADIANS_TO_ANGLE_UNIT:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(RADIANS_TO_ANGLE_UNIT)}")
    if motion:
        refuse_given_options(
            POSE_PLAN_OPTION_NAMES - MOTION_PLAN_OPTION_NAMES, "is about poses, not about a motion"
        )
    else:
        refuse_given_options(
            MOTION_PLAN_OPTION_NAMES - POSE_PLAN_OPTION_NAMES, "is about a motion, with motion="
        )
    arm = load_robot(robot)
    chosen["joints"] = parse_joint_limits(chosen["joints"], arm)
    used = MOTION_PLAN_OPTION_NAMES if motion else POSE_PLAN_OPTION_NAMES
    asked = {name: value for name, value in chosen.items() if name in used}
    if motion:
        check_writable_paths(waypoints)
        moved = to.call_with_progress(plan_motion, arm, **asked)
        code = replace(to, keep="motion.csv").write_and_print_result(
            moved, rows=lambda: moved.csv(unit)
        )
        if waypoints:
            write_file_atomically(waypoints, moved.waypoints(unit))
            to.report_written_files(waypoints)
        return code
    if poses is None:
        raise OptionError("give the number of poses=, or motion= for a motion")
    found = to.call_with_progress(plan, arm, poses, **asked)
    return to.write_and_print_result(
        found,
        rows=lambda: found.csv(unit),
        tables=lambda: (*found.tables(), *[found.pose_table(unit)] * (to.output is None)),
        draw=save_plan,
    )
