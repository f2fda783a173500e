"""What the commands share: options, arguments, and how results reach the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from minimax_cal.ground.files import check_writable, write_whole
from minimax_cal.ground.tables import Table
from minimax_cal.solvers.status import Status

FAILED, MISUSED = 1, 2  # exit codes of the contract
WIDTH = 110  # of text that goes to no terminal

ROBOT = click.argument("robot")
DATA = click.argument("data", type=click.Path(path_type=Path))
JSON = click.option(
    "--json", "as_json", is_flag=True, help="Print JSON and nothing else on stdout."
)
QUIET = click.option("--quiet", "-q", is_flag=True, help="No notices and no progress on stderr.")
HOLDOUT = click.option(
    "--holdout",
    type=float,
    default=0.2,
    show_default=True,
    help="Share of the poses kept out of the fit; a split column overrides it.",
)
SEED = click.option(
    "--seed",
    type=int,
    default=0,
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


def names_of(texts: Sequence[str]) -> tuple[str, ...]:
    """Names separated by commas, from an option that may be given several times."""
    return tuple(name.strip() for text in texts for name in text.split(",") if name.strip())


def terminal() -> Console:
    """Stdout, as wide as the terminal, or 110 columns elsewhere."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDTH)


def show(*tables: Table) -> None:
    """Print tables on stdout."""
    console = terminal()
    for table in tables:
        console.print(table.rich())


def writable(*paths: Path | None, kinds: tuple[str, ...] = ()) -> None:
    """Raise an error, before any work, for an output that cannot be written."""
    for path in paths:
        if path:
            check_writable(path, kinds)


@contextmanager
def stages(*, quiet: bool) -> Iterator[Callable[[str], None]]:
    """To be told of each stage of long work, which a terminal shows on stderr."""
    with Console(stderr=True, quiet=quiet, highlight=False).status("reading") as status:
        yield status.update


def notify(notices: Iterable[str], *, quiet: bool) -> None:
    """Print notices on stderr, one a line."""
    for text in notices:
        notice(text, quiet=quiet)


def notice(text: str, *, quiet: bool) -> None:
    """Print one notice on stderr."""
    if not quiet:
        click.echo(f"notice: {text}", err=True)


def deliver(text: str, output: Path | None, *, as_json: bool) -> bool:
    """Write the JSON of a result where it was asked for; whether people want to read it too."""
    if output:
        write_whole(output, text)
    if as_json:
        click.echo(text, nl=False)
    return not as_json


def exit_code(status: Status) -> int:
    """Of how the numbers ended, with a line of error where they did not work out."""
    if status is Status.CONVERGED:
        return 0
    click.echo(f"error: {status}: {status.advice}", err=True)
    return FAILED
