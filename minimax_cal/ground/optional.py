"""Packages that not everybody needs: imported at their first use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from minimax_cal.ground.errors import OptionError


def from_clone(install: str) -> str:
    """Extras of this package as they are installed from a clone."""
    extra = install.removeprefix("minimax-cal")
    return install if extra == install else f'".{extra}" in a clone of the repository'


def optional(module: str, what: str, install: str) -> Any:
    """A package that may be missing.  what: needs it.  install: what brings it, for pip.

    Extras of our own, as "minimax-cal[report]", are installed from a clone: no index has them yet.

    Raises OptionError.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise OptionError(
            f"{what} needs {error.name}: pip install {from_clone(install)}"
        ) from error
