"""One thread of linear algebra: of small matrices several wait for each other, and longer."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

Given = ParamSpec("Given")
Made = TypeVar("Made")


@cache
def libraries() -> ThreadpoolController:
    """Those of linear algebra that are loaded: looked for once, which takes 6 ms."""
    return ThreadpoolController()


def on_one_thread(verb: Callable[Given, Made]) -> Callable[Given, Made]:
    """Make a function do its linear algebra by one thread."""

    @wraps(verb)
    def alone(*given: Given.args, **named: Given.kwargs) -> Made:
        with libraries().limit(limits=1, user_api="blas"):
            return verb(*given, **named)

    return alone
