"""One thread of linear algebra: of small matrices several wait for each other, and longer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def find_blas_libraries() -> ThreadpoolController:
    """Those of linear algebra that are loaded: looked for once, which takes 6 ms."""
    return ThreadpoolController()


@contextmanager
def limit_blas_to_one_thread() -> Iterator[None]:
    """Linear algebra by one thread, within a block or, as a decorator, a function."""
    with find_blas_libraries().limit(limits=1, user_api="blas"):
        yield
