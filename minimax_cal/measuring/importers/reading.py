"""What the columns of a file mean, before they become measurements."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import name_first
from minimax_cal.reading.rows import lacking, numbers
from minimax_cal.reading.sheet import Sheet

POINT_NAME = re.compile(r"smr(\d+)_([xyz])")


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
