"""Packages that not everybody needs: imported at their first use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from minimax_cal.ground.errors import OptionError


def optional(module: str, what: str, install: str) -> Any:
    """A package that may be missing.  what: needs it.  install: what brings it, for pip.

    Raises OptionError.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise OptionError(f"{what} needs {error.name}: pip install {install}") from error
