"""The command `plan`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from minimax_cal.cli import options
from minimax_cal.cli.plan_options import keywords_of
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import write_whole
from minimax_cal.planning.options import EFFORTS, PlanOptions
from minimax_cal.planning.plan import plan
from minimax_cal.planning.prospect import Instrument
from minimax_cal.planning.result import MEANINGS
from minimax_cal.planning.stops import ANGLES
from minimax_cal.planning.task import CRITERIA
from minimax_cal.planning.visibility import NORMALS
from minimax_cal.reporting.plots.figures import PICTURES
from minimax_cal.reporting.plots.plan import save_plan
from minimax_cal.robots.robot import load_robot

DEFAULTS, NOISE = PlanOptions(), Instrument()
PATH = click.Path(path_type=Path)


@click.command(name="plan")
@options.ROBOT
@click.option("--poses", type=int, required=True, metavar="N", help="How many to measure.")
@click.option("--fit", type=PATH, help="Calibration (JSON): robot, base, targets, its poses.")
@click.option("--data", type=PATH, help="Measurements at hand (CSV); they count as known.")
@click.option(
    "--criterion",
    default=DEFAULTS.criterion,
    show_default=True,
    help="; ".join(f"{name}: {MEANINGS[name]}" for name in CRITERIA) + ".",
)
@click.option(
    "--effects",
    multiple=True,
    metavar="NAME:PLACE",
    help="Fitted too, as with `calibrate --effects`; unknown until then.",
)
@click.option(
    "--separate",
    nargs=2,
    metavar="EFFECT RIVAL",
    help="Instead: poses that tell two effects apart, as joint_compliance:J2 link_bending:L2.",
)
@click.option(
    "--tracker",
    metavar="X,Y,Z",
    help="Where it stands, in base axes, mm [default: 3 m before the arm].",
)
@click.option(
    "--targets",
    type=int,
    default=DEFAULTS.targets,
    show_default=True,
    help="Reflectors on a circle of 100 mm radius about the flange's axis.",
)
@click.option(
    "--target",
    "spots",
    multiple=True,
    metavar="X,Y,Z",
    help="A reflector in the flange's frame, mm; once for each.",
)
@click.option(
    "--normals",
    default=DEFAULTS.normals,
    show_default=True,
    help=f"Where reflectors look: {' or '.join(NORMALS)}.",
)
@click.option(
    "--acceptance",
    type=float,
    default=30.0,
    show_default=True,
    metavar="DEG",
    help="Half angle of a reflector's cone; 180: seen from anywhere.",
)
@click.option("--all-targets", "whole", is_flag=True, help="Only poses at which all are seen.")
@click.option(
    "--range",
    "reach",
    default="0.5:50",
    show_default=True,
    metavar="LOW:HIGH",
    help="Of the tracker, m.",
)
@click.option(
    "--elevation",
    default="-50:75",
    show_default=True,
    metavar="LOW:HIGH",
    help="Of the tracker, deg.",
)
@click.option(
    "--joint",
    "joints",
    multiple=True,
    metavar="J2=LOW:HIGH",
    help="Narrow a joint's limits, deg (slides: mm).",
)
@click.option(
    "--volume",
    metavar="X0:X1,Y0:Y1,Z0:Z1",
    help="Box in base axes that the flange must stay in, mm.",
)
@click.option(
    "--floor",
    type=float,
    default=0.0,
    show_default=True,
    metavar="MM",
    help="Height of the floor above the base's origin.",
)
@click.option(
    "--body",
    type=float,
    metavar="MM",
    help="Radius of the arm's links [default: 4 % of its reach].",
)
@click.option(
    "--noise",
    type=float,
    metavar="UM",
    help=f"Of a coordinate [default: as the data show it, else {1e6 * NOISE.noise:g}].",
)
@click.option(
    "--noise-per-metre",
    "per_metre",
    type=float,
    metavar="UM/M",
    help=f"Its growth with range [default: {1e6 * NOISE.per_metre:g}].",
)
@click.option(
    "--jitter",
    type=float,
    metavar="URAD",
    help=f"Of a joint that stops [default: as the data show it, else {1e6 * NOISE.jitter:g}].",
)
@click.option(
    "--revisit",
    type=int,
    default=0,
    show_default=True,
    metavar="K",
    help="Go back to so many of the poses.",
)
@click.option(
    "--approach",
    default=DEFAULTS.approach,
    show_default=True,
    help=f"{' or '.join(EFFORTS)}: come to a revisited pose from its other side.",
)
@click.option("--candidates", type=int, default=DEFAULTS.candidates, show_default=True)
@click.option("--seed", type=int, default=0, show_default=True, help="Of candidates and starts.")
@click.option(
    "--unit",
    default="deg",
    show_default=True,
    help=f"Of joints in the file: {' or '.join(ANGLES)}.",
)
@options.figure_option("the poses and how accuracy grows with their number")
@options.JSON
@options.output("the poses (CSV)")
@options.QUIET
def plan_command(
    robot: str,
    unit: str,
    figure: Path | None,
    as_json: bool,
    output: Path | None,
    quiet: bool,
    **given: Any,
) -> int:
    """Which poses of ROBOT to measure next, in which order, and how accurate they will make it."""
    options.writable(output)
    options.writable(figure, kinds=PICTURES)
    if unit not in ANGLES:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
    arm = load_robot(robot)
    with options.stages(quiet=quiet) as progress:
        found = plan(arm, progress=progress, **keywords_of(given, arm))
    options.notify(found.notices, quiet=quiet)
    if output:
        write_whole(output, found.csv(unit))
    if figure:
        save_plan(found, figure)
    if as_json:
        click.echo(found.json(), nl=False)
        return 0
    options.terminal().print(found.headline() + "\n", markup=False)
    options.show(*found.tables(), *(() if output else (found.pose_table(unit),)))
    return 0
