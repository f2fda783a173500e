r"""ABB `MOC.cfg`: a writer of corrections that is EXPERIMENTAL.

Grammar: a header line ``MOC:CFG_1.0:6:0::``; ``#`` lines; ``SECTION:``; entries ``-name "x" -key
value ...``, continued after ``\``, where a key without a value is a flag.  Metres and radians.  The
file holds no nominal geometry, and its maker documents neither frames nor signs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from minimax_cal.correcting.exporters.job import Export, Job, compliance_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.compliance import JOINT_COMPLIANCE
from minimax_cal.modelling.effects.scene import joint_of
from minimax_cal.modelling.effects.table import Term
from minimax_cal.robots.transforms import inverse, link, to_rpy

HEADER = "MOC:CFG_1.0:6:0::"
KEYS = (
    *(f"error_offset_{axis}" for axis in "xyz"),
    *(f"error_{turn}" for turn in ("roll", "pitch", "jaw")),  # sic
)
WIDTH = 80
NEGLIGIBLE = 1e-12  # a smaller correction is left out, as the maker leaves out defaults [m, rad]
WARNING = (
    "EXPERIMENTAL: the maker documents neither the frames nor the signs of these numbers; here "
    "they are corrections in the frames of minimax-cal, so do not load them into a controller "
    "without a check on the robot"
)

Entry = tuple[tuple[str, str], ...]  # keys and raw values, the value of a flag is empty


def text_of(sections: Mapping[str, Sequence[Entry]], comment: str) -> str:
    """A MOC.cfg of these sections."""
    lines = [HEADER, *(f"# {line}" for line in comment.splitlines())]
    for name, entries in sections.items():
        lines += ["#", f"{name}:"]
        for entry in entries:
            lines += ["", *folded(entry)]
    return "\n".join([*lines, ""])


def folded(entry: Entry) -> list[str]:
    """An entry on lines that end in a backslash where it goes on."""
    lines = [""]
    for key, value in entry:
        part = f"-{key} {value}".rstrip()
        if lines[-1] and len(lines[-1]) + len(part) + 8 > WIDTH:
            lines[-1] += "\\"
            lines.append("")
        lines[-1] = f"{lines[-1]} {part}".strip()
    return [" " * 6 + line for line in lines]


def write(job: Job) -> Export:
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
        arm(i, before, after)
        for i, (before, after) in enumerate(zip(job.nominal.mdh, job.robot.mdh, strict=True))
    )
    joints = tuple(
        (name_of(i), *((("Compl", written(c)),) if np.isfinite(c) else ()))
        for i, c in enumerate(job.compliance)
    )
    comment = (
        "Written by minimax-cal for " + "".join(filter(str.isprintable, job.robot.name)) + ".\n"
        "EXPERIMENTAL: corrections only; the maker documents neither frames nor signs.\n"
        "Here: T of link i = (nominal T of link i) Txyz(offset) Rz(jaw) Ry(pitch) Rx(roll),\n"
        "in frame i after the link Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta), base and\n"
        "tool as in the fit; Compl is the turn of the joint per torque [rad/(N m)]."
    )
    return Export.of(text_of({"ARM_CALIB": arms, "JOINT_CALIB": joints}, comment), WARNING)


def carries(cell: Cell) -> tuple[Term, ...]:
    """The compliance of joints, where each has one number."""
    own = compliance_of(cell)

    def is_written(term: Term) -> bool:
        numbers = own if term.place == "all" else own[[joint_of(term.place)]]
        return bool(np.isfinite(numbers).any())

    name = JOINT_COMPLIANCE.name
    return tuple(t for t in cell.effects.terms if t.effect == name and is_written(t))


def name_of(i: int) -> tuple[str, str]:
    """The name of an arm or joint."""
    return "name", f'"rob1_{i + 1}"'


def arm(i: int, before: Array, after: Array) -> Entry:
    """The correction of a link, in the frame at its end."""
    pose = inverse(link(before)) @ link(after)
    values: Mapping[str, float] = dict(zip(KEYS, (*pose[:3, 3], *to_rpy(pose)), strict=True))
    version = (("absacc_version", "2"),) if i == 0 else ()
    kept = ((key, written(v)) for key, v in values.items() if abs(v) > NEGLIGIBLE)
    return (name_of(i), *version, *kept)


def written(value: float) -> str:
    """A number as the controller writes it, with all its digits."""
    return f"{value:.17G}"
