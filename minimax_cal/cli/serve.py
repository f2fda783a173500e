"""The command `minimax-cal serve`."""

from __future__ import annotations

import webbrowser
from contextlib import ExitStack
from pathlib import Path

import click

from minimax_cal.cli.options import PATH, command, flag
from minimax_cal.serving.server import FOLDER, PORT, redirecting, serve


@command
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    metavar="N",
    help=f"Where the page is; 0 for any that is free [default: {PORT}, or any that is free].",
)
@click.option(
    "--folder",
    type=PATH,
    default=FOLDER,
    show_default=True,
    help="Where the sessions are kept, a folder of plain files each.",
)
@flag("--no-browser", help="Print the address and open no browser.")
def serve_command(port: int | None, folder: Path, no_browser: bool) -> int:
    """A page in the browser: drop files, fit, diagnose, judge, plan.

    The command prints one address, with a token that opens the page.  Only this machine can reach
    it, nothing leaves the machine, and each click shows the command line that does the same.
    Ctrl-C ends it.
    """
    with ExitStack() as files:

        def ready(url: str) -> None:
            click.echo(url)
            click.echo(f"sessions are kept in {folder}; Ctrl-C ends the page", err=True)
            if not no_browser:
                webbrowser.open(files.enter_context(redirecting(folder, url)).as_uri())

        try:
            serve(folder, port, ready)
        except KeyboardInterrupt:
            click.echo("ended; the sessions stay where they are", err=True)
    return 0
