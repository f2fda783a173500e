"""CSV files with the unit in every column's name: rows, names, numbers."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.reading.sheet import COMMA, POINT, Sheet, cut, numbers_of, open_text
from minimax_cal.reading.words import (
    JOINTS,
    OWN,
    SIZES,
    folded,
    in_own_words,
    joint_number,
    near,
    own_kind,
    own_name,
    split_unit,
    stems_of,
)

UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3}
MOST = 1e5  # of a joint: 16,000 turns, or 100 km [rad, m]
JOINT, TARGET = (re.compile(OWN[kind].pattern) for kind in ("q", "smr"))
TEXT = {kind for kind, own in OWN.items() if own.text}
KNOWN = ("order", "time_s", "temperature_C", "payload_kg", "session", "group", "u95_mm", "pose",
         "split", "set_aside", "tool", "payload_x_mm", "q1_rad", "q1_deg",
         *(f"smr1_{axis}_mm" for axis in "xyz"))  # fmt: skip
NOTHING = re.compile(r"(?!)")
OF_UNIT = re.compile(rf"{POINT.pattern} ?[^\W\d_]{{1,3}}|{POINT.pattern} ?[\u00b0\u00ba]")
MISSING = ("", "-", "--", "---", "n/a", "na", "#n/a", "n.a.", "k.a.", "null", "none")
OF_JOINT = re.compile(r"(?:approach|tau|qread)(\d+)(?:_\w+)?")


@dataclass(frozen=True, eq=False)
class Rows:
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
    def own(self) -> bool:
        """Whether joints or targets have this project's names in the file."""
        names = (own_name(name, self.given) for name in self.given)
        return any(own_kind(name)[0] in ("q", "smr") for name in names)

    def text(self, name: str) -> list[str]:
        """The cells of a column."""
        at = self.header.index(name)
        return [row[at] for row in self.rows]

    def number(self, name: str, *, unit: str = "", empty: bool = False) -> Array:
        """A column as floats, in SI.  empty: whether empty cells, NaN, are allowed."""
        at = self.header.index(name)
        if self.block is not None:
            return self.block[:, at] * UNITS.get(unit, 1.0)
        called = self.given[at]
        values = numbers(self.path, called, [row[at] for row in self.rows], self.line, empty=empty)
        return values * UNITS.get(unit, 1.0)

    def optional(
        self, own: re.Pattern[str] = NOTHING, doubts: re.Pattern[str] = NOTHING
    ) -> tuple[dict[str, Array], dict[str, str]]:
        """The optional columns by name, in SI, and columns that are not used, with why.

        own: names of columns that the caller reads.  doubts: of the instrument's accuracy, with the
        unit as their group; others have no use there.
        """
        columns: dict[str, Array] = {}
        unused = {
            name: f": {why}"
            for name, why in useless(self.header).items()
            if not own.fullmatch(name)
        }
        for name in self.header:
            kind, stem, unit = own_kind(name)
            if name in unused or own.fullmatch(name) or kind in ("q", "smr"):
                continue
            if doubt := doubts.fullmatch(name):
                unit = doubt[1]
                stem = name.removesuffix(f"_{unit}")
            if kind in TEXT:
                columns[name] = np.array(self.text(name))
            elif doubt or kind not in ("", "u95"):
                columns[stem] = self.number(name, unit=unit, empty=True)
            else:
                unused[name] = "" if kind else near(name, KNOWN)
        return columns, unused

    def joints(self) -> tuple[Array, Array]:
        """Joint values (m, n) [rad, m], and (n,) True where a column has a unit of length."""
        found = sorted(
            (int(m[1]), m[2], name) for name in self.header if (m := JOINT.fullmatch(name))
        )
        q = np.stack([self.number(name, unit=unit) for _, unit, name in found], axis=1)
        if (odd := np.abs(q) > MOST).any():
            row, joint = np.argwhere(odd)[0]
            name = found[joint][2]
            raise DataError(
                f"{self.path}:{self.line[row]}: column {name}: {self.text(name)[row]} cannot be; "
                "check the number and its unit"
            )
        return q, np.array([unit in ("m", "mm") for _, unit, _ in found])


def read_rows(path: Path | str | Sheet) -> Rows:
    """The columns of a file, or of a text.  Raises DataError where it is no table."""
    table = cut(open_text(path), alone=",")
    rows = table.cells
    if table.decimal == "," and table.block is None:
        rows = tuple(
            tuple(c.replace(",", ".") if COMMA.fullmatch(c) else c for c in row) for row in rows
        )
    given = table.header or rows[0]
    header = in_own_words(given)
    told = (table.line, given, table.block, table.left_out())
    return Rows(table, table.path, header, rows, *told)


def header_check(path: Path | str, header: Sequence[str]) -> None:
    """Raise DataError for a header that cannot be understood."""
    kinds = [own_kind(name) for name in header]
    stems: dict[str, str] = {}
    for name, (_, stem, _) in zip(header, kinds, strict=True):
        if (first := stems.get(stem)) is not None:
            twice = f"column {name or '(without a name)'} stands twice{numbering(header)}"
            other = f"{first} and {name} are one column; keep one unit"
            raise DataError(f"{path}:1: {twice if first == name else other}")
        stems[stem] = name
    units = {kind: {unit for one, _, unit in kinds if one == kind} for kind in ("q", "smr")}
    if not units["q"]:
        pairs = zip(header, stems_of(header), strict=True)
        bare = [n for n, stem in pairs if joint_number(stem) >= 0 and not split_unit(n)[1]]
        hint = f"; {bare[0]} has no unit: write {bare[0]} [deg], or [rad]" if bare else ""
        raise DataError(
            f"{path}:1: no joint columns; name them q1_rad (or q1_deg, q1_mm), q2_rad, ...{hint}"
        )
    if {"rad", "deg"} <= units["q"]:
        raise DataError(f"{path}:1: joint columns mix _rad and _deg; use one of them")
    if not units["smr"]:
        raise DataError(f"{path}:1: no target columns; name them smr1_x_mm, smr1_y_mm, smr1_z_mm")
    if lost := lacking([stem for kind, stem, _ in kinds if kind]):
        beside = lost[:-1] if "_" in lost else "q"
        unit = next(unit for _, stem, unit in kinds if stem.startswith(beside) and unit)
        raise DataError(f"{path}:1: column {lost}_{unit} is missing{numbering(header)}")


def numbering(header: Sequence[str]) -> str:
    """What to do about a joint without its number, as q [rad]; or ''."""
    for name in header:
        stem, unit = split_unit(name)
        if re.fullmatch(JOINTS, folded(stem)):
            unit = unit or "deg"
            return f"; number the joints, as q1_{unit}, q2_{unit}, not {name}"
    return ""


def lacking(stems: Collection[str]) -> str:
    """The first joint before the last, or axis of a target, without a column; or ''."""
    joints = [int(m[1]) for stem in stems if (m := re.fullmatch(OWN["q"].stem, stem))]
    targets = {int(m[1]) for stem in stems if (m := re.fullmatch(OWN["smr"].stem, stem))}
    last = max(joints, default=0)
    wanted = [f"q{i}" for i in range(1, last + 1)] if last <= len(stems) else [f"q{last - 1}"]
    wanted += [f"smr{number}_{axis}" for number in sorted(targets) for axis in "xyz"]
    return next((stem for stem in wanted if stem not in stems), "")


def useless(header: Sequence[str]) -> dict[str, str]:
    """Optional columns that say nothing of this arm, and why."""
    joints = max((int(m[1]) for name in header if (m := JOINT.fullmatch(name))), default=0)
    names = {*header}
    out = {}
    for name in header:
        kind, stem, unit = own_kind(name)
        beside = [f"{stem[:-1]}{axis}" for axis in "xyz"]
        lost = [one for one in beside if not names & {f"{one}_{size}" for size in SIZES}]
        if (m := OF_JOINT.fullmatch(name)) and not 1 <= int(m[1]) <= joints:
            out[name] = f"the file has no joint {m[1]}"
        elif kind == "payload centre" and "payload_kg" not in names:
            out[name] = "the file has no column payload_kg"
        elif kind == "payload centre" and lost:
            out[name] = "the payload's centre needs x, y and z"
        elif kind == "base" and lost:
            out[name] = f"{lost[0]}_{unit} is missing"
    return out


def numbers(
    path: Path | str,
    name: str,
    cells: Sequence[str],
    line: Array,
    *,
    decimal: str = ".",
    empty: bool,
) -> Array:
    """One column as floats; an empty cell is NaN where that is allowed.  Raises DataError."""
    out = numbers_of(cells, decimal)
    for i in np.flatnonzero(~np.isfinite(out)).tolist():
        cell = cells[i]
        if empty and cell.lower() in MISSING:
            continue
        mends = (
            (not cell, "complete it or delete the row"),
            (COMMA.fullmatch(cell), "use a decimal point"),
            (OF_UNIT.fullmatch(cell), "write the unit in the header, not in the cells"),
            (empty, "mend it, or leave the cell empty where it was not measured"),
            (True, "mend it or delete the row"),
        )
        mend = next(mend for fits, mend in mends if fits)
        wild = np.isinf(out[i]) or cell.lower().strip("+-") == "nan"
        what = f"{cell} is not a finite number" if wild else f"{cell!r} is not a number"
        what = what if cell else "is empty"
        raise DataError(f"{path}:{line[i]}: column {name}: {what}; {mend}")
    return out
