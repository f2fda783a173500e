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

from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import create_folder
from minimax_cal.core.optional_packages import import_optional
from minimax_cal.reporting.html.html_page import import_report_packages

LOOPBACK_ADDRESS = "127.0.0.1"
DEFAULT_PORT = 8321  # the usual one; another where it is taken
DEFAULT_SESSIONS_FOLDER = "minimax-cal-sessions"
PRIVATE_UMASK = 0o077  # what others may not do with new files and folders
WEBAPP_EXTRA = "minimax-cal[app]"

REDIRECT_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>minimax-cal</title>
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={url}"></head>
<body><p><a href="{url}">Open the page</a></p></body></html>
"""


def serve_sessions(
    sessions_folder: Path, port: int | None, on_ready: Callable[[str], object]
) -> None:
    """Serve the sessions of a folder until Ctrl-C.

    port: None for the usual one, or any that is free.  on_ready: called with the page's address,
    once that can be opened.  Raises CalibrationError.
    """
    uvicorn = import_optional("uvicorn", "the page", WEBAPP_EXTRA)
    import_optional("starlette", "the page", WEBAPP_EXTRA)
    import_report_packages()
    before = os.umask(PRIVATE_UMASK)  # of this process and of the commands that it starts
    try:
        run_server(uvicorn, sessions_folder, port, on_ready)
    finally:
        os.umask(before)


def run_server(
    uvicorn: Any, sessions_folder: Path, port: int | None, on_ready: Callable[[str], object]
) -> None:
    """As `serve_sessions`, once all is there that it needs."""
    from minimax_cal.webapp.bounded_connection import BoundedConnection
    from minimax_cal.webapp.request_guard import PageAccess, RequestGuard
    from minimax_cal.webapp.routes import build_application
    from minimax_cal.webapp.sessions import remove_abandoned_partial_files

    with open_listening_socket(
        port
    ) as listener:  # before the folder: a port in use leaves none behind
        root = create_folder(sessions_folder).resolve()
        remove_abandoned_partial_files(root)
        door = PageAccess(listener.getsockname()[1], secrets.token_urlsafe(24))
        config = uvicorn.Config(
            RequestGuard(build_application(root), door), http=BoundedConnection, log_level="error",
            access_log=False, server_header=False, date_header=False, proxy_headers=False,
            ws="none", timeout_graceful_shutdown=2,
        )  # fmt: skip
        on_ready(door.url)
        uvicorn.Server(config).run(sockets=[listener])


@contextmanager
def temporary_redirect_page(folder: Path, url: str) -> Iterator[Path]:
    """A private page that leads to an address, for a browser to open; removed in the end.

    Command lines can be read by all who share this machine, so that of the browser holds the path
    of this file and not the token.  In the sessions' folder, since a browser in a sandbox may see
    neither hidden folders nor those of temporary files.
    """
    handle, name = tempfile.mkstemp(prefix="open-", suffix=".html", dir=folder)  # 0600
    path = Path(name).resolve()
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(REDIRECT_PAGE.format(url=escape(url)))
        yield path
    finally:
        path.unlink(missing_ok=True)


def open_listening_socket(port: int | None) -> socket.socket:
    """A socket on this machine alone.  Raises OptionError for a port that is not free."""
    for each in (DEFAULT_PORT, 0) if port is None else (port,):
        found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        if sys.platform != "win32":  # there it would let two servers share a port
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            found.bind((LOOPBACK_ADDRESS, each))
            found.listen(64)
        except OSError as error:
            found.close()
            reason = error.strerror
        else:
            return found
    raise OptionError(f"port={port}: cannot be had ({reason}); choose another")
