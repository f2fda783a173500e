"""Arms of several studies: off their drawing, or real, where their measurements are here."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import click
import numpy as np

from minimax_cal.measuring.datasets import DATA_FOLDER_VARIABLE
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.robots.robot import Robot, load_robot

SHARED_DATA_FOLDER = Path(
    os.environ.get(DATA_FOLDER_VARIABLE) or Path(__file__).parents[2] / "shared" / "data"
)


def has_measurements(arm_name: str) -> bool:
    """Whether the measurements of an arm, as irb120, are on this machine; says so if not."""
    there = (SHARED_DATA_FOLDER / arm_name).is_dir()
    if not there:
        report_absent_arm(arm_name)
    return there


@cache
def report_absent_arm(arm_name: str) -> None:
    """Say once that an arm takes no part, and where its measurements can be had."""
    click.echo(
        (
            f"{arm_name} takes no part: no {SHARED_DATA_FOLDER / arm_name}"
            f"; docs/data.md has its source"
        ),
        err=True,
    )


def read_real_arm(arm_name: str) -> tuple[Robot, Measurements]:
    """An arm as drawn and its measurements."""
    return load_robot(SHARED_DATA_FOLDER / arm_name / "robot.json"), read_measurements(
        SHARED_DATA_FOLDER / arm_name / "measurements.csv"
    )


def perturb_link_parameters(
    robot: Robot, rng: np.random.Generator, length_sigma: float, angle_sigma: float
) -> Robot:
    """A copy of the arm whose links are off their drawing by standard deviations [m, rad]."""
    scale = [length_sigma, length_sigma, angle_sigma, angle_sigma, angle_sigma]
    return robot.with_mdh(robot.mdh + rng.normal(size=robot.mdh.shape) * scale)
