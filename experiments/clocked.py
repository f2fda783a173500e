"""Calls in a process of their own, which is ended when a call takes too long."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

START = 60.0  # that a new process may take to import what it needs [s]


class Clocked(AbstractContextManager["Clocked"]):
    """A function of this project in another process, which lives from call to call.

    function: importable from a module.  It is given the arguments of `call`, which must pickle.
    limit: seconds of one call.
    """

    def __init__(self, function: Callable[..., Any], limit: float) -> None:
        self.function, self.limit = function, limit
        self.alive: tuple[multiprocessing.process.BaseProcess, Connection] | None = None

    def call(self, *arguments: Any) -> Any:
        """What the function returns.

        Raises TimeoutError when it was ended, RuntimeError where it raised or its process died.
        """
        _, ours = self.alive = self.alive or self.started()
        ours.send(arguments)
        if not ours.poll(self.limit):
            self.end()
            raise TimeoutError(f"ended after {self.limit:g} s")
        try:
            good, found = ours.recv()
        except EOFError:
            self.end()
            raise RuntimeError("the process died") from None
        if not good:
            raise RuntimeError(found)
        return found

    def started(self) -> tuple[multiprocessing.process.BaseProcess, Connection]:
        """A process that waits for calls."""
        context = multiprocessing.get_context("spawn")  # a fork may hang in a solver's threads
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(self.function, theirs), daemon=True)
        process.start()
        theirs.close()
        if not (ours.poll(START) and ours.recv() == "ready"):
            raise RuntimeError("the process did not start")
        return process, ours

    def end(self) -> None:
        """End the process, whatever it does."""
        if self.alive:
            process, ours = self.alive
            process.kill()
            process.join()
            ours.close()
        self.alive = None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end()


def serve(function: Callable[..., Any], theirs: Connection) -> None:
    """Answer calls until the other side is gone."""
    theirs.send("ready")
    while True:
        try:
            arguments = theirs.recv()
        except (EOFError, OSError):
            return
        try:
            answer = (True, function(*arguments))
        except Exception as error:  # the caller is told
            answer = (False, f"{type(error).__name__}: {error}")
        theirs.send(answer)
