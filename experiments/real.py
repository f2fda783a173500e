"""Arms of several studies: off their drawing, or real, where their measurements are here."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import click
import numpy as np

from minimax_cal.measuring.datasets import FOLDER
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.robots.robot import Robot, load_robot

SHARED = Path(os.environ.get(FOLDER) or Path(__file__).parents[2] / "shared" / "data")


def here(name: str) -> bool:
    """Whether the measurements of an arm, as irb120, are on this machine; says so if not."""
    there = (SHARED / name).is_dir()
    if not there:
        report_absent(name)
    return there


@cache
def report_absent(name: str) -> None:
    """Say once that an arm takes no part, and where its measurements can be had."""
    click.echo(f"{name} takes no part: no {SHARED / name}; docs/data.md has its source", err=True)


def real(name: str) -> tuple[Robot, Measurements]:
    """An arm as drawn and its measurements."""
    return load_robot(SHARED / name / "robot.json"), read_measurements(
        SHARED / name / "measurements.csv"
    )


def off_drawing(robot: Robot, rng: np.random.Generator, length: float, angle: float) -> Robot:
    """A copy of the arm whose links are off their drawing by standard deviations [m, rad]."""
    scale = [length, length, angle, angle, angle]
    return robot.with_mdh(robot.mdh + rng.normal(size=robot.mdh.shape) * scale)
