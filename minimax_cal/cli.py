"""The command line: wiring only."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console

import qp_backends
from minimax_cal import gates
from minimax_cal.calibrate import POOR_FIT, Options, calibrate
from minimax_cal.cell import evaluate, load_cell
from minimax_cal.compensate_command import compensate_command
from minimax_cal.data import read_measurements, write_measurements
from minimax_cal.diagnose import diagnose
from minimax_cal.errors import CalibrationError, OptionError
from minimax_cal.export_command import export_command
from minimax_cal.figures import PICTURES, save_errors
from minimax_cal.files import check_writable, json_text, write_whole
from minimax_cal.history import with_history
from minimax_cal.import_command import import_command
from minimax_cal.kinematics import MDH_NAMES
from minimax_cal.pictures import save_diagnosis
from minimax_cal.robot import builtin_robots, load_robot
from minimax_cal.sheets import closing_tables, effects_list, effects_table, where_tables
from minimax_cal.simulate import Truth, simulate
from minimax_cal.solvers.least_squares import METHODS
from minimax_cal.solvers.status import Status
from minimax_cal.tables import Table

DEFAULTS, TRUTH = Options(), Truth()
UNITS = {"mm": 1e-3, "um": 1e-6, "m": 1.0, "mrad": 1e-3, "rad": 1.0, "deg": 0.017453292519943295}
LENGTHS = ("mm", "um", "m")
FAILED, MISUSED = 1, 2  # exit codes of the contract


def prior_of(text: str) -> tuple[str, float]:
    """NAME=SIGMA with its unit, as ``a*=0.5mm`` or ``theta2=1mrad``."""
    name, equals, size = text.partition("=")
    kind = name.rstrip("0123456789*")
    for unit in sorted(UNITS, key=len, reverse=True):
        if size.endswith(unit) and kind in MDH_NAMES and (kind in "ad") != (unit in LENGTHS):
            what = "a length: give mm" if kind in "ad" else "an angle: give mrad or deg"
            raise OptionError(f"--prior {text!r}: {name} is {what}")
        if equals and name and size.endswith(unit):
            try:
                return name, float(size.removesuffix(unit)) * UNITS[unit]
            except ValueError:
                break
    raise OptionError(
        f"--prior {text!r}: write NAME=SIGMA with a unit, as a*=0.5mm or theta2=1mrad"
    )


def names_of(texts: Sequence[str]) -> tuple[str, ...]:
    """Names separated by commas, from an option that may be given several times."""
    return tuple(name.strip() for text in texts for name in text.split(",") if name.strip())


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="minimax-cal", prog_name="minimax-cal")
def cli() -> None:
    """Calibrate robot arms, and tell why a calibrated arm still misses."""


ROBOT = click.argument("robot")
DATA = click.argument("data", type=click.Path(path_type=Path))
JSON = click.option(
    "--json", "as_json", is_flag=True, help="Print JSON and nothing else on stdout."
)
QUIET = click.option("--quiet", "-q", is_flag=True, help="No notices and no progress on stderr.")
HOLDOUT = click.option(
    "--holdout",
    type=float,
    default=DEFAULTS.holdout,
    show_default=True,
    help="Share of the poses kept out of the fit; a split column overrides it.",
)
SEED = click.option(
    "--seed",
    type=int,
    default=DEFAULTS.seed,
    show_default=True,
    help="Seed of the choice of held-out poses.",
)


def figure_option(what: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The option --figure."""
    return click.option(
        "--figure",
        type=click.Path(path_type=Path),
        help=f"Draw {what} to this PNG, SVG or PDF.",
    )


def output(what: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The option -o."""
    return click.option(
        "-o", "--output", type=click.Path(path_type=Path), help=f"Write {what} to this file."
    )


@cli.command(name="calibrate")
@ROBOT
@DATA
@click.option(
    "--objective",
    default=DEFAULTS.objective,
    show_default=True,
    help="sum, minimax (worst target), point (worst point), pose, or one target: smr:K.",
)
@click.option("--qp", default=DEFAULTS.qp, show_default=True, help="QP backend of minimax.")
@HOLDOUT
@SEED
@click.option("--fix", multiple=True, help="Parameters to keep nominal, as d2,beta*.")
@click.option("--free", multiple=True, help="Parameters to prefer among redundant ones.")
@click.option(
    "--prior",
    multiple=True,
    metavar="NAME=SIGMA",
    help="Known tolerance of a parameter about its nominal value, as a*=0.5mm.",
)
@click.option(
    "--effects",
    multiple=True,
    metavar="NAME:PLACE",
    help="Fit these too, as joint_compliance:all,backlash:J6; `minimax-cal effects` lists them.",
)
@click.option(
    "--method",
    default=DEFAULTS.method,
    show_default=True,
    help="Least squares: " + ", ".join(METHODS) + ".",
)
@click.option(
    "--hessian",
    default=DEFAULTS.hessian,
    show_default=True,
    help="Of the minimax SQP: gauss-newton or bfgs.",
)
@click.option(
    "--distance",
    default=DEFAULTS.distance,
    show_default=True,
    help="Form of the distance constraints: two-sided, squared or off.",
)
@click.option(
    "--lever",
    type=float,
    metavar="MM",
    help="What a radian counts as in the pose objective [default: the targets' own].",
)
@click.option(
    "--distance-tolerance",
    type=float,
    metavar="MM",
    help="How far a distance between targets may be off [default: as measured].",
)
@figure_option("the errors before and after")
@JSON
@output("the result (JSON)")
@QUIET
def calibrate_command(
    robot: str,
    data: Path,
    prior: Sequence[str],
    fix: Sequence[str],
    free: Sequence[str],
    effects: Sequence[str],
    lever: float | None,
    distance_tolerance: float | None,
    figure: Path | None,
    as_json: bool,
    output: Path | None,
    quiet: bool,
    **choices: Any,
) -> int:
    """Calibrate ROBOT (a file or a built-in name) from the measurements in DATA."""
    if output:
        check_writable(output)
    if figure:
        check_writable(figure, PICTURES)
    notes = Console(stderr=True, quiet=quiet, highlight=False)
    millimetres = float("nan") if distance_tolerance is None else distance_tolerance
    with notes.status("reading") as status:
        fit = calibrate(
            robot,
            data,
            fix=names_of(fix),
            free=names_of(free),
            effects=names_of(effects),
            priors=dict(map(prior_of, prior)),
            distance_tolerance=millimetres * 1e-3,
            lever=float("nan") if lever is None else lever * 1e-3,
            report=status.update,
            **choices,
        )
    for notice in fit.notices:
        notes.print(f"notice: {notice}", markup=False, soft_wrap=True)
    if output:
        fit.save(output)
    if figure:
        save_errors(fit, figure)
    if as_json:
        click.echo(fit.json(), nl=False)
    else:
        show(*fit.tables())
        click.echo(f"\n{fit.headline()}")
    if fit.status is not Status.CONVERGED:
        click.echo(f"error: {fit.status}: {fit.status.advice}", err=True)
        return FAILED
    return 0


@cli.command(name="diagnose")
@ROBOT
@DATA
@HOLDOUT
@SEED
@click.option(
    "--without",
    multiple=True,
    metavar="EFFECT",
    help="Do not consider this effect; `minimax-cal effects` lists them.",
)
@figure_option("the gap and where it lies")
@JSON
@output("the diagnosis (JSON)")
@QUIET
def diagnose_command(
    robot: str,
    data: Path,
    holdout: float,
    seed: int,
    without: Sequence[str],
    figure: Path | None,
    as_json: bool,
    output: Path | None,
    quiet: bool,
) -> int:
    """Say why ROBOT still misses once calibrated, as far as the measurements in DATA can tell."""
    if output:
        check_writable(output)
    if figure:
        check_writable(figure, PICTURES)
    notes = Console(stderr=True, quiet=quiet, highlight=False)
    with notes.status("reading") as status:
        found = diagnose(
            robot,
            data,
            seed=seed,
            holdout=holdout,
            exclude=names_of(without),
            report=status.update,
        )
    for notice in found.notices:
        notes.print(f"notice: {notice}", markup=False, soft_wrap=True)
    if output:
        found.save(output)
    if figure:
        save_diagnosis(found, figure)
    if as_json:
        click.echo(found.json(), nl=False)
    else:
        terminal().print(found.headline() + "\n", markup=False)
        show(*found.tables(), *where_tables(found.where), *closing_tables(found))
    if found.status is not Status.CONVERGED:
        click.echo(f"error: {found.status}: {found.status.advice}", err=True)
        return FAILED
    return 0


@cli.command(name="effects")
@click.argument("robot", required=False)
@click.argument("data", type=click.Path(path_type=Path), required=False)
@JSON
def effects_command(robot: str | None, data: Path | None, as_json: bool) -> int:
    """The library of effects; with ROBOT and DATA, where these measurements can test them."""
    scene = None
    if robot is not None:
        if data is None:
            raise OptionError("effects needs both ROBOT and DATA, or neither")
        measured = with_history(read_measurements(data))
        fit = calibrate(robot, measured, objective="sum", holdout=0.0)
        scene = fit.cell.scene(measured)
    entries = effects_list(scene)
    if as_json:
        click.echo(json_text({"schema": 1, "effects": entries}), nl=False)
    else:
        show(effects_table(entries))
    return 0


@cli.command(name="evaluate")
@click.argument("fit", type=click.Path(path_type=Path))
@DATA
@JSON
@output("the accuracy (JSON)")
@QUIET
def evaluate_command(fit: Path, data: Path, as_json: bool, output: Path | None, quiet: bool) -> int:
    """Accuracy of a saved calibration FIT on the measurements in DATA; nothing is fitted."""
    if output:
        check_writable(output)
    cell, measured = load_cell(fit), read_measurements(data)
    found = evaluate(cell, measured)
    doubts = gates.outliers(measured, np.linalg.norm(cell.error(measured), axis=-1))
    if found.rms_mm > 1e3 * POOR_FIT * cell.robot.reach():
        doubts.append(
            f"{data}: the fit misses by {found.rms_mm:.3g} mm: check that data and fit belong to "
            "the same robot, measurement frame, units and order of targets"
        )
    for notice in () if quiet else (*measured.notices, *doubts):
        click.echo(f"notice: {notice}", err=True)
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
    if output:
        write_whole(output, text)
    if as_json:
        click.echo(text, nl=False)
    else:
        show(found.table(f"{cell.robot.name} on {data}", measured.targets))
    return 0


@cli.command(name="simulate")
@ROBOT
@click.option("--poses", type=int, default=100, show_default=True)
@click.option("--targets", type=int, default=3, show_default=True, help="Reflectors on the flange.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option(
    "--length-error",
    type=float,
    default=TRUTH.length * 1e3,
    show_default=True,
    metavar="MM",
    help="Standard deviation of the errors of a and d.",
)
@click.option(
    "--angle-error",
    type=float,
    default=TRUTH.angle * 1e3,
    show_default=True,
    metavar="MRAD",
    help="Standard deviation of the errors of theta, alpha, beta.",
)
@click.option(
    "--compliance",
    type=float,
    default=TRUTH.compliance * 1e6,
    show_default=True,
    metavar="URAD/NM",
    help="Turn of each joint under gravity's torque.",
)
@click.option(
    "--noise",
    type=float,
    default=TRUTH.noise * 1e6,
    show_default=True,
    metavar="UM",
    help="Standard deviation of a coordinate at the instrument.",
)
@click.option(
    "--noise-per-metre",
    type=float,
    default=TRUTH.noise_per_metre * 1e6,
    show_default=True,
    metavar="UM/M",
    help="Its growth with range.",
)
@click.option(
    "--truth",
    "truth_path",
    type=click.Path(path_type=Path),
    help="Write the true robot, base and targets to this file (JSON).",
)
@output("the measurements (CSV)")
def simulate_command(
    robot: str,
    poses: int,
    targets: int,
    seed: int,
    length_error: float,
    angle_error: float,
    compliance: float,
    noise: float,
    noise_per_metre: float,
    truth_path: Path | None,
    output: Path | None,
) -> int:
    """Measurements of an imperfect copy of ROBOT, from a tracker at a random place."""
    if output is None:
        raise OptionError("simulate needs -o FILE for the measurements")
    for path in (output, truth_path):
        if path:
            check_writable(path)
    truth = Truth(
        length_error * 1e-3,
        angle_error * 1e-3,
        compliance * 1e-6,
        noise * 1e-6,
        noise_per_metre * 1e-6,
    )
    made = simulate(load_robot(robot), poses, targets, seed, truth)
    write_measurements(output, made.data)
    if truth_path:
        write_whole(
            truth_path, json_text({"robot": made.cell.robot.to_dict(), **made.cell.to_dict()})
        )
    return 0


@cli.command(name="backends")
@JSON
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
@JSON
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


def terminal() -> Console:
    """Stdout, as wide as the terminal, or 110 columns elsewhere."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=110)


cli.add_command(compensate_command)
cli.add_command(export_command)
cli.add_command(import_command)


def show(*tables: Table) -> None:
    """Print tables on stdout."""
    console = terminal()
    for table in tables:
        console.print(table.rich())


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


if __name__ == "__main__":
    main()
