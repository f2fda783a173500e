"""A connection to the page that ends where nothing comes any more."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_HEAD_SECONDS = 10.0  # from a connection, or a request's first byte, to the end of its head
MAX_SILENT_BODY_SECONDS = 30.0  # without a byte of a request's body
MAX_BLOCKED_WRITE_SECONDS = 60.0  # in which a client takes nothing of an answer


class BoundedConnection(H11Protocol):
    """HTTP as uvicorn speaks it, whose half-open connections are closed.

    uvicorn alone bounds the wait between two requests, and no wait within one: a client that sends
    half a head, half a body, or reads no answer would keep its connection for ever.
    """

    deadline: asyncio.TimerHandle | None = None
    blocked: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Expect a request."""
        super().connection_made(transport)
        self.deadline = self.loop.call_later(MAX_HEAD_SECONDS, self.close_if_silent)

    def data_received(self, data: bytes) -> None:
        """Take bytes, and expect those that are missing."""
        super().data_received(data)
        if self.is_awaiting_request_head():  # further bytes of a head win no time
            if self.deadline is None:
                self.deadline = self.loop.call_later(MAX_HEAD_SECONDS, self.close_if_silent)
            return
        self.cancel_deadline()
        if self.is_awaiting_request_body():
            self.deadline = self.loop.call_later(MAX_SILENT_BODY_SECONDS, self.close_if_silent)

    def is_awaiting_request_head(self) -> bool:
        """Whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def is_awaiting_request_body(self) -> bool:
        """Whether a request that is being answered has not been received as a whole."""
        return not self.is_awaiting_request_head() and self.cycle.more_body

    def close_if_silent(self) -> None:
        """Close the connection, unless all that was expected has come or the server was slow."""
        self.deadline = None
        if self.is_awaiting_request_body() and self.flow.read_paused:
            self.deadline = self.loop.call_later(MAX_SILENT_BODY_SECONDS, self.close_if_silent)
        elif self.is_awaiting_request_head() or self.is_awaiting_request_body():
            self.transport.abort()

    def cancel_deadline(self) -> None:
        """Expect nothing."""
        if self.deadline is not None:
            self.deadline.cancel()
            self.deadline = None

    def pause_writing(self) -> None:
        """Bound how long an answer waits for a client that does not read it."""
        super().pause_writing()
        self.blocked = self.loop.call_later(MAX_BLOCKED_WRITE_SECONDS, self.transport.abort)

    def resume_writing(self) -> None:
        """The client has read."""
        super().resume_writing()
        if self.blocked is not None:
            self.blocked.cancel()
            self.blocked = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget what was expected."""
        self.cancel_deadline()
        if self.blocked is not None:
            self.blocked.cancel()
        super().connection_lost(exc)
