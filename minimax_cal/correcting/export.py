"""A calibrated robot as a file that other programs load."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from minimax_cal.correcting.deliverable import Delivered, as_written, block, kept
from minimax_cal.correcting.exporters import table
from minimax_cal.correcting.exporters.job import Export, Job, job_of, read_source
from minimax_cal.fitting.opened import Result
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import check_writable, write_whole
from minimax_cal.ground.options import grouped, takes
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.urdf import ends_of
from minimax_cal.robots.urdf_file import read_urdf


@dataclass(frozen=True, eq=False)
class Exported:
    """A file in a format, and what it delivers of a result; None of a bare robot."""

    format: str
    file: Export
    delivered: Delivered | None = None

    @property
    def notices(self) -> tuple[str, ...]:
        """What people should know about the file, its own accuracy last."""
        own = self.delivered
        return (*self.file.notices, own.sentence()) if own and own.lacks else self.file.notices

    def to_dict(self) -> dict[str, Any]:
        """What is delivered, for JSON."""
        own = self.delivered
        return {"delivered": own.to_dict() if own else block(self.format)}


FORMAT = "The format"
of_format = grouped(FORMAT)


@dataclass(frozen=True)
class ExportOptions:
    """What to export.

    urdf: a file whose joint origins are corrected, all else left as it is.
    mjcf: one whose bodies, gains and springs are.
    tip: last link of the chain in that file.
    experimental: agree to a format whose frames its maker does not document (moc).
    rung: of a diagnosis, the last unless given.
    keep_anyway: also where the calibrated arm is no better than the drawn one.
    """

    urdf: Path | str | None = of_format(  # noqa: RUF009
        None,
        "Correct the joint origins of this URDF; all else stays, byte for byte.",
        metavar="ORIGINAL",
        read=Path,
    )
    mjcf: Path | str | None = of_format(  # noqa: RUF009
        None,
        "Correct the bodies, gains and springs of this MJCF; all else stays.",
        metavar="ORIGINAL",
        read=Path,
    )
    tip: str = of_format("", "The last link of the chain in that file.", metavar="LINK")
    experimental: bool = of_format(False, "Agree to moc.", hidden=True)
    rung: int | None = None
    keep_anyway: bool = of_format(
        False, "Also where the calibrated arm is no better than the drawn one."
    )


@takes(options=ExportOptions)
def export(
    fit: Result | Robot,
    to: str,
    path: Path | str | None = None,
    *,
    options: ExportOptions,
    notify: Callable[[str], object] = warnings.warn,
) -> str:
    """The robot of a calibration in a format that other programs load.

    The geometry is fitted again for exactly the effects that the format carries, with the same
    data and options; `deliver` tells its accuracy, and so does a notice where effects are
    missing.

    Parameters
    ----------
    fit
        A calibration, its cell, a diagnosis, a relative calibration or a robot, or the file
        or name of one.
    to
        urdf, ur-yaml, ros-yaml, ros2-control, dh-csv, json or mjcf.
    path
        Written to as well, where given.
    options
        See `ExportOptions`.
    notify
        Called with what the format cannot hold and other notices.

    Returns
    -------
    str
        The file as text; lengths and angles are in the units of the format.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> text = mc.export(fit, to="urdf", path="arm.urdf")
    """
    if path is not None:
        check_writable(path)
    place = None if path is None else Path(path)
    made = exported(fit, to, place, options)
    written(made.file, place)
    for notice in made.notices:
        notify(notice)
    return made.file.content.decode("utf-8")


def exported(
    fit: Result | Robot,
    to: str,
    path: Path | None = None,
    options: ExportOptions = ExportOptions(),
) -> Exported:
    """The bytes of the file, its notices, and what it delivers; arguments as of `export`."""
    table.exporter(to)
    source, found = read_source(fit, options.rung), None
    if isinstance(source, Job):
        job = source
    else:
        found = kept(source, to, options.keep_anyway)
        q = source.train.q if source.data.poses else None
        job = job_of(source.source, found.cell, found.nominal, q)
    urdf, mjcf = (ends_of(given or "") for given in (options.urdf, options.mjcf))
    job = replace(
        job,
        originals=(read_urdf(urdf[0]),) if urdf[0] else (),
        model=Path(mjcf[0]) if mjcf[0] else None,
        path=path,
        tip=options.tip or urdf[1] or mjcf[1],
        experimental=options.experimental,
    )
    file = table.export(job, to)
    if found is not None and not isinstance(source, Job):
        found = as_written(found, source, file)
    return Exported(to, file, found)


def written(made: Export, path: Path | None) -> None:
    """Write a file and those beside it.  Raises OptionError where these have no place."""
    if path is None and made.beside:
        raise OptionError(
            f"the file needs another beside it (*{', *'.join(made.beside)}); name where to write it"
        )
    if path is not None:
        for ending, content in made.beside.items():
            write_whole(path.with_suffix(ending), content)
        write_whole(path, made.content)
