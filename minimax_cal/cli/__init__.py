"""The command line: wiring only."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

import qp_backends
from minimax_cal.cli import options
from minimax_cal.cli.calibrate import calibrate_command
from minimax_cal.cli.compensate import compensate_command
from minimax_cal.cli.diagnose import diagnose_command, effects_command
from minimax_cal.cli.export import export_command
from minimax_cal.cli.import_ import import_command
from minimax_cal.cli.iso9283 import iso9283_command
from minimax_cal.cli.map import map_command
from minimax_cal.cli.options import FAILED, MISUSED, show
from minimax_cal.cli.plan import plan_command
from minimax_cal.cli.relative import relative_command
from minimax_cal.cli.report import report_command
from minimax_cal.cli.simulate import simulate_command
from minimax_cal.cli.tradeoff import tradeoff_command
from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.files import json_text
from minimax_cal.ground.tables import Table
from minimax_cal.measuring import checks
from minimax_cal.measuring.measurements import read_measurements
from minimax_cal.modelling.cell import evaluate, load_cell
from minimax_cal.robots.robot import builtin_robots, load_robot

COMMANDS = (
    calibrate_command,
    diagnose_command,
    effects_command,
    simulate_command,
    compensate_command,
    export_command,
    import_command,
    iso9283_command,
    map_command,
    tradeoff_command,
    plan_command,
    relative_command,
    report_command,
)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="minimax-cal", prog_name="minimax-cal")
def cli() -> None:
    """Calibrate robot arms, and tell why a calibrated arm still misses."""


for command in COMMANDS:
    cli.add_command(command)


@cli.command(name="evaluate")
@click.argument("fit", type=click.Path(path_type=Path))
@options.DATA
@options.JSON
@options.output("the accuracy (JSON)")
@options.QUIET
def evaluate_command(fit: Path, data: Path, as_json: bool, output: Path | None, quiet: bool) -> int:
    """Accuracy of a saved calibration FIT on the measurements in DATA; nothing is fitted."""
    options.writable(output)
    cell, measured = load_cell(fit), read_measurements(data)
    found = evaluate(cell, measured)
    doubts = checks.outliers(measured, np.linalg.norm(cell.error(measured), axis=-1))
    if found.rms_mm > 1e3 * POOR_FIT * cell.robot.reach():
        doubts.append(
            f"{data}: the fit misses by {found.rms_mm:.3g} mm: check that data and fit belong to "
            "the same robot, measurement frame, units and order of targets"
        )
    options.notify((*measured.notices, *doubts), quiet=quiet)
    text = json_text(
        {
            "schema": 1,
            "kind": "evaluation",
            "fit": str(fit),
            "data": str(data),
            "data_sha256": measured.digest,
            "accuracy": found.to_dict(),
        }
    )
    if options.deliver(text, output, as_json=as_json):
        show(found.table(f"{cell.robot.name} on {data}", measured.target_names))
    return 0


@cli.command(name="backends")
@options.JSON
def backends_command(as_json: bool) -> int:
    """The QP backends that are installed, with their versions."""
    found = qp_backends.available()
    if as_json:
        click.echo(json_text({"schema": 1, "backends": found}), nl=False)
        return 0
    missing = [name for name in qp_backends.names() if name not in found]
    rows = (*found.items(), *((name, "not installed") for name in missing))
    show(Table("QP backends", ("name", "version"), tuple(rows)))
    return 0


@cli.command(name="robots")
@options.JSON
def robots_command(as_json: bool) -> int:
    """The robots that come with the package."""
    names = {name: load_robot(name) for name in builtin_robots()}
    if as_json:
        content = {name: robot.to_dict() for name, robot in names.items()}
        click.echo(json_text({"schema": 1, "robots": content}), nl=False)
        return 0
    rows = tuple((name, robot.name, robot.joints, robot.reach()) for name, robot in names.items())
    show(
        Table("built-in robots", ("name", "robot", "joints", "reach m"), rows, ("", "", "d", ".2f"))
    )
    return 0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every outcome is an exit code and at most one line of error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without the letter shows another
    try:
        code = cli.main(args=arguments, prog_name="minimax-cal", standalone_mode=False)
    except (CalibrationError, qp_backends.BackendError) as error:
        code = complain(str(error))
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        code = MISUSED
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        code = complain(error.format_message() + hint)
    except np.linalg.LinAlgError as error:
        code = complain(f"the numbers did not work out ({error}): more poses may help", FAILED)
    except (KeyboardInterrupt, click.Abort):
        code = complain("interrupted", 130)
    except OSError as error:
        code = complain(f"the output cannot be written ({error.strerror})", FAILED)
    sys.exit(code or 0)


def complain(message: str, code: int = MISUSED) -> int:
    """One line on stderr."""
    click.echo("error: " + " ".join(message.split()), err=True)
    return code
