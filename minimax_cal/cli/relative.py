"""The command `minimax-cal relative`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from minimax_cal.cli import options
from minimax_cal.fitting.instruments import RelativeOptions, relative
from minimax_cal.fitting.instruments.options import known_of
from minimax_cal.solvers.least_squares import METHODS

DEFAULTS = RelativeOptions()


@click.command(name="relative")
@options.ROBOT
@options.DATA
@options.HOLDOUT
@options.SEED
@click.option("--fix", multiple=True, help="Parameters to keep nominal, as d2,beta*.")
@click.option("--free", multiple=True, help="Parameters to prefer among redundant ones.")
@click.option(
    "--offset",
    is_flag=True,
    help="Lengths: fit a constant offset of each wire (weakly determined).",
)
@click.option(
    "--known-distance",
    multiple=True,
    metavar="A,B,MM",
    help="Closures: the distance between two sockets' centres; gives the scale.",
)
@click.option(
    "--lever",
    type=float,
    metavar="MM",
    help="Poses: what a radian counts as, linear over angular noise [default: of the columns "
    "u95_mm and rotation_u95_rad, else 100].",
)
@click.option(
    "--method",
    default=DEFAULTS.method,
    show_default=True,
    help="Least squares: " + ", ".join(METHODS) + ".",
)
@options.JSON
@options.output("the result (JSON)")
@options.QUIET
def relative_command(
    robot: str,
    data: Path,
    holdout: float,
    seed: int,
    fix: Sequence[str],
    free: Sequence[str],
    offset: bool,
    known_distance: Sequence[str],
    lever: float | None,
    method: str,
    as_json: bool,
    output: Path | None,
    quiet: bool,
) -> int:
    """Calibrate ROBOT without coordinates, from the lengths, closures or poses in DATA.

    DATA has joint columns and one of: wire1_mm ... (lengths from unknown fixed points to a target
    on the flange); socket (rows with the same label held the flange's ball in the same socket);
    flange_x_mm, flange_y_mm, flange_z_mm with flange_rx_rad ... or flange_qw ... (whole poses).
    """
    options.writable(output)
    with options.stages(quiet=quiet) as progress:
        fit = relative(
            robot,
            data,
            progress,
            holdout=holdout,
            seed=seed,
            fix=options.names_of(fix),
            free=options.names_of(free),
            offset=offset,
            known_distances=tuple(map(known_of, known_distance)),
            lever=None if lever is None else lever * 1e-3,
            method=method,
        )
    options.notify(fit.notices, quiet=quiet)
    if options.deliver(fit.json() if output or as_json else "", output, as_json=as_json):
        options.show(*fit.tables())
        click.echo(f"\n{fit.headline()}")
    return options.exit_code(fit.status)
