"""JSON schemas of the files that people and programs write and read."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import click

from minimax_cal.ground.files import json_text

KINDS = {  # name: (module, class that reads such a file, title)
    "robot": ("robots.robot", "RobotSchema", "Robot file of minimax-cal"),
    "calibration": ("fitting.fit_file", "FitPart", "Result of minimax-cal calibrate"),
    "relative": ("fitting.instruments.result", "RelativePart", "Result of minimax-cal relative"),
    "pixels": (
        "fitting.instruments.pixel_result",
        "PixelPart",
        "Result of minimax-cal calibrate by cameras",
    ),
    "diagnosis": ("diagnosing.result_file", "DiagnosisPart", "Result of minimax-cal diagnose"),
    "simulator_gap": ("simulators.result", "SimulatorGap", "Result of minimax-cal gap"),
    "motion_gap": ("simulators.motion.result", "MotionGap", "Result of minimax-cal gap, of logs"),
    "motion_diagnosis": ("dynamics.result", "MotionDiagnosis", "Result of minimax-cal torques"),
}


def schema_of(name: str) -> dict[str, Any]:
    """The JSON schema of a kind of file, made from what reads it."""
    from minimax_cal.ground.records import json_schema

    module, kind, title = KINDS[name]
    return json_schema(getattr(import_module(f"minimax_cal.{module}"), kind), title)


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


def print_schema(name: str) -> None:
    """Print a JSON schema."""
    click.echo(json_text(schema_of(name)), nl=False)
