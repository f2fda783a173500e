"""CSV files with the unit in every column's name: rows, names, numbers."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.reading.column_words import (
    JOINT_WORDS_REGEX,
    LENGTH_COLUMN_UNITS,
    STANDARD_COLUMN_KINDS,
    convert_header_to_standard_names,
    convert_to_standard_name,
    fold_case_and_accents,
    joint_number_in_name,
    names_without_units,
    parse_standard_column_name,
    similar_column_hint,
    split_name_and_unit,
)
from minimax_cal.reading.text_sheet import (
    CELL_NUMBER_PATTERN,
    COMMA_NUMBER_PATTERN,
    Sheet,
    parse_numbers,
    parse_sheet_table,
    read_text_sheet,
)

SI_PER_COLUMN_UNIT = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3}
MAX_JOINT_VALUE = 1e5  # of a joint: 16,000 turns, or 100 km [rad, m]
JOINT_COLUMN_PATTERN, TARGET_COLUMN_PATTERN = (
    re.compile(STANDARD_COLUMN_KINDS[kind].full_name_pattern) for kind in ("q", "smr")
)
MEASUREMENT_TEXT_KINDS = {kind for kind, own in STANDARD_COLUMN_KINDS.items() if own.text}
EXAMPLE_COLUMN_NAMES = (
    "order",
    "time_s",
    "temperature_C",
    "payload_kg",
    "session",
    "group",
    "u95_mm",
    "pose",
    "split",
    "set_aside",
    "tool",
    "payload_x_mm",
    "q1_rad",
    "q1_deg",
    *(f"smr1_{axis}_mm" for axis in "xyz"),
)
MATCH_NOTHING_PATTERN = re.compile(r"(?!)")
NUMBER_WITH_UNIT_CELL_PATTERN = re.compile(
    rf"{CELL_NUMBER_PATTERN.pattern} ?[^\W\d_]{{1,3}}|{CELL_NUMBER_PATTERN.pattern} ?[\u00b0\u00ba]"
)
EMPTY_CELL_WORDS = ("", "-", "--", "---", "n/a", "na", "#n/a", "n.a.", "k.a.", "null", "none")
JOINT_OPTION_COLUMN_PATTERN = re.compile(r"(?:approach|tau|qread)(\d+)(?:_\w+)?")


class OptionalColumns(NamedTuple):
    """Optional columns in SI, and why others are not used, both by the column's name."""

    values: dict[str, Array]
    unused_reasons: dict[str, str]


class JointColumns(NamedTuple):
    """Joint values (m, n) [rad, m], and (n,) True for columns with a unit of length."""

    joint_values: Array
    sliding: Array


@dataclass(frozen=True, eq=False)
class MeasurementTable:
    """A table as text: header, rows, and the line on which each row ends.

    header: names as this project has them.  given: as the file has them.  block: the rows as
    numbers, where all cells are.
    """

    sheet: Sheet
    path: Path | str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    line: Array
    given: tuple[str, ...] = ()
    block: Array | None = None
    notices: tuple[str, ...] = ()

    @property
    def has_standard_column_names(self) -> bool:
        """Whether joints or targets have this project's names in the file."""
        names = (convert_to_standard_name(name, self.given) for name in self.given)
        return any(parse_standard_column_name(name)[0] in ("q", "smr") for name in names)

    def text_column(self, name: str) -> list[str]:
        """The cells of a column."""
        at = self.header.index(name)
        return [row[at] for row in self.rows]

    def number_column(self, name: str, *, unit: str = "", allow_empty: bool = False) -> Array:
        """A column as floats, in SI.  allow_empty: whether empty cells, NaN, are allowed."""
        at = self.header.index(name)
        if self.block is not None:
            return self.block[:, at] * SI_PER_COLUMN_UNIT.get(unit, 1.0)
        called = self.given[at]
        values = parse_number_column(
            self.path, called, [row[at] for row in self.rows], self.line, allow_empty=allow_empty
        )
        return values * SI_PER_COLUMN_UNIT.get(unit, 1.0)

    def optional_and_unused_columns(
        self,
        handled_pattern: re.Pattern[str] = MATCH_NOTHING_PATTERN,
        uncertainty_pattern: re.Pattern[str] = MATCH_NOTHING_PATTERN,
    ) -> OptionalColumns:
        """The optional columns by name, in SI, and columns that are not used, with why.

        handled_pattern: names of columns that the caller reads.  uncertainty_pattern: of the
        instrument's accuracy, with the unit as their group; others have no use there.
        """
        columns: dict[str, Array] = {}
        unused = {
            name: f": {why}"
            for name, why in find_useless_columns(self.header).items()
            if not handled_pattern.fullmatch(name)
        }
        for name in self.header:
            kind, stem, unit = parse_standard_column_name(name)
            if name in unused or handled_pattern.fullmatch(name) or kind in ("q", "smr"):
                continue
            if doubt := uncertainty_pattern.fullmatch(name):
                unit = doubt[1]
                stem = name.removesuffix(f"_{unit}")
            if kind in MEASUREMENT_TEXT_KINDS:
                columns[name] = np.array(self.text_column(name))
            elif doubt or kind not in ("", "u95"):
                columns[stem] = self.number_column(name, unit=unit, allow_empty=True)
            else:
                unused[name] = "" if kind else similar_column_hint(name, EXAMPLE_COLUMN_NAMES)
        return OptionalColumns(columns, unused)

    def joint_values_and_sliding(self) -> JointColumns:
        """Joint values (m, n) [rad, m], and (n,) True where a column has a unit of length."""
        found = sorted(
            (int(m[1]), m[2], name)
            for name in self.header
            if (m := JOINT_COLUMN_PATTERN.fullmatch(name))
        )
        q = np.stack([self.number_column(name, unit=unit) for _, unit, name in found], axis=1)
        if (odd := np.abs(q) > MAX_JOINT_VALUE).any():
            row, joint = np.argwhere(odd)[0]
            name = found[joint][2]
            raise DataError(
                f"{self.path}:{self.line[row]}: column {name}: "
                f"{self.text_column(name)[row]} cannot be; "
                "check the number and its unit"
            )
        return JointColumns(q, np.array([unit in ("m", "mm") for _, unit, _ in found]))


def read_measurement_table(path: Path | str | Sheet) -> MeasurementTable:
    """The columns of a file, or of a text.  Raises DataError where it is no table."""
    table = parse_sheet_table(read_text_sheet(path), lone_column_delimiter=",")
    rows = table.cells
    if table.decimal == "," and table.block is None:
        rows = tuple(
            tuple(c.replace(",", ".") if COMMA_NUMBER_PATTERN.fullmatch(c) else c for c in row)
            for row in rows
        )
    given = table.header or rows[0]
    header = convert_header_to_standard_names(given)
    told = (table.line, given, table.block, table.list_left_out_notices())
    return MeasurementTable(table, table.path, header, rows, *told)


def check_measurement_header(path: Path | str, header: Sequence[str]) -> None:
    """Raise DataError for a header that cannot be understood."""
    kinds = [parse_standard_column_name(name) for name in header]
    stems: dict[str, str] = {}
    for name, (_, stem, _) in zip(header, kinds, strict=True):
        if (first := stems.get(stem)) is not None:
            twice = (
                f"column {name or '(without a name)'} stands twice{joint_numbering_hint(header)}"
            )
            other = f"{first} and {name} are one column; keep one unit"
            raise DataError(f"{path}:1: {twice if first == name else other}")
        stems[stem] = name
    units = {kind: {unit for one, _, unit in kinds if one == kind} for kind in ("q", "smr")}
    if not units["q"]:
        pairs = zip(header, names_without_units(header), strict=True)
        bare = [
            n
            for n, stem in pairs
            if joint_number_in_name(stem) >= 0 and not split_name_and_unit(n)[1]
        ]
        hint = f"; {bare[0]} has no unit: write {bare[0]} [deg], or [rad]" if bare else ""
        raise DataError(
            f"{path}:1: no joint columns; name them q1_rad (or q1_deg, q1_mm), q2_rad, ...{hint}"
        )
    if {"rad", "deg"} <= units["q"]:
        raise DataError(f"{path}:1: joint columns mix _rad and _deg; use one of them")
    if not units["smr"]:
        raise DataError(f"{path}:1: no target columns; name them smr1_x_mm, smr1_y_mm, smr1_z_mm")
    if lost := find_missing_column([stem for kind, stem, _ in kinds if kind]):
        beside = lost[:-1] if "_" in lost else "q"
        unit = next(unit for _, stem, unit in kinds if stem.startswith(beside) and unit)
        raise DataError(f"{path}:1: column {lost}_{unit} is missing{joint_numbering_hint(header)}")


def joint_numbering_hint(header: Sequence[str]) -> str:
    """What to do about a joint without its number, as q [rad]; or ''."""
    for name in header:
        stem, unit = split_name_and_unit(name)
        if re.fullmatch(JOINT_WORDS_REGEX, fold_case_and_accents(stem)):
            unit = unit or "deg"
            return f"; number the joints, as q1_{unit}, q2_{unit}, not {name}"
    return ""


def find_missing_column(stems: Collection[str]) -> str:
    """The first joint before the last, or axis of a target, without a column; or ''."""
    joints = [
        int(m[1]) for stem in stems if (m := re.fullmatch(STANDARD_COLUMN_KINDS["q"].stem, stem))
    ]
    targets = {
        int(m[1]) for stem in stems if (m := re.fullmatch(STANDARD_COLUMN_KINDS["smr"].stem, stem))
    }
    last = max(joints, default=0)
    wanted = [f"q{i}" for i in range(1, last + 1)] if last <= len(stems) else [f"q{last - 1}"]
    wanted += [f"smr{number}_{axis}" for number in sorted(targets) for axis in "xyz"]
    return next((stem for stem in wanted if stem not in stems), "")


def find_useless_columns(header: Sequence[str]) -> dict[str, str]:
    """Optional columns that say nothing of this arm, and why."""
    joints = max(
        (int(m[1]) for name in header if (m := JOINT_COLUMN_PATTERN.fullmatch(name))), default=0
    )
    names = {*header}
    out = {}
    for name in header:
        kind, stem, unit = parse_standard_column_name(name)
        beside = [f"{stem[:-1]}{axis}" for axis in "xyz"]
        lost = [
            one for one in beside if not names & {f"{one}_{size}" for size in LENGTH_COLUMN_UNITS}
        ]
        if (m := JOINT_OPTION_COLUMN_PATTERN.fullmatch(name)) and not 1 <= int(m[1]) <= joints:
            out[name] = f"the file has no joint {m[1]}"
        elif kind == "payload centre" and "payload_kg" not in names:
            out[name] = "the file has no column payload_kg"
        elif kind == "payload centre" and lost:
            out[name] = "the payload's centre needs x, y and z"
        elif kind == "base" and lost:
            out[name] = f"{lost[0]}_{unit} is missing"
    return out


def parse_number_column(
    path: Path | str,
    column_name: str,
    cells: Sequence[str],
    lines: Array,
    *,
    decimal_sign: str = ".",
    allow_empty: bool,
) -> Array:
    """One column as floats; an empty cell is NaN where that is allowed.  Raises DataError."""
    out = parse_numbers(cells, decimal_sign)
    for i in np.flatnonzero(~np.isfinite(out)).tolist():
        cell = cells[i]
        if allow_empty and cell.lower() in EMPTY_CELL_WORDS:
            continue
        mends = (
            (not cell, "complete it or delete the row"),
            (COMMA_NUMBER_PATTERN.fullmatch(cell), "use a decimal point"),
            (
                NUMBER_WITH_UNIT_CELL_PATTERN.fullmatch(cell),
                "write the unit in the header, not in the cells",
            ),
            (allow_empty, "mend it, or leave the cell empty where it was not measured"),
            (True, "mend it or delete the row"),
        )
        mend = next(mend for fits, mend in mends if fits)
        wild = np.isinf(out[i]) or cell.lower().strip("+-") == "nan"
        what = f"{cell} is not a finite number" if wild else f"{cell!r} is not a number"
        what = what if cell else "is empty"
        raise DataError(f"{path}:{lines[i]}: column {column_name}: {what}; {mend}")
    return out
