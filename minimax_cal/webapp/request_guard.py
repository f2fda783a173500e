"""Who may ask: requests of the page itself, with the token; and what every answer carries."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_HOST_NAMES = ("127.0.0.1", "localhost")
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self'; "
    "img-src 'self' data: blob:; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
# of every answer; a file that people dropped is never shown as a page, see `routes`
SECURITY_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
READ_METHODS = ("GET", "HEAD")


@dataclass(frozen=True)
class PageAccess:
    """Where the page is, and the token that opens it."""

    port: int
    token: str

    @property
    def url(self) -> str:
        """The address to open."""
        return f"http://{LOOPBACK_HOST_NAMES[0]}:{self.port}/?{urlencode({'token': self.token})}"

    @property
    def cookie_name(self) -> str:
        """Its name: cookies are not kept apart by port."""
        return f"minimax-cal-{self.port}"

    def reason_to_refuse(self, method: str, headers: Mapping[str, str]) -> str:
        """Why a request is refused before its token is looked at, empty if it is not.

        A page elsewhere may send requests here, also under a name of its own that it makes lead to
        this machine: the browser then tells that name as Host, or the page as Origin.
        """
        hosts = {f"{name}:{self.port}" for name in LOOPBACK_HOST_NAMES}
        if headers.get("host", "").lower() not in hosts:
            return f"wrong host: this page is at {LOOPBACK_HOST_NAMES[0]}:{self.port} alone"
        origin = headers.get("origin")
        if origin is not None and origin not in {f"http://{host}" for host in hosts}:
            return "wrong origin: another page may not ask for this"
        site, mode = headers.get("sec-fetch-site", "none"), headers.get("sec-fetch-mode")
        came = site in ("none", "same-origin") or (method in READ_METHODS and mode == "navigate")
        return "" if came else "wrong origin: another page may not ask for this"

    def is_right_token(self, given: str | None) -> bool:
        """Whether a token is the right one."""
        return secrets.compare_digest((given or "").encode(), self.token.encode())


class RequestGuard:
    """The application behind a door."""

    def __init__(self, app: ASGIApp, door: PageAccess) -> None:
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
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        app = self.refuse_or_set_cookie(Request(scope)) or self.app
        await app(scope, receive, safely)

    def refuse_or_set_cookie(self, request: Request) -> Response | None:
        """The answer to a request that goes no further, None for one that does."""
        said = self.door.reason_to_refuse(request.method, Headers(scope=request.scope))
        if said:
            return PlainTextResponse(said, 403)
        given = request.query_params.get("token")
        if given is None and self.door.is_right_token(request.cookies.get(self.door.cookie_name)):
            return None
        if given is not None and self.door.is_right_token(given) and request.method in READ_METHODS:
            there = RedirectResponse("/" + request.url.path.lstrip("/"), 303)
            there.set_cookie(self.door.cookie_name, self.door.token, httponly=True, samesite="lax")
            return there
        wrong = "wrong token" if given or self.door.cookie_name in request.cookies else "no token"
        return PlainTextResponse(f"{wrong}: open the address that minimax-cal serve printed", 403)
