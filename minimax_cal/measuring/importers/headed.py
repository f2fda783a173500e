"""Tables with a header, and tables of nothing but numbers that are points or joints."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.reading import (
    Column,
    Given,
    Reading,
    checked,
    family_of,
)
from minimax_cal.reading.sheet import Sheet, is_number
from minimax_cal.reading.words import (
    WORDS,
    along_arm,
    joints_of,
    kind_of,
    plain,
    points_of,
    split_unit,
    stems_of,
)

Meanings = Mapping[str, str]
Stems = Sequence[str]
XYZ = frozenset("xyz")
MEASURED = {f"measurement_{axis}": f"smr1_{axis}" for axis in "xyz"}
MARKER = re.compile(r"([xyz])(\d+)")
TURNED = re.compile(r"phi[xyz]\d+")
LEAST_JOINTS = 2
MARKS = ("delete", "deleted", "gel\N{LATIN SMALL LETTER O WITH DIAERESIS}scht")
YES = {"true", "yes", "1", "x", "y", "wahr", "ja", "j", "vrai", "oui", *MARKS}
NO = {"", "false", "no", "0", "-", "n", "falsch", "nein", "faux", "non"}
KEPT = "kept as it is"
SCATTER = "scatter of samples, not an uncertainty"


@dataclass(frozen=True)
class Format:
    """A kind of table: title, whether a header is its own, what its names mean, units it fixes.

    fits: of the names without units, and whether the user says that the file is of joints.
    """

    title: str
    fits: Callable[[Stems, bool], bool]
    meanings: Callable[[Stems], Meanings]
    units: Mapping[str, str] = field(default_factory=dict)
    remark: Callable[[str], str] = lambda stem: ""
    notice: str = ""


def in_words(stems: Stems) -> Meanings:
    """Names in plain words of several languages."""
    return {**joints_of(stems), **points_of(stems)}


def of_tracker6d(stems: Stems) -> Meanings:
    """Named joints beside the measured pose, of which the origin counts."""
    named = along_arm([stem for stem in stems if stem.endswith("_joint")])
    return MEASURED | {stem: f"q{i + 1}" for i, stem in enumerate(named)}


def of_figaroh(stems: Stems) -> Meanings:
    """Markers x1, y1, z1 ...; what is neither marker nor known is a joint."""
    others = [s for s in stems if not (MARKER.fullmatch(s) or TURNED.fullmatch(s) or plain(s))]
    joints = {stem: f"q{i + 1}" for i, stem in enumerate(along_arm(others))}
    return {s: f"smr{m[2]}_{m[1]}" for s in stems if (m := MARKER.fullmatch(s))} | joints


TRACKER6D = Format(
    "6D tracker log",
    lambda stems, joints: (
        {*MEASURED} <= {*stems} and any(stem.endswith("_joint") for stem in stems)
    ),
    of_tracker6d,
    remark=lambda stem: SCATTER if stem.startswith("measurement_std_") else "",
)
ROBODK = Format(
    "RoboDK CSV",
    lambda stems, joints: {"j1", "j2", *XYZ} <= {*stems},
    lambda stems: {**joints_of(stems), **points_of("xyz")},
    {"q": "deg", "smr": "mm"},
    notice="x, y, z are taken as measured points; if they are the controller's own pose there is "
    "nothing to calibrate from",
)
POINTS = Format("points", lambda stems, joints: not joints and bool(points_of(stems)), in_words)
FORMATS = (  # the first that fits is taken
    ROBODK,
    TRACKER6D,
    Format(
        "minimax-cal CSV",
        lambda stems, joints: (
            "q0" not in stems and ("smr1_x" in stems or ("q1" in stems and not points_of(stems)))
        ),
        lambda stems: {stem: stem if kind_of(stem) or stem in WORDS else "" for stem in stems},
        remark=lambda stem: KEPT,  # whatever it means elsewhere
    ),
    Format(
        "FIGAROH CSV",
        lambda stems, joints: tuple(stems[:3]) == ("x1", "y1", "z1") and len(stems) > 4,
        of_figaroh,
        {"q": "rad", "smr": "m"},
    ),
    Format(
        "table of joints and points",
        lambda stems, joints: (
            not joints and len(joints_of(stems)) >= LEAST_JOINTS and bool(points_of(stems))
        ),
        in_words,
    ),
    Format(
        "joint values",  # beside x, y, z only if the user says so
        lambda stems, joints: bool(joints_of(stems)) and (joints or not {*stems} >= XYZ),
        in_words,
    ),
    POINTS,
)


def read(sheet: Sheet, given: Given, joints: bool) -> Reading | None:
    """The columns, as the first format that fits has them; None where none does.

    Raises DataError.
    """
    if not sheet.header:
        fits = sheet.width > 1 if joints else sheet.width == len(XYZ)
        return headless(sheet, joints) if fits else None
    stems = stems_of(sheet.header)
    form = next((form for form in FORMATS if form.fits(stems, joints)), None)
    return understood(sheet, form) if form else None


def understood(sheet: Sheet, form: Format) -> Reading:
    """The columns, as a format has them.  Raises DataError."""
    stems = stems_of(sheet.header)
    meanings = form.meanings(stems)
    columns = []
    for i, (name, stem) in enumerate(zip(sheet.header, stems, strict=True)):
        own = stem if kind_of(stem) not in ("", "q", "smr") else ""
        what = meanings[stem] if stem in meanings else plain(stem) or own
        unit, known = split_unit(name)[1], "header"
        if not unit:
            unit = form.units.get(family_of(what), "")
            known = "format" if unit else ""
        cells = tuple(row[i] for row in sheet.cells)
        columns.append(Column(name, what, unit, cells, known, "" if what else form.remark(stem)))
    reading = checked(Reading(form.title, sheet, tuple(one_name(columns)), sheet.line))
    reading = replace(reading, deleted=deleted_rows(reading))
    if form is ROBODK:
        reading = with_tools(reading, stems)
    return reading.saying(form.notice) if form.notice else reading


def headless(sheet: Sheet, joints: bool) -> Reading:
    """Three columns of a point, or joints; a first column of words is the key of joints."""
    first = [row[0] for row in sheet.cells]
    keyed = joints and bool(first) and not any(map(is_number, first))
    names = [f"smr1_{axis}" for axis in "xyz"]
    if joints:
        names = ["pose"] * keyed + [f"q{i + 1}" for i in range(sheet.width - keyed)]
    columns = tuple(
        Column(f"column {i + 1}", what, "", tuple(row[i] for row in sheet.cells))
        for i, what in enumerate(names)
    )
    title = "joint values" if joints else "points"
    return checked(Reading(title, sheet, columns, sheet.line))


def one_name(columns: Sequence[Column]) -> list[Column]:
    """The columns with one of several that name the points: the one that tells most apart."""
    named = [column for column in columns if column.meaning == "pose"]
    if len(named) < 2:
        return list(columns)
    words = {c.name: any(not is_number(cell) for cell in c.cells) for c in named}
    best = max(named, key=lambda c: (len(set(c.cells)), words[c.name]))
    other = f"points have their names in column {best.name}"
    return [
        replace(c, meaning="", remark=other) if c.meaning == "pose" and c is not best else c
        for c in columns
    ]


def with_tools(reading: Reading, stems: Stems) -> Reading:
    """A tool that differs between rows, as a target of its own."""
    tools = [i for i, stem in enumerate(stems) if stem.startswith("tool")]
    labels = tuple(" ".join(row[i] for i in tools) for row in reading.sheet.cells)
    if reading.find("target") or len(set(labels)) < 2:
        return reading
    return replace(reading, columns=(*reading.columns, Column("tool", "target", "", labels)))


def deleted_rows(reading: Reading) -> tuple[int, ...]:
    """Rows that a column marks as deleted.  Raises DataError for a mark that says neither."""
    gone = set[int]()
    for mark in reading.columns:
        if mark.meaning or mark.name.lower() not in MARKS:
            continue
        cells = [cell.lower() for cell in mark.cells]
        for line, cell in zip(reading.line, cells, strict=True):
            if cell not in YES | NO:
                raise DataError(
                    f"{reading.sheet.path}:{line}: column {mark.name}: {cell!r} does not say "
                    "whether the point is deleted; write true or false"
                )
        gone |= {i for i, cell in enumerate(cells) if cell in YES}
    return tuple(sorted(gone))
