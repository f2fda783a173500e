"""The command `minimax-cal calibrate`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minimax_cal.cli.options import (
    OPTIONAL_DATA_ARGUMENTS,
    ROBOT_ARGUMENT,
    ROWS_IN_ORDER_OPTION,
    CommandOutput,
    SuggestedCommand,
    build_result_options,
    define_command,
    flag_option,
    group_option,
    options_from_dataclass,
    options_given_on_command_line,
    read_any_measurements,
    refuse_given_options,
    run_on_any_instruments,
    split_camera_files,
)
from minimax_cal.core.files import convert_to_plain_json, format_json
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.multi_instrument.options import RelativeOptions
from minimax_cal.fitting.opened_results import read_effect_list
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.pixels.options import (
    CAMERA_OPTION_NAMES,
    PIXEL_OPTION_NAMES,
    PixelFiles,
    PixelOptions,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.reporting.plots.error_figure import save_errors
from minimax_cal.robots.kernels.kernel_choice import use_numpy_kernels_for_brief_work
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:
    from minimax_cal.validation.bootstrap import Bootstrap

CALIBRATION_OPTION_NAMES = {f.name for kind in (Options, RelativeOptions) for f in fields(kind)}
MAX_POSES_WITHOUT_KERNELS = 1000  # poses that one fit needs no compiled kernels for


@define_command
@ROBOT_ARGUMENT
@OPTIONAL_DATA_ARGUMENTS
@options_from_dataclass(Options)
@options_from_dataclass(RelativeOptions, "offset", "known_distances", "noises")
@options_from_dataclass(PixelFiles)
@options_from_dataclass(PixelOptions, *CAMERA_OPTION_NAMES)
@ROWS_IN_ORDER_OPTION
@group_option(
    "What is known",
    "--bootstrap",
    "replicates",
    type=int,
    metavar="N",
    help="Calibrate N resampled sets of poses for bootstrap intervals (500 are enough).",
)
@flag_option(
    "--no-poses",
    "without",
    help="Leave the poses out of the JSON, which of very many poses are nearly all of it.",
)
@build_result_options(
    "the result (JSON)", suggested_file_name="fit.json", drawn_content="the errors before and after"
)
def calibrate_command(
    robot: str,
    data: tuple[Path, ...],
    replicates: int | None,
    in_rows: bool,
    without: bool,
    to: CommandOutput,
    **chosen: Any,
) -> int:
    """Calibrate ROBOT from the measurements in DATA.

    ROBOT is a file or a built-in name.  DATA has joint columns, and the points of a tracker
    (smr1_x_mm ...), or those of another instrument: wire1_mm ... (lengths from unknown fixed points
    to a target on the flange); socket (rows with the same label held the flange's ball in the same
    socket); surface with kind, plane or sphere (what a probe's ball touched; where known radius_mm,
    ball_radius_mm, and normal_x, normal_y, normal_z, offset_mm of a body's faces); flange_x_mm,
    flange_y_mm, flange_z_mm with flange_rx_rad ... or flange_qw ... (whole poses).

    Files of several instruments are one fit: all share the arm, each counts by its own noise.  What
    cameras saw is given with --pixels, --joints and --camera, alone or beside DATA.
    """
    files, rest = split_camera_files(data, chosen)
    to.print_notices(*warn_of_unconfirmed_diagnoses(chosen["effects"]))
    if not rest and "effects" not in options_given_on_command_line():
        return calibrate_from_cameras(robot, files, to, chosen)
    asked = {name: chosen[name] for name in chosen if name in CALIBRATION_OPTION_NAMES}
    given = read_any_measurements(rest, in_rows, to) if rest else []
    if files.is_given or not isinstance(given, Measurements):
        refuse_given_options(("replicates", "in_rows", "without"), "is for points of a tracker")
        refuse_given_options({"drawn_prior"}, "is for pixels alone, without effects")
        if asked["objective"] != "sum":
            what = "is for points of a tracker, or pixels alone; minimax-cal relative has one, too"
            refuse_given_options(("objective",), what)
        every = given if isinstance(given, list) else [given]
        return run_on_any_instruments(calibrate, robot, every, files, to, asked)
    with (
        use_numpy_kernels_for_brief_work(
            brief=replicates is None and given.poses <= MAX_POSES_WITHOUT_KERNELS
        ),
        to.open_stage_callback() as progress,
    ):
        fit = calibrate(robot, given, progress=progress, **asked)
        more: dict[str, Bootstrap] = {}
        if replicates is not None:
            from minimax_cal.validation.bootstrap import bootstrap

            more["bootstrap"] = bootstrap(fit, replicates, asked["seed"], progress)
    return to.write_and_print_result(
        fit,
        status=fit.status,
        reason=fit.reason,
        json=lambda: format_json(fit.to_dict(poses=not without) | convert_to_plain_json(more)),
        sentences=(*fit.sentences(), *[fit.describe_solution()] * to.details),
        more=[found.table() for found in more.values()],
        advice=suggest_next_commands(fit, robot, data, to.output),
        draw=save_errors,
    )


def calibrate_from_cameras(
    robot: str, files: PixelFiles, output: CommandOutput, option_values: dict[str, Any]
) -> int:
    """Calibrate from pixels.  Raises OptionError for what they do not know."""
    from minimax_cal.fitting.pixels.calibrate import calibrate_pixels

    refuse_given_options(
        {*option_values, "replicates", "in_rows", "without"} - {*PIXEL_OPTION_NAMES},
        "is not for pixels",
    )
    own = {
        name: option_values[name]
        for name in options_given_on_command_line() & {*PIXEL_OPTION_NAMES}
    }
    fit = output.call_with_progress(calibrate_pixels, robot, *files.paths(), **own)
    return output.write_and_print_result(fit, status=fit.status, reason=fit.reason)


def warn_of_unconfirmed_diagnoses(effects: Sequence[str]) -> Iterator[str]:
    """What is said of diagnoses among `--effects` that confirm nothing."""
    for name in effects:
        if name.endswith(".json") and not read_effect_list(name):
            yield f"{name}: the diagnosis confirms no effect; nothing of it is fitted"


def suggest_next_commands(
    fit: Fit, robot: str, data: tuple[Path, ...], written_path: Path | None
) -> Iterator[SuggestedCommand]:
    """What to do next, and its command.  written_path: where the result went."""
    from minimax_cal.robots.urdf_robot import (
        is_urdf_or_mjcf_source,
        is_urdf_source,
        split_file_and_link_names,
    )  # not before it has calibrated

    has_effects = fit.cell.effects.terms or "effects" in options_given_on_command_line()
    if not has_effects and not fit.status.keeps_drawn:
        left = f"{fit.within.after.rms_mm:.3f} mm"
        diagnose = f"minimax-cal diagnose {robot} {' '.join(map(str, data))}"
        yield SuggestedCommand(f"Next, to find the cause of the remaining {left}", diagnose)
    if written_path and fit.status is Status.CONVERGED:
        part = " (prints which effects the file contains, and its accuracy)"
        alone = part if fit.cell.effects.terms else " by geometry alone"
        correct = f"minimax-cal compensate {written_path} targets.csv -o corrected.csv"
        yield SuggestedCommand(
            f"To correct joint targets, or a program, for the controller{alone}", correct
        )
        write, file = "To write a file for MuJoCo, or --to urdf, dh-csv and others", "--to mjcf"
        out = "arm.xml"
        if is_urdf_or_mjcf_source(robot):
            name, tip = split_file_and_link_names(robot)
            kind = "urdf" if is_urdf_source(robot) else "mjcf"
            write, out = f"To correct a copy of {name}", f"calibrated{Path(name).suffix}"
            file = f"--to {kind} --{kind} {name}" + f" --tip {tip}" * bool(tip)
        yield SuggestedCommand(
            f"{write}{alone}", f"minimax-cal export {written_path} {file} -o {out}"
        )
        yield SuggestedCommand("To see every parameter and table", "add --details")
    else:
        yield SuggestedCommand(
            "To keep the result, and to see every table", "add -o fit.json --details"
        )
