"""The commands in the order of the work, each imported when it is used."""

from __future__ import annotations

import os
import re
import sys
from collections import UserDict
from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from importlib.util import LazyLoader, find_spec, module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import click

from minimax_cal.core.errors import OptionError

MORE_COMMANDS_HEADING = "More"
COMMAND_NAMES_BY_HEADING = {  # what most people need, in the order of the work, and the rest
    "Commands": "import calibrate diagnose check compare evaluate compensate export gap plan "
    "report serve",
    MORE_COMMANDS_HEADING: "identify relative torques simulate robots effects backends iso9283 map",
}
HELP_ALL_FLAG = "--help-all"
# parameters that name outputs
OUTPUT_PARAMETERS = ("output", "figure", "path", "pdf", "truth", "write", "waypoints", "randomize")
LAZILY_LOADED_MODULES = (
    "numpy.f2py",
    "numpy.testing",
)  # which SciPy would load and no command uses
LONG_COMMANDS = ("relative", "diagnose", "plan", "gap")  # worth compiled kernels
COMMAND_MODULE_EXCEPTIONS = {
    "import": "import_",
    "effects": "diagnose",
}  # not in a module of their name
COMMAND_MODULES = {
    name: COMMAND_MODULE_EXCEPTIONS.get(name, name)
    for name in " ".join(COMMAND_NAMES_BY_HEADING.values()).split()
}
HELP_SOURCE_PATTERN = r'def {}_command\(.*?"""(.*?)(?:"""|\n\n)'


def wrap_with_output_check_and_kernels(
    command: Callable[..., Any], *, brief: bool
) -> Callable[..., Any]:
    """The command with the kernels that suit its work, once its outputs are known to be its own."""

    @wraps(command)
    def at_work(*given: Any, **named: Any) -> Any:
        check_output_paths(named)
        from minimax_cal.robots.kernels.kernel_choice import (
            use_numpy_kernels_for_brief_work,
        )  # NumPy comes with it

        with use_numpy_kernels_for_brief_work(brief=brief):
            return command(*given, **named)

    return at_work


def check_output_paths(parameters: Mapping[str, Any]) -> None:
    """Raise OptionError for an output that is an input or another output, or a file called -."""
    outputs = [parameters[name] for name in OUTPUT_PARAMETERS if parameters.get(name) is not None]
    inputs = [
        part
        for name, value in parameters.items()
        if name not in OUTPUT_PARAMETERS
        for part in (value if isinstance(value, list | tuple) else [value])
        if isinstance(part, str | Path) and str(part)
    ]
    inputs += [part.rpartition("#")[0] for part in map(str, inputs) if "#" in part]  # a link
    for i, path in enumerate(map(Path, outputs)):
        if str(path) == "-":
            raise OptionError("-o -: name a file; --json prints to stdout")
        if any(is_same_file(path, Path(part)) for part in inputs):
            raise OptionError(f"{path}: is an input of this command; name another file")
        if any(is_same_output(path, Path(other)) for other in outputs[:i]):
            raise OptionError(f"{path}: is to hold two results; name another file for one")


def is_same_file(first_path: Path, second_path: Path) -> bool:
    """Whether two paths lead to one file that is there."""
    try:
        return first_path.samefile(second_path)
    except (OSError, ValueError):
        return False


def is_same_output(first_path: Path, second_path: Path) -> bool:
    """Whether two outputs lead to one place, other than a device such as /dev/null."""
    place = os.path.realpath(first_path)
    return place == os.path.realpath(second_path) and (
        os.path.isfile(place) or not os.path.exists(place)
    )


def import_quickly(module_name: str) -> ModuleType:
    """A module, imported without what only takes time.

    SciPy copies every name of NumPy, which would load a compiler's front end and a test framework.
    """
    for part in LAZILY_LOADED_MODULES:
        load_module_lazily(part)
    return import_module(module_name)


def load_module_lazily(module_name: str) -> None:
    """Let a part of a package be loaded when one of its names is asked for."""
    package, _, part = module_name.rpartition(".")
    spec = find_spec(module_name)
    if module_name in sys.modules or spec is None or spec.loader is None:
        return
    spec.loader = LazyLoader(spec.loader)
    module = sys.modules[module_name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    setattr(sys.modules[package], part, module)


class LazyCommands(UserDict[str, Any]):
    """Commands by name, each imported when it is asked for."""

    def __getitem__(self, name: str) -> click.Command:
        """The command; KeyError for a name that is none."""
        found = self.data[name]
        if isinstance(found, click.Command):
            return found
        module = import_quickly(f"{__package__}.{found}")
        command: click.Command = getattr(module, f"{name}_command")
        assert command.callback is not None
        command.callback = wrap_with_output_check_and_kernels(
            command.callback, brief=name not in LONG_COMMANDS
        )
        self.data[name] = command
        return command


class OrderedCommandGroup(click.Group):
    """A group that lists its commands in the order of the work, without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of the work."""
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """What most people need, and names of the rest, or with --help-all what it does, too."""
        whole = ctx.meta.get(HELP_ALL_FLAG)
        for part, names in COMMAND_NAMES_BY_HEADING.items():
            with formatter.section(part):
                if whole or part != MORE_COMMANDS_HEADING:
                    formatter.write_dl(
                        [(name, read_first_help_sentence(name)) for name in names.split()]
                    )
                else:
                    formatter.write_text(names.replace(" ", ", "))
        if not whole:
            formatter.write(f"\nEvery command in a line: {ctx.command_path} {HELP_ALL_FLAG}\n")


def print_whole_help(ctx: click.Context, _: click.Parameter, is_requested: bool) -> None:
    """Print the whole help and end."""
    if is_requested:
        ctx.meta[HELP_ALL_FLAG] = True
        click.echo(ctx.get_help())
        ctx.exit()


HELP_ALL_OPTION = click.help_option(
    HELP_ALL_FLAG, hidden=True, callback=print_whole_help, help="Show all and exit."
)


def read_first_help_sentence(command_name: str) -> str:
    """The first sentence of a command's help, from its source: to import all takes seconds."""
    spec: Any = find_spec(f"{__package__}.{COMMAND_MODULES[command_name]}")
    found = re.search(
        HELP_SOURCE_PATTERN.format(command_name), spec.loader.get_source(spec.name) or "", re.S
    )
    return " ".join(found[1].split()) if found else ""
