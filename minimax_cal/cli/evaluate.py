"""The command `minimax-cal evaluate`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import click

from minimax_cal.cli.options import (
    DATA_ARGUMENT,
    FIT_ARGUMENT,
    PATH_TYPE,
    STEP_OPTION,
    CommandOutput,
    build_result_options,
    define_command,
    options_from_parameters,
)
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import read_saved_result_json
from minimax_cal.core.option_fields import Option
from minimax_cal.dynamics.cross_validation import MotionEvaluation, evaluate_motion
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.validation.evaluation import Evaluation, evaluate_with_notices


def read_result_kind(path: Path) -> str:
    """The kind that a result file says; empty where it says none."""
    with suppress(CalibrationError):
        return str(read_saved_result_json(path).get("kind", ""))
    return ""


@define_command
@FIT_ARGUMENT
@DATA_ARGUMENT
@click.argument("more", type=PATH_TYPE, nargs=-1)
@STEP_OPTION
@options_from_parameters(
    evaluate_with_notices,
    new_frame=Option(
        "The instrument or the base stands elsewhere than in FIT: fit its frame, six numbers."
    ),
)
@build_result_options("the accuracy (JSON)")
def evaluate_command(
    fit: Path,
    data: Path,
    more: tuple[Path, ...],
    rung: int | None,
    new_frame: bool,
    to: CommandOutput,
) -> int:
    """Accuracy of a saved calibration FIT on the measurements in DATA.

    Nothing of the arm is fitted.  DATA of other instruments than a tracker is as `calibrate` takes
    it; what they have of their own is fitted.  FIT is a calibration, a diagnosis or a relative
    calibration, as -o wrote it.  Of a motion diagnosis, DATA and MORE are logs, and its torques are
    judged.
    """
    found: Evaluation | MotionEvaluation
    if read_result_kind(fit) == MotionDiagnosis.KIND:
        found = evaluate_motion(fit, (data, *more))
    elif more:
        raise OptionError(f"{more[0]}: evaluate takes one file of measurements; join them first")
    else:
        found = evaluate_with_notices(fit, data, rung, new_frame)
    return to.write_and_print_result(found)
