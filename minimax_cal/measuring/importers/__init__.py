"""Files of trackers and controllers as they are."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.tables import Table
from minimax_cal.measuring.faults import find_faults_by_distances
from minimax_cal.measuring.file_mistakes import apply_mends
from minimax_cal.measuring.importers import cmm_reports, column_tables, robot_programs
from minimax_cal.measuring.importers.assemble import ImportAssembly, assemble_measurements
from minimax_cal.measuring.importers.column_tables import ImportedTable, ImportOptions
from minimax_cal.measuring.importers.point_pose_matching import SAME_ROW
from minimax_cal.measuring.measurements import (
    Measurements,
    check_measurements,
    drop_rows_without_targets,
    format_measurements_csv,
)
from minimax_cal.measuring.set_aside_points import (
    merge_set_aside_points_with_reasons,
    set_aside_points_named_by_user,
)
from minimax_cal.reading.column_words import (
    COLUMN_SECONDS_PER_TIME_UNIT,
    METRES_PER_LENGTH_UNIT,
    RADIANS_PER_ANGLE_UNIT,
    TEMPERATURE_UNITS,
)
from minimax_cal.reading.text_sheet import (
    DECIMAL_SIGN_NAMES,
    DELIMITER_NAMES,
    Sheet,
    parse_sheet_table,
    read_text_sheet,
)

__all__ = [
    "ImportOptions",
    "Imported",
    "import_files",
    "parse_unit_options",
    "read_in_first_fitting_format",
    "save",
]

# The first that fits a file is taken: of the text alone, then of its rows and columns.
ReadTable = Callable[
    [Sheet, ImportOptions, bool], ImportedTable | None
]  # None where a file is of another format
TEXT_IMPORTERS: tuple[ReadTable, ...] = (
    robot_programs.import_robot_program,
    cmm_reports.import_cmm_report,
)
TABLE_IMPORTERS: tuple[ReadTable, ...] = (
    cmm_reports.import_cmm_report,
    column_tables.import_table_by_header,
)
UNIT_OPTION_PATTERN = re.compile(r"q\d*|(?:smr|base)\d*(?:_[xyz])?|qread\d*|u95|temperature|time")
JOINT_MAPPING_PATTERN = re.compile(r"(?:^|[,=])\s*q\d*(?:_|\s*(?:,|$))")
LAYOUT_CHOICES = ("", "pose", "target")
DATE_ORDERS = ("dmy", "mdy", "ymd")


@dataclass(frozen=True, eq=False)
class Imported:
    """data: the measurements.  assembly: every file and column, and how it was understood."""

    data: Measurements
    assembly: ImportAssembly

    def files(self) -> Table:
        """A row for each file."""
        rows = (
            (
                s.path,
                r.format,
                DELIMITER_NAMES.get(s.delimiter, "-"),
                DECIMAL_SIGN_NAMES.get(s.decimal, "-"),
                s.encoding,
                len(r.line),
                how,
            )
            for r, how in zip(self.assembly.readings, self.assembly.matched, strict=True)
            for s in [r.sheet]
        )
        columns = "file | format | delimiter | decimal | encoding | rows | matched by"
        return Table.from_rows("files", rows, columns)

    def columns(self) -> tuple[Table, ...]:
        """A table for each file: its columns."""
        columns = "column.name=column | meaning | unit | known=known by | first=first row, SI"
        return tuple(
            Table.from_records(str(r.sheet.path), meanings, columns)
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
        return Table.from_rows("rows as understood", lines, " | unit", *heads)

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
                if (how := file["matched by"]) and how != SAME_ROW
                else ""
            )
            for file in self.files().to_records()
        ]
        data = self.data
        told = replace(data, notices=(*data.notices, *said[:-1], f"{said[-1]}: {self.headline()}"))
        return drop_rows_without_targets(told, np.zeros(data.poses, dtype=bool))

    def with_mends(self, mend_texts: Sequence[str], left_out_points: Sequence[str]) -> Imported:
        """With mends made and points set aside; what then still looks wrong is a notice.

        mend_texts, left_out_points: as of `apply_mends` and `set_aside_points_named_by_user`.
        Raises CalibrationError.
        """
        data = set_aside_points_named_by_user(apply_mends(self.data, mend_texts), left_out_points)
        check_measurements(data)  # what is left of it
        off = (fault.text for fault in find_faults_by_distances(data))
        return replace(self, data=replace(data, notices=(*data.notices, *off)))

    def csv(self) -> str:
        """The contract's CSV; what nothing uses is kept as text, points set aside with why."""
        data = merge_set_aside_points_with_reasons(self.data)
        return format_measurements_csv(replace(data, columns={**data.columns, **data.unknown}))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        data, files = self.data, zip(self.files().to_records(), self.columns(), strict=True)
        return {
            "poses": data.poses,
            "joints": data.q.shape[1],
            "targets": data.target_names,
            "files": [{**file, "columns": table.to_records()} for file, table in files],
            "set_aside": data.set_aside,
            "notices": data.notices,
        }


def parse_unit_options(unit_texts: str | Sequence[str] | Mapping[str, str]) -> Mapping[str, str]:
    """Units by meaning, also from `q=deg,smr=mm`, or bare: `deg,mm`.  Raises OptionError."""
    if isinstance(unit_texts, Mapping):
        return unit_texts
    found, texts = dict[str, str](), [unit_texts] if isinstance(unit_texts, str) else unit_texts
    for part in (p.strip() for text in texts for p in text.split(",") if p.strip()):
        name, equals, unit = part.rpartition("=")
        if not equals:
            name = (
                "q"
                if unit in RADIANS_PER_ANGLE_UNIT
                else "smr"
                if unit in METRES_PER_LENGTH_UNIT
                else ""
            )
        kinds: Sequence[str] = (
            (*RADIANS_PER_ANGLE_UNIT, *METRES_PER_LENGTH_UNIT)
            if name.startswith("q")
            else tuple(METRES_PER_LENGTH_UNIT)
        )
        kinds = TEMPERATURE_UNITS if name == "temperature" else kinds
        kinds = (*COLUMN_SECONDS_PER_TIME_UNIT, *DATE_ORDERS) if name == "time" else kinds
        known = bool(UNIT_OPTION_PATTERN.fullmatch(name))
        if not known or unit not in kinds:
            ways = [f"{name}={k}" for k in kinds] if known else ["q=deg", "smr=mm", "time=dmy"]
            raise OptionError(f"units={part!r}: write {', '.join(ways[:-1])} or {ways[-1]}")
        if found.setdefault(name, unit) != unit:
            raise OptionError(f"units={part!r}: {name} is in {found[name]} already; give one unit")
    return found


def read_in_first_fitting_format(
    path: Path | str | Sheet, options: ImportOptions, *, holds_joints: bool = False
) -> ImportedTable:
    """A file in the first format that fits.  holds_joints: the user said that it holds joint
    values.

    Raises DataError with what to add.
    """
    sheet = read_text_sheet(path)
    options = replace(options, columns=options.joint_columns if holds_joints else options.columns)
    if not options.columns:
        for read in TEXT_IMPORTERS:
            if found := read(sheet, options, holds_joints):
                return found
    sheet = parse_sheet_table(sheet, options.decimal)
    ways = (column_tables.import_table_by_mapping,) if options.columns else TABLE_IMPORTERS
    reading = next(filter(None, (read(sheet, options, holds_joints) for read in ways)), None)
    if reading is None:
        raise DataError(describe_unknown_format(sheet))
    return replace(reading, notices=(*reading.notices, *sheet.list_left_out_notices()))


def describe_unknown_format(sheet: Sheet) -> str:
    """A format that nobody knows: what to add."""
    w = sheet.column_count
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
    given = build_import_options(columns, units, layout, decimal, has_joint_file=joints is not None)
    readings = [read_in_first_fitting_format(path, given) for path in files]
    check_no_duplicate_point_files(readings)
    points = [reading for reading in readings if reading.target_numbers]
    held = find_joint_table(joints, readings, given)
    where = held.sheet.path
    if not points:
        raise DataError(f"{where}: holds joint values but no points; add the tracker's file")
    neither = [r.sheet.path for r in readings if not (r.target_numbers or r.joint_columns)]
    if neither:
        raise DataError(f"{neither[0]}: holds neither points nor joint values")
    other = next((r.sheet.path for r in points if r is not held and held in points), None)
    if other:
        raise DataError(
            f"{other}: holds points without joints, but {where} holds both; import it alone"
        )
    assembly = assemble_measurements(points, held, given)
    return Imported(assembly.data, assembly)


def check_no_duplicate_point_files(tables: Sequence[ImportedTable]) -> None:
    """Raise DataError where two files of points are one: they would be two targets in one place."""
    texts: dict[str, Path] = {}
    for path, text in ((r.sheet.path, r.sheet.text) for r in tables if r.target_numbers):
        first = texts.setdefault(text, path)
        if first is not path:
            what = "is given twice" if first == path else f"holds the same points as {first}"
            raise DataError(f"{path}: {what}; give each target's file once")


def build_import_options(
    columns: str | Sequence[str],
    units: str | Sequence[str] | Mapping[str, str],
    layout: str,
    decimal: str,
    *,
    has_joint_file: bool = False,
) -> ImportOptions:
    """What the user says about files.  Raises OptionError."""
    if layout not in LAYOUT_CHOICES:
        raise OptionError(f"layout={layout!r}: write pose or target")
    sign = {name: sign for sign, name in DECIMAL_SIGN_NAMES.items()}.get(decimal, decimal)
    if sign not in ("", *DECIMAL_SIGN_NAMES):
        raise OptionError(f"decimal={decimal!r}: write comma or point")
    mappings = [columns] if isinstance(columns, str) else list(columns)
    of_joints = [
        text
        for text in mappings
        if has_joint_file and "smr" not in text and JOINT_MAPPING_PATTERN.search(text)
    ]
    others = [text for text in mappings if text and text not in of_joints]
    if len(others) > 1 or len(of_joints) > 1:
        raise OptionError(
            "columns=: two mappings of one file; give one for the points and, with joints=, one "
            "for the joints"
        )
    return ImportOptions(
        "".join(others), "".join(of_joints), parse_unit_options(units), layout, sign
    )


def find_joint_table(
    joint_path: Path | str | None, imported_tables: Sequence[ImportedTable], options: ImportOptions
) -> ImportedTable:
    """The file of joint values: that of the path, or the only one that holds some.

    Raises DataError.
    """
    turns = [reading for reading in imported_tables if reading.joint_columns]
    others = [reading.sheet.path for reading in turns]
    if joint_path is not None:
        held = read_in_first_fitting_format(joint_path, options, holds_joints=True)
        if not held.joint_columns:
            raise DataError(
                f"{joint_path}: holds no joint values; name its columns q1_deg, q2_deg ..."
            )
        if turns:
            raise DataError(
                f"{others[0]}: holds joint values, as "
                f"joints={str(joint_path)!r} does; leave one of "
                "them out"
            )
        return held
    if len(turns) > 1:
        raise DataError(
            f"{others[1]}: holds joint values, as {others[0]} does; import one at a time, or name "
            "the file of joints as joints="
        )
    points = [reading for reading in imported_tables if reading.target_numbers]
    if not turns:
        lacks = "points but no joint values; add their file as joints="
        neither = "neither points nor joint values; say what its columns are as columns="
        of = (points or imported_tables)[0].sheet.path
        raise DataError(f"{of}: holds {lacks if points else neither}")
    return turns[0]


def save(path: Path | str, imported: Imported) -> None:
    """Write the contract's CSV."""
    write_file_atomically(path, imported.csv())
