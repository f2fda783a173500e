"""Every format that a robot can be written in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import cast

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
from minimax_cal.ground.errors import OptionError
from minimax_cal.modelling.effects.compliance import JOINT_COMPLIANCE


def mjcf(job: Job) -> Export:
    """MJCF, by the room of simulators, which stands on this one: imported at its first use."""
    return cast(Export, import_module("minimax_cal.simulators.exporter").write(job))


EXPORTERS: dict[str, Callable[[Job], Export]] = {
    "urdf": urdf.write,
    "ur-yaml": ur_yaml.write,
    "ros-yaml": ros_yaml.write,
    "ros2-control": ros2_control.write,
    "dh-csv": dh_csv.write,
    "json": robot_json.write,
    "moc": moc.write,
    "mjcf": mjcf,
}


def export(job: Job, to: str) -> Export:
    """The file in a format, with notices.  Raises OptionError."""
    if to not in EXPORTERS:
        raise OptionError(f"{to}: no such format; choose one of {', '.join(EXPORTERS)}")
    if job.originals and to != "urdf":
        raise OptionError(f"urdf goes with the format urdf, not with {to}")
    if job.model and to != "mjcf":
        raise OptionError(f"mjcf goes with the format mjcf, not with {to}")
    if job.tip and not (job.originals or job.model):
        raise OptionError("tip names a link of the file given as urdf or mjcf")
    found = EXPORTERS[to](job)
    if not job.originals:  # a given URDF keeps its own constants
        found = replace(found, notices=(*job.notices, *found.notices))
    lost = [label for label in job.effects if not (to == "moc" and is_written(job, label))]
    if not lost or to == "mjcf":  # which tells itself what it holds
        return found
    said = (
        f"{', '.join(lost)}: effects beyond geometry are not in this file, which then does not "
        "reach the accuracy of the fit; minimax-cal compensate takes them into account"
    )
    return replace(found, notices=(*found.notices, said))


def is_written(job: Job, label: str) -> bool:
    """Whether MOC.cfg holds an effect: the compliance of joints, where each has one number."""
    name, _, place = label.partition(":")
    numbers = job.compliance if place == "all" else job.compliance[int(place[1:]) - 1 :][:1]
    return name == JOINT_COMPLIANCE.name and bool((numbers == numbers).any())
