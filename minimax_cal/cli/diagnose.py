"""The commands `minimax-cal diagnose` and `minimax-cal effects`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    JSON,
    ROBOT,
    ROWS,
    SOME_CAMPAIGNS,
    SOME_DATA,
    Output,
    among,
    command,
    looked_up,
    measured,
    of_any,
    on_command_line,
    options_from,
    plain_option,
    refuse,
    result_options,
    together,
)
from minimax_cal.diagnosing.diagnose import DiagnosisOptions, diagnose
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.dynamics.logs import are_logs
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import PixelFiles
from minimax_cal.fitting.several.options import RelativeOptions
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.tables import Table, filled
from minimax_cal.instruments.images import Images
from minimax_cal.measuring.history import with_history
from minimax_cal.reporting.plots.diagnosis import save_diagnosis
from minimax_cal.reporting.tables import effects_list, effects_table, remaining_table, where_tables
from minimax_cal.solvers.status import Status


@command
@ROBOT
@SOME_CAMPAIGNS
@options_from(Options, "holdout", "seed", "holdout_by", "instrument")
@options_from(DiagnosisOptions)
@options_from(RelativeOptions, "offset", "known_distances", "lever", "noises", *Images.options)
@options_from(PixelFiles)
@plain_option(
    "Who does the work",
    "--jobs",
    type=int,
    default=1,
    help="The number of processes; -1: one a core [default: 1].",
)
@plain_option(
    "Who does the work", "--cluster", default="", metavar="tcp://HOST:PORT",
    help="Let a Dask cluster do it instead.",
)  # fmt: skip
@ROWS
@result_options("the diagnosis (JSON)", keep="diagnosis.json", figure="the gap and where it lies")
def diagnose_command(
    robot: str, data: tuple[Path, ...], in_rows: bool, to: Output, **chosen: Any
) -> int:
    """Say why ROBOT still misses once it is calibrated from DATA.

    DATA is as `calibrate` takes it; of logs, `torques` says why their torques are not ROBOT's.
    """
    if data and are_logs(data):
        return by_torques(robot, data, to, chosen)
    files, rest = among(data, chosen)
    given = of_any(rest, in_rows, to) if rest else []
    if files.given or isinstance(given, list):
        refuse(("in_rows", "jobs", "cluster"), "is for points of a tracker")
        every = given if isinstance(given, list) else [given]
        return together(diagnose, robot, every, files, to, chosen)
    found = to.work(diagnose, robot, given, **chosen)
    return to.finish(
        found,
        status=found.status,
        sentences=found.said,
        tables=partial(every_table, found),
        advice=advice(found, robot, data, to.output, in_rows),
        draw=save_diagnosis,
    )


def by_torques(robot: str, logs: tuple[Path, ...], to: Output, chosen: dict[str, Any]) -> int:
    """Diagnose torques.  Raises OptionError for what they do not know."""
    from minimax_cal.cli.torques import model_of
    from minimax_cal.dynamics.diagnose import diagnose_motion
    from minimax_cal.dynamics.given import read_logs
    from minimax_cal.reporting.plots.motion import save_motion

    known = {"holdout", "exclude"}
    refuse({*chosen, "in_rows"} - known, "is for measurements; minimax-cal torques has its own")
    runs = read_logs(robot, logs)
    own = {name: chosen[name] for name in on_command_line() & known}
    to.took(*((run.source, f"torques of {run.joints} joints") for run in runs))
    found = to.work(diagnose_motion, model_of(robot, runs), runs, **own)
    return to.finish(found, sentences=found.sentences(), draw=save_motion)


def every_table(found: Diagnosis) -> Iterator[Table]:
    """Those of the result, and of where its errors lie."""
    yield from (*found.tables(), *filled(remaining_table(found)))
    yield from where_tables(found.where)


def advice(
    found: Diagnosis, robot: str, data: tuple[Path, ...], written: Path | None, in_rows: bool
) -> Iterator[tuple[str, str]]:
    """What to do next, and its command.  written: where the diagnosis went."""
    if written and found.main and found.status is Status.CONVERGED:
        files = shlex.join(map(str, data))
        told, usual = found.provenance.settings, vars(DiagnosisOptions())
        given = [n for n in ("seed", "holdout", "holdout_by", "instrument") if told[n] != usual[n]]
        split = "".join(
            f"--{name.replace('_', '-')} {shlex.quote(str(told[name]))} " for name in given
        ) + ("--rows-in-visit-order " if in_rows else "")
        fit = (
            f"minimax-cal calibrate {robot} {files} --effects {written} --objective sum {split}"
            "-o fit_effects.json"
        )
        yield "Next, to calibrate with the confirmed causes", fit
        correct = "minimax-cal compensate fit_effects.json targets.csv -o corrected.csv"
        yield "Then, to correct joint targets, or a program, for the controller", correct
    keep = "" if written else "-o diagnosis.json "
    what = "To see" if written else "To keep the result, and to see"
    yield f"{what} every effect, parameter and table", f"add {keep}--details"


@command
@click.argument("robot", required=False)
@SOME_DATA
@ROWS
@JSON
def effects_command(robot: str | None, data: Path | None, in_rows: bool, as_json: bool) -> int:
    """The library of effects; with ROBOT and DATA, where these measurements can test them."""
    scene = None
    if robot is not None:
        if data is None:
            raise OptionError("effects needs both ROBOT and DATA, or neither")
        given = with_history(measured([data], in_rows))
        fit = calibrate(robot, given, objective="sum", holdout=0.0)
        scene = fit.cell.scene(given)
    entries = effects_list(scene)
    return looked_up(as_json, {"schema": 1, "effects": entries}, effects_table(entries))
