"""The command `minimax-cal evaluate`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import click
import numpy as np

from minimax_cal.cli.options import DATA, FIT, PATH, RUNG, InGroups, Output, result_options, show
from minimax_cal.dynamics.evaluate import evaluate_motion
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.opened import open_result
from minimax_cal.fitting.set_aside import aside_sentence, errors_of, with_them
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import json_text, plain, saved_content
from minimax_cal.judging.saved import training_poses
from minimax_cal.measuring import checks
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import read_measurements
from minimax_cal.measuring.spans import narrow, outside, spans_in_words
from minimax_cal.modelling.cell import strangers


def kind_of_file(path: Path) -> str:
    """The kind that a result file says; empty where it says none."""
    with suppress(CalibrationError):
        return str(saved_content(path).get("kind", ""))
    return ""


def evaluate_logs(motion: Path, logs: tuple[Path, ...], to: Output) -> int:
    """What a motion diagnosis misses on other logs."""
    found = evaluate_motion(motion, list(logs))
    to.notice(*found.notices)
    if to.deliver(found.json):
        show(found.table())
    return 0


@click.command(name="evaluate", cls=InGroups)
@FIT
@DATA
@click.argument("more", type=PATH, nargs=-1)
@RUNG
@click.option(
    "--new-frame",
    is_flag=True,
    help="The instrument or the base stands elsewhere than in FIT: fit its frame, six numbers.",
)
@result_options("the accuracy (JSON)")
def evaluate_command(
    fit: Path, data: Path, more: tuple[Path, ...], rung: int | None, new_frame: bool, to: Output
) -> int:
    """Accuracy of a saved calibration FIT on the measurements in DATA; nothing is fitted.

    FIT is a calibration, a diagnosis or a relative calibration, as -o wrote it.  Of a motion
    diagnosis, DATA and MORE are logs, and its torques are judged.
    """
    if kind_of_file(fit) == MotionDiagnosis.KIND:
        return evaluate_logs(fit, (data, *more), to)
    if more:
        raise OptionError(f"{more[0]}: evaluate takes one file of measurements; join them first")
    measured = read_measurements(data)
    opened = open_result(fit, rung)
    cell, _, said = opened.placed_by(measured, new_frame)
    error = cell.error(measured)
    found = accuracy(error)
    count, mixed = training_poses(measured, opened, error)
    doubts = checks.outliers(measured, np.linalg.norm(error, axis=-1))
    if found.rms_mm > 1e3 * POOR_FIT * cell.robot.reach():
        doubts.append(
            f"{data}: the fit misses by {found.rms_mm:.3g} mm: check that data and fit belong to "
            "the same robot, measurement frame, units and order of targets; if it was measured "
            "from elsewhere, --new-frame fits where"
        )
    away = outside(opened.spans, measured.q)
    if away.any():
        doubts.append(
            f"{data}: {away.sum()} of {measured.poses} poses are outside what the joints of the "
            f"fit spanned ({spans_in_words(narrow(opened.spans))}): no claim was made for them"
        )
    to.notice(*measured.notices, *said, *strangers(cell, measured), *mixed, *doubts)
    content: dict[str, Any] = {
        "schema": 1,
        "kind": "evaluation",
        "fit": str(fit),
        "rung": opened.rungs[opened.number].name,
        "data": str(data),
        "data_sha256": measured.digest,
        "training_poses": count,
        "outside_spans": {
            "poses": away.sum(),
            "joints": [span.joint for span in narrow(opened.spans)],
        },
        "accuracy": plain(found),
        "set_aside": measured.set_aside,
    }
    if measured.set_aside:
        gone = with_them(error, groups(measured), errors_of(cell, measured))
        content["accuracy"]["holdout_with_them"] = gone
        to.notice(aside_sentence(measured.set_aside, gone))
    if to.deliver(lambda: json_text(plain(content))):
        name = cell.robot.name if rung is None else f"{cell.robot.name}, {content['rung']},"
        show(found.table(f"{name} on {data}", measured.target_names))
    return 0
