"""Which kernels run: compiled ones where numba is installed, else those of NumPy."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import import_module, util
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots.kernels import plain

KERNELS_VARIABLE = (
    "MINIMAX_CAL_KERNELS"  # plain or fast, in the environment; unset takes what is there
)
COMPILING_NOTICE = "compiling kernels for this machine, once: about ten seconds"
NO_KERNEL_CACHE_NOTICE = (
    "numba finds no folder for compiled kernels, and NumPy does their work, more slowly: set "
    "NUMBA_CACHE_DIR to a folder that can be written"
)
IS_BRIEF_WORK: ContextVar[bool] = ContextVar("brief", default=False)


@contextmanager
def use_numpy_kernels_for_brief_work(*, brief: bool) -> Iterator[None]:
    """Let NumPy's kernels do what is too brief for numba to be worth loading (a third second)."""
    token = IS_BRIEF_WORK.set(brief)
    try:
        yield
    finally:
        IS_BRIEF_WORK.reset(token)


def active_kernels() -> Any:
    """The module of the kernels, `fast` or `plain`."""
    return plain if IS_BRIEF_WORK.get() else load_best_kernels()


@cache
def load_best_kernels() -> Any:
    """`fast` where numba is installed, else `plain`."""
    told = os.environ.get(KERNELS_VARIABLE, "")
    if told == "plain" or (told != "fast" and util.find_spec("numba") is None):
        return plain
    try:
        fast = import_module("minimax_cal.robots.kernels.fast")
    except RuntimeError:  # package and home are both read-only
        logging.getLogger("minimax_cal").warning(NO_KERNEL_CACHE_NOTICE)
        return plain
    if not any(Path(fast.link_frames_in_flange.stats.cache_path).glob("fast.*.nbi")):
        logging.getLogger("minimax_cal").warning(COMPILING_NOTICE)
    return fast


def prepare_kernel_arrays(*arrays: Array) -> tuple[Array, ...]:
    """Arrays as the compiled kernels know them: in order and writeable; others compile anew."""
    return tuple(
        array if array.flags.c_contiguous and array.flags.writeable else np.array(array, order="C")
        for array in arrays
    )
