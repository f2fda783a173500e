"""What the columns of a table mean: by its header, as the user maps them, or without either."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.words import name_first
from minimax_cal.reading.rows import lacking, numbers
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

POINT_NAME = re.compile(r"smr(\d+)_([xyz])")
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
SKIP = re.compile(r"(?:-|skip)(?:\*(\d+))?")
SPAN = re.compile(r"(\d+)(?:-(\d+))?")
SMR = re.compile(r"smr(\d+)")


@dataclass(frozen=True)
class Given:
    """What the user says: columns of points and of joints, units by meaning, layout, decimal."""

    columns: str = ""
    joint_columns: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    layout: str = ""
    decimal: str = ""


def family_of(meaning: str) -> str:
    """A column's meaning without numbers and axes: q, smr, u95."""
    found = re.match(r"u95|[a-z]+", meaning)
    return found[0] if found else ""


@dataclass(frozen=True)
class Column:
    """One column: its name, what it means (as q3, smr1_x, u95, or '' for nothing), its unit.

    known: how the unit is known.  remark: why a column means nothing.
    """

    name: str
    meaning: str
    unit: str
    cells: tuple[str, ...]
    known: str = ""
    remark: str = ""

    @property
    def family(self) -> str:
        """Meaning without numbers and axes."""
        return family_of(self.meaning)


@dataclass(frozen=True, eq=False)
class Reading:
    """A file understood: columns of m cells each, and the line of each row.

    deleted: rows whose point the file itself says is not to be used.
    """

    format: str
    sheet: Sheet
    columns: tuple[Column, ...]
    line: Array
    notices: tuple[str, ...] = ()
    deleted: tuple[int, ...] = ()

    def find(self, meaning: str) -> Column | None:
        """The column with a meaning."""
        return next((c for c in self.columns if c.meaning == meaning), None)

    def column(self, meaning: str) -> Column:
        """The column with a meaning that is surely there."""
        return next(c for c in self.columns if c.meaning == meaning)

    def meaning(self, meanings: Mapping[str, str]) -> Reading:
        """With other meanings of the columns of some names."""
        columns = (replace(c, meaning=meanings.get(c.name, c.meaning)) for c in self.columns)
        return replace(self, columns=tuple(columns))

    @property
    def joints(self) -> tuple[Column, ...]:
        """Joint columns, by number."""
        found = [c for c in self.columns if c.family == "q"]
        return tuple(sorted(found, key=lambda c: int(c.meaning[1:])))

    @property
    def smrs(self) -> tuple[int, ...]:
        """Numbers of the targets that have columns."""
        found = (POINT_NAME.fullmatch(c.meaning) for c in self.columns)
        return tuple(sorted({int(m[1]) for m in found if m}))

    def take(self, rows: Iterable[int]) -> Reading:
        """Some rows only.  rows: their indices, in order."""
        some = [int(row) for row in rows]
        place = {row: i for i, row in enumerate(some)}
        columns = tuple(replace(c, cells=tuple(c.cells[i] for i in some)) for c in self.columns)
        deleted = tuple(place[row] for row in self.deleted if row in place)
        return replace(self, columns=columns, line=self.line[some], deleted=deleted)

    def saying(self, *what: str) -> Reading:
        """With notices, after the name of its file."""
        said = tuple(f"{self.sheet.path}: {text}" for text in what)
        return replace(self, notices=(*self.notices, *said))

    def lines(self, rows: Sequence[int]) -> str:
        """The lines of some rows, for people."""
        named = name_first([str(self.line[row]) for row in rows])
        return f"line{'s' * (len(rows) > 1)} {named}"

    def without_deleted(self) -> Reading:
        """Without the rows that are marked deleted, which have others in their place."""
        kept = sorted({*range(len(self.line))} - {*self.deleted})
        where = self.lines(self.deleted)
        return self.take(kept).saying(f"points that are marked deleted are left out: {where}")

    def with_deleted(self) -> Reading:
        """With rows that are marked deleted as points that are set aside."""
        gone = set(self.deleted)
        columns = tuple(
            replace(c, cells=tuple("" if i in gone else cell for i, cell in enumerate(c.cells)))
            if c.family == "u95"
            else c
            for c in self.columns
        )
        where = self.lines(self.deleted)
        said = f"points that are marked deleted are set aside: {where}"
        return replace(self, columns=columns).saying(said)

    def numbers(self, column: Column, *, empty: bool = True) -> Array:
        """A column as floats, NaN where empty.  Raises DataError."""
        path, sign = self.sheet.path, self.sheet.decimal
        return numbers(path, column.name, column.cells, self.line, decimal=sign, empty=empty)


def checked(reading: Reading) -> Reading:
    """The reading, if no meaning stands twice and every target is whole.  Raises DataError."""
    path = reading.sheet.path
    seen: dict[str, str] = {}
    for column in reading.columns:
        if column.meaning and column.meaning in seen:
            raise DataError(
                f"{path}: columns {seen[column.meaning]!r} and {column.name!r} both are "
                f"{column.meaning}; delete one, or say which with columns="
            )
        seen[column.meaning] = column.name
    if lost := lacking(seen):
        target, _, axis = lost.removeprefix("smr").partition("_")
        what = f"target {target} has no column for {axis}" if axis else f"has no column for {lost}"
        raise DataError(f"{path}: {what.replace('for q', 'for joint ')}; add it")
    return reading


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


def of_own(stems: Stems) -> Meanings:
    """Every name as it is; joints without points have names of poses under any word for these."""
    known = {stem: stem if kind_of(stem) or stem in WORDS else "" for stem in stems}
    lone = not {"pose", "smr1_x"} & {*stems}
    return known | {stem: "pose" for stem in stems if lone and plain(stem) == "pose"}


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
        of_own,
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


def mapped(sheet: Sheet, given: Given, joints: bool) -> Reading:
    """The file under the mapping.  Raises OptionError."""
    tokens = [token.strip() for token in given.columns.split(",") if token.strip()]
    placed = any("=" in token for token in tokens)
    found = by_place(sheet, tokens) if placed else in_order(sheet, tokens)
    columns = []
    for i in range(sheet.width):
        name = sheet.header[i] if sheet.header else f"column {i + 1}"
        what, unit = found.get(i, ("", ""))
        known = "given" if unit else ""
        if what and not unit and sheet.header and (unit := split_unit(name)[1]):
            known = "header"
        columns.append(Column(name, what, unit, tuple(row[i] for row in sheet.cells), known))
    return checked(Reading("columns as mapped", sheet, tuple(columns), sheet.line))


def expand(token: str, room: int) -> list[tuple[str, str]]:
    """Meanings and unit of the columns a token stands for.  room: how many `q` may take."""
    stem, unit = split_unit(token)
    if skip := SKIP.fullmatch(token):
        return [("", "")] * int(skip[1] or 1)
    if stem == "q":
        return [(f"q{i + 1}", unit) for i in range(room)]
    if SMR.fullmatch(stem):
        return [(f"{stem}_{axis}", unit) for axis in "xyz"]
    if what := stem if kind_of(stem) else plain(stem):
        return [(what, unit)]
    raise OptionError(
        f"columns=: {token!r} is not known; write smr1, smr1_mm, q_deg, q1_deg, u95_mm, "
        "temperature_C, time_s, pose, target, order or skip*3"
    )


def in_order(sheet: Sheet, tokens: list[str]) -> dict[int, tuple[str, str]]:
    """Tokens that follow each other; `q` takes what the others leave."""
    if sum(split_unit(token)[0] == "q" for token in tokens) > 1:
        raise OptionError("columns=: q stands twice; write q1_deg, q2_deg, ... for single joints")
    fixed = sum(len(expand(token, 0)) for token in tokens)
    room = sheet.width - fixed
    whole = [pair for token in tokens for pair in expand(token, max(room, 0))]
    if len(whole) != sheet.width:
        raise OptionError(
            f"columns=: means {len(whole)} columns, but {sheet.path} has {sheet.width}; "
            "use skip (or skip*3) for columns to leave out"
        )
    return dict(enumerate(whole))


def by_place(sheet: Sheet, tokens: list[str]) -> dict[int, tuple[str, str]]:
    """Tokens with a place: `1-3=smr1_mm` or a header's name: `X=smr1_x_mm`."""
    found: dict[int, tuple[str, str]] = {}
    for token in tokens:
        place, equals, what = (part.strip() for part in token.partition("="))
        if not equals:
            raise OptionError(f"columns=: {token!r} has no place; write 1-3={token}")
        if place in sheet.header:
            first = last = sheet.header.index(place)
        elif span := SPAN.fullmatch(place):
            first, last = int(span[1]) - 1, int(span[2] or span[1]) - 1
        else:
            raise OptionError(f"columns=: {sheet.path} has no column {place!r}")
        if not 0 <= first <= last < sheet.width:
            raise OptionError(
                f"columns=: {place}: {sheet.path} has columns 1 to {sheet.width} only"
            )
        whole = expand(what, last - first + 1)
        if len(whole) != last - first + 1:
            raise OptionError(
                f"columns=: {token}: {what} takes {len(whole)} columns, {place} are "
                f"{last - first + 1}"
            )
        if twice := found.keys() & set(range(first, last + 1)):
            raise OptionError(f"columns=: {token}: column {min(twice) + 1} is placed twice")
        found |= dict(zip(range(first, last + 1), whole, strict=True))
    return found
