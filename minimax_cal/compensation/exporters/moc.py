r"""ABB `MOC.cfg`: a writer of corrections that is EXPERIMENTAL.

Grammar: a header line ``MOC:CFG_1.0:6:0::``; ``#`` lines; ``SECTION:``; entries ``-name "x" -key
value ...``, continued after ``\``, where a key without a value is a flag.  Metres and radians.  The
file holds no nominal geometry, and its maker documents neither frames nor signs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from minimax_cal.compensation.exporters.export_job import ExportedFile, ExportJob, joint_compliances
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.compliance import JOINT_COMPLIANCE
from minimax_cal.modelling.effects.scene import joint_index_from_place
from minimax_cal.modelling.effects.table import Term
from minimax_cal.robots.transforms import invert_transform, link_transform, pose_to_rpy

MOC_HEADER_LINE = "MOC:CFG_1.0:6:0::"
MOC_CORRECTION_KEYS = (
    *(f"error_offset_{axis}" for axis in "xyz"),
    *(f"error_{turn}" for turn in ("roll", "pitch", "jaw")),  # sic
)
MAX_MOC_LINE_LETTERS = 80
MAX_OMITTED_CORRECTION = (
    1e-12  # a smaller correction is left out, as the maker leaves out defaults [m, rad]
)
MOC_EXPERIMENTAL_WARNING = (
    "EXPERIMENTAL: the maker documents neither the frames nor the signs of these numbers; here "
    "they are corrections in the frames of minimax-cal, so do not load them into a controller "
    "without a check on the robot"
)

MocEntry = tuple[tuple[str, str], ...]  # keys and raw values, the value of a flag is empty


def format_moc_sections(sections: Mapping[str, Sequence[MocEntry]], comment: str) -> str:
    """A MOC.cfg of these sections."""
    lines = [MOC_HEADER_LINE, *(f"# {line}" for line in comment.splitlines())]
    for name, entries in sections.items():
        lines += ["#", f"{name}:"]
        for entry in entries:
            lines += ["", *wrap_moc_entry(entry)]
    return "\n".join([*lines, ""])


def wrap_moc_entry(entry: MocEntry) -> list[str]:
    """An entry on lines that end in a backslash where it goes on."""
    lines = [""]
    for key, value in entry:
        part = f"-{key} {value}".rstrip()
        if lines[-1] and len(lines[-1]) + len(part) + 8 > MAX_MOC_LINE_LETTERS:
            lines[-1] += "\\"
            lines.append("")
        lines[-1] = f"{lines[-1]} {part}".strip()
    return [" " * 6 + line for line in lines]


def build_moc_file(job: ExportJob) -> ExportedFile:
    """ARM_CALIB and JOINT_CALIB of a fit, corrections only.  Raises OptionError."""
    if not job.experimental:
        raise OptionError(
            "moc: the writer is experimental: ABB documents neither frames nor signs of these "
            "numbers; agree (experimental) to write the corrections all the same"
        )
    if not job.fitted:
        raise OptionError(
            f"moc: {job.source} holds no nominal robot, and the format holds corrections "
            "only; export a fit written by minimax-cal calibrate"
        )
    if job.robot.prismatic.any():
        raise OptionError("moc: the format is for turning joints")
    arms = tuple(
        build_link_correction_entry(i, before, after)
        for i, (before, after) in enumerate(zip(job.nominal.mdh, job.robot.mdh, strict=True))
    )
    joints = tuple(
        (build_name_item(i), *((("Compl", format_moc_number(c)),) if np.isfinite(c) else ()))
        for i, c in enumerate(job.compliance)
    )
    comment = (
        "Written by minimax-cal for " + "".join(filter(str.isprintable, job.robot.name)) + ".\n"
        "EXPERIMENTAL: corrections only; the maker documents neither frames nor signs.\n"
        "Here: T of link i = (nominal T of link i) Txyz(offset) Rz(jaw) Ry(pitch) Rx(roll),\n"
        "in frame i after the link Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta), base and\n"
        "tool as in the fit; Compl is the turn of the joint per torque [rad/(N m)]."
    )
    return ExportedFile.from_text(
        format_moc_sections({"ARM_CALIB": arms, "JOINT_CALIB": joints}, comment),
        MOC_EXPERIMENTAL_WARNING,
    )


def list_written_compliance_effects(cell: Cell) -> tuple[Term, ...]:
    """The compliance of joints, where each has one number."""
    own = joint_compliances(cell)

    def is_written(term: Term) -> bool:
        numbers = own if term.place == "all" else own[[joint_index_from_place(term.place)]]
        return bool(np.isfinite(numbers).any())

    name = JOINT_COMPLIANCE.name
    return tuple(t for t in cell.effects.terms if t.effect == name and is_written(t))


def build_name_item(index: int) -> tuple[str, str]:
    """The name of an arm or joint."""
    return "name", f'"rob1_{index + 1}"'


def build_link_correction_entry(
    link_index: int, nominal_link: Array, calibrated_link: Array
) -> MocEntry:
    """The correction of a link, in the frame at its end."""
    pose = invert_transform(link_transform(nominal_link)) @ link_transform(calibrated_link)
    values: Mapping[str, float] = dict(
        zip(MOC_CORRECTION_KEYS, (*pose[:3, 3], *pose_to_rpy(pose)), strict=True)
    )
    version = (("absacc_version", "2"),) if link_index == 0 else ()
    kept = (
        (key, format_moc_number(v)) for key, v in values.items() if abs(v) > MAX_OMITTED_CORRECTION
    )
    return (build_name_item(link_index), *version, *kept)


def format_moc_number(value: float) -> str:
    """A number as the controller writes it, with all its digits."""
    return f"{value:.17G}"
