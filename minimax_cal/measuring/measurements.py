"""Measurements: what a tracker saw at each pose; CSV in, CSV out."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import csv_text, write_whole
from minimax_cal.ground.words import name_first, one_line
from minimax_cal.reading.rows import NOTHING, TARGET, TEXT, UNITS, Rows, header_check, read_rows
from minimax_cal.reading.sheet import Lines
from minimax_cal.reading.words import OWN, joints_of, kind_of, points_of, stems_of

APPROACH = re.compile(r"approach\d+")
FARTHEST = 1e5  # no instrument measures farther [m]
PLAUSIBLE = {  # least and largest value in SI of columns of a kind
    "temperature": (-273.15, 1000.0),
    "payload": (0.0, 3e3),  # the strongest arms carry 2.3 t
    "u95": (0.0, 1.0),
    "payload centre": (-10.0, 10.0),  # from the flange
    "tau": (-1e5, 1e5),  # the strongest joints hold some 1e4 N m
    "base": (-FARTHEST, FARTHEST),
    "qread": (-1e3, 1e3),
}
USER, FILE, TOOL = "user", "file", "tool"  # who sets points aside
MARK = "simulated"  # the column of 1 where points were computed
NAMED = re.compile(r"smr\d+_target")  # what the tracker calls it
OF_POINTS = re.compile(f"{NAMED.pattern}|{TARGET.pattern}")
ANY_TARGET = ("smr1_x_mm", "smr1_y_mm", "smr1_z_mm")  # the header's rules ask for one
U95 = re.compile(OWN["u95"].pattern)


@dataclass(frozen=True)
class SetAside:
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
class Origin:
    """The files of some measurements, for a message or a command that concerns them.

    points: files of points.  joints: that of joint values where it is another, else empty.
    begin: what is added to the lines of the file.  point_lines: FILE:LINE of the point of a pose,
    by the pose's line, where the two lie in files of their own.
    """

    points: tuple[str, ...]
    joints: str = ""
    begin: int = 0
    point_lines: Mapping[int, str] = field(default_factory=dict)

    def place(self, line: int) -> str:
        """FILE:LINE of a measured point.  line: of the pose."""
        return self.point_lines.get(line) or f"{self.points[0]}:{line - self.begin}"


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
    origins: the files, where they are not `source` alone.
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
    set_aside: tuple[SetAside, ...] = ()
    aside: Measurements | None = None
    origins: tuple[Origin, ...] = ()

    @property
    def poses(self) -> int:
        """Number of rows."""
        return len(self.q)

    @property
    def seen(self) -> Array:
        """(m, k) True where a target was measured."""
        return np.isfinite(self.y[:, :, 0])

    def origin(self, line: int) -> Origin:
        """The files that hold a line."""
        begun = [one for one in self.origins if one.begin < line]
        return begun[-1] if begun else Origin((self.source,))

    def called(self, line: int) -> str:
        """The row of a line as people call it: pose P201 where the file names it, else line 202."""
        at = np.flatnonzero(self.line == line)
        return self.row_called(int(at[0])) if at.size else f"line {line}"

    def row_called(self, row: int) -> str:
        """As `called`, of a row by its index."""
        name = str(self.columns["pose"][row]).strip() if "pose" in self.columns else ""
        return f"pose {name}" if name else f"line {self.line[row]}"

    def list_rows(self, rows: Array, most: int = 8) -> str:
        """Rows as people call them: poses P201, P202, else lines 202, 203; the first few.

        rows: indices or a mask.
        """
        every = self.line[rows]
        names = [self.called(line) for line in every[:most]]
        kinds = {name.partition(" ")[0] for name in names}
        if len(kinds) == 1 and len(names) > 1:
            names = [name.partition(" ")[2] for name in names]
            names[0] = f"{kinds.pop()}s {names[0]}"
        more = [""] * (len(every) - len(names))  # counted, and not named
        return name_first([*names, *more], most)

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

    def followed_by(self, *others: Measurements) -> Measurements:
        """These rows, then others; a part that lacks a column knows nothing there."""
        parts = (self, *others)
        poses = [part.poses for part in parts]
        aside = [part.aside for part in parts if part.aside]
        return replace(
            self,
            q=np.concatenate([part.q for part in parts]),
            y=np.concatenate([part.y for part in parts]),
            line=np.concatenate([part.line for part in parts]),
            columns=stacked([part.columns for part in parts], poses),
            unknown=stacked([part.unknown for part in parts], poses),
            simulated=all(part.simulated for part in parts),
            set_aside=tuple(point for part in parts for point in part.set_aside),
            aside=aside[0].followed_by(*aside[1:]) if aside else None,
        )

    def everywhere(self, change: Callable[[Measurements], Measurements]) -> Measurements:
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


def stacked(parts: Sequence[Mapping[str, Array]], poses: Sequence[int]) -> dict[str, Array]:
    """Columns of parts of so many poses one after the other, empty where a part lacks one.

    Without a `split` all its poses are for training.
    """
    out = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        found = next(part[name] for part in parts if name in part)
        text = name in TEXT or found.dtype.kind in "US"
        none = "train" if name == "split" else "" if text else np.nan
        every = [part.get(name, np.full(m, none)) for part, m in zip(parts, poses, strict=True)]
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
    q, y = real("q", q), real("y", y)
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
    return check_finite(Measurements(q, y, names, sliding, np.arange(len(q)) + 1, extra))


def real(name: str, values: Array) -> Array:
    """Numbers as floats.  Raises DataError."""
    try:
        found = np.array(values)
        if np.iscomplexobj(found):
            raise DataError(f"{name} must be real numbers, not complex ones")
        return found.astype(float)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name} must be an array of numbers ({one_line(str(error))})") from error


def check_finite(data: Measurements) -> Measurements:
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
    if np.nanmax(np.abs(data.y), initial=0.0) > FARTHEST:
        row, target, _ = np.argwhere(np.abs(data.y) > FARTHEST)[0]
        raise DataError(
            f"{data.source}:{data.line[row]}: {data.target_names[target]} is more than "
            f"{FARTHEST / 1e3:g} km away; check the number and its unit"
        )
    check_seen(data, "no target was measured at any pose")
    for target, name in enumerate(data.target_names):
        points = data.y[data.seen[:, target], target]
        if len(points) > 2 and np.all(np.ptp(points, axis=0) == 0.0):
            raise DataError(f"{data.source}: all points of {name} are the same")
    return check_u95(check_columns(data))


def check_seen(data: Measurements, none: str, but: str = "") -> Measurements:
    """The data, if a point of each target counts; else says `none`, or what one lacks.

    Raises DataError.
    """
    seen = np.asarray(data.seen.any(axis=0))
    if not seen.all():
        name = data.target_names[int(np.argmin(seen))]
        said = f"{name} is measured at no pose{but}; delete its columns" if seen.any() else none
        raise DataError(f"{data.source}: {said}")
    return data


def check_columns(data: Measurements) -> Measurements:
    """The data, if their optional columns can be.  Raises DataError."""
    for stem, column in data.columns.items():
        kind = kind_of(stem)
        if kind not in PLAUSIBLE:
            continue
        low, high = PLAUSIBLE[kind]
        values = np.asarray(column, dtype=float)
        odd = (values < low) | (values > high)
        if odd.any():
            row = int(np.argmax(odd))
            name, scale = (stem, 1.0) if kind == "qread" else file_column(stem)  # an angle, or not
            raise DataError(
                f"{data.source}:{data.line[row]}: column {name}: {scale * values[row]:g} cannot "
                f"be; expected {scale * low:g} to {scale * high:g}, or an empty cell"
            )
    for name in filter(APPROACH.fullmatch, data.columns):
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
    return path if isinstance(path, Measurements) else measurements_in(read_rows(path))


def measurements_in(file: Rows) -> Measurements:
    """The measurements in a file's rows.  Raises DataError."""
    path, header = file.path, file.header
    pointless = not any(map(TARGET.fullmatch, header))
    if not file.own or (pointless and points_of(stems_of(file.given))):
        from minimax_cal.measuring.importers import import_files  # which makes measurements itself

        try:
            return import_files([file.sheet]).understood()
        except DataError as error:
            if joints_of(stems_of(file.given)):
                taken = "; the command import takes that" if "='" in str(error) else ""
                raise DataError(f"{error}{taken}") from error
    header_check(path, header)
    at = joint_rows(file, OF_POINTS, U95)
    found = sorted({int(m[1]) for name in header if (m := TARGET.fullmatch(name))})
    y = np.full((at.poses, len(found), 3), np.nan)
    for m in filter(None, map(TARGET.fullmatch, header)):
        cells = file.number(m[0], unit=m[3], empty=True)
        y[:, found.index(int(m[1])), "xyz".index(m[2])] = cells
    unknown = {name: np.array(file.text(name)) for name in header if NAMED.fullmatch(name)}
    data = replace(
        at,
        y=y,
        target_names=tuple(f"smr{i}" for i in found),
        unknown={**at.unknown, **unknown},
        simulated=file.sheet.simulated,
        notices=(),
    )
    data = marked(check_finite(data))
    again, said = pasted(file, np.asarray(data.seen.any(axis=1)))
    data = without_blind(replace(data, notices=(*data.notices, *at.notices)), again)
    data = replace(data, notices=(*data.notices, *said))
    from minimax_cal.measuring.set_aside import from_column  # which makes measurements itself
    from minimax_cal.measuring.tools import by_tool

    return from_column(by_tool(data))


def joint_rows(
    file: Rows,
    own: re.Pattern[str],
    doubts: re.Pattern[str] = NOTHING,
    unused: str = "is not used",
) -> Measurements:
    """The poses of a file without any point, and the optional columns beside them.

    own, doubts: as of `Rows.optional`.  unused: what is said of other columns.  Raises DataError.
    """
    bare = [name for name in file.header if not TARGET.fullmatch(name)]
    header_check(file.path, [*bare, *ANY_TARGET])
    q, sliding = file.joints()
    columns, left = file.optional(own, doubts)
    left |= {name: "" for name in file.header if TARGET.fullmatch(name) and not own.fullmatch(name)}
    idle = (f"{file.path}: column {name} {unused}{why}" for name, why in left.items())
    at = Measurements(
        q,
        np.zeros((len(q), 0, 3)),
        (),
        sliding,
        file.line,
        columns,
        {name: np.array(file.text(name)) for name in left},
        (*file.notices, *idle),
        str(file.path),
        file.sheet.digest,
    )
    return check_u95(check_columns(at))


def marked(data: Measurements) -> Measurements:
    """The same with the mark of computed points, where the file has it as a column of its own."""
    columns = dict(data.columns)
    mark = columns.pop(MARK, None)
    if mark is None:
        return data
    return replace(data, columns=columns, simulated=data.simulated or bool((mark == 1.0).all()))


def without_blind(data: Measurements, again: Array) -> Measurements:
    """The rows that hold a measured target, without others.  again: (m,) those others."""
    blind = np.asarray(~data.seen.any(axis=1))
    if blind.any():
        said = f"{data.source}: {blind.sum()} rows hold no measured target and are left out"
        data = replace(data, notices=(*data.notices, said))
    return data.take(~blind & ~again)


def pasted(file: Rows, kept: Array) -> tuple[Array, list[str]]:
    """(m,) True for rows that repeat an earlier one in every cell, and a notice of them.

    Nothing is measured twice to the last digit; as repeats they would tell of no noise at all.
    kept: (m,) rows that count.
    """
    first: dict[Sequence[str], int] = {}
    rows = file.rows.lines if isinstance(file.rows, Lines) else file.rows
    source = np.array([first.setdefault(row, i) for i, row in enumerate(rows)])
    again = (source < np.arange(len(source))) & kept
    at = np.flatnonzero(again)
    if not len(at):
        return again, []
    runs = np.split(at, 1 + np.flatnonzero((np.diff(at) != 1) | (np.diff(source[at]) != 1)))
    told = [repeated(file, run, source[run]) for run in runs[:5]]
    more = f", and {len(runs) - 5} more places" if len(runs) > 5 else ""
    return again, [
        f"{file.path}: {', '.join(told)}{more} in every cell: pasted twice? they count once"
    ]


def repeated(file: Rows, run: Array, source: Array) -> str:
    """That rows which follow each other repeat others, to people."""
    if len(run) == 1:
        return f"line {file.line[run[0]]} repeats line {file.line[source[0]]}"
    (a, b), (c, d) = file.line[run[[0, -1]]], file.line[source[[0, -1]]]
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
    write_whole(path, measurements_text(data))


def measurements_text(data: Measurements) -> str:
    """The CSV of measurements, points set aside with why, computed ones marked."""
    from minimax_cal.measuring.set_aside import whole  # which makes measurements itself
    from minimax_cal.measuring.tools import side_by_side

    data = side_by_side(whole(data))
    joints, k = data.q.shape[1], len(data.target_names)
    header = [f"q{i + 1}_{'mm' if data.sliding[i] else 'rad'}" for i in range(joints)]
    header += [f"{name}_{axis}_mm" for name in data.target_names for axis in "xyz"]
    named = {name: file_column(name) for name in data.columns}
    header += [name for name, _ in named.values()]
    mark = [MARK] * data.simulated
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
    return csv_text(rows)


def file_column(stem: str) -> tuple[str, float]:
    """Name with its unit, and the factor from SI, of an optional column."""
    if stem == "rotation_u95":
        return f"{stem}_rad", 1.0
    for unit in OWN[kind].units[:1] if (kind := kind_of(stem)) else ():
        return f"{stem}_{unit}", 1.0 / UNITS.get(unit, 1.0)
    return stem, 1.0
