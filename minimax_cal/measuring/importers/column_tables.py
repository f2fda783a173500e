"""What the columns of a table mean: by its header, as the user maps them, or without either."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.reading.column_words import (
    WORDS_BY_MEANING,
    joint_meanings_of_names,
    meaning_of_plain_name,
    names_without_units,
    point_meanings_of_names,
    sort_joint_names_along_arm,
    split_name_and_unit,
    standard_column_kind,
)
from minimax_cal.reading.measurement_table import find_missing_column, parse_number_column
from minimax_cal.reading.text_sheet import Sheet, is_number_cell

POINT_MEANING_PATTERN = re.compile(r"smr(\d+)_([xyz])")
MeaningByStem = Mapping[str, str]
ColumnStems = Sequence[str]
XYZ_LETTERS = frozenset("xyz")
TRACKER6D_POINT_COLUMNS = {f"measurement_{axis}": f"smr1_{axis}" for axis in "xyz"}
MARKER_COLUMN_PATTERN = re.compile(r"([xyz])(\d+)")
MARKER_ANGLE_PATTERN = re.compile(r"phi[xyz]\d+")
MIN_JOINT_COLUMNS = 2
DELETED_COLUMN_NAMES = ("delete", "deleted", "gel\N{LATIN SMALL LETTER O WITH DIAERESIS}scht")
YES_WORDS = {"true", "yes", "1", "x", "y", "wahr", "ja", "j", "vrai", "oui", *DELETED_COLUMN_NAMES}
NO_WORDS = {"", "false", "no", "0", "-", "n", "falsch", "nein", "faux", "non"}
KEPT_REMARK = "kept as it is"
SCATTER_REMARK = "scatter of samples, not an uncertainty"
SKIP_TOKEN_PATTERN = re.compile(r"(?:-|skip)(?:\*(\d+))?")
COLUMN_SPAN_PATTERN = re.compile(r"(\d+)(?:-(\d+))?")
TARGET_STEM_PATTERN = re.compile(r"smr(\d+)")


@dataclass(frozen=True)
class ImportOptions:
    """What the user says: columns of points and of joints, units by meaning, layout, decimal."""

    columns: str = ""
    joint_columns: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    layout: str = ""
    decimal: str = ""


def meaning_family(meaning: str) -> str:
    """A column's meaning without numbers and axes: q, smr, u95."""
    found = re.match(r"u95|[a-z]+", meaning)
    return found[0] if found else ""


@dataclass(frozen=True)
class ImportedColumn:
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
        return meaning_family(self.meaning)


@dataclass(frozen=True, eq=False)
class ImportedTable:
    """A file understood: columns of m cells each, and the line of each row.

    deleted: rows whose point the file itself says is not to be used.
    """

    format: str
    sheet: Sheet
    columns: tuple[ImportedColumn, ...]
    line: Array
    notices: tuple[str, ...] = ()
    deleted: tuple[int, ...] = ()

    def find_column(self, meaning: str) -> ImportedColumn | None:
        """The column with a meaning."""
        return next((c for c in self.columns if c.meaning == meaning), None)

    def column_with_meaning(self, meaning: str) -> ImportedColumn:
        """The column with a meaning that is surely there."""
        return next(c for c in self.columns if c.meaning == meaning)

    def with_meanings(self, meaning_by_column: Mapping[str, str]) -> ImportedTable:
        """With other meanings of the columns of some names."""
        columns = (
            replace(c, meaning=meaning_by_column.get(c.name, c.meaning)) for c in self.columns
        )
        return replace(self, columns=tuple(columns))

    @property
    def joint_columns(self) -> tuple[ImportedColumn, ...]:
        """Joint columns, by number."""
        found = [c for c in self.columns if c.family == "q"]
        return tuple(sorted(found, key=lambda c: int(c.meaning[1:])))

    @property
    def target_numbers(self) -> tuple[int, ...]:
        """Numbers of the targets that have columns."""
        found = (POINT_MEANING_PATTERN.fullmatch(c.meaning) for c in self.columns)
        return tuple(sorted({int(m[1]) for m in found if m}))

    def take_rows(self, rows: Iterable[int]) -> ImportedTable:
        """Some rows only.  rows: their indices, in order."""
        some = [int(row) for row in rows]
        place = {row: i for i, row in enumerate(some)}
        columns = tuple(replace(c, cells=tuple(c.cells[i] for i in some)) for c in self.columns)
        deleted = tuple(place[row] for row in self.deleted if row in place)
        return replace(self, columns=columns, line=self.line[some], deleted=deleted)

    def with_notices(self, *notice_texts: str) -> ImportedTable:
        """With notices, after the name of its file."""
        said = tuple(f"{self.sheet.path}: {text}" for text in notice_texts)
        return replace(self, notices=(*self.notices, *said))

    def format_lines(self, rows: Sequence[int]) -> str:
        """The lines of some rows, for people."""
        named = format_first_names([str(self.line[row]) for row in rows])
        return f"line{'s' * (len(rows) > 1)} {named}"

    def without_deleted(self) -> ImportedTable:
        """Without the rows that are marked deleted, which have others in their place."""
        kept = sorted({*range(len(self.line))} - {*self.deleted})
        where = self.format_lines(self.deleted)
        return self.take_rows(kept).with_notices(
            f"points that are marked deleted are left out: {where}"
        )

    def with_deleted(self) -> ImportedTable:
        """With rows that are marked deleted as points that are set aside."""
        gone = set(self.deleted)
        columns = tuple(
            replace(c, cells=tuple("" if i in gone else cell for i, cell in enumerate(c.cells)))
            if c.family == "u95"
            else c
            for c in self.columns
        )
        where = self.format_lines(self.deleted)
        said = f"points that are marked deleted are set aside: {where}"
        return replace(self, columns=columns).with_notices(said)

    def column_numbers(self, column: ImportedColumn, *, allow_empty: bool = True) -> Array:
        """A column as floats, NaN where empty.  Raises DataError."""
        path, sign = self.sheet.path, self.sheet.decimal
        return parse_number_column(
            path, column.name, column.cells, self.line, decimal_sign=sign, allow_empty=allow_empty
        )


def check_column_meanings(table: ImportedTable) -> ImportedTable:
    """The reading, if no meaning stands twice and every target is whole.  Raises DataError."""
    path = table.sheet.path
    seen: dict[str, str] = {}
    for column in table.columns:
        if column.meaning and column.meaning in seen:
            raise DataError(
                f"{path}: columns {seen[column.meaning]!r} and {column.name!r} both are "
                f"{column.meaning}; delete one, or say which with columns="
            )
        seen[column.meaning] = column.name
    if lost := find_missing_column(seen):
        target, _, axis = lost.removeprefix("smr").partition("_")
        what = f"target {target} has no column for {axis}" if axis else f"has no column for {lost}"
        raise DataError(f"{path}: {what.replace('for q', 'for joint ')}; add it")
    return table


@dataclass(frozen=True)
class TableFormat:
    """A kind of table: title, whether a header is its own, what its names mean, units it fixes.

    fits: of the names without units, and whether the user says that the file is of joints.
    """

    title: str
    fits: Callable[[ColumnStems, bool], bool]
    meanings: Callable[[ColumnStems], MeaningByStem]
    units: Mapping[str, str] = field(default_factory=dict)
    remark: Callable[[str], str] = lambda stem: ""
    notice: str = ""


def meanings_of_plain_words(stems: ColumnStems) -> MeaningByStem:
    """Names in plain words of several languages."""
    return {**joint_meanings_of_names(stems), **point_meanings_of_names(stems)}


def meanings_of_tracker6d(stems: ColumnStems) -> MeaningByStem:
    """Named joints beside the measured pose, of which the origin counts."""
    named = sort_joint_names_along_arm([stem for stem in stems if stem.endswith("_joint")])
    return TRACKER6D_POINT_COLUMNS | {stem: f"q{i + 1}" for i, stem in enumerate(named)}


def meanings_of_figaroh(stems: ColumnStems) -> MeaningByStem:
    """Markers x1, y1, z1 ...; what is neither marker nor known is a joint."""
    others = [
        s
        for s in stems
        if not (
            MARKER_COLUMN_PATTERN.fullmatch(s)
            or MARKER_ANGLE_PATTERN.fullmatch(s)
            or meaning_of_plain_name(s)
        )
    ]
    joints = {stem: f"q{i + 1}" for i, stem in enumerate(sort_joint_names_along_arm(others))}
    return {
        s: f"smr{m[2]}_{m[1]}" for s in stems if (m := MARKER_COLUMN_PATTERN.fullmatch(s))
    } | joints


def meanings_of_standard_format(stems: ColumnStems) -> MeaningByStem:
    """Every name as it is; joints without points have names of poses under any word for these."""
    known = {
        stem: stem if standard_column_kind(stem) or stem in WORDS_BY_MEANING else ""
        for stem in stems
    }
    lone = not {"pose", "smr1_x"} & {*stems}
    return known | {
        stem: "pose" for stem in stems if lone and meaning_of_plain_name(stem) == "pose"
    }


TRACKER6D_FORMAT = TableFormat(
    "6D tracker log",
    lambda stems, joints: (
        {*TRACKER6D_POINT_COLUMNS} <= {*stems} and any(stem.endswith("_joint") for stem in stems)
    ),
    meanings_of_tracker6d,
    remark=lambda stem: SCATTER_REMARK if stem.startswith("measurement_std_") else "",
)
ROBODK_FORMAT = TableFormat(
    "RoboDK CSV",
    lambda stems, joints: {"j1", "j2", *XYZ_LETTERS} <= {*stems},
    lambda stems: {**joint_meanings_of_names(stems), **point_meanings_of_names("xyz")},
    {"q": "deg", "smr": "mm"},
    notice="x, y, z are taken as measured points; if they are the controller's own pose there is "
    "nothing to calibrate from",
)
POINTS_FORMAT = TableFormat(
    "points",
    lambda stems, joints: not joints and bool(point_meanings_of_names(stems)),
    meanings_of_plain_words,
)
TABLE_FORMATS = (  # the first that fits is taken
    ROBODK_FORMAT,
    TRACKER6D_FORMAT,
    TableFormat(
        "minimax-cal CSV",
        lambda stems, joints: (
            "q0" not in stems
            and ("smr1_x" in stems or ("q1" in stems and not point_meanings_of_names(stems)))
        ),
        meanings_of_standard_format,
        remark=lambda stem: KEPT_REMARK,  # whatever it means elsewhere
    ),
    TableFormat(
        "FIGAROH CSV",
        lambda stems, joints: tuple(stems[:3]) == ("x1", "y1", "z1") and len(stems) > 4,
        meanings_of_figaroh,
        {"q": "rad", "smr": "m"},
    ),
    TableFormat(
        "table of joints and points",
        lambda stems, joints: (
            not joints
            and len(joint_meanings_of_names(stems)) >= MIN_JOINT_COLUMNS
            and bool(point_meanings_of_names(stems))
        ),
        meanings_of_plain_words,
    ),
    TableFormat(
        "joint values",  # beside x, y, z only if the user says so
        lambda stems, joints: (
            bool(joint_meanings_of_names(stems)) and (joints or not {*stems} >= XYZ_LETTERS)
        ),
        meanings_of_plain_words,
    ),
    POINTS_FORMAT,
)


def import_table_by_header(
    sheet: Sheet, options: ImportOptions, holds_joints: bool
) -> ImportedTable | None:
    """The columns, as the first format that fits has them; None where none does.

    Raises DataError.
    """
    if not sheet.header:
        fits = sheet.column_count > 1 if holds_joints else sheet.column_count == len(XYZ_LETTERS)
        return import_table_without_header(sheet, holds_joints) if fits else None
    stems = names_without_units(sheet.header)
    form = next((form for form in TABLE_FORMATS if form.fits(stems, holds_joints)), None)
    return interpret_columns(sheet, form) if form else None


def interpret_columns(sheet: Sheet, table_format: TableFormat) -> ImportedTable:
    """The columns, as a format has them.  Raises DataError."""
    stems = names_without_units(sheet.header)
    meanings = table_format.meanings(stems)
    columns = []
    for i, (name, stem) in enumerate(zip(sheet.header, stems, strict=True)):
        own = stem if standard_column_kind(stem) not in ("", "q", "smr") else ""
        what = meanings[stem] if stem in meanings else meaning_of_plain_name(stem) or own
        unit, known = split_name_and_unit(name)[1], "header"
        if not unit:
            unit = table_format.units.get(meaning_family(what), "")
            known = "format" if unit else ""
        cells = tuple(row[i] for row in sheet.cells)
        columns.append(
            ImportedColumn(
                name, what, unit, cells, known, "" if what else table_format.remark(stem)
            )
        )
    reading = check_column_meanings(
        ImportedTable(table_format.title, sheet, tuple(keep_one_name_column(columns)), sheet.line)
    )
    reading = replace(reading, deleted=find_deleted_rows(reading))
    if table_format is ROBODK_FORMAT:
        reading = add_tool_target_column(reading, stems)
    return reading.with_notices(table_format.notice) if table_format.notice else reading


def import_table_without_header(sheet: Sheet, holds_joints: bool) -> ImportedTable:
    """Three columns of a point, or joints; a first column of words is the key of joints."""
    first = [row[0] for row in sheet.cells]
    keyed = holds_joints and bool(first) and not any(map(is_number_cell, first))
    names = [f"smr1_{axis}" for axis in "xyz"]
    if holds_joints:
        names = ["pose"] * keyed + [f"q{i + 1}" for i in range(sheet.column_count - keyed)]
    columns = tuple(
        ImportedColumn(f"column {i + 1}", what, "", tuple(row[i] for row in sheet.cells))
        for i, what in enumerate(names)
    )
    title = "joint values" if holds_joints else "points"
    return check_column_meanings(ImportedTable(title, sheet, columns, sheet.line))


def keep_one_name_column(columns: Sequence[ImportedColumn]) -> list[ImportedColumn]:
    """The columns with one of several that name the points: the one that tells most apart."""
    named = [column for column in columns if column.meaning == "pose"]
    if len(named) < 2:
        return list(columns)
    words = {c.name: any(not is_number_cell(cell) for cell in c.cells) for c in named}
    best = max(named, key=lambda c: (len(set(c.cells)), words[c.name]))
    other = f"points have their names in column {best.name}"
    return [
        replace(c, meaning="", remark=other) if c.meaning == "pose" and c is not best else c
        for c in columns
    ]


def add_tool_target_column(table: ImportedTable, stems: ColumnStems) -> ImportedTable:
    """A tool that differs between rows, as a target of its own."""
    tools = [i for i, stem in enumerate(stems) if stem.startswith("tool")]
    labels = tuple(" ".join(row[i] for i in tools) for row in table.sheet.cells)
    if table.find_column("target") or len(set(labels)) < 2:
        return table
    return replace(table, columns=(*table.columns, ImportedColumn("tool", "target", "", labels)))


def find_deleted_rows(table: ImportedTable) -> tuple[int, ...]:
    """Rows that a column marks as deleted.  Raises DataError for a mark that says neither."""
    gone = set[int]()
    for mark in table.columns:
        if mark.meaning or mark.name.lower() not in DELETED_COLUMN_NAMES:
            continue
        cells = [cell.lower() for cell in mark.cells]
        for line, cell in zip(table.line, cells, strict=True):
            if cell not in YES_WORDS | NO_WORDS:
                raise DataError(
                    f"{table.sheet.path}:{line}: column {mark.name}: {cell!r} does not say "
                    "whether the point is deleted; write true or false"
                )
        gone |= {i for i, cell in enumerate(cells) if cell in YES_WORDS}
    return tuple(sorted(gone))


def import_table_by_mapping(
    sheet: Sheet, options: ImportOptions, holds_joints: bool
) -> ImportedTable:
    """The file under the mapping.  Raises OptionError."""
    tokens = [token.strip() for token in options.columns.split(",") if token.strip()]
    placed = any("=" in token for token in tokens)
    found = map_tokens_by_place(sheet, tokens) if placed else map_tokens_in_order(sheet, tokens)
    columns = []
    for i in range(sheet.column_count):
        name = sheet.header[i] if sheet.header else f"column {i + 1}"
        what, unit = found.get(i, ("", ""))
        known = "given" if unit else ""
        if what and not unit and sheet.header and (unit := split_name_and_unit(name)[1]):
            known = "header"
        columns.append(
            ImportedColumn(name, what, unit, tuple(row[i] for row in sheet.cells), known)
        )
    return check_column_meanings(
        ImportedTable("columns as mapped", sheet, tuple(columns), sheet.line)
    )


def expand_mapping_token(token: str, joint_count: int) -> list[tuple[str, str]]:
    """Meanings and unit of the columns a token stands for.  joint_count: how many `q` may take."""
    stem, unit = split_name_and_unit(token)
    if skip := SKIP_TOKEN_PATTERN.fullmatch(token):
        return [("", "")] * int(skip[1] or 1)
    if stem == "q":
        return [(f"q{i + 1}", unit) for i in range(joint_count)]
    if TARGET_STEM_PATTERN.fullmatch(stem):
        return [(f"{stem}_{axis}", unit) for axis in "xyz"]
    if what := stem if standard_column_kind(stem) else meaning_of_plain_name(stem):
        return [(what, unit)]
    raise OptionError(
        f"columns=: {token!r} is not known; write smr1, smr1_mm, q_deg, q1_deg, u95_mm, "
        "temperature_C, time_s, pose, target, order or skip*3"
    )


def map_tokens_in_order(sheet: Sheet, tokens: list[str]) -> dict[int, tuple[str, str]]:
    """Tokens that follow each other; `q` takes what the others leave."""
    if sum(split_name_and_unit(token)[0] == "q" for token in tokens) > 1:
        raise OptionError("columns=: q stands twice; write q1_deg, q2_deg, ... for single joints")
    fixed = sum(len(expand_mapping_token(token, 0)) for token in tokens)
    room = sheet.column_count - fixed
    whole = [pair for token in tokens for pair in expand_mapping_token(token, max(room, 0))]
    if len(whole) != sheet.column_count:
        raise OptionError(
            f"columns=: means {len(whole)} columns, but {sheet.path} has {sheet.column_count}; "
            "use skip (or skip*3) for columns to leave out"
        )
    return dict(enumerate(whole))


def map_tokens_by_place(sheet: Sheet, tokens: list[str]) -> dict[int, tuple[str, str]]:
    """Tokens with a place: `1-3=smr1_mm` or a header's name: `X=smr1_x_mm`."""
    found: dict[int, tuple[str, str]] = {}
    for token in tokens:
        place, equals, what = (part.strip() for part in token.partition("="))
        if not equals:
            raise OptionError(f"columns=: {token!r} has no place; write 1-3={token}")
        if place in sheet.header:
            first = last = sheet.header.index(place)
        elif span := COLUMN_SPAN_PATTERN.fullmatch(place):
            first, last = int(span[1]) - 1, int(span[2] or span[1]) - 1
        else:
            raise OptionError(f"columns=: {sheet.path} has no column {place!r}")
        if not 0 <= first <= last < sheet.column_count:
            raise OptionError(
                f"columns=: {place}: {sheet.path} has columns 1 to {sheet.column_count} only"
            )
        whole = expand_mapping_token(what, last - first + 1)
        if len(whole) != last - first + 1:
            raise OptionError(
                f"columns=: {token}: {what} takes {len(whole)} columns, {place} are "
                f"{last - first + 1}"
            )
        if twice := found.keys() & set(range(first, last + 1)):
            raise OptionError(f"columns=: {token}: column {min(twice) + 1} is placed twice")
        found |= dict(zip(range(first, last + 1), whole, strict=True))
    return found
