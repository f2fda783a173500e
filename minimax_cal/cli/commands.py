"""The commands in the order of the work, each imported when it is used."""

from __future__ import annotations

import os
import sys
from collections import UserDict
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from importlib.util import LazyLoader, find_spec, module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import click

from minimax_cal.ground.errors import OptionError

Entry = tuple[str, str]  # module in this folder, the first sentence of the command's help

COMMANDS: dict[str, dict[str, Entry]] = {
    "Calibrate": {
        "import": (
            "import_",
            "Read FILEs of a tracker or controller as they are, show what was understood, write "
            "CSV.",
        ),
        "calibrate": (
            "calibrate",
            "Calibrate ROBOT (a file or a built-in name) from the measurements in DATA.",
        ),
        "identify": (
            "identify",
            "Make a robot file where nothing is drawn, from the measurements in DATA.",
        ),
        "relative": (
            "relative",
            "Calibrate ROBOT without coordinates, by lengths, closures, contacts or poses in DATA.",
        ),
    },
    "Judge": {
        "evaluate": (
            "evaluate",
            "Accuracy of a saved calibration FIT on the measurements in DATA; nothing is fitted.",
        ),
        "check": (
            "check",
            "Check with a few poses in DATA whether the calibration FIT is still valid, and what "
            "moved.",
        ),
        "compare": (
            "compare",
            "What differs between two calibrations A and B: before and after a repair, say.",
        ),
    },
    "Diagnose": {
        "diagnose": (
            "diagnose",
            "Say why ROBOT still misses once calibrated, as far as the measurements in DATA can "
            "tell.",
        ),
        "torques": (
            "torques",
            "Say why joint torques (or currents) in LOGs differ from those of MODEL, and by how "
            "much.",
        ),
    },
    "Plan": {
        "plan": (
            "plan",
            "Which poses of ROBOT to measure next, in which order, and how accurate they will make "
            "it.",
        ),
        "simulate": (
            "simulate",
            "Measurements of an imperfect copy of ROBOT, from a tracker at a random place.",
        ),
    },
    "Correct": {
        "compensate": (
            "compensate",
            "Correct the joint TARGETS (CSV) so that the robot of FIT goes where it is drawn to "
            "go.",
        ),
        "export": (
            "export",
            "Write the robot of FIT (a saved result or a robot) as a file others can load.",
        ),
    },
    "Simulate": {
        "gap": (
            "gap",
            "How far the simulated arm of MODEL (MJCF or URDF) misses the real one in DATA, and "
            "why.",
        ),
    },
    "Report": {
        "report": (
            "report",
            "A page to sign of RESULTS: a calibration, a diagnosis, or both of the same "
            "measurements.",
        ),
    },
    "Work on a page": {
        "serve": (
            "serve",
            "A page to work in, in the browser of this machine: drop files, fit, diagnose, judge, "
            "plan.",
        ),
    },
    "Look up": {
        "robots": ("robots", "The robots that come with the package."),
        "effects": (
            "diagnose",
            "The library of effects; with ROBOT and DATA, where these measurements can test them.",
        ),
        "backends": ("backends", "The QP backends that are installed, with their versions."),
    },
    "More": {
        "fleet": (
            "fleet",
            "Calibrate or check every cell of CELLS (TOML) in one go, with one overview of all.",
        ),
        "iso9283": (
            "iso9283",
            "Pose and distance accuracy of FIT by the formulas of ISO 9283, before and after.",
        ),
        "map": (
            "map",
            "Where FIT is sure of a position, and where the arm missed, over the workspace.",
        ),
    },
}
# parameters that name outputs
WRITTEN = ("output", "figure", "path", "pdf", "truth", "write", "out")
SPARED = ("numpy.f2py", "numpy.testing")  # which SciPy would load and no command uses
LONG = ("relative", "diagnose", "plan", "gap")  # worth compiled kernels
ENTRIES = {name: entry for part in COMMANDS.values() for name, entry in part.items()}


def keeping_inputs(command: Callable[..., Any] | None) -> Callable[..., Any]:
    """The command, refusing an output that is an input or another output, or a file called -."""

    @wraps(command)  # type: ignore[arg-type]
    def kept(*given: Any, **named: Any) -> Any:
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
        return command(*given, **named)  # type: ignore[misc]

    return kept


def paced(command: Callable[..., Any] | None, *, brief: bool) -> Callable[..., Any]:
    """The command, with the kernels that suit its work."""

    @wraps(command)  # type: ignore[arg-type]
    def at_pace(*given: Any, **named: Any) -> Any:
        from minimax_cal.robots.kernels.choice import work  # NumPy comes with it

        with work(brief=brief):
            return command(*given, **named)  # type: ignore[misc]

    return at_pace


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
        module = quickly(f"minimax_cal.cli.{found[0]}")
        command: click.Command = getattr(module, f"{name}_command")
        command.callback = keeping_inputs(paced(command.callback, brief=name not in LONG))
        self.data[name] = command
        return command


class Workflow(click.Group):
    """A group that lists its commands in the order of the work, without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of the work."""
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list of commands, part by part."""
        for part, entries in COMMANDS.items():
            with formatter.section(part):
                formatter.write_dl([(name, said) for name, (_, said) in entries.items()])
