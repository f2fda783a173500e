"""The command `minimax-cal calibrate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.robust import LOSSES, SQUARE
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text
from minimax_cal.judging.bootstrap import Bootstrap, bootstrap
from minimax_cal.reporting.plots.figures import PICTURES, save_errors
from minimax_cal.robots.kinematics import MDH_NAMES
from minimax_cal.solvers.least_squares import METHODS

DEFAULTS = Options()
UNITS = {"mm": 1e-3, "um": 1e-6, "m": 1.0, "mrad": 1e-3, "rad": 1.0, "deg": 0.017453292519943295}
LENGTHS = ("mm", "um", "m")


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


@click.command(name="calibrate")
@options.ROBOT
@options.DATA
@click.option(
    "--objective",
    default=DEFAULTS.objective,
    show_default=True,
    help="sum, minimax (worst target), point (worst point), pose, or one target: smr:K.",
)
@click.option("--qp", default=DEFAULTS.qp, show_default=True, help="QP backend of minimax.")
@options.HOLDOUT
@options.SEED
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
    "--loss",
    default=DEFAULTS.loss,
    show_default=True,
    help="Of the distances, against outliers: " + ", ".join((SQUARE, *LOSSES)) + ".",
)
@click.option(
    "--trim",
    type=float,
    default=DEFAULTS.trim,
    show_default=True,
    metavar="SHARE",
    help="Set at most this share of the points aside: those that stand out.",
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
@click.option(
    "--bootstrap",
    "replicates",
    type=int,
    metavar="N",
    help="Calibrate N times more, on poses drawn anew, for intervals by percentiles (500 serve).",
)
@options.figure_option("the errors before and after")
@options.JSON
@options.output("the result (JSON)")
@options.QUIET
def calibrate_command(
    robot: str,
    data: Path,
    prior: Sequence[str],
    fix: Sequence[str],
    free: Sequence[str],
    effects: Sequence[str],
    lever: float | None,
    replicates: int | None,
    distance_tolerance: float | None,
    figure: Path | None,
    as_json: bool,
    output: Path | None,
    quiet: bool,
    **choices: Any,
) -> int:
    """Calibrate ROBOT (a file or a built-in name) from the measurements in DATA."""
    options.writable(output)
    options.writable(figure, kinds=PICTURES)
    with options.stages(quiet=quiet) as progress:
        fit = calibrate(
            robot,
            data,
            fix=options.names_of(fix),
            free=options.names_of(free),
            effects=options.names_of(effects),
            priors=dict(map(prior_of, prior)),
            distance_tolerance=None if distance_tolerance is None else distance_tolerance * 1e-3,
            lever=None if lever is None else lever * 1e-3,
            progress=progress,
            **choices,
        )
        drawn = (
            [] if replicates is None else [bootstrap(fit, replicates, choices["seed"], progress)]
        )
    options.notify(fit.notices, quiet=quiet)
    if figure:
        save_errors(fit, figure)
    text = text_of(fit, drawn) if output or as_json else ""
    if options.deliver(text, output, as_json=as_json):
        options.show(*fit.tables(), *(found.table() for found in drawn))
        click.echo(f"\n{fit.headline()}")
    return options.exit_code(fit.status)


def text_of(fit: Fit, drawn: Sequence[Bootstrap]) -> str:
    """The JSON of a calibration, with its bootstrap where there was one."""
    content = fit.to_dict()
    for found in drawn:
        content["bootstrap"] = found.to_dict()
    return json_text(content)
