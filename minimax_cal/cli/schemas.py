"""JSON schemas of the files that people and programs write and read."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import click

KINDS = {  # by name the class that reads such a file
    "robot": "robots.robot.RobotSchema",
    "calibration": "fitting.fit.Fit",
    "relative": "fitting.several.result.RelativeCalibration",
    "pixels": "fitting.several.result.PixelCalibration",
    "diagnosis": "diagnosing.result.Diagnosis",
    "simulator_gap": "simulators.result.SimulatorGap",
    "motion_gap": "simulators.result.MotionGap",
    "motion_diagnosis": "dynamics.result.MotionDiagnosis",
}


def schema_of(name: str) -> dict[str, Any]:
    """The JSON schema of a kind of file, made from what reads it."""
    from minimax_cal.ground.records import json_schema

    module, _, kind = KINDS[name].rpartition(".")
    return json_schema(getattr(import_module(f"minimax_cal.{module}"), kind))


def schema_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """The option --schema."""
    return click.option(
        "--schema",
        is_flag=False,
        flag_value="robot",
        type=click.Choice(list(KINDS)),
        metavar="[KIND]",
        help="Print the JSON schema of a robot file, for editors, or of results: "
        + ", ".join(list(KINDS)[1:]) + ".",
    )(command)  # fmt: skip
