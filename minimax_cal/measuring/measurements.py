"""Measurements: what a tracker saw at each pose; CSV in, CSV out."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import clean_and_shorten_to_one_line, format_first_names
from minimax_cal.core.errors import DataError
from minimax_cal.core.files import format_csv, write_file_atomically
from minimax_cal.reading.column_words import (
    STANDARD_COLUMN_KINDS,
    joint_meanings_of_names,
    names_without_units,
    point_meanings_of_names,
    standard_column_kind,
)
from minimax_cal.reading.measurement_table import (
    MATCH_NOTHING_PATTERN,
    MEASUREMENT_TEXT_KINDS,
    SI_PER_COLUMN_UNIT,
    TARGET_COLUMN_PATTERN,
    MeasurementTable,
    check_measurement_header,
    read_measurement_table,
)
from minimax_cal.reading.text_sheet import LazyRows

APPROACH_COLUMN_PATTERN = re.compile(r"approach\d+")
MAX_POINT_DISTANCE = 1e5  # no instrument measures farther [m]
PLAUSIBLE_COLUMN_RANGES = {  # least and largest value in SI of columns of a kind
    "temperature": (-273.15, 1000.0),
    "payload": (0.0, 3e3),  # the strongest arms carry 2.3 t
    "u95": (0.0, 1.0),
    "payload centre": (-10.0, 10.0),  # from the flange
    "tau": (-1e5, 1e5),  # the strongest joints hold some 1e4 N m
    "base": (-MAX_POINT_DISTANCE, MAX_POINT_DISTANCE),
    "qread": (-1e3, 1e3),
}
SET_ASIDE_BY_USER, SET_ASIDE_BY_FILE, SET_ASIDE_BY_TOOL = (
    "user",
    "file",
    "tool",
)  # who sets points aside
SIMULATED_COLUMN = "simulated"  # the column of 1 where points were computed
TARGET_NAME_COLUMN_PATTERN = re.compile(r"smr\d+_target")  # what the tracker calls it
POINT_COLUMN_PATTERN = re.compile(
    f"{TARGET_NAME_COLUMN_PATTERN.pattern}|{TARGET_COLUMN_PATTERN.pattern}"
)
PLACEHOLDER_TARGET_COLUMNS = (
    "smr1_x_mm",
    "smr1_y_mm",
    "smr1_z_mm",
)  # the header's rules ask for one
U95_COLUMN_PATTERN = re.compile(STANDARD_COLUMN_KINDS["u95"].full_name_pattern)


@dataclass(frozen=True)
class SetAsidePoint:
    """A measured point that takes no part in a fit.

    row: line of the measurement file.  pose: its number among the poses of that file, from 1.  why:
    the reason; by: USER, FILE or TOOL.
    """

    row: int
    pose: int
    target: str
    why: str
    by: str


@dataclass(frozen=True)
class RowOrigin:
    """The files of some measurements, for a message or a command that concerns them.

    points: files of points.  joints: that of joint values where it is another, else empty.
    begin: what is added to the lines of the file.  point_lines: FILE:LINE of the point of a pose,
    by the pose's line, where the two lie in files of their own.
    """

    points: tuple[str, ...]
    joints: str = ""
    begin: int = 0
    point_lines: Mapping[int, str] = field(default_factory=dict)

    def point_location(self, pose_line: int) -> str:
        """FILE:LINE of a measured point.  pose_line: of the pose."""
        return self.point_lines.get(pose_line) or f"{self.points[0]}:{pose_line - self.begin}"


@dataclass(frozen=True, eq=False)
class Measurements:
    """Joint values and the targets seen at each of m poses.

    q: (m, n) joint values as the controller gives them [rad, or m where `sliding`].
    y: (m, k, 3) targets in the measurement frame, NaN where not measured [m].
    target_names: k of them, as smr1.
    sliding: (n,) True where the joint column has a unit of length.
    line: (m,) line of the file, for messages.
    columns: the optional columns by name; numbers in SI, labels as text.
    unknown: columns that nothing uses, as text, by their name in the file.
    notices: what the reader should know about the file.
    source, digest: path and SHA-256 of the file.
    frames: (4, 4) where the measurement frame of each session stands in the one that y is given in,
    by its label, the first one's first [m]; empty where y is as measured.
    simulated: whether the source says that its points were computed.
    set_aside: points that were measured and take no part; aside: these points alone, in rows of
    their own, as the file has them.
    origins: the files, where they are not `source_rows` alone.
    """

    q: Array
    y: Array
    target_names: tuple[str, ...]
    sliding: Array
    line: Array
    columns: Mapping[str, Array]
    unknown: Mapping[str, Array] = field(default_factory=dict)
    notices: tuple[str, ...] = ()
    source: str = "measurements"
    digest: str = ""
    frames: Mapping[str, Array] = field(default_factory=dict)
    simulated: bool = False
    set_aside: tuple[SetAsidePoint, ...] = ()
    aside: Measurements | None = None
    origins: tuple[RowOrigin, ...] = ()

    @property
    def poses(self) -> int:
        """Number of rows."""
        return len(self.q)

    @property
    def seen(self) -> Array:
        """(m, k) True where a target was measured."""
        return np.isfinite(self.y[:, :, 0])

    def origin_of_line(self, line: int) -> RowOrigin:
        """The files that hold a line."""
        begun = [one for one in self.origins if one.begin < line]
        return begun[-1] if begun else RowOrigin((self.source,))

    def called(self, line: int) -> str:
        """The row of a line as people call it: pose P201 where the file names it, else line 202."""
        at = np.flatnonzero(self.line == line)
        return self.row_name(int(at[0])) if at.size else f"line {line}"

    def row_name(self, row: int) -> str:
        """As `called`, of a row by its index."""
        name = str(self.columns["pose"][row]).strip() if "pose" in self.columns else ""
        return f"pose {name}" if name else f"line {self.line[row]}"

    def format_row_names(self, rows: Array, max_names: int = 8) -> str:
        """Rows as people call them: poses P201, P202, else lines 202, 203; the first few.

        rows: indices or a mask.
        """
        every = self.line[rows]
        names = [self.called(line) for line in every[:max_names]]
        kinds = {name.partition(" ")[0] for name in names}
        if len(kinds) == 1 and len(names) > 1:
            names = [name.partition(" ")[2] for name in names]
            names[0] = f"{kinds.pop()}s {names[0]}"
        more = [""] * (len(every) - len(names))  # counted, and not named
        return format_first_names([*names, *more], max_names)

    def in_visit_order(self) -> Measurements:
        """The same, its rows taken as visited one after the other."""
        return replace(self, columns={**self.columns, "order": np.arange(self.poses, dtype=float)})

    def take(self, rows: Array) -> Measurements:
        """The measurements at some rows only.  rows: indices or a mask."""
        return replace(
            self,
            q=self.q[rows],
            y=self.y[rows],
            line=self.line[rows],
            columns={name: column[rows] for name, column in self.columns.items()},
            unknown={name: column[rows] for name, column in self.unknown.items()},
        )

    def append_measurements(self, *others: Measurements) -> Measurements:
        """These rows, then others; a part that lacks a column knows nothing there."""
        parts = (self, *others)
        poses = [part.poses for part in parts]
        aside = [part.aside for part in parts if part.aside]
        return replace(
            self,
            q=np.concatenate([part.q for part in parts]),
            y=np.concatenate([part.y for part in parts]),
            line=np.concatenate([part.line for part in parts]),
            columns=stack_columns([part.columns for part in parts], poses),
            unknown=stack_columns([part.unknown for part in parts], poses),
            simulated=all(part.simulated for part in parts),
            set_aside=tuple(point for part in parts for point in part.set_aside),
            aside=aside[0].append_measurements(*aside[1:]) if aside else None,
        )

    def change_with_set_aside(self, change: Callable[[Measurements], Measurements]) -> Measurements:
        """Changed, and the points that are set aside as well."""
        return replace(change(self), aside=change(self.aside) if self.aside else None)

    def keep(self, targets: Array) -> Measurements:
        """Some targets only, at the poses where one of them was measured.  targets: (k,) mask."""
        names = tuple(name for name, kept in zip(self.target_names, targets, strict=True) if kept)
        aside = self.aside.keep(targets) if self.aside else None
        aside = aside if aside and aside.poses else None
        some = replace(self, y=self.y[:, targets], target_names=names, aside=aside)
        return some.take(np.asarray(some.seen.any(axis=1)))

    def only(self, target: int) -> Measurements:
        """One target alone, at the poses where it was measured."""
        name = (self.target_names[target],)
        alone = replace(self, y=self.y[:, [target]], target_names=name, aside=None)
        return alone.take(self.seen[:, target])

    def with_y(self, y: Array) -> Measurements:
        """The same poses with other measured points."""
        return replace(self, y=y)


def stack_columns(
    columns_of_parts: Sequence[Mapping[str, Array]], pose_counts: Sequence[int]
) -> dict[str, Array]:
    """Columns of parts of so many poses one after the other, empty where a part lacks one.

    Without a `split` all its poses are for training.
    """
    out = {}
    for name in dict.fromkeys(name for part in columns_of_parts for name in part):
        found = next(part[name] for part in columns_of_parts if name in part)
        text = name in MEASUREMENT_TEXT_KINDS or found.dtype.kind in "US"
        none = "train" if name == "split" else "" if text else np.nan
        every = [
            part.get(name, np.full(m, none))
            for part, m in zip(columns_of_parts, pose_counts, strict=True)
        ]
        out[name] = np.concatenate(every)
    return out


def measurements(q: Array, y: Array, **columns: Array) -> Measurements:
    """Measurements from arrays.

    Parameters
    ----------
    q
        (m, n) [rad, m].
    y
        (m, 3) or (m, k, 3), NaN where not measured [m].
    columns
        Optional columns by their file name without the unit (`order`, `u95`), in SI.

    Returns
    -------
    Measurements
        Measurements in metres and radians.

    Raises
    ------
    DataError
        For wrong input.

    Examples
    --------
    >>> data = mc.measurements(q, y, order=range(len(q)))
    """
    q, y = check_real_numbers("q", q), check_real_numbers("y", y)
    y = y[:, None, :] if y.ndim == 2 else y
    if q.ndim != 2 or y.ndim != 3 or y.shape[2] != 3 or len(q) != len(y):
        raise DataError(f"q must be (m, n) and y (m, k, 3); got {q.shape} and {y.shape}")
    names = tuple(f"smr{i + 1}" for i in range(y.shape[1]))
    sliding = np.zeros(q.shape[1], dtype=bool)
    extra = {name: np.asarray(column) for name, column in columns.items()}
    for name, column in extra.items():
        if column.shape != (len(q),):
            raise DataError(
                f"column {name} must be one value a pose ({len(q)},), not {column.shape}"
            )
    return check_measurements(Measurements(q, y, names, sliding, np.arange(len(q)) + 1, extra))


def check_real_numbers(name: str, values: Array) -> Array:
    """Numbers as floats.  Raises DataError."""
    try:
        found = np.array(values)
        if np.iscomplexobj(found):
            raise DataError(f"{name} must be real numbers, not complex ones")
        return found.astype(float)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{name} must be an array of numbers ({clean_and_shorten_to_one_line(str(error))})"
        ) from error


def check_measurements(data: Measurements) -> Measurements:
    """The data, if every joint value is a number and every point whole.  Raises DataError."""
    if not len(data.q):
        raise DataError(f"{data.source}: holds no poses")
    if not np.all(np.isfinite(data.q)):
        row, joint = np.argwhere(~np.isfinite(data.q))[0]
        raise DataError(f"{data.source}:{data.line[row]}: joint {joint + 1} is not a finite number")
    broken = np.isinf(data.y).any(-1) | (np.isnan(data.y).any(-1) != np.isnan(data.y).all(-1))
    if broken.any():
        row, target = np.argwhere(broken)[0]
        raise DataError(
            f"{data.source}:{data.line[row]}: {data.target_names[target]} has some of x, y, z "
            "only; give all three, or leave all three empty where it was not measured"
        )
    if np.nanmax(np.abs(data.y), initial=0.0) > MAX_POINT_DISTANCE:
        row, target, _ = np.argwhere(np.abs(data.y) > MAX_POINT_DISTANCE)[0]
        raise DataError(
            f"{data.source}:{data.line[row]}: {data.target_names[target]} is more than "
            f"{MAX_POINT_DISTANCE / 1e3:g} km away; check the number and its unit"
        )
    check_every_target_measured(data, "no target was measured at any pose")
    for target, name in enumerate(data.target_names):
        points = data.y[data.seen[:, target], target]
        if len(points) > 2 and np.all(np.ptp(points, axis=0) == 0.0):
            raise DataError(f"{data.source}: all points of {name} are the same")
    return check_u95(check_optional_columns(data))


def check_every_target_measured(
    data: Measurements, no_point_message: str, exception_text: str = ""
) -> Measurements:
    """The data, if a point of each target counts; else says `no_point_message`, or what one lacks.

    Raises DataError.
    """
    seen = np.asarray(data.seen.any(axis=0))
    if not seen.all():
        name = data.target_names[int(np.argmin(seen))]
        said = (
            f"{name} is measured at no pose{exception_text}; delete its columns"
            if seen.any()
            else no_point_message
        )
        raise DataError(f"{data.source}: {said}")
    return data


def check_optional_columns(data: Measurements) -> Measurements:
    """The data, if their optional columns can be.  Raises DataError."""
    for stem, column in data.columns.items():
        kind = standard_column_kind(stem)
        if kind not in PLAUSIBLE_COLUMN_RANGES:
            continue
        low, high = PLAUSIBLE_COLUMN_RANGES[kind]
        values = np.asarray(column, dtype=float)
        odd = (values < low) | (values > high)
        if odd.any():
            row = int(np.argmax(odd))
            name, scale = (
                (stem, 1.0) if kind == "qread" else file_column_name_and_scale(stem)
            )  # an angle, or not
            raise DataError(
                f"{data.source}:{data.line[row]}: column {name}: {scale * values[row]:g} cannot "
                f"be; expected {scale * low:g} to {scale * high:g}, or an empty cell"
            )
    for name in filter(APPROACH_COLUMN_PATTERN.fullmatch, data.columns):
        side = data.columns[name].astype(float)
        odd = ~np.isin(side, (-1.0, 0.0, 1.0)) & ~np.isnan(side)
        if odd.any():
            row = int(np.argmax(odd))
            raise DataError(
                f"{data.source}:{data.line[row]}: column {name}: {side[row]:g} is no sign of a "
                "move; expected -1 or 1, or an empty cell where it is not known"
            )
    return data


def check_u95(data: Measurements) -> Measurements:
    """The data, if every given `u95` is positive.  Raises DataError."""
    if "u95" not in data.columns:
        return data
    u95 = data.columns["u95"]
    wrong = u95 <= 0.0
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(
            f"{data.source}:{data.line[row]}: column u95_mm: {1e3 * u95[row]:g} is not positive; "
            "leave the cell empty where it is not known"
        )
    if not np.isfinite(u95).any():
        columns = {name: column for name, column in data.columns.items() if name != "u95"}
        notice = f"{data.source}: column u95_mm is empty and not used"
        return replace(data, columns=columns, notices=(*data.notices, notice))
    return data


def read_measurements(path: Measurements | Path | str) -> Measurements:
    """Measurements of a file: of this project's CSV, or as a tracker or controller wrote it.

    Parameters
    ----------
    path
        With joints q1_deg ... or q1_rad ... (slides q3_mm), points smr1_x_mm ... or
        smr1_x_m ..., and what else is known (order, temperature_C ...).  Measurements stay as
        they are.

    Returns
    -------
    Measurements
        The measurements have metres and radians.

    Raises
    ------
    DataError
        For wrong input.

    Examples
    --------
    >>> data = mc.read_measurements("poses.csv")
    """
    return (
        path if isinstance(path, Measurements) else build_measurements(read_measurement_table(path))
    )


def build_measurements(table: MeasurementTable) -> Measurements:
    """The measurements in a file's rows.  Raises DataError."""
    path, header = table.path, table.header
    pointless = not any(map(TARGET_COLUMN_PATTERN.fullmatch, header))
    if not table.has_standard_column_names or (
        pointless and point_meanings_of_names(names_without_units(table.given))
    ):
        from minimax_cal.measuring.importers import import_files  # which makes measurements itself

        try:
            return import_files([table.sheet]).understood()
        except DataError as error:
            if joint_meanings_of_names(names_without_units(table.given)):
                taken = "; the command import takes that" if "='" in str(error) else ""
                raise DataError(f"{error}{taken}") from error
    check_measurement_header(path, header)
    at = build_joint_measurements(table, POINT_COLUMN_PATTERN, U95_COLUMN_PATTERN)
    found = sorted({int(m[1]) for name in header if (m := TARGET_COLUMN_PATTERN.fullmatch(name))})
    y = np.full((at.poses, len(found), 3), np.nan)
    for m in filter(None, map(TARGET_COLUMN_PATTERN.fullmatch, header)):
        cells = table.number_column(m[0], unit=m[3], allow_empty=True)
        y[:, found.index(int(m[1])), "xyz".index(m[2])] = cells
    unknown = {
        name: np.array(table.text_column(name))
        for name in header
        if TARGET_NAME_COLUMN_PATTERN.fullmatch(name)
    }
    data = replace(
        at,
        y=y,
        target_names=tuple(f"smr{i}" for i in found),
        unknown={**at.unknown, **unknown},
        simulated=table.sheet.is_marked_simulated,
        notices=(),
    )
    data = apply_simulated_column(check_measurements(data))
    again, said = find_pasted_rows(table, np.asarray(data.seen.any(axis=1)))
    data = drop_rows_without_targets(replace(data, notices=(*data.notices, *at.notices)), again)
    data = replace(data, notices=(*data.notices, *said))
    from minimax_cal.measuring.set_aside_points import (
        set_aside_points_named_in_column,
    )  # which makes measurements itself
    from minimax_cal.measuring.tool_targets import split_targets_by_tool

    return set_aside_points_named_in_column(split_targets_by_tool(data))


def build_joint_measurements(
    table: MeasurementTable,
    handled_pattern: re.Pattern[str],
    uncertainty_pattern: re.Pattern[str] = MATCH_NOTHING_PATTERN,
    unused_text: str = "is not used",
) -> Measurements:
    """The poses of a file without any point, and the optional columns beside them.

    handled_pattern, uncertainty_pattern: as of `MeasurementTable.optional_and_unused_columns`.
    unused_text: what is said of other columns.  Raises DataError.
    """
    bare = [name for name in table.header if not TARGET_COLUMN_PATTERN.fullmatch(name)]
    check_measurement_header(table.path, [*bare, *PLACEHOLDER_TARGET_COLUMNS])
    q, sliding = table.joint_values_and_sliding()
    columns, left = table.optional_and_unused_columns(handled_pattern, uncertainty_pattern)
    left |= {
        name: ""
        for name in table.header
        if TARGET_COLUMN_PATTERN.fullmatch(name) and not handled_pattern.fullmatch(name)
    }
    idle = (f"{table.path}: column {name} {unused_text}{why}" for name, why in left.items())
    at = Measurements(
        q,
        np.zeros((len(q), 0, 3)),
        (),
        sliding,
        table.line,
        columns,
        {name: np.array(table.text_column(name)) for name in left},
        (*table.notices, *idle),
        str(table.path),
        table.sheet.digest,
    )
    return check_u95(check_optional_columns(at))


def apply_simulated_column(data: Measurements) -> Measurements:
    """The same with the mark of computed points, where the file has it as a column of its own."""
    columns = dict(data.columns)
    mark = columns.pop(SIMULATED_COLUMN, None)
    if mark is None:
        return data
    return replace(data, columns=columns, simulated=data.simulated or bool((mark == 1.0).all()))


def drop_rows_without_targets(data: Measurements, repeated_rows: Array) -> Measurements:
    """The rows that hold a measured target, without others.  repeated_rows: (m,) those others."""
    blind = np.asarray(~data.seen.any(axis=1))
    if blind.any():
        said = f"{data.source}: {blind.sum()} rows hold no measured target and are left out"
        data = replace(data, notices=(*data.notices, said))
    return data.take(~blind & ~repeated_rows)


class PastedRows(NamedTuple):
    """Rows (m,) that repeat an earlier one in every cell, and notices of them."""

    repeated_rows: Array
    notices: list[str]


def find_pasted_rows(table: MeasurementTable, counted_rows: Array) -> PastedRows:
    """(m,) True for rows that repeat an earlier one in every cell, and a notice of them.

    Nothing is measured twice to the last digit; as repeats they would tell of no noise at all.
    counted_rows: (m,) rows that count.
    """
    first: dict[Sequence[str], int] = {}
    rows = table.rows.lines if isinstance(table.rows, LazyRows) else table.rows
    source = np.array([first.setdefault(row, i) for i, row in enumerate(rows)])
    again = (source < np.arange(len(source))) & counted_rows
    at = np.flatnonzero(again)
    if not len(at):
        return PastedRows(again, [])
    runs = np.split(at, 1 + np.flatnonzero((np.diff(at) != 1) | (np.diff(source[at]) != 1)))
    told = [describe_pasted_rows(table, run, source[run]) for run in runs[:5]]
    more = f", and {len(runs) - 5} more places" if len(runs) > 5 else ""
    return PastedRows(
        again,
        [f"{table.path}: {', '.join(told)}{more} in every cell: pasted twice? they count once"],
    )


def describe_pasted_rows(table: MeasurementTable, rows: Array, source_rows: Array) -> str:
    """That rows which follow each other repeat others, to people."""
    if len(rows) == 1:
        return f"line {table.line[rows[0]]} repeats line {table.line[source_rows[0]]}"
    (a, b), (c, d) = table.line[rows[[0, -1]]], table.line[source_rows[[0, -1]]]
    return f"lines {a}-{b} repeat lines {c}-{d}"


def write_measurements(path: Path | str, data: Measurements) -> None:
    """Write CSV that `read_measurements` reads.

    Parameters
    ----------
    path
        Of the file.
    data
        Joints are written in radians (slides in mm), points in mm.

    Examples
    --------
    >>> mc.write_measurements("poses.csv", data)
    """
    write_file_atomically(path, format_measurements_csv(data))


def format_measurements_csv(data: Measurements) -> str:
    """The CSV of measurements, points set aside with why, computed ones marked."""
    from minimax_cal.measuring.set_aside_points import (
        merge_set_aside_points_with_reasons,
    )  # which makes measurements itself
    from minimax_cal.measuring.tool_targets import join_targets_of_tools

    data = join_targets_of_tools(merge_set_aside_points_with_reasons(data))
    joints, k = data.q.shape[1], len(data.target_names)
    header = [f"q{i + 1}_{'mm' if data.sliding[i] else 'rad'}" for i in range(joints)]
    header += [f"{name}_{axis}_mm" for name in data.target_names for axis in "xyz"]
    named = {name: file_column_name_and_scale(name) for name in data.columns}
    header += [name for name, _ in named.values()]
    mark = [SIMULATED_COLUMN] * data.simulated
    rows = [header + mark]
    for j in range(data.poses):
        q = data.q[j] * np.where(data.sliding, 1e3, 1.0)
        y = data.y[j].reshape(3 * k) * 1e3
        row = [f"{value:.9f}" for value in q]
        row += ["" if np.isnan(value) else f"{value:.6f}" for value in y]
        for name, column in data.columns.items():
            value = column[j]
            if isinstance(value, str):
                row.append(str(value))
            else:
                number = float(value) * named[name][1]
                row.append("" if np.isnan(number) else f"{number:.9g}")
        rows.append(row + ["1"] * len(mark))
    return format_csv(rows)


class FileColumn(NamedTuple):
    """Name of a column in a file, with its unit, and the factor from SI."""

    name: str
    scale: float


def file_column_name_and_scale(stem: str) -> FileColumn:
    """Name with its unit, and the factor from SI, of an optional column."""
    if stem == "rotation_u95":
        return FileColumn(f"{stem}_rad", 1.0)
    for unit in (
        STANDARD_COLUMN_KINDS[kind].units[:1] if (kind := standard_column_kind(stem)) else ()
    ):
        return FileColumn(f"{stem}_{unit}", 1.0 / SI_PER_COLUMN_UNIT.get(unit, 1.0))
    return FileColumn(stem, 1.0)
