"""Packages that not everybody needs: imported at their first use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from minimax_cal.core.errors import OptionError


def install_command(requirement: str) -> str:
    """The command that installs a distribution, or extras of this one as "minimax-cal[report]".

    Extras are installed from a clone, since no index has this package.
    """
    extra = requirement.removeprefix("minimax-cal")
    place = requirement if extra == requirement else f'".{extra}" in a clone of the repository'
    return f"pip install {place}"


def import_optional(module_name: str, feature: str, requirement: str) -> Any:
    """A package that may be missing.  feature: needs it.  requirement: what brings it, for pip.

    Raises OptionError, which says how to install it.
    """
    try:
        return import_module(module_name)
    except ModuleNotFoundError as error:
        raise OptionError(
            f"{feature} needs {error.name}: {install_command(requirement)}"
        ) from error
