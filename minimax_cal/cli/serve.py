"""The command `minimax-cal serve`."""

from __future__ import annotations

import webbrowser
from contextlib import ExitStack
from pathlib import Path

import click

from minimax_cal.cli.options import PATH_TYPE, define_command, flag_option
from minimax_cal.webapp.page_server import (
    DEFAULT_PORT,
    DEFAULT_SESSIONS_FOLDER,
    serve_sessions,
    temporary_redirect_page,
)


@define_command
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    metavar="N",
    help=(
        f"Where the page is; 0 for any that is free [default: {DEFAULT_PORT}, or any that is free]."
    ),
)
@click.option(
    "--folder",
    type=PATH_TYPE,
    default=DEFAULT_SESSIONS_FOLDER,
    show_default=True,
    help="Where the sessions are kept, a folder of plain files each.",
)
@flag_option("--no-browser", help="Print the address and open no browser.")
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
                webbrowser.open(files.enter_context(temporary_redirect_page(folder, url)).as_uri())

        try:
            serve_sessions(folder, port, ready)
        except KeyboardInterrupt:
            click.echo("ended; the sessions stay where they are", err=True)
    return 0
