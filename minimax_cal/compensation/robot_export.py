"""A calibrated robot as a file that other programs load."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from minimax_cal.compensation.deliverable import (
    Delivered,
    build_delivered_json,
    deliver_if_better,
    with_figures_of_file,
)
from minimax_cal.compensation.exporters import export_formats
from minimax_cal.compensation.exporters.export_job import (
    ExportedFile,
    ExportJob,
    build_export_job,
    open_export_source,
)
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import check_output_path, write_file_atomically
from minimax_cal.core.option_fields import option_field_in_group, take_option_fields_as_keywords
from minimax_cal.fitting.opened_results import ResultOrFile
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.urdf_file import read_urdf
from minimax_cal.robots.urdf_robot import split_file_and_link_names


@dataclass(frozen=True, eq=False)
class ExportResult:
    """A file in a format, and what it delivers of a result; None of a bare robot."""

    format: str
    file: ExportedFile
    delivered: Delivered | None = None

    @property
    def notices(self) -> tuple[str, ...]:
        """What people should know about the file, its own accuracy last."""
        own = self.delivered
        return (*self.file.notices, own.sentence()) if own and own.lacks else self.file.notices

    def to_dict(self) -> dict[str, Any]:
        """What is delivered, for JSON."""
        own = self.delivered
        return {"delivered": own.to_dict() if own else build_delivered_json(self.format)}


EXPORT_OPTION_GROUP = "The format"
export_option = option_field_in_group(EXPORT_OPTION_GROUP)


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

    urdf: Path | str | None = export_option(  # noqa: RUF009
        None,
        "Correct the joint origins of this URDF; all else stays, byte for byte.",
        metavar="ORIGINAL",
        read=Path,
    )
    mjcf: Path | str | None = export_option(  # noqa: RUF009
        None,
        "Correct the bodies, gains and springs of this MJCF; all else stays.",
        metavar="ORIGINAL",
        read=Path,
    )
    tip: str = export_option("", "The last link of the chain in that file.", metavar="LINK")
    experimental: bool = export_option(False, "Agree to moc.", hidden=True)
    rung: int | None = None
    keep_anyway: bool = export_option(
        False, "Also where the calibrated arm is no better than the drawn one."
    )


@take_option_fields_as_keywords(options=ExportOptions)
def export(
    fit: ResultOrFile | Robot,
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
        check_output_path(path)
    place = None if path is None else Path(path)
    made = build_export(fit, to, place, options)
    write_exported_files(made.file, place)
    for notice in made.notices:
        notify(notice)
    return made.file.content.decode("utf-8")


def build_export(
    fit: ResultOrFile | Robot,
    format_name: str,
    path: Path | None = None,
    options: ExportOptions = ExportOptions(),
) -> ExportResult:
    """The bytes of the file, its notices, and what it delivers; arguments as of
    `build_exported_file`.
    """
    export_formats.find_exporter(format_name)
    source, found = open_export_source(fit, options.rung), None
    if isinstance(source, ExportJob):
        job = source
    else:
        found = deliver_if_better(source, format_name, options.keep_anyway)
        q = source.train.q if source.data.poses else None
        job = build_export_job(source.source, found.cell, found.nominal, q)
    urdf, mjcf = (split_file_and_link_names(given or "") for given in (options.urdf, options.mjcf))
    job = replace(
        job,
        originals=(read_urdf(urdf[0]),) if urdf[0] else (),
        model=Path(mjcf[0]) if mjcf[0] else None,
        path=path,
        tip=options.tip or urdf[1] or mjcf[1],
        experimental=options.experimental,
    )
    file = export_formats.build_exported_file(job, format_name)
    if found is not None and not isinstance(source, ExportJob):
        found = with_figures_of_file(found, source, file)
    return ExportResult(format_name, file, found)


def write_exported_files(exported_file: ExportedFile, path: Path | None) -> None:
    """Write a file and those beside it.  Raises OptionError where these have no place."""
    if path is None and exported_file.beside:
        raise OptionError(
            f"the file needs another beside it (*{', *'.join(exported_file.beside)}"
            f"); name where to write it"
        )
    if path is not None:
        for ending, content in exported_file.beside.items():
            write_file_atomically(path.with_suffix(ending), content)
        write_file_atomically(path, exported_file.content)
