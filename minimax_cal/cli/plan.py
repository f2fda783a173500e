"""The command `plan`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from minimax_cal.cli import options
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
from minimax_cal.robots.robot import Robot, load_robot

DEFAULTS, NOISE = PlanOptions(), Instrument()
PATH = click.Path(path_type=Path)
JOINT = re.compile(r"[Jj]?(\d+)=(.+)")


def triple(text: str, option: str) -> tuple[float, ...]:
    """Three lengths in millimetres, in metres.  Raises OptionError."""
    parts = [number(part) for part in text.split(",")]
    if len(parts) != 3 or not np.isfinite(parts).all():
        raise OptionError(f"{option} {text!r}: give x,y,z in mm, as 3000,0,500")
    return tuple(1e-3 * part for part in parts)


def number(text: str) -> float:
    """A number, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def pair(text: str, option: str, scale: float) -> tuple[float, float]:
    """LOW:HIGH in SI.  Raises OptionError."""
    parts = [scale * number(part) for part in text.split(":")]
    if len(parts) != 2 or np.isnan(parts).any():
        raise OptionError(f"{option} {text!r}: give low:high, as 0.5:20")
    if not parts[0] < parts[1]:
        raise OptionError(f"{option} {text!r}: the limits are reversed; give low:high")
    return parts[0], parts[1]


def joint(text: str, robot: Robot) -> tuple[int, tuple[float, float]]:
    """J2=LOW:HIGH in degrees, slides in millimetres.  Raises OptionError."""
    match = JOINT.fullmatch(text)
    if not match:
        raise OptionError(f"--joint {text!r}: write J2=-30:60, in degrees (slides: mm)")
    index = int(match[1]) - 1
    if not 0 <= index < robot.joints:
        raise OptionError(f"--joint {text!r}: {robot.name} has joints 1 to {robot.joints}")
    scale = 1e-3 if robot.prismatic[index] else float(np.radians(1.0))
    return index, pair(match[2], f"--joint {text.partition('=')[0]}", scale)


def box(text: str) -> tuple[tuple[float, ...], ...]:
    """LOW:HIGH of x, y and z in millimetres, as corners in metres.  Raises OptionError."""
    axes = text.split(",")
    if len(axes) != 3:
        raise OptionError(f"--volume {text!r}: give x, y and z, as 700:1700,-500:500,300:1300")
    limits = [pair(axis, "--volume", 1e-3) for axis in axes]
    return tuple(low for low, _ in limits), tuple(high for _, high in limits)


def scaled(value: float | None, scale: float) -> float:
    """An option in SI, NaN where it was not given."""
    return float("nan") if value is None else scale * value


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
    poses: int,
    fit: Path | None,
    data: Path | None,
    criterion: str,
    effects: Sequence[str],
    separate: Sequence[str] | None,
    tracker: str | None,
    targets: int,
    spots: Sequence[str],
    normals: str,
    acceptance: float,
    whole: bool,
    reach: str,
    elevation: str,
    joints: Sequence[str],
    volume: str | None,
    floor: float,
    body: float | None,
    noise: float | None,
    noise_per_metre: float | None,
    jitter: float | None,
    revisit: int,
    approach: str,
    candidates: int,
    seed: int,
    unit: str,
    figure: Path | None,
    as_json: bool,
    output: Path | None,
    quiet: bool,
) -> int:
    """Which poses of ROBOT to measure next, in which order, and how accurate they will make it."""
    options.writable(output)
    options.writable(figure, kinds=PICTURES)
    if unit not in ANGLES:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
    arm = load_robot(robot)
    degree = float(np.radians(1.0))
    with options.stages(quiet=quiet) as progress:
        found = plan(
            arm,
            poses,
            fit=fit or "",
            data=data or "",
            progress=progress,
            criterion=criterion,
            effects=options.names_of(effects),
            separate=tuple(separate or ()),
            tracker=triple(tracker, "--tracker") if tracker else (),
            targets=targets,
            spots=tuple(triple(spot, "--target") for spot in spots),
            normals=normals,
            acceptance=acceptance * degree,
            whole=whole,
            reach=pair(reach, "--range", 1.0),
            elevation=pair(elevation, "--elevation", degree),
            joints=dict(joint(text, arm) for text in joints),
            volume=box(volume) if volume else (),
            floor=1e-3 * floor,
            body=scaled(body, 1e-3),
            noise=scaled(noise, 1e-6),
            per_metre=scaled(noise_per_metre, 1e-6),
            jitter=scaled(jitter, 1e-6),
            revisit=revisit,
            approach=approach,
            candidates=candidates,
            seed=seed,
        )
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
