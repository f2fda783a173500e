"""The command `minimax-cal simulate`."""

from __future__ import annotations

from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_text, write_whole
from minimax_cal.measuring.measurements import write_measurements
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.robot import load_robot

TRUTH = Truth()


@click.command(name="simulate")
@options.ROBOT
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
@options.output("the measurements (CSV)")
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
    options.writable(output, truth_path)
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
