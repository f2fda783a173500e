"""The server of the page: on this machine alone, until it is stopped."""

from __future__ import annotations

import os
import secrets
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
    from minimax_cal.serving.routes import application
    from minimax_cal.serving.server import Door, Guard
    from minimax_cal.serving.sessions import remove_parts

    root = made_folder(folder).resolve()
    remove_parts(root)
    listener = listening(port)
    door = Door(listener.getsockname()[1], secrets.token_urlsafe(24))
    config = uvicorn.Config(
        Guard(application(root), door), log_level="error", access_log=False, server_header=False,
        date_header=False, proxy_headers=False, ws="none", timeout_graceful_shutdown=2,
    )  # fmt: skip
    ready(door.url)
    with listener:
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


# ---- who may ask ---------------------------------------------------------------------------------


NAMES = ("127.0.0.1", "localhost")
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self'; "
    "img-src 'self' data: blob:; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
SAFE = {  # of every answer; a file that people dropped is never shown as a page, see `routes`
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
READS = ("GET", "HEAD")


@dataclass(frozen=True)
class Door:
    """Where the page is, and the token that opens it."""

    port: int
    token: str

    @property
    def url(self) -> str:
        """The address to open."""
        return f"http://{NAMES[0]}:{self.port}/?{urlencode({'token': self.token})}"

    @property
    def cookie(self) -> str:
        """Its name: cookies are not kept apart by port."""
        return f"minimax-cal-{self.port}"

    def refusal(self, method: str, headers: Mapping[str, str]) -> str:
        """Why a request is refused before its token is looked at, empty if it is not.

        A page elsewhere may send requests here, also under a name of its own that it makes lead to
        this machine: the browser then tells that name as Host, or the page as Origin.
        """
        hosts = {f"{name}:{self.port}" for name in NAMES}
        if headers.get("host", "").lower() not in hosts:
            return f"wrong host: this page is at {NAMES[0]}:{self.port} alone"
        origin = headers.get("origin")
        if origin is not None and origin not in {f"http://{host}" for host in hosts}:
            return "wrong origin: another page may not ask for this"
        site, mode = headers.get("sec-fetch-site", "none"), headers.get("sec-fetch-mode")
        came = site in ("none", "same-origin") or (method in READS and mode == "navigate")
        return "" if came else "wrong origin: another page may not ask for this"

    def opens(self, given: str | None) -> bool:
        """Whether a token is the right one."""
        return secrets.compare_digest((given or "").encode(), self.token.encode())


class Guard:
    """The application behind a door."""

    def __init__(self, app: ASGIApp, door: Door) -> None:
        self.app = app
        self.door = door

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer what is refused, pass on the rest."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SAFE.items():
                    headers.setdefault(name, value)
            await send(message)

        app = self.answer(Request(scope)) or self.app
        await app(scope, receive, safely)

    def answer(self, request: Request) -> Response | None:
        """The answer to a request that goes no further, None for one that does."""
        said = self.door.refusal(request.method, Headers(scope=request.scope))
        if said:
            return PlainTextResponse(said, 403)
        given = request.query_params.get("token")
        if given is None and self.door.opens(request.cookies.get(self.door.cookie)):
            return None
        if given is not None and self.door.opens(given) and request.method in READS:
            there = RedirectResponse("/" + request.url.path.lstrip("/"), 303)
            there.set_cookie(self.door.cookie, self.door.token, httponly=True, samesite="lax")
            return there
        wrong = "wrong token" if given or self.door.cookie in request.cookies else "no token"
        return PlainTextResponse(f"{wrong}: open the address that minimax-cal serve printed", 403)
