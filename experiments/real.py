"""Real arms and their measurements, where they are on this machine."""

from __future__ import annotations

from pathlib import Path

from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.robots.robot import Robot, load_robot

SHARED = Path(__file__).parents[2] / "shared" / "data"


def here(name: str) -> bool:
    """Whether the measurements of an arm, as irb120, are on this machine."""
    return (SHARED / name).is_dir()


def real(name: str) -> tuple[Robot, Measurements]:
    """An arm as drawn and its measurements."""
    return load_robot(SHARED / name / "robot.json"), read_measurements(
        SHARED / name / "measurements.csv"
    )
