"""JSON schemas of the files that people and programs write and read."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import click

SCHEMA_CLASS_BY_KIND = {  # by name the class that reads such a file
    "robot": "robots.robot.RobotSchema",
    "calibration": "fitting.fit.Fit",
    "relative": "fitting.multi_instrument.relative_result.RelativeCalibration",
    "pixels": "fitting.multi_instrument.relative_result.PixelCalibration",
    "diagnosis": "diagnosing.diagnosis.Diagnosis",
    "simulator_gap": "simulators.result.SimulatorGap",
    "motion_gap": "simulators.result.MotionGap",
    "motion_diagnosis": "dynamics.result.MotionDiagnosis",
}


def build_file_schema(file_kind: str) -> dict[str, Any]:
    """The JSON schema of a kind of file, made from what reads it."""
    from minimax_cal.core.record_parsing import build_json_schema

    module, _, kind = SCHEMA_CLASS_BY_KIND[file_kind].rpartition(".")
    return build_json_schema(getattr(import_module(f"minimax_cal.{module}"), kind))


def schema_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """The option --schema."""
    return click.option(
        "--schema",
        is_flag=False,
        flag_value="robot",
        type=click.Choice(list(SCHEMA_CLASS_BY_KIND)),
        metavar="[KIND]",
        help="Print the JSON schema of a robot file, for editors, or of results: "
        + ", ".join(list(SCHEMA_CLASS_BY_KIND)[1:]) + ".",
    )(command)  # fmt: skip
