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

from minimax_cal.ground.errors import OptionError

MORE = "More"
COMMANDS = {  # what most people need, in the order of the work, and the rest
    "Commands": "import calibrate diagnose check compare evaluate compensate export gap plan "
    "report serve",
    MORE: "identify relative torques simulate robots effects backends iso9283 map",
}
WHOLE = "--help-all"
# parameters that name outputs
WRITTEN = ("output", "figure", "path", "pdf", "truth", "write", "waypoints", "randomize")
SPARED = ("numpy.f2py", "numpy.testing")  # which SciPy would load and no command uses
LONG = ("relative", "diagnose", "plan", "gap")  # worth compiled kernels
ELSEWHERE = {"import": "import_", "effects": "diagnose"}  # not in a module of their name
ENTRIES = {name: ELSEWHERE.get(name, name) for name in " ".join(COMMANDS.values()).split()}
HELP = r'def {}_command\(.*?"""(.*?)(?:"""|\n\n)'


def guarded(command: Callable[..., Any], *, brief: bool) -> Callable[..., Any]:
    """The command with the kernels that suit its work, once its outputs are known to be its own."""

    @wraps(command)
    def at_work(*given: Any, **named: Any) -> Any:
        check_outputs(named)
        from minimax_cal.robots.kernels.choice import work  # NumPy comes with it

        with work(brief=brief):
            return command(*given, **named)

    return at_work


def check_outputs(named: Mapping[str, Any]) -> None:
    """Raise OptionError for an output that is an input or another output, or a file called -."""
    outputs = [named[name] for name in WRITTEN if named.get(name) is not None]
    inputs = [
        part
        for name, value in named.items()
        if name not in WRITTEN
        for part in (value if isinstance(value, list | tuple) else [value])
        if isinstance(part, str | Path) and str(part)
    ]
    inputs += [part.rpartition("#")[0] for part in map(str, inputs) if "#" in part]  # a link
    for i, path in enumerate(map(Path, outputs)):
        if str(path) == "-":
            raise OptionError("-o -: name a file; --json prints to stdout")
        if any(is_same(path, Path(part)) for part in inputs):
            raise OptionError(f"{path}: is an input of this command; name another file")
        if any(leads_with(path, Path(other)) for other in outputs[:i]):
            raise OptionError(f"{path}: is to hold two results; name another file for one")


def is_same(one: Path, other: Path) -> bool:
    """Whether two paths lead to one file that is there."""
    try:
        return one.samefile(other)
    except (OSError, ValueError):
        return False


def leads_with(one: Path, other: Path) -> bool:
    """Whether two outputs lead to one place, other than a device such as /dev/null."""
    place = os.path.realpath(one)
    return place == os.path.realpath(other) and (os.path.isfile(place) or not os.path.exists(place))


def quickly(name: str) -> ModuleType:
    """A module, imported without what only takes time.

    SciPy copies every name of NumPy, which would load a compiler's front end and a test framework.
    """
    for part in SPARED:
        when_used(part)
    return import_module(name)


def when_used(name: str) -> None:
    """Let a part of a package be loaded when one of its names is asked for."""
    package, _, part = name.rpartition(".")
    spec = find_spec(name)
    if name in sys.modules or spec is None or spec.loader is None:
        return
    spec.loader = LazyLoader(spec.loader)
    module = sys.modules[name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    setattr(sys.modules[package], part, module)


class Commands(UserDict[str, Any]):
    """Commands by name, each imported when it is asked for."""

    def __getitem__(self, name: str) -> click.Command:
        """The command; KeyError for a name that is none."""
        found = self.data[name]
        if isinstance(found, click.Command):
            return found
        module = quickly(f"{__package__}.{found}")
        command: click.Command = getattr(module, f"{name}_command")
        assert command.callback is not None
        command.callback = guarded(command.callback, brief=name not in LONG)
        self.data[name] = command
        return command


class Workflow(click.Group):
    """A group that lists its commands in the order of the work, without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of the work."""
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """What most people need, and names of the rest, or with --help-all what it does, too."""
        whole = ctx.meta.get(WHOLE)
        for part, names in COMMANDS.items():
            with formatter.section(part):
                if whole or part != MORE:
                    formatter.write_dl([(name, said_of(name)) for name in names.split()])
                else:
                    formatter.write_text(names.replace(" ", ", "))
        if not whole:
            formatter.write(f"\nEvery command in a line: {ctx.command_path} {WHOLE}\n")


def show_whole(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    """Print the whole help and end."""
    if asked:
        ctx.meta[WHOLE] = True
        click.echo(ctx.get_help())
        ctx.exit()


WHOLE_HELP = click.help_option(WHOLE, hidden=True, callback=show_whole, help="Show all and exit.")


def said_of(name: str) -> str:
    """The first sentence of a command's help, from its source: to import all takes seconds."""
    spec: Any = find_spec(f"{__package__}.{ENTRIES[name]}")
    found = re.search(HELP.format(name), spec.loader.get_source(spec.name) or "", re.S)
    return " ".join(found[1].split()) if found else ""
