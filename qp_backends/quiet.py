"""HiGHS without its greeting, which would stand before whatever is written to stdout."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from threading import Lock
from typing import Any

_lock = Lock()  # the class is exchanged for one solve at a time


@contextmanager
def ungreeted(solver: str) -> Iterator[None]:
    """What a solver of this name makes in here begins without a word.

    HiGHS 1.16 tells its version on stdout as soon as it is made, before anyone can ask it for
    silence; qpsolvers and cvxpy ask right afterwards.  Others keep to what they are told.
    """
    if solver.lower() != "highs":
        yield
        return
    highspy: Any = import_module("highspy")  # it has no types
    greeting = highspy.Highs
    with _lock:
        highspy.Highs = _silent(greeting)
        try:
            yield
        finally:
            highspy.Highs = greeting


def _silent(greeting: Any) -> Any:
    """The class of HiGHS, its output off while it is made and then as it was."""

    class Silent(greeting):  # type: ignore[misc]
        def enableCallbacks(self) -> None:  # the first that its constructor calls
            self.setOptionValue("output_flag", False)
            super().enableCallbacks()
            self.setOptionValue("output_flag", True)

    return Silent
