r"""ABB `MOC.cfg`: a reader, and a writer of corrections that is EXPERIMENTAL.

Grammar: a header line ``MOC:CFG_1.0:6:0::``; ``#`` lines; ``SECTION:``; entries ``-name "x" -key
value ...``, continued after ``\``, where a key without a value is a flag.  Metres and radians.  The
file holds no nominal geometry, and its maker documents neither frames nor signs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from minimax_cal.correcting.exporters.job import Export, Job, compliance_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import read_raw
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
CALIBRATED = ("TOOL_INTERFACE", "ARM_CALIB", "JOINT_CALIB", "PARALLEL_ARM_CALIB")
SECTION = re.compile(r"([A-Za-z][A-Za-z0-9_]*):\s*")
KEY = re.compile(r"-([A-Za-z_][A-Za-z0-9_]*)")
TOKEN = re.compile(r'"[^"]*"|[^\s"]+')
WIDTH = 80
NEGLIGIBLE = 1e-12  # a smaller correction is left out, as the maker leaves out defaults [m, rad]
WARNING = (
    "EXPERIMENTAL: the maker documents neither the frames nor the signs of these numbers; here "
    "they are corrections in the frames of minimax-cal, so do not load them into a controller "
    "without a check on the robot"
)

Entry = tuple[tuple[str, str], ...]  # keys and raw values, the value of a flag is empty


@dataclass(frozen=True)
class Section:
    """A section and its entries, in the file's order."""

    name: str
    entries: tuple[Entry, ...]


@dataclass(frozen=True)
class Moc:
    """A file: every section, the text of every value."""

    header: str
    sections: tuple[Section, ...]

    def corrections(self) -> dict[str, dict[str, dict[str, float]]]:
        """Numbers of the calibration sections: by section, name and key [m, rad, rad/(N m)]."""
        out: dict[str, dict[str, dict[str, float]]] = {}
        for section in self.sections:
            if section.name in CALIBRATED:
                for entry in section.entries:
                    row = out.setdefault(section.name, {}).setdefault(named(entry, section), {})
                    row |= {k: real(v, k, section) for k, v in entry if v and k != "name"}
        return out


def named(entry: Entry, section: Section) -> str:
    """The name of an entry.  Raises CalibrationError where it has none."""
    name = dict(entry).get("name", "").strip('"')
    if not name:
        raise CalibrationError(f"MOC.cfg: {section.name}: an entry has no -name")
    return name


def real(text: str, key: str, section: Section) -> float:
    """A number.  Raises CalibrationError."""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise CalibrationError(f"MOC.cfg: {section.name}: -{key} {text}: expected a number")
    return value


def read_moc(path: Path | str) -> Moc:
    """A controller's MOC.cfg, in UTF-8 or Latin-1.  Raises CalibrationError."""
    raw = read_raw(path)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return parse_moc(text, str(path))


def parse_moc(text: str, source: str = "MOC.cfg") -> Moc:
    """The sections of a MOC.cfg.  Raises CalibrationError."""
    lines = text.splitlines()
    header = lines[0].strip() if lines else ""
    if not header.startswith("MOC:CFG_"):
        raise CalibrationError(f"{source}:1: is not a MOC.cfg; expected a first line {HEADER}")
    names: list[str] = []
    entries: list[list[Entry]] = []
    open_line, begun = "", 0
    for number, line in enumerate(lines[1:], 2):
        stripped = line.strip()
        if not open_line and (not stripped or stripped.startswith("#")):
            continue
        begun = begun if open_line else number
        whole = f"{open_line} {stripped}".strip()
        if whole.endswith("\\"):
            open_line = whole[:-1].strip() or " "
            continue
        open_line = ""
        if section := SECTION.fullmatch(whole):
            names.append(section[1])
            entries.append([])
        elif not names:
            raise CalibrationError(f"{source}:{begun}: an entry before any section")
        else:
            entries[-1].append(entry_of(whole, f"{source}:{begun}"))
    if open_line:
        raise CalibrationError(f"{source}:{begun}: ends in the middle of an entry (after \\)")
    return Moc(header, tuple(Section(n, tuple(e)) for n, e in zip(names, entries, strict=True)))


def entry_of(text: str, place: str) -> Entry:
    """The keys and values of an entry.  Raises CalibrationError."""
    if text.count('"') % 2:
        raise CalibrationError(f"{place}: a quotation mark is not closed")
    out: list[tuple[str, str]] = []
    for token in TOKEN.findall(text):
        if key := KEY.fullmatch(token):
            out.append((key[1], ""))
        elif out and not out[-1][1]:
            out[-1] = (out[-1][0], token)
        else:
            raise CalibrationError(f"{place}: {token[:40]!r}: expected -key value")
    return tuple(out)


def text_of(moc: Moc, comment: str = "") -> str:
    """A MOC.cfg that `parse_moc` reads as the same sections."""
    lines = [moc.header, *(f"# {line}" for line in comment.splitlines())]
    for section in moc.sections:
        lines += ["#", f"{section.name}:"]
        for entry in section.entries:
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
    moc = Moc(HEADER, (Section("ARM_CALIB", arms), Section("JOINT_CALIB", joints)))
    comment = (
        "Written by minimax-cal for " + "".join(filter(str.isprintable, job.robot.name)) + ".\n"
        "EXPERIMENTAL: corrections only; the maker documents neither frames nor signs.\n"
        "Here: T of link i = (nominal T of link i) Txyz(offset) Rz(jaw) Ry(pitch) Rx(roll),\n"
        "in frame i after the link Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta), base and\n"
        "tool as in the fit; Compl is the turn of the joint per torque [rad/(N m)]."
    )
    return Export.of(text_of(moc, comment), WARNING)


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
