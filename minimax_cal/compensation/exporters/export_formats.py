"""Every format that a robot can be written in, and what of a calibrated arm each carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from minimax_cal.compensation.exporters import (
    dh_csv,
    moc,
    robot_json,
    ros2_control,
    ros_yaml,
    ur_yaml,
    urdf_file,
)
from minimax_cal.compensation.exporters.export_job import ExportedFile, ExportJob
from minimax_cal.core.errors import OptionError
from minimax_cal.fitting.options import ONLY_OFFSETS
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Term

CarriedEffects = Callable[[Cell], tuple[Term, ...]]


def carry_no_effects(cell: Cell) -> tuple[Term, ...]:
    """No effect: geometry alone."""
    return ()


@dataclass(frozen=True)
class Exporter:
    """A format.

    write: its file.  carries: the effects of a cell that the file holds.  only: of the geometry it
    holds no more than a fit with this `only` finds; all of it where empty.  couples: whether it
    holds that a joint follows others.  simulated: whether its file tells how far it stands off.
    """

    write: Callable[[ExportJob], ExportedFile]
    carries: CarriedEffects = carry_no_effects
    only: str = ""
    couples: bool = False
    simulated: bool = False


def import_function_on_call(module: str, function_name: str) -> Callable[..., Any]:
    """A function of a room that stands on this one, imported when it is first called."""
    return lambda *given: getattr(import_module(module), function_name)(*given)


MJCF_EXPORTER_MODULE = "minimax_cal.simulators.mjcf"
EXPORTERS: dict[str, Exporter] = {
    "urdf": Exporter(urdf_file.build_urdf, couples=True),
    "ur-yaml": Exporter(ur_yaml.build_ur_yaml),
    "ros-yaml": Exporter(ros_yaml.build_ros_yaml),
    "ros2-control": Exporter(ros2_control.build_ros2_transmissions, only=ONLY_OFFSETS),
    "dh-csv": Exporter(dh_csv.build_dh_csv),
    "json": Exporter(robot_json.build_robot_json, couples=True),
    "moc": Exporter(moc.build_moc_file, moc.list_written_compliance_effects),
    "mjcf": Exporter(
        import_function_on_call(MJCF_EXPORTER_MODULE, "build_mjcf_file"),
        import_function_on_call(MJCF_EXPORTER_MODULE, "list_effects_held_by_mjcf"),
        simulated=True,
    ),
}


DOCUMENTED_EXPORT_FORMATS = tuple(
    name for name in EXPORTERS if name != "moc"
)  # its frames are not documented


def find_exporter(format_name: str) -> Exporter:
    """The format of a name.  Raises OptionError."""
    if format_name not in EXPORTERS:
        raise OptionError(
            f"{format_name}: no such format; choose one of {', '.join(DOCUMENTED_EXPORT_FORMATS)}"
        )
    return EXPORTERS[format_name]


def build_exported_file(job: ExportJob, format_name: str) -> ExportedFile:
    """The file in a format, with notices.  Raises OptionError."""
    chosen = find_exporter(format_name)
    if job.originals and format_name != "urdf":
        raise OptionError(f"urdf goes with the format urdf, not with {format_name}")
    if job.model and format_name != "mjcf":
        raise OptionError(f"mjcf goes with the format mjcf, not with {format_name}")
    if job.tip and not (job.originals or job.model):
        raise OptionError("tip names a link of the file given as urdf or mjcf")
    if len(job.robot.coupling) and not chosen.couples:
        able = ", ".join(name for name, one in EXPORTERS.items() if one.couples)
        raise OptionError(
            f"{format_name}: has no place for joints that follow others (coupling); use {able}"
        )
    found = chosen.write(job)
    if not job.originals:  # a given URDF keeps its own constants
        found = replace(found, notices=(*job.notices, *found.notices))
    return found
