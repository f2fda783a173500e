"""A calibrated robot as a file that other programs load."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from minimax_cal.correcting.exporters import table
from minimax_cal.correcting.exporters.job import Export, read_job
from minimax_cal.fitting.opened import Result
from minimax_cal.ground.files import check_writable, write_whole
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.urdf_file import read_urdf


def export(
    fit: Result | Robot,
    to: str,
    path: Path | str | None = None,
    *,
    urdf: Path | str | None = None,
    tip: str = "",
    experimental: bool = False,
    rung: int | None = None,
    notify: Callable[[str], object] = warnings.warn,
) -> str:
    """The robot of a calibration in a format that other programs load.

    fit: a calibration, its cell, a diagnosis, a relative calibration or a robot, or the file or
    name of one.  to: urdf, ur-yaml,
    ros-yaml, dh-csv, json or moc.  path: written to as well, where given.  urdf: a file whose joint
    origins are corrected, all else left as it is.  tip: last link of the chain in that file.
    experimental: agree to a format whose frames its maker does not document (moc).  rung: of a
    diagnosis, the last unless given.  notify: called
    with what the format cannot hold and other notices.  Lengths and angles are in the units of the
    format.  Raises CalibrationError for wrong input.

    >>> text = mc.export(fit, to="urdf", path="arm.urdf")
    """
    if path is not None:
        check_writable(path)
    made = exported(fit, to, urdf=urdf, tip=tip, experimental=experimental, rung=rung)
    if path is not None:
        write_whole(path, made.content)
    for notice in made.notices:
        notify(notice)
    return made.content.decode("utf-8")


def exported(
    fit: Result | Robot,
    to: str,
    *,
    urdf: Path | str | None = None,
    tip: str = "",
    experimental: bool = False,
    rung: int | None = None,
) -> Export:
    """The bytes of the file and its notices; arguments as of `export`."""
    originals = () if urdf is None else (read_urdf(urdf),)
    job = replace(read_job(fit, rung), originals=originals, tip=tip, experimental=experimental)
    return table.export(job, to)
