"""The command `minimax-cal evaluate`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import click

from minimax_cal.cli.options import (
    DATA,
    FIT,
    PATH,
    RUNG,
    Output,
    command,
    options_of,
    result_options,
)
from minimax_cal.dynamics.budget import MotionEvaluation, evaluate_motion
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import saved_content
from minimax_cal.ground.options import Option
from minimax_cal.judging.saved import Evaluation, evaluated


def kind_of_file(path: Path) -> str:
    """The kind that a result file says; empty where it says none."""
    with suppress(CalibrationError):
        return str(saved_content(path).get("kind", ""))
    return ""


@command
@FIT
@DATA
@click.argument("more", type=PATH, nargs=-1)
@RUNG
@options_of(
    evaluated,
    new_frame=Option(
        "The instrument or the base stands elsewhere than in FIT: fit its frame, six numbers."
    ),
)
@result_options("the accuracy (JSON)")
def evaluate_command(
    fit: Path, data: Path, more: tuple[Path, ...], rung: int | None, new_frame: bool, to: Output
) -> int:
    """Accuracy of a saved calibration FIT on the measurements in DATA.

    Nothing of the arm is fitted.  DATA of other instruments than a tracker is as `calibrate` takes
    it; what they have of their own is fitted.  FIT is a calibration, a diagnosis or a relative
    calibration, as -o wrote it.  Of a motion diagnosis, DATA and MORE are logs, and its torques are
    judged.
    """
    found: Evaluation | MotionEvaluation
    if kind_of_file(fit) == MotionDiagnosis.KIND:
        found = evaluate_motion(fit, (data, *more))
    elif more:
        raise OptionError(f"{more[0]}: evaluate takes one file of measurements; join them first")
    else:
        found = evaluated(fit, data, rung, new_frame)
    return to.finish(found)
