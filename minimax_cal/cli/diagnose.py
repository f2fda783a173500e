"""The commands `minimax-cal diagnose` and `minimax-cal effects`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli.options import (
    JSON_OPTION,
    OPTIONAL_DATA_ARGUMENT,
    OPTIONAL_DATA_ARGUMENTS,
    ROBOT_ARGUMENT,
    ROWS_IN_ORDER_OPTION,
    CommandOutput,
    SuggestedCommand,
    build_result_options,
    define_command,
    group_option,
    options_from_dataclass,
    options_given_on_command_line,
    print_json_or_tables,
    read_any_measurements,
    read_measured_points,
    refuse_given_options,
    run_on_any_instruments,
    split_camera_files,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.diagnosing.diagnose import DiagnosisOptions, diagnose
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.dynamics.logs import are_logs
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.multi_instrument.options import RelativeOptions
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import PixelFiles
from minimax_cal.instruments.camera_images import CameraImages
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.reporting.diagnosis_tables import (
    build_effects_table,
    build_error_location_tables,
    build_remaining_error_table,
    list_effects,
)
from minimax_cal.reporting.plots.diagnosis_figure import save_diagnosis
from minimax_cal.solvers.status import Status


@define_command
@ROBOT_ARGUMENT
@OPTIONAL_DATA_ARGUMENTS
@options_from_dataclass(Options, "holdout", "seed", "holdout_by", "instrument")
@options_from_dataclass(DiagnosisOptions)
@options_from_dataclass(
    RelativeOptions, "offset", "known_distances", "lever", "noises", *CameraImages.options
)
@options_from_dataclass(PixelFiles)
@group_option(
    "Who does the work",
    "--jobs",
    type=int,
    default=1,
    help="The number of processes; -1: one a core [default: 1].",
)
@group_option(
    "Who does the work", "--cluster", default="", metavar="tcp://HOST:PORT",
    help="Let a Dask cluster do it instead.",
)  # fmt: skip
@ROWS_IN_ORDER_OPTION
@build_result_options(
    "the diagnosis (JSON)",
    suggested_file_name="diagnosis.json",
    drawn_content="the gap and where it lies",
)
def diagnose_command(
    robot: str, data: tuple[Path, ...], in_rows: bool, to: CommandOutput, **chosen: Any
) -> int:
    """Say why ROBOT still misses once it is calibrated from DATA.

    DATA is as `calibrate` takes it; of logs, `torques` says why their torques are not ROBOT's.
    """
    if data and are_logs(data):
        return diagnose_torques(robot, data, to, chosen)
    files, rest = split_camera_files(data, chosen)
    given = read_any_measurements(rest, in_rows, to) if rest else []
    if files.is_given or isinstance(given, list):
        refuse_given_options(("in_rows", "jobs", "cluster"), "is for points of a tracker")
        every = given if isinstance(given, list) else [given]
        return run_on_any_instruments(diagnose, robot, every, files, to, chosen)
    found = to.call_with_progress(diagnose, robot, given, **chosen)
    return to.write_and_print_result(
        found,
        status=found.status,
        sentences=found.said,
        tables=partial(list_all_tables, found),
        advice=suggest_next_commands(found, robot, data, to.output, in_rows),
        draw=save_diagnosis,
    )


def diagnose_torques(
    robot: str, logs: tuple[Path, ...], output: CommandOutput, option_values: dict[str, Any]
) -> int:
    """Diagnose torques.  Raises OptionError for what they do not know."""
    from minimax_cal.cli.torques import load_torque_robot
    from minimax_cal.dynamics.diagnose import diagnose_motion
    from minimax_cal.dynamics.known_inputs import read_runs_of_robot
    from minimax_cal.reporting.plots.motion_figure import write_motion_figure

    known = {"holdout", "exclude"}
    refuse_given_options(
        {*option_values, "in_rows"} - known, "is for measurements; minimax-cal torques has its own"
    )
    runs = read_runs_of_robot(robot, logs)
    own = {name: option_values[name] for name in options_given_on_command_line() & known}
    output.remember_file_kinds(*((run.source, f"torques of {run.joints} joints") for run in runs))
    found = output.call_with_progress(diagnose_motion, load_torque_robot(robot, runs), runs, **own)
    return output.write_and_print_result(
        found, sentences=found.sentences(), draw=write_motion_figure
    )


def list_all_tables(diagnosis: Diagnosis) -> Iterator[Table]:
    """Those of the result, and of where its errors lie."""
    yield from (*diagnosis.tables(), *drop_empty_tables(build_remaining_error_table(diagnosis)))
    yield from build_error_location_tables(diagnosis.where)


def suggest_next_commands(
    diagnosis: Diagnosis,
    robot: str,
    data: tuple[Path, ...],
    written_path: Path | None,
    rows_in_visit_order: bool,
) -> Iterator[SuggestedCommand]:
    """What to do next, and its command.  written_path: where the diagnosis went."""
    is_next_named = bool(diagnosis.main_findings) and diagnosis.status is Status.CONVERGED
    if is_next_named:
        files = shlex.join(map(str, data))
        told, usual = diagnosis.provenance.settings, vars(DiagnosisOptions())
        given = [n for n in ("seed", "holdout", "holdout_by", "instrument") if told[n] != usual[n]]
        split = "".join(
            f"--{name.replace('_', '-')} {shlex.quote(str(told[name]))} " for name in given
        ) + ("--rows-in-visit-order " if rows_in_visit_order else "")
        fit = (
            f"minimax-cal calibrate {robot} {files} --effects "
            f"{written_path or 'diagnosis.json'} --objective sum {split}"
            "-o fit_effects.json"
        )
        if not written_path:
            yield SuggestedCommand("Next, to keep this diagnosis", "add -o diagnosis.json")
        first_word = "Next" if written_path else "Then"
        yield SuggestedCommand(f"{first_word}, to calibrate with the confirmed causes", fit)
        correct = "minimax-cal compensate fit_effects.json targets.csv -o corrected.csv"
        yield SuggestedCommand(
            "Then, to correct joint targets, or a program, for the controller", correct
        )
    keep = "" if written_path or is_next_named else "-o diagnosis.json "
    what = "To keep the result, and to see" if keep else "To see"
    yield SuggestedCommand(f"{what} every effect, parameter and table", f"add {keep}--details")


@define_command
@click.argument("robot", required=False)
@OPTIONAL_DATA_ARGUMENT
@ROWS_IN_ORDER_OPTION
@JSON_OPTION
def effects_command(robot: str | None, data: Path | None, in_rows: bool, as_json: bool) -> int:
    """The library of effects; with ROBOT and DATA, where these measurements can test them."""
    scene = None
    if robot is not None:
        if data is None:
            raise OptionError("effects needs both ROBOT and DATA, or neither")
        given = add_history_columns(read_measured_points([data], in_rows))
        fit = calibrate(robot, given, objective="sum", holdout=0.0)
        scene = fit.cell.pose_arm(given)
    entries = list_effects(scene)
    return print_json_or_tables(
        as_json, {"schema": 1, "effects": entries}, build_effects_table(entries)
    )
