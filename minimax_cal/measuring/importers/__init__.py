"""Files of trackers and controllers as they are."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.files import write_whole
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.faults import distance_faults
from minimax_cal.measuring.importers import cmm, programs, tables
from minimax_cal.measuring.importers.assemble import Assembly, assemble
from minimax_cal.measuring.importers.join import SAME
from minimax_cal.measuring.importers.tables import Given, Reading
from minimax_cal.measuring.measurements import (
    Measurements,
    check_finite,
    measurements_text,
    without_blind,
)
from minimax_cal.measuring.set_aside import left_out, whole
from minimax_cal.measuring.slips import mended
from minimax_cal.reading.sheet import DECIMALS, DELIMITERS, Sheet, cut, open_text
from minimax_cal.reading.words import ANGLES, LENGTHS, TEMPERATURES, TIMES

__all__ = ["Given", "Imported", "import_files", "read_any", "save", "units_of"]

# The first that fits a file is taken: of the text alone, then of its rows and columns.
Read = Callable[[Sheet, Given, bool], Reading | None]  # None where a file is of another format
OF_TEXT: tuple[Read, ...] = (programs.read, cmm.read)
OF_ROWS: tuple[Read, ...] = (cmm.read, tables.read)
MEASURED = re.compile(r"q\d*|(?:smr|base)\d*(?:_[xyz])?|qread\d*|u95|temperature|time")
OF_JOINTS = re.compile(r"(?:^|[,=])\s*q\d*(?:_|\s*(?:,|$))")
LAYOUTS = ("", "pose", "target")
DATES = ("dmy", "mdy", "ymd")


@dataclass(frozen=True, eq=False)
class Imported:
    """data: the measurements.  assembly: every file and column, and how it was understood."""

    data: Measurements
    assembly: Assembly

    def files(self) -> Table:
        """A row for each file."""
        rows = (
            (s.path, r.format, DELIMITERS.get(s.delimiter, "-"), DECIMALS.get(s.decimal, "-"),
             s.encoding, len(r.line), how)
            for r, how in zip(self.assembly.readings, self.assembly.matched, strict=True)
            for s in [r.sheet]
        )  # fmt: skip
        columns = "file | format | delimiter | decimal | encoding | rows | matched by"
        return Table.made("files", rows, columns)

    def columns(self) -> tuple[Table, ...]:
        """A table for each file: its columns."""
        columns = "column.name=column | meaning | unit | known=known by | first=first row, SI"
        return tuple(
            Table.of(str(r.sheet.path), meanings, columns)
            for r, meanings in zip(self.assembly.readings, self.assembly.meanings, strict=True)
        )

    def preview(self, rows: int = 3) -> Table:
        """The first rows as they were understood, and the last: a column each."""
        data = self.data
        some = sorted({*range(min(rows, data.poses)), data.poses - 1})
        lines: list[tuple[object, ...]] = []
        for i, slides in enumerate(data.sliding):
            factor, unit = (1e3, "mm") if slides else (180.0 / np.pi, "deg")
            lines.append((f"joint {i + 1}", unit, *(factor * data.q[row, i] for row in some)))
        for target, name in enumerate(data.target_names):
            for axis in range(3):
                values = [1e3 * float(data.y[row, target, axis]) for row in some]
                shown = (value if np.isfinite(value) else "" for value in values)
                lines.append((f"{name} {'xyz'[axis]}", "mm", *shown))
        for name, column in data.columns.items():
            lines.append((name, "", *(str(column[row]) for row in some)))
        heads = (f"line {data.line[row]} .4f" for row in some)
        return Table.made("rows as understood", lines, " | unit", *heads)

    def headline(self) -> str:
        """What came out, in a line."""
        data = self.data
        whole = ", ".join(
            f"{name} at {count}"
            for name, count in zip(data.target_names, data.seen.sum(0), strict=True)
        )
        return f"{data.poses} poses, {data.q.shape[1]} joints; points: {whole}"

    def understood(self) -> Measurements:
        """The measurements, with a line that says how the files were read."""
        held = self.assembly.readings[-1].sheet.path
        said = [
            f"{file['file']}: read as {file['format']}, separated by {file['delimiter']}, decimal "
            f"{file['decimal']}, {file['encoding']}"
            + (
                f", matched with {held} by {how}"
                if (how := file["matched by"]) and how != SAME
                else ""
            )
            for file in self.files().records()
        ]
        data = self.data
        told = replace(data, notices=(*data.notices, *said[:-1], f"{said[-1]}: {self.headline()}"))
        return without_blind(told, np.zeros(data.poses, dtype=bool))

    def put_right(self, mend: Sequence[str], leave_out: Sequence[str]) -> Imported:
        """With mends made and points set aside; what then still looks wrong is a notice.

        mend, leave_out: as of `mended` and `left_out`.  Raises CalibrationError.
        """
        data = left_out(mended(self.data, mend), leave_out)
        check_finite(data)  # what is left of it
        off = (fault.text for fault in distance_faults(data))
        return replace(self, data=replace(data, notices=(*data.notices, *off)))

    def csv(self) -> str:
        """The contract's CSV; what nothing uses is kept as text, points set aside with why."""
        data = whole(self.data)
        return measurements_text(replace(data, columns={**data.columns, **data.unknown}))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        data, files = self.data, zip(self.files().records(), self.columns(), strict=True)
        return {
            "poses": data.poses,
            "joints": data.q.shape[1],
            "targets": data.target_names,
            "files": [{**file, "columns": table.records()} for file, table in files],
            "set_aside": data.set_aside,
            "notices": data.notices,
        }


def units_of(given: str | Sequence[str] | Mapping[str, str]) -> Mapping[str, str]:
    """Units by meaning, also from `q=deg,smr=mm`, or bare: `deg,mm`.  Raises OptionError."""
    if isinstance(given, Mapping):
        return given
    found, texts = dict[str, str](), [given] if isinstance(given, str) else given
    for part in (p.strip() for text in texts for p in text.split(",") if p.strip()):
        name, equals, unit = part.rpartition("=")
        if not equals:
            name = "q" if unit in ANGLES else "smr" if unit in LENGTHS else ""
        kinds: Sequence[str] = (*ANGLES, *LENGTHS) if name.startswith("q") else tuple(LENGTHS)
        kinds = TEMPERATURES if name == "temperature" else kinds
        kinds = (*TIMES, *DATES) if name == "time" else kinds
        known = bool(MEASURED.fullmatch(name))
        if not known or unit not in kinds:
            ways = [f"{name}={k}" for k in kinds] if known else ["q=deg", "smr=mm", "time=dmy"]
            raise OptionError(f"units={part!r}: write {', '.join(ways[:-1])} or {ways[-1]}")
        if found.setdefault(name, unit) != unit:
            raise OptionError(f"units={part!r}: {name} is in {found[name]} already; give one unit")
    return found


def read_any(path: Path | str | Sheet, given: Given, *, joints: bool = False) -> Reading:
    """A file in the first format that fits.  joints: the user said that it holds joint values.

    Raises DataError with what to add.
    """
    sheet = open_text(path)
    given = replace(given, columns=given.joint_columns if joints else given.columns)
    if not given.columns:
        for read in OF_TEXT:
            if found := read(sheet, given, joints):
                return found
    sheet = cut(sheet, given.decimal)
    ways = (tables.mapped,) if given.columns else OF_ROWS
    reading = next(filter(None, (read(sheet, given, joints) for read in ways)), None)
    if reading is None:
        raise DataError(unknown(sheet))
    return replace(reading, notices=(*reading.notices, *sheet.left_out()))


def unknown(sheet: Sheet) -> str:
    """A format that nobody knows: what to add."""
    w = sheet.width
    if sheet.header:
        names = ", ".join(sheet.header[:6])
        return (
            f"{sheet.path}:1: columns {names}{' ...' if w > 6 else ''} are not known; say what "
            "they are, as columns='1-3=smr1_mm,4-9=q_deg'"
        )
    targets = 3 if w >= 13 else 1
    example = ",".join([f"smr{i + 1}_mm" for i in range(targets)] + ["q_deg"])
    return (
        f"{sheet.path}: has {w} columns and no header; say what they are, as "
        f"columns='{example}' ({w - 3 * targets} joints) or columns='q_deg,smr1_mm'"
    )


def import_files(
    files: Sequence[Path | str | Sheet],
    joints: Path | str | None = None,
    *,
    columns: str | Sequence[str] = "",
    units: str | Sequence[str] | Mapping[str, str] = (),
    layout: str = "",
    decimal: str = "",
) -> Imported:
    """Measurements from files as trackers and controllers write them.

    Parameters
    ----------
    files
        Their paths.
    joints
        A file of joint values, where the points stand alone.
    columns, units, layout, decimal
        What the files do not tell (the error asks for it), as q=deg or smr=mm; of columns,
        a mapping with joints and no points is that of the file of joints.

    Returns
    -------
    Imported
        The measurements have metres and radians.

    Raises
    ------
    DataError, OptionError
        For wrong input.

    Examples
    --------
    >>> data = mc.import_files(["points.txt"], "joints.txt", units="q=deg,smr=mm").data
    """
    if not files:
        raise OptionError("name a file to import")
    given = given_by(columns, units, layout, decimal, apart=joints is not None)
    readings = [read_any(path, given) for path in files]
    check_twice(readings)
    points = [reading for reading in readings if reading.smrs]
    held = file_of_joints(joints, readings, given)
    where = held.sheet.path
    if not points:
        raise DataError(f"{where}: holds joint values but no points; add the tracker's file")
    neither = [r.sheet.path for r in readings if not (r.smrs or r.joints)]
    if neither:
        raise DataError(f"{neither[0]}: holds neither points nor joint values")
    other = next((r.sheet.path for r in points if r is not held and held in points), None)
    if other:
        raise DataError(
            f"{other}: holds points without joints, but {where} holds both; import it alone"
        )
    assembly = assemble(points, held, given)
    return Imported(assembly.data, assembly)


def check_twice(readings: Sequence[Reading]) -> None:
    """Raise DataError where two files of points are one: they would be two targets in one place."""
    texts: dict[str, Path] = {}
    for path, text in ((r.sheet.path, r.sheet.text) for r in readings if r.smrs):
        first = texts.setdefault(text, path)
        if first is not path:
            what = "is given twice" if first == path else f"holds the same points as {first}"
            raise DataError(f"{path}: {what}; give each target's file once")


def given_by(
    columns: str | Sequence[str],
    units: str | Sequence[str] | Mapping[str, str],
    layout: str,
    decimal: str,
    *,
    apart: bool = False,
) -> Given:
    """What the user says about files.  Raises OptionError."""
    if layout not in LAYOUTS:
        raise OptionError(f"layout={layout!r}: write pose or target")
    sign = {name: sign for sign, name in DECIMALS.items()}.get(decimal, decimal)
    if sign not in ("", *DECIMALS):
        raise OptionError(f"decimal={decimal!r}: write comma or point")
    mappings = [columns] if isinstance(columns, str) else list(columns)
    of_joints = [
        text for text in mappings if apart and "smr" not in text and OF_JOINTS.search(text)
    ]
    others = [text for text in mappings if text and text not in of_joints]
    if len(others) > 1 or len(of_joints) > 1:
        raise OptionError(
            "columns=: two mappings of one file; give one for the points and, with joints=, one "
            "for the joints"
        )
    return Given("".join(others), "".join(of_joints), units_of(units), layout, sign)


def file_of_joints(path: Path | str | None, readings: Sequence[Reading], given: Given) -> Reading:
    """The file of joint values: that of the path, or the only one that holds some.

    Raises DataError.
    """
    turns = [reading for reading in readings if reading.joints]
    others = [reading.sheet.path for reading in turns]
    if path is not None:
        held = read_any(path, given, joints=True)
        if not held.joints:
            raise DataError(f"{path}: holds no joint values; name its columns q1_deg, q2_deg ...")
        if turns:
            raise DataError(
                f"{others[0]}: holds joint values, as joints={str(path)!r} does; leave one of "
                "them out"
            )
        return held
    if len(turns) > 1:
        raise DataError(
            f"{others[1]}: holds joint values, as {others[0]} does; import one at a time, or name "
            "the file of joints as joints="
        )
    points = [reading for reading in readings if reading.smrs]
    if not turns:
        lacks = "points but no joint values; add their file as joints="
        neither = "neither points nor joint values; say what its columns are as columns="
        of = (points or readings)[0].sheet.path
        raise DataError(f"{of}: holds {lacks if points else neither}")
    return turns[0]


def save(path: Path | str, imported: Imported) -> None:
    """Write the contract's CSV."""
    write_whole(path, imported.csv())
