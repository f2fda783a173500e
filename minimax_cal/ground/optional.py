"""Packages that not everybody needs: imported at their first use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from minimax_cal.ground.errors import OptionError


def install_command(install: str) -> str:
    """The command that installs a distribution, or extras of this one as "minimax-cal[report]".

    Extras are installed from a clone, since no index has this package.
    """
    extra = install.removeprefix("minimax-cal")
    place = install if extra == install else f'".{extra}" in a clone of the repository'
    return f"pip install {place}"


def optional(module: str, what: str, install: str) -> Any:
    """A package that may be missing.  what: needs it.  install: what brings it, for pip.

    Raises OptionError, which says how to install it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise OptionError(f"{what} needs {error.name}: {install_command(install)}") from error
