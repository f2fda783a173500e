"""Files understood become measurements in SI, and a table of what was understood."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.measuring.importers.column_tables import (
    KEPT_REMARK,
    ImportedColumn,
    ImportedTable,
    ImportOptions,
)
from minimax_cal.measuring.importers.point_pose_matching import (
    PointPlacement,
    extract_pose_table,
    mark_pose_name_column,
    place_points_and_list_gaps,
    resolve_deleted_points,
    sort_tables_by_file_number,
)
from minimax_cal.measuring.importers.unit_inference import (
    TIME_STAMPS_TEXT,
    decide_units,
    parse_temperature_column,
    parse_time_column,
)
from minimax_cal.measuring.measurements import (
    SET_ASIDE_BY_FILE,
    Measurements,
    RowOrigin,
    apply_simulated_column,
    check_measurements,
)
from minimax_cal.measuring.set_aside_points import (
    SET_ASIDE_COLUMN,
    check_each_target_counts,
    set_aside_points_named_in_column,
    set_points_aside,
)
from minimax_cal.measuring.tool_targets import split_targets_by_tool
from minimax_cal.reading.column_words import METRES_PER_LENGTH_UNIT, RADIANS_PER_ANGLE_UNIT
from minimax_cal.reading.text_sheet import parse_number

TEXT_MEANINGS = ("session", "group", "split", "pose", "tool", SET_ASIDE_COLUMN)
DELETED_IN_FILE_REASON = "marked deleted in the tracker's file"
UNITS_BY_FAMILY = {
    "u95": METRES_PER_LENGTH_UNIT,
    "base": METRES_PER_LENGTH_UNIT,
    "qread": RADIANS_PER_ANGLE_UNIT,
}  # optional columns with a choice
MIXED_UNITS = "mixed"
EXTREME_FUNCTIONS = {"u95": np.fmax, "time": np.fmin}  # which of several values of a pose counts


NO_COLUMN_VALUES = np.empty(0)


@dataclass(frozen=True, eq=False)
class ColumnMeaning:
    """A row of the table: a column, what it means, its unit, how that is known, its first value.

    values: in SI, of a column that becomes one of the measurements'.  kept: only as text.
    """

    column: ImportedColumn
    meaning: str
    unit: str = ""
    known: str = ""
    first: str = ""
    values: Array = field(default_factory=lambda: NO_COLUMN_VALUES)
    kept: bool = False


@dataclass(frozen=True, eq=False)
class ImportAssembly:
    """data: the measurements.  meanings: a tuple for each file, in the order of `readings`."""

    data: Measurements
    readings: tuple[ImportedTable, ...]
    meanings: tuple[tuple[ColumnMeaning, ...], ...]
    matched: tuple[str, ...]


class ColumnUnit(NamedTuple):
    """A unit, '' where unknown, and how it is known."""

    unit: str
    source: str


def find_column_unit(column: ImportedColumn, options: ImportOptions) -> ColumnUnit:
    """A column's unit and how it is known; '' where it is not."""
    for name in (column.meaning, column.meaning.partition("_")[0], column.family):
        if name in options.units:
            also = f", though {column.known} says {column.unit}" if column.unit else ""
            return ColumnUnit(
                options.units[name], "given" + (also if column.unit != options.units[name] else "")
            )
    return ColumnUnit(column.unit, column.known)


def find_shared_unit(
    columns: Sequence[tuple[ImportedTable, ImportedColumn]],
    options: ImportOptions,
    allowed_units: Mapping[str, float],
) -> str:
    """The unit that columns of one kind share, '' where unknown, or MIXED.  Raises DataError."""
    found = {find_column_unit(column, options)[0]: (reading, column) for reading, column in columns}
    for unit, (reading, column) in found.items():
        if unit and unit not in allowed_units:
            raise DataError(
                f"{reading.sheet.path}: column {column.name}: {unit} is no unit for it; one of "
                f"{', '.join(allowed_units)}"
            )
    if len(found) > 1 and "" in found:
        reading, column = found[""]
        raise DataError(
            f"{reading.sheet.path}: column {column.name} has no unit, others have; add "
            f"units='{column.family}={next(unit for unit in found if unit)}'"
        )
    return MIXED_UNITS if len(found) > 1 else next(iter(found), "rad")


@dataclass(frozen=True)
class ImportUnits:
    """What was decided: units of the joints' angles and of the points, and how they are known."""

    q: str
    y: str
    why_q: str
    why_y: str


@dataclass(frozen=True, eq=False)
class ImportPart:
    """A file, the pose (m,) of each of its rows, and which targets its columns smr1 ... are."""

    reading: ImportedTable
    pose: Array
    targets: Mapping[str, tuple[str, ...]]


def assemble_measurements(
    point_tables: Sequence[ImportedTable], joint_table: ImportedTable, options: ImportOptions
) -> ImportAssembly:
    """Measurements from files of points and the file of joints (which may be one).

    Raises DataError.
    """
    alone = joint_table not in point_tables
    if not alone and (apart := extract_pose_table(joint_table)):
        joint_table, alone = apart, True
    point_tables = [
        mark_pose_name_column(reading, joint_table)
        for reading in sort_tables_by_file_number(list(point_tables))
    ]
    point_tables = [
        resolve_deleted_points(reading, joint_table, options.layout) for reading in point_tables
    ]
    joint_table = joint_table if alone else point_tables[0]
    placed = [
        place_points_and_list_gaps(reading, joint_table, options.layout) for reading in point_tables
    ]
    point_tables, places = [reading for reading, _ in placed], [spot for _, spot in placed]
    called = name_targets_of_files(point_tables, places)
    parts = [
        ImportPart(r, at.pose, c) for r, at, c in zip(point_tables, places, called, strict=True)
    ]
    data, scales = build_raw_measurements(parts, places, joint_table, options)
    if alone:
        parts.append(
            ImportPart(ignore_points_of_joint_table(joint_table), np.arange(data.poses), {})
        )
    columns, unknown, meanings = gather_optional_columns(parts, options, scales, data.poses)
    names = (name for r, spot in placed for _ in r.target_numbers for name in spot.names)
    unknown |= {
        f"{target}_target": np.full(data.poses, name)
        for target, name in zip(data.target_names, names, strict=True)
        if name
    }
    readings = tuple(part.reading for part in parts)
    data = replace(
        data,
        columns=columns,
        unknown=unknown,
        notices=tuple(notice for reading in readings for notice in reading.notices),
        source=str(joint_table.sheet.path),
        origins=(build_row_origin(joint_table, point_tables, places),) if alone else (),
        digest=hashlib.sha256("".join(r.sheet.text for r in readings).encode()).hexdigest(),
        simulated=any(r.sheet.is_marked_simulated for r in readings),
    )
    matched = (*(spot.how for spot in places), "")[: len(readings)]
    data = split_targets_by_tool(
        set_aside_deleted_points(
            set_aside_points_named_in_column(apply_simulated_column(data)), point_tables, places
        )
    )
    return ImportAssembly(check_measurements(data), readings, meanings, matched)


def build_row_origin(
    joint_table: ImportedTable,
    point_tables: Sequence[ImportedTable],
    placements: Sequence[PointPlacement],
) -> RowOrigin:
    """The files of points and of joints, and where the point of each pose stands."""
    lines: dict[int, str] = {}
    for reading, spot in zip(point_tables, placements, strict=True):
        for line, pose in zip(reading.line, spot.pose, strict=True):
            lines.setdefault(int(joint_table.line[pose]), f"{reading.sheet.path}:{line}")
    files = tuple(str(reading.sheet.path) for reading in point_tables)
    return RowOrigin(files, str(joint_table.sheet.path), point_lines=lines)


def set_aside_deleted_points(
    data: Measurements, point_tables: Sequence[ImportedTable], placements: Sequence[PointPlacement]
) -> Measurements:
    """The measurements without the points that the trackers' files mark deleted."""
    marked = np.zeros((data.poses, len(data.target_names)), dtype=bool)
    first = 0
    for reading, spot in zip(point_tables, placements, strict=True):
        rows = np.array(reading.deleted, dtype=int)
        for number in range(len(reading.target_numbers)):
            marked[spot.pose[rows], first + number * len(spot.names) + spot.slot[rows]] = True
        first += len(reading.target_numbers) * len(spot.names)
    return (
        check_each_target_counts(
            set_points_aside(data, marked, DELETED_IN_FILE_REASON, SET_ASIDE_BY_FILE)
        )
        if marked.any()
        else data
    )


class RawMeasurements(NamedTuple):
    """Joints and points of files, and the units that were decided for them."""

    data: Measurements
    units: ImportUnits


def build_raw_measurements(
    parts: Sequence[ImportPart],
    placements: Sequence[PointPlacement],
    joint_table: ImportedTable,
    options: ImportOptions,
) -> RawMeasurements:
    """The numbers of joints and points, their units decided.  Raises DataError."""
    points = [part.reading for part in parts]
    q_units = [find_column_unit(column, options)[0] for column in joint_table.joint_columns]
    sliding = np.array([unit in METRES_PER_LENGTH_UNIT for unit in q_units])
    turning = [
        (joint_table, c)
        for c, slides in zip(joint_table.joint_columns, sliding, strict=True)
        if not slides
    ]
    q_unit = find_shared_unit(turning, options, RADIANS_PER_ANGLE_UNIT)
    y_unit = find_shared_unit(
        [(r, c) for r in points for c in r.columns if c.family == "smr"],
        options,
        METRES_PER_LENGTH_UNIT,
    )
    if q_unit == MIXED_UNITS:
        raise DataError(
            f"{joint_table.sheet.path}: joint columns mix units of angle; use one of them"
        )
    q = np.stack(
        [
            joint_table.column_numbers(column, allow_empty=False)
            for column in joint_table.joint_columns
        ],
        axis=1,
    )
    mixed = y_unit == MIXED_UNITS
    y = build_raw_points(points, placements, len(q), options if mixed else None)
    where = (joint_table.sheet.path, points[0].sheet.path)
    scales = ImportUnits(*decide_units(q, y, q_unit, "m" if mixed else y_unit, sliding, where))
    scale = [METRES_PER_LENGTH_UNIT.get(unit, RADIANS_PER_ANGLE_UNIT[scales.q]) for unit in q_units]
    targets = tuple(name for part in parts for names in part.targets.values() for name in names)
    return RawMeasurements(
        Measurements(
            q * scale, y * METRES_PER_LENGTH_UNIT[scales.y], targets, sliding, joint_table.line, {}
        ),
        scales,
    )


def ignore_points_of_joint_table(joint_table: ImportedTable) -> ImportedTable:
    """A file of joints whose own points do not count."""
    remark = "points come from the other file"
    columns = tuple(
        replace(c, meaning="", remark=remark) if c.family in ("smr", "target") else c
        for c in joint_table.columns
    )
    return replace(joint_table, columns=columns)


class GatheredColumns(NamedTuple):
    """Columns that something uses, columns that are only kept, and the meanings in each file."""

    used: dict[str, Array]
    kept: dict[str, Array]
    meanings: tuple[tuple[ColumnMeaning, ...], ...]


def gather_optional_columns(
    parts: Sequence[ImportPart], options: ImportOptions, units: ImportUnits, pose_count: int
) -> GatheredColumns:
    """Columns that something uses, columns that are only kept, and the meanings in each file."""
    columns: dict[str, Array] = {}
    unknown: dict[str, Array] = {}
    meanings = []
    for part in parts:
        mine = []
        for column in part.reading.columns:
            name = column.meaning
            who = part.targets.get(name.partition("_")[0], ("",))
            target = " to ".join(dict.fromkeys((who[0], who[-1])))
            found = interpret_column(part.reading, column, options, units, target)
            mine.append(found)
            if len(found.values) and found.kept:
                unknown[column.name] = convert_row_values_to_poses(
                    found.values, part.pose, pose_count, "first"
                )
            elif len(found.values):
                values = convert_row_values_to_poses(found.values, part.pose, pose_count, name)
                columns[name] = (
                    merge_column_of_two_files(name, columns[name], values)
                    if name in columns
                    else values
                )
        meanings.append(tuple(mine))
    if any(meaning.known.startswith(TIME_STAMPS_TEXT) for mine in meanings for meaning in mine):
        columns["time"] = columns["time"] - np.nanmin(columns["time"])
    return GatheredColumns(columns, unknown, tuple(meanings))


def name_targets_of_files(
    point_tables: Sequence[ImportedTable], placements: Sequence[PointPlacement]
) -> list[dict[str, tuple[str, ...]]]:
    """For each file: which targets its columns smr1 ... are; one file keeps the numbers it has."""
    new = count(1)
    own = len(point_tables) == 1 and len(placements[0].names) == 1
    return [
        {
            f"smr{number}": tuple(f"smr{number if own else next(new)}" for _ in spot.names)
            for number in reading.target_numbers
        }
        for reading, spot in zip(point_tables, placements, strict=True)
    ]


def build_raw_points(
    point_tables: Sequence[ImportedTable],
    placements: Sequence[PointPlacement],
    pose_count: int,
    options: ImportOptions | None,
) -> Array:
    """(poses, k, 3) points as in the files.

    options: where the columns' units differ; the points are then in metres.  Raises DataError.
    """
    blocks: list[Array] = []
    for reading, spot in zip(point_tables, placements, strict=True):
        for number in reading.target_numbers:
            block = np.full((pose_count, len(spot.names), 3), np.nan)
            for axis, letter in enumerate("xyz"):
                column = reading.column_with_meaning(f"smr{number}_{letter}")
                factor = (
                    METRES_PER_LENGTH_UNIT[find_column_unit(column, options)[0]] if options else 1.0
                )
                block[spot.pose, spot.slot, axis] = reading.column_numbers(column) * factor
            partly = np.isnan(block).any(-1) & ~np.isnan(block).all(-1)
            if partly.any():
                pose, slot = np.argwhere(partly)[0]
                row = np.flatnonzero((spot.pose == pose) & (spot.slot == slot))[0]
                raise DataError(
                    f"{reading.sheet.path}:{reading.line[row]}: a point has some of x, y, z only; "
                    "complete it, or leave all three empty"
                )
            blocks.append(block)
    return np.concatenate(blocks, axis=1)


def interpret_column(
    table: ImportedTable,
    column: ImportedColumn,
    options: ImportOptions,
    units: ImportUnits,
    target_name: str,
) -> ColumnMeaning:
    """What a column means, with its values in SI.  target_name: the target of a point."""
    unit, known = find_column_unit(column, options)
    first = next((cell for cell in column.cells if cell), "")
    family = column.family
    if not column.meaning:
        if column.remark == KEPT_REMARK:
            return ColumnMeaning(column, "kept", unit, "", first, np.array(column.cells), kept=True)
        return ColumnMeaning(column, "left out", unit, column.remark)
    if family in ("q", "smr"):
        what, *decided = (
            (f"joint {column.meaning[1:]}", units.q, units.why_q)
            if family == "q"
            else (f"{target_name} {column.meaning[-1]}", units.y, units.why_y)
        )
        unit, known = (unit, known) if unit else decided
        value = (
            parse_number(first, table.sheet.decimal)
            * (METRES_PER_LENGTH_UNIT | RADIANS_PER_ANGLE_UNIT)[unit]
        )
        si = f"{value:.6g} {'m' if unit in METRES_PER_LENGTH_UNIT else 'rad'}" if first else ""
        return ColumnMeaning(column, what, unit, known, si)
    if family == "target":
        return ColumnMeaning(column, "name of the target", "", known, first)
    if column.meaning in TEXT_MEANINGS:
        return ColumnMeaning(column, column.meaning, "", known, first, np.array(column.cells))
    if family == "time":
        values, known = parse_time_column(table, column, options.units.get("time", ""))
        unit, si = "s", first
    elif family == "temperature":
        values, unit, known = parse_temperature_column(
            table, column, options.units.get("temperature", "")
        )
        si = f"{values[0]:.6g} C" if len(values) else ""
    else:
        values, si, known = interpret_optional_column(table, column, unit, known)
    if len(values):
        return ColumnMeaning(column, column.meaning, unit, known, si, values)
    return ColumnMeaning(column, "left out", "", known)


class OptionalColumnValues(NamedTuple):
    """Numbers (m,) of a column in SI, its first cell, and how its unit is known."""

    values: Array
    first_cell: str
    unit_source: str


def interpret_optional_column(
    table: ImportedTable, column: ImportedColumn, unit: str, unit_source: str
) -> OptionalColumnValues:
    """An optional column of numbers in SI, its first, and how its unit is known.

    Raises DataError where it needs a unit and has none.
    """
    family = column.family
    centre = family == "payload" and column.meaning != family  # payload_x, beside payload in kg
    factors = METRES_PER_LENGTH_UNIT if centre else UNITS_BY_FAMILY.get(family, {})
    if factors and unit not in factors:
        what = f"{unit} is no unit for it" if unit else "has no unit"
        raise DataError(
            f"{table.sheet.path}: column {column.name}: {what}; add "
            f"units='{family}={next(iter(factors))}'"
        )
    values = table.column_numbers(column) * factors.get(unit, 1.0)
    if not np.isfinite(values).any():
        return OptionalColumnValues(NO_COLUMN_VALUES, "", "empty")
    si = f"{values[0]:.6g}" + (" rad" if family == "qread" else " m" if factors else "")
    return OptionalColumnValues(values, si, unit_source)


def convert_row_values_to_poses(
    values: Array, pose_indices: Array, pose_count: int, column_name: str
) -> Array:
    """Values of rows as values of poses: the largest u95, the first time, the mean
    temperature.
    """
    if values.dtype.kind in "US":
        text = np.full(pose_count, "", dtype=object)
        text[pose_indices[::-1]] = values[::-1]
        return text.astype(str)
    out = np.full(pose_count, np.nan)
    if column_name == "temperature":
        given = np.isfinite(values)
        many = np.bincount(pose_indices[given], minlength=pose_count)
        total = np.bincount(pose_indices[given], values[given], minlength=pose_count)
        return np.where(many > 0, total / np.maximum(many, 1), np.nan)
    if column_name in EXTREME_FUNCTIONS:
        EXTREME_FUNCTIONS[column_name].at(out, pose_indices, values)
    else:
        out[pose_indices[::-1]] = values[::-1]
    return out


def merge_column_of_two_files(column_name: str, first: Array, second: Array) -> Array:
    """A column that stands in two files: the largest u95, the first time, else the first file's.

    A pose is called as in the file of joints, which comes last: points may have names of their own.
    """
    if first.dtype.kind in "US":
        first, second = (second, first) if column_name == "pose" else (first, second)
        return np.where(first != "", first, second)
    if column_name in EXTREME_FUNCTIONS:
        return np.asarray(EXTREME_FUNCTIONS[column_name](first, second))
    return np.where(np.isfinite(first), first, second)
