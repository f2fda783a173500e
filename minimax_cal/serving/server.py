"""The server of the page: on this machine alone, until it is stopped."""

from __future__ import annotations

import secrets
import socket
import sys
from collections.abc import Callable
from pathlib import Path

from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import made_folder
from minimax_cal.ground.optional import optional
from minimax_cal.reporting.html.page import needed

HOST = "127.0.0.1"
PORT = 8321  # the usual one; another where it is taken
FOLDER = "minimax-cal-sessions"
EXTRA = "minimax-cal[app]"


def serve(folder: Path, port: int | None, ready: Callable[[str], object]) -> None:
    """Serve the sessions of a folder until Ctrl-C.

    port: None for the usual one, or any that is free.  ready: called with the page's address, once
    that can be opened.  Raises CalibrationError.
    """
    uvicorn = optional("uvicorn", "the page", EXTRA)
    optional("starlette", "the page", EXTRA)
    needed()
    from minimax_cal.serving.guard import Door, Guard
    from minimax_cal.serving.routes import application

    root = made_folder(folder).resolve()
    listener = listening(port)
    door = Door(listener.getsockname()[1], secrets.token_urlsafe(24))
    config = uvicorn.Config(
        Guard(application(root), door), log_level="error", access_log=False, server_header=False,
        date_header=False, proxy_headers=False, ws="none", timeout_graceful_shutdown=2,
    )  # fmt: skip
    ready(door.url)
    with listener:
        uvicorn.Server(config).run(sockets=[listener])


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
