"""Every format that a robot can be written in, and what of a calibrated arm each carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from minimax_cal.correcting.exporters import (
    dh_csv,
    moc,
    robot_json,
    ros2_control,
    ros_yaml,
    ur_yaml,
    urdf,
)
from minimax_cal.correcting.exporters.job import Export, Job
from minimax_cal.fitting.options import OFFSETS
from minimax_cal.ground.errors import OptionError
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Term

Carries = Callable[[Cell], tuple[Term, ...]]


def nothing(cell: Cell) -> tuple[Term, ...]:
    """No effect: geometry alone."""
    return ()


@dataclass(frozen=True)
class Exporter:
    """A format.

    write: its file.  carries: the effects of a cell that the file holds.  only: of the geometry it
    holds no more than a fit with this `only` finds; all of it where empty.  couples: whether it
    holds that a joint follows others.  simulated: whether its file tells how far it stands off.
    """

    write: Callable[[Job], Export]
    carries: Carries = nothing
    only: str = ""
    couples: bool = False
    simulated: bool = False


def later(module: str, verb: str) -> Callable[..., Any]:
    """A function of a room that stands on this one, imported when it is first called."""
    return lambda *given: getattr(import_module(module), verb)(*given)


MJCF = "minimax_cal.simulators.mjcf"
EXPORTERS: dict[str, Exporter] = {
    "urdf": Exporter(urdf.write, couples=True),
    "ur-yaml": Exporter(ur_yaml.write),
    "ros-yaml": Exporter(ros_yaml.write),
    "ros2-control": Exporter(ros2_control.write, only=OFFSETS),
    "dh-csv": Exporter(dh_csv.write),
    "json": Exporter(robot_json.write, couples=True),
    "moc": Exporter(moc.write, moc.carries),
    "mjcf": Exporter(later(MJCF, "write"), later(MJCF, "carries"), simulated=True),
}


FORMATS = tuple(name for name in EXPORTERS if name != "moc")  # its frames are not documented


def exporter(to: str) -> Exporter:
    """The format of a name.  Raises OptionError."""
    if to not in EXPORTERS:
        raise OptionError(f"{to}: no such format; choose one of {', '.join(FORMATS)}")
    return EXPORTERS[to]


def export(job: Job, to: str) -> Export:
    """The file in a format, with notices.  Raises OptionError."""
    chosen = exporter(to)
    if job.originals and to != "urdf":
        raise OptionError(f"urdf goes with the format urdf, not with {to}")
    if job.model and to != "mjcf":
        raise OptionError(f"mjcf goes with the format mjcf, not with {to}")
    if job.tip and not (job.originals or job.model):
        raise OptionError("tip names a link of the file given as urdf or mjcf")
    if len(job.robot.coupling) and not chosen.couples:
        able = ", ".join(name for name, one in EXPORTERS.items() if one.couples)
        raise OptionError(
            f"{to}: has no place for joints that follow others (coupling); use {able}"
        )
    found = chosen.write(job)
    if not job.originals:  # a given URDF keeps its own constants
        found = replace(found, notices=(*job.notices, *found.notices))
    return found
