"""One thread of linear algebra: of small matrices several wait for each other, and longer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def get_blas_thread_controller() -> ThreadpoolController:
    """Those of linear algebra that are loaded: looked for once, which takes 6 ms."""
    return ThreadpoolController()


@contextmanager
def limit_blas_to_one_thread() -> Iterator[None]:
    """Linear algebra by one thread, within a block or, as a decorator, a function."""
    with get_blas_thread_controller().limit(limits=1, user_api="blas"):
        yield
