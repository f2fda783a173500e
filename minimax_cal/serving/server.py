"""The server of the page: on this machine alone, until it is stopped."""

from __future__ import annotations

import os
import secrets
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any

from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import made_folder
from minimax_cal.ground.optional import optional
from minimax_cal.reporting.html.page import needed

HOST = "127.0.0.1"
PORT = 8321  # the usual one; another where it is taken
FOLDER = "minimax-cal-sessions"
PRIVATE = 0o077  # what others may not do with new files and folders
EXTRA = "minimax-cal[app]"

REDIRECT = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>minimax-cal</title>
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={url}"></head>
<body><p><a href="{url}">Open the page</a></p></body></html>
"""


def serve(folder: Path, port: int | None, ready: Callable[[str], object]) -> None:
    """Serve the sessions of a folder until Ctrl-C.

    port: None for the usual one, or any that is free.  ready: called with the page's address, once
    that can be opened.  Raises CalibrationError.
    """
    uvicorn = optional("uvicorn", "the page", EXTRA)
    optional("starlette", "the page", EXTRA)
    needed()
    before = os.umask(PRIVATE)  # of this process and of the commands that it starts
    try:
        serve_privately(uvicorn, folder, port, ready)
    finally:
        os.umask(before)


def serve_privately(
    uvicorn: Any, folder: Path, port: int | None, ready: Callable[[str], object]
) -> None:
    """As `serve`, once all is there that it needs."""
    from minimax_cal.serving.connection import BoundedConnection
    from minimax_cal.serving.guard import Door, Guard
    from minimax_cal.serving.routes import application
    from minimax_cal.serving.sessions import remove_parts

    with listening(port) as listener:  # before the folder: a port in use leaves none behind
        root = made_folder(folder).resolve()
        remove_parts(root)
        door = Door(listener.getsockname()[1], secrets.token_urlsafe(24))
        config = uvicorn.Config(
            Guard(application(root), door), http=BoundedConnection, log_level="error",
            access_log=False, server_header=False, date_header=False, proxy_headers=False,
            ws="none", timeout_graceful_shutdown=2,
        )  # fmt: skip
        ready(door.url)
        uvicorn.Server(config).run(sockets=[listener])


@contextmanager
def redirecting(folder: Path, url: str) -> Iterator[Path]:
    """A private page that leads to an address, for a browser to open; removed in the end.

    Command lines can be read by all who share this machine, so that of the browser holds the path
    of this file and not the token.  In the sessions' folder, since a browser in a sandbox may see
    neither hidden folders nor those of temporary files.
    """
    handle, name = tempfile.mkstemp(prefix="open-", suffix=".html", dir=folder)  # 0600
    path = Path(name).resolve()
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(REDIRECT.format(url=escape(url)))
        yield path
    finally:
        path.unlink(missing_ok=True)


def listening(port: int | None) -> socket.socket:
    """A socket on this machine alone.  Raises OptionError for a port that is not free."""
    for each in (PORT, 0) if port is None else (port,):
        found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        if sys.platform != "win32":  # there it would let two servers share a port
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            found.bind((HOST, each))
            found.listen(64)
        except OSError as error:
            found.close()
            reason = error.strerror
        else:
            return found
    raise OptionError(f"port={port}: cannot be had ({reason}); choose another")
