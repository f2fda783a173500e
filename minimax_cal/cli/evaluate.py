"""The command `minimax-cal evaluate`."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from minimax_cal.cli.options import DATA, FIT, RUNG, InGroups, Output, result_options, show
from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.opened import open_result
from minimax_cal.fitting.set_aside import aside_sentence, errors_of, with_them
from minimax_cal.ground.files import json_text
from minimax_cal.judging.saved import training_poses
from minimax_cal.measuring import checks
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import read_measurements
from minimax_cal.measuring.spans import narrow, outside, spans_in_words
from minimax_cal.modelling.cell import strangers


@click.command(name="evaluate", cls=InGroups)
@FIT
@DATA
@RUNG
@result_options("the accuracy (JSON)")
def evaluate_command(fit: Path, data: Path, rung: int | None, to: Output) -> int:
    """Accuracy of a saved calibration FIT on the measurements in DATA; nothing is fitted.

    FIT is a calibration, a diagnosis or a relative calibration, as -o wrote it.
    """
    measured = read_measurements(data)
    opened = open_result(fit, rung)
    cell, _, said = opened.placed_by(measured)
    error = cell.error(measured)
    found = accuracy(error)
    count, mixed = training_poses(measured, opened, error)
    doubts = checks.outliers(measured, np.linalg.norm(error, axis=-1))
    if found.rms_mm > 1e3 * POOR_FIT * cell.robot.reach():
        doubts.append(
            f"{data}: the fit misses by {found.rms_mm:.3g} mm: check that data and fit belong to "
            "the same robot, measurement frame, units and order of targets"
        )
    away = outside(opened.spans, measured.q)
    if away.any():
        doubts.append(
            f"{data}: {away.sum()} of {measured.poses} poses are outside what the joints of the "
            f"fit spanned ({spans_in_words(narrow(opened.spans))}): no claim was made for them"
        )
    to.notice(*measured.notices, *said, *strangers(cell, measured), *mixed, *doubts)
    content = {
        "schema": 1,
        "kind": "evaluation",
        "fit": str(fit),
        "rung": opened.rungs[opened.number].name,
        "data": str(data),
        "data_sha256": measured.digest,
        "training_poses": count,
        "outside_spans": {
            "poses": int(away.sum()),
            "joints": [span.joint for span in narrow(opened.spans)],
        },
        "accuracy": found.to_dict(),
        "set_aside": [point.to_dict() for point in measured.set_aside],
    }
    if measured.set_aside:
        gone = with_them(error, groups(measured), errors_of(cell, measured))
        content["accuracy"] = found.to_dict() | {"holdout_with_them": gone.to_dict()}
        to.notice(aside_sentence(measured.set_aside, gone))
    if to.deliver(lambda: json_text(content)):
        name = cell.robot.name if rung is None else f"{cell.robot.name}, {content['rung']},"
        show(found.table(f"{name} on {data}", measured.target_names))
    return 0
