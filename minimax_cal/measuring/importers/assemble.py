"""Files understood become measurements in SI, and a table of what was understood."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.join import (
    Places,
    in_file_order,
    place,
    poses_of,
    settled,
    with_keys,
)
from minimax_cal.measuring.importers.tables import KEPT, Column, Given, Reading
from minimax_cal.measuring.importers.units import STAMPED, celsius, decide, seconds
from minimax_cal.measuring.measurements import FILE, Measurements, Origin, check_finite, marked
from minimax_cal.measuring.set_aside import COLUMN, from_column, set_aside, sound
from minimax_cal.measuring.tools import by_tool
from minimax_cal.reading.sheet import number_of
from minimax_cal.reading.words import ANGLES, LENGTHS

TEXTS = ("session", "group", "split", "pose", "tool", COLUMN)
MARKED = "marked deleted in the tracker's file"
OF_UNIT = {"u95": LENGTHS, "base": LENGTHS, "qread": ANGLES}  # optional columns with a choice
MIXED = "mixed"
EXTREME = {"u95": np.fmax, "time": np.fmin}  # which of several values of a pose counts


NOTHING = np.empty(0)


@dataclass(frozen=True, eq=False)
class Meaning:
    """A row of the table: a column, what it means, its unit, how that is known, its first value.

    values: in SI, of a column that becomes one of the measurements'.  kept: only as text.
    """

    column: Column
    meaning: str
    unit: str = ""
    known: str = ""
    first: str = ""
    values: Array = field(default_factory=lambda: NOTHING)
    kept: bool = False


@dataclass(frozen=True, eq=False)
class Assembly:
    """data: the measurements.  meanings: a tuple for each file, in the order of `readings`."""

    data: Measurements
    readings: tuple[Reading, ...]
    meanings: tuple[tuple[Meaning, ...], ...]
    matched: tuple[str, ...]


def unit_of(column: Column, given: Given) -> tuple[str, str]:
    """A column's unit and how it is known; '' where it is not."""
    for name in (column.meaning, column.meaning.partition("_")[0], column.family):
        if name in given.units:
            also = f", though {column.known} says {column.unit}" if column.unit else ""
            return given.units[name], "given" + (also if column.unit != given.units[name] else "")
    return column.unit, column.known


def one_unit(
    columns: Sequence[tuple[Reading, Column]], given: Given, kinds: Mapping[str, float]
) -> str:
    """The unit that columns of one kind share, '' where unknown, or MIXED.  Raises DataError."""
    found = {unit_of(column, given)[0]: (reading, column) for reading, column in columns}
    for unit, (reading, column) in found.items():
        if unit and unit not in kinds:
            raise DataError(
                f"{reading.sheet.path}: column {column.name}: {unit} is no unit for it; one of "
                f"{', '.join(kinds)}"
            )
    if len(found) > 1 and "" in found:
        reading, column = found[""]
        raise DataError(
            f"{reading.sheet.path}: column {column.name} has no unit, others have; add "
            f"units='{column.family}={next(unit for unit in found if unit)}'"
        )
    return MIXED if len(found) > 1 else next(iter(found), "rad")


@dataclass(frozen=True)
class Scales:
    """What was decided: units of the joints' angles and of the points, and how they are known."""

    q: str
    y: str
    why_q: str
    why_y: str


@dataclass(frozen=True, eq=False)
class Part:
    """A file, the pose (m,) of each of its rows, and which targets its columns smr1 ... are."""

    reading: Reading
    pose: Array
    targets: Mapping[str, tuple[str, ...]]


def assemble(points: Sequence[Reading], joints: Reading, given: Given) -> Assembly:
    """Measurements from files of points and the file of joints (which may be one).

    Raises DataError.
    """
    alone = joints not in points
    if not alone and (apart := poses_of(joints)):
        joints, alone = apart, True
    points = [with_keys(reading, joints) for reading in in_file_order(list(points))]
    points = [settled(reading, joints, given.layout) for reading in points]
    joints = joints if alone else points[0]
    placed = [place(reading, joints, given.layout) for reading in points]
    points, places = [reading for reading, _ in placed], [spot for _, spot in placed]
    called = callings(points, places)
    parts = [Part(r, at.pose, c) for r, at, c in zip(points, places, called, strict=True)]
    data, scales = raw_of(parts, places, joints, given)
    if alone:
        parts.append(Part(without_points(joints), np.arange(data.poses), {}))
    columns, unknown, meanings = gathered(parts, given, scales, data.poses)
    names = (name for r, spot in placed for _ in r.smrs for name in spot.names)
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
        source=str(joints.sheet.path),
        origins=(apart_from(joints, points, places),) if alone else (),
        digest=hashlib.sha256("".join(r.sheet.text for r in readings).encode()).hexdigest(),
        simulated=any(r.sheet.simulated for r in readings),
    )
    matched = (*(spot.how for spot in places), "")[: len(readings)]
    data = by_tool(without_marked(from_column(marked(data)), points, places))
    return Assembly(check_finite(data), readings, meanings, matched)


def apart_from(joints: Reading, points: Sequence[Reading], places: Sequence[Places]) -> Origin:
    """The files of points and of joints, and where the point of each pose stands."""
    lines: dict[int, str] = {}
    for reading, spot in zip(points, places, strict=True):
        for line, pose in zip(reading.line, spot.pose, strict=True):
            lines.setdefault(int(joints.line[pose]), f"{reading.sheet.path}:{line}")
    files = tuple(str(reading.sheet.path) for reading in points)
    return Origin(files, str(joints.sheet.path), point_lines=lines)


def without_marked(
    data: Measurements, points: Sequence[Reading], places: Sequence[Places]
) -> Measurements:
    """The measurements without the points that the trackers' files mark deleted."""
    marked = np.zeros((data.poses, len(data.target_names)), dtype=bool)
    first = 0
    for reading, spot in zip(points, places, strict=True):
        rows = np.array(reading.deleted, dtype=int)
        for number in range(len(reading.smrs)):
            marked[spot.pose[rows], first + number * len(spot.names) + spot.slot[rows]] = True
        first += len(reading.smrs) * len(spot.names)
    return sound(set_aside(data, marked, MARKED, FILE)) if marked.any() else data


def raw_of(
    parts: Sequence[Part], places: Sequence[Places], joints: Reading, given: Given
) -> tuple[Measurements, Scales]:
    """The numbers of joints and points, their units decided.  Raises DataError."""
    points = [part.reading for part in parts]
    q_units = [unit_of(column, given)[0] for column in joints.joints]
    sliding = np.array([unit in LENGTHS for unit in q_units])
    turning = [(joints, c) for c, slides in zip(joints.joints, sliding, strict=True) if not slides]
    q_unit = one_unit(turning, given, ANGLES)
    y_unit = one_unit(
        [(r, c) for r in points for c in r.columns if c.family == "smr"], given, LENGTHS
    )
    if q_unit == MIXED:
        raise DataError(f"{joints.sheet.path}: joint columns mix units of angle; use one of them")
    q = np.stack([joints.numbers(column, empty=False) for column in joints.joints], axis=1)
    mixed = y_unit == MIXED
    y = raw_points(points, places, len(q), given if mixed else None)
    where = (joints.sheet.path, points[0].sheet.path)
    scales = Scales(*decide(q, y, q_unit, "m" if mixed else y_unit, sliding, where))
    scale = [LENGTHS.get(unit, ANGLES[scales.q]) for unit in q_units]
    targets = tuple(name for part in parts for names in part.targets.values() for name in names)
    return Measurements(q * scale, y * LENGTHS[scales.y], targets, sliding, joints.line, {}), scales


def without_points(joints: Reading) -> Reading:
    """A file of joints whose own points do not count."""
    remark = "points come from the other file"
    columns = tuple(
        replace(c, meaning="", remark=remark) if c.family in ("smr", "target") else c
        for c in joints.columns
    )
    return replace(joints, columns=columns)


def gathered(
    parts: Sequence[Part], given: Given, scales: Scales, poses: int
) -> tuple[dict[str, Array], dict[str, Array], tuple[tuple[Meaning, ...], ...]]:
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
            found = understood(part.reading, column, given, scales, target)
            mine.append(found)
            if len(found.values) and found.kept:
                unknown[column.name] = spread(found.values, part.pose, poses, "first")
            elif len(found.values):
                values = spread(found.values, part.pose, poses, name)
                columns[name] = together(name, columns[name], values) if name in columns else values
        meanings.append(tuple(mine))
    if any(meaning.known.startswith(STAMPED) for mine in meanings for meaning in mine):
        columns["time"] = columns["time"] - np.nanmin(columns["time"])
    return columns, unknown, tuple(meanings)


def callings(
    points: Sequence[Reading], places: Sequence[Places]
) -> list[dict[str, tuple[str, ...]]]:
    """For each file: which targets its columns smr1 ... are; one file keeps the numbers it has."""
    new = count(1)
    own = len(points) == 1 and len(places[0].names) == 1
    return [
        {
            f"smr{number}": tuple(f"smr{number if own else next(new)}" for _ in spot.names)
            for number in reading.smrs
        }
        for reading, spot in zip(points, places, strict=True)
    ]


def raw_points(
    points: Sequence[Reading], places: Sequence[Places], poses: int, given: Given | None
) -> Array:
    """(poses, k, 3) points as in the files.

    given: where the columns' units differ; the points are then in metres.  Raises DataError.
    """
    blocks: list[Array] = []
    for reading, spot in zip(points, places, strict=True):
        for number in reading.smrs:
            block = np.full((poses, len(spot.names), 3), np.nan)
            for axis, letter in enumerate("xyz"):
                column = reading.column(f"smr{number}_{letter}")
                factor = LENGTHS[unit_of(column, given)[0]] if given else 1.0
                block[spot.pose, spot.slot, axis] = reading.numbers(column) * factor
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


def understood(reading: Reading, column: Column, given: Given, scales: Scales, who: str) -> Meaning:
    """What a column means, with its values in SI.  who: the target of a point."""
    unit, known = unit_of(column, given)
    first = next((cell for cell in column.cells if cell), "")
    family = column.family
    if not column.meaning:
        if column.remark == KEPT:
            return Meaning(column, "kept", unit, "", first, np.array(column.cells), kept=True)
        return Meaning(column, "left out", unit, column.remark)
    if family in ("q", "smr"):
        what, *decided = (
            (f"joint {column.meaning[1:]}", scales.q, scales.why_q)
            if family == "q"
            else (f"{who} {column.meaning[-1]}", scales.y, scales.why_y)
        )
        unit, known = (unit, known) if unit else decided
        value = number_of(first, reading.sheet.decimal) * (LENGTHS | ANGLES)[unit]
        si = f"{value:.6g} {'m' if unit in LENGTHS else 'rad'}" if first else ""
        return Meaning(column, what, unit, known, si)
    if family == "target":
        return Meaning(column, "name of the target", "", known, first)
    if column.meaning in TEXTS:
        return Meaning(column, column.meaning, "", known, first, np.array(column.cells))
    if family == "time":
        values, known = seconds(reading, column, given.units.get("time", ""))
        unit, si = "s", first
    elif family == "temperature":
        values, unit, known = celsius(reading, column, given.units.get("temperature", ""))
        si = f"{values[0]:.6g} C" if len(values) else ""
    else:
        values, si, known = optional(reading, column, unit, known)
    if len(values):
        return Meaning(column, column.meaning, unit, known, si, values)
    return Meaning(column, "left out", "", known)


def optional(reading: Reading, column: Column, unit: str, known: str) -> tuple[Array, str, str]:
    """An optional column of numbers in SI, its first, and how its unit is known.

    Raises DataError where it needs a unit and has none.
    """
    family = column.family
    centre = family == "payload" and column.meaning != family  # payload_x, beside payload in kg
    factors = LENGTHS if centre else OF_UNIT.get(family, {})
    if factors and unit not in factors:
        what = f"{unit} is no unit for it" if unit else "has no unit"
        raise DataError(
            f"{reading.sheet.path}: column {column.name}: {what}; add "
            f"units='{family}={next(iter(factors))}'"
        )
    values = reading.numbers(column) * factors.get(unit, 1.0)
    if not np.isfinite(values).any():
        return NOTHING, "", "empty"
    si = f"{values[0]:.6g}" + (" rad" if family == "qread" else " m" if factors else "")
    return values, si, known


def spread(values: Array, pose: Array, poses: int, name: str) -> Array:
    """Values of rows as values of poses: the largest u95, the first time, the mean temperature."""
    if values.dtype.kind in "US":
        text = np.full(poses, "", dtype=object)
        text[pose[::-1]] = values[::-1]
        return text.astype(str)
    out = np.full(poses, np.nan)
    if name == "temperature":
        given = np.isfinite(values)
        many = np.bincount(pose[given], minlength=poses)
        total = np.bincount(pose[given], values[given], minlength=poses)
        return np.where(many > 0, total / np.maximum(many, 1), np.nan)
    if name in EXTREME:
        EXTREME[name].at(out, pose, values)
    else:
        out[pose[::-1]] = values[::-1]
    return out


def together(name: str, one: Array, other: Array) -> Array:
    """A column that stands in two files: the largest u95, the first time, else the first file's.

    A pose is called as in the file of joints, which comes last: points may have names of their own.
    """
    if one.dtype.kind in "US":
        one, other = (other, one) if name == "pose" else (one, other)
        return np.where(one != "", one, other)
    if name in EXTREME:
        return np.asarray(EXTREME[name](one, other))
    return np.where(np.isfinite(one), one, other)
