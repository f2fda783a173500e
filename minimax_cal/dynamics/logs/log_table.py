"""A run, and how it is made of a log: its columns in SI, whatever tool wrote it, cut into runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.reading.column_words import LENGTH_COLUMN_UNITS, similar_column_hint
from minimax_cal.reading.log_formats import LOG_FORMATS, LogColumn, LogFormat, detect_log_format
from minimax_cal.reading.text_sheet import (
    MAX_TORN_SHARE,
    Sheet,
    parse_numbers,
    parse_sheet_table,
    read_text_sheet,
)

TORQUE_UNIT = "N m"  # of a revolute joint; N of one that slides
CURRENT_UNIT = "A"
NO_TORQUE_UNIT = ""  # where neither was logged, but commands
RUN_ROW_FIELDS = (
    "time",
    "q",
    "qd",
    "qdd",
    "torque",
    "temperature",
    "command",
)  # what has a value a row


@dataclass(frozen=True, eq=False)
class Run:
    """One trajectory of n joints at m times.

    name: of the run, unique among those read together.  source: path of the file.
    time: (m,) increasing, evenly spaced or not [s].
    q: (m, n) joint values in the robot file's order, without jumps by whole turns [rad, m].
    qd, qdd: (m, n) the controller's own derivatives, where it logged them [rad/s, rad/s^2].
    torque: (m, n) measured at the joints or motors [unit]; 0 where it was not.
    unit: TORQUE, CURRENT or NOTHING.
    payload: mass at the flange, where it was reported [kg].
    temperature: (m, n), or (m,) of the whole arm [C].
    command: (m, n) joint values that were commanded, where all were logged [rad, m].
    notices: what the reader should know about the log.
    """

    name: str
    source: str
    time: Array
    q: Array
    qd: Array | None
    qdd: Array | None
    torque: Array
    unit: str
    payload: float | None = None
    temperature: Array | None = None
    notices: tuple[str, ...] = ()
    command: Array | None = None

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    @property
    def duration(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def step(self) -> float:
        """Typical time between rows [s]."""
        return float(np.median(np.diff(self.time)))

    def at(self, rows: Array) -> Run:
        """Some rows, time as it is.  rows: (m,) mask."""
        return replace(self, **select_field_rows(self, RUN_ROW_FIELDS, rows))


def select_field_rows(record: Any, field_names: Sequence[str], rows: Array) -> dict[str, Any]:
    """Some rows of fields of a record, None where it has none."""
    every = {name: getattr(record, name) for name in field_names}
    return {name: None if value is None else value[rows] for name, value in every.items()}


# ---- a table -------------------------------------------------------------------------------------


MAX_LOG_JOINTS = 100  # of any machine; guards against a number that is none of a joint
MAX_LOG_NUMBER = 1e6  # of a joint value, speed, acceleration, torque or current, in any unit
MAX_TIME_STAMP = 1e20  # nanoseconds since 1970 are 2e18
MIN_LOG_TIME_STEP, MAX_LOG_TIME_STEP = 5e-5, 0.5  # between rows of any log of a motion [s]
SI_PER_LOG_UNIT = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3, "mA": 1e-3}
SECONDS_PER_TIME_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TEXT_COLUMN_KINDS = ("name", "run")  # columns of text
TIME_COLUMN_KINDS = ("t", "sec", "nanosec")
SINGLE_COLUMN_KINDS = ("t", "sec", "nanosec", "payload")  # kinds of which a file has one column
HOUSE_COLUMN_NAMES = (
    "t_s",
    "payload_kg",
    "run",
    "q1_rad",
    "q1_deg",
    "qd1_rad_s",
    "qdd1_rad_s2",
    "tau1_Nm",
    "i1_A",
    "q1_cmd_rad",
    "tau1_cmd_Nm",
    "temperature1_C",
)
MAX_SHOWN_LOG_LINES = 3  # lines or names that a notice gives


@dataclass(frozen=True, eq=False)
class LogColumns:
    """A file's columns.

    line_numbers: (m,) of each row.  values_by_kind: by kind, (m, n) where joints have a column
    each, else (m,), in SI, NaN where empty.  column_names_by_kind: by kind, the columns' names.
    units_by_kind: by kind and joint, as named. joint_names: (n,) names of the joints, or empty.
    run_labels: (m,) labels, or empty.
    """

    source: str
    format_name: str
    line_numbers: Array
    values_by_kind: Mapping[str, Array]
    column_names_by_kind: Mapping[str, tuple[str, ...]]
    units_by_kind: Mapping[str, tuple[str, ...]]
    joint_names: tuple[str, ...] = ()
    run_labels: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    is_simulated: bool = False

    @property
    def is_prismatic(self) -> Array:
        """(n,) True where a joint's column has a unit of length."""
        return np.array([unit in LENGTH_COLUMN_UNITS for unit in self.units_by_kind["q"]])

    def select_joints(self, joint_indices: Sequence[int]) -> LogColumns:
        """The log of some joints, in an order."""
        n, at = self.values_by_kind["q"].shape[1], list(joint_indices)

        def some(columns: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(columns[i] for i in at) if len(columns) == n else columns

        values = {kind: value[:, at] if value.shape[1:] == (n,) else value
                  for kind, value in self.values_by_kind.items()}  # fmt: skip
        headers = {kind: some(names) for kind, names in self.column_names_by_kind.items()}
        units = {kind: some(names) for kind, names in self.units_by_kind.items()}
        return replace(
            self,
            values_by_kind=values,
            column_names_by_kind=headers,
            units_by_kind=units,
            joint_names=some(self.joint_names),
        )


def read_log_sheet(path: Path, max_lines: int | None = None) -> Sheet:
    """The rows of a log, with a header also where a recorder writes none.  Raises DataError.

    max_lines: how many are looked at, torn or not; all unless given.
    """
    text = read_text_sheet(path)
    body = text.text.lstrip("%")  # of rostopic echo -p, whose header is no comment
    head = body if max_lines is None else "\n".join(body.splitlines()[:max_lines])
    sheet = parse_sheet_table(
        replace(text, text=head), max_torn_share=MAX_TORN_SHARE if max_lines is None else 1.0
    )
    if sheet.header or not sheet.cells:
        return sheet
    return replace(sheet, header=build_header_of_topic(sheet.cells[0]))


def build_header_of_topic(first_row: Sequence[str]) -> tuple[str, ...]:
    """The names of what `ros2 topic echo --csv` writes of JointState, or nothing.

    Stamp, frame, names, and up to three arrays.  first_row: the first row.
    """
    n = sum(bool(re.fullmatch(r"[A-Za-z]\w*", cell)) for cell in first_row[3:])
    held = ("name", "position", "velocity", "effort")[: (len(first_row) - 3) // max(n, 1)]
    if len(held) < 2 or len(first_row) != 3 + len(held) * n:
        return ()
    stamp = ("header.stamp.sec", "header.stamp.nanosec", "frame")
    return (*stamp, *(f"{kind}[{i}]" for kind in held for i in range(n)))


def read_log_table(path: Path, unit_by_kind: Mapping[str, str]) -> LogColumns:
    """A text file's columns.  unit_by_kind: that the file does not tell, as {"q": "deg"}.

    Raises DataError.
    """
    sheet = read_log_sheet(path)
    if not len(sheet.line):
        raise DataError(f"{path}: holds a header but no whole row")
    if not sheet.header:
        raise DataError(
            f"{path}: has no header; name the columns t_s, q1_rad, ..., and tau1_Nm or i1_A"
        )
    if found := detect_log_format(sheet.header):
        return LogSheetReader(sheet, *found, unit_by_kind).build_log()
    names = ", ".join(sheet.header[:6]) + (" ..." if len(sheet.header) > 6 else "")
    raise DataError(
        f"{path}:1: no joint columns among {names}; name them q1_rad (or q1_deg), q2_rad, ..., or "
        f"as {', '.join(form.title for form in LOG_FORMATS[1:-1])} do"
    )


@dataclass(frozen=True, eq=False)
class LogSheetReader:
    """The columns of a sheet, whose format is known.

    column_meanings: what they hold.  unit_by_kind: units that the user tells.  broken_rows: rows
    with a cell that is no number, and what it holds.
    """

    sheet: Sheet
    log_format: LogFormat
    column_meanings: Mapping[int, LogColumn]
    unit_by_kind: Mapping[str, str]
    broken_rows: dict[int, str] = field(default_factory=dict)

    def build_log(self) -> LogColumns:
        """The columns in SI.  Raises DataError."""
        values: dict[str, Array] = {}
        headers: dict[str, tuple[str, ...]] = {}
        units: dict[str, tuple[str, ...]] = {}
        for kind in dict.fromkeys(place.kind for place in self.column_meanings.values()):
            at = [] if kind in TEXT_COLUMN_KINDS else self.find_columns_by_joint(kind)
            if not at:
                continue
            blocks = [self.read_number_block(i) for i in at]
            wide = [block.shape[1] for block in blocks]
            units[kind] = tuple(np.repeat([self.find_unit(i) for i in at], wide).tolist())
            factors = [SI_PER_LOG_UNIT.get(unit, 1.0) for unit in units[kind]]
            block = np.concatenate(blocks, axis=1) * factors
            names = [self.sheet.header[i] for i in at]
            of_list = tuple(f"{names[0]}[{j}]" for j in range(wide[0]))
            headers[kind] = of_list if wide[0] > 1 else tuple(names)
            single = kind in SINGLE_COLUMN_KINDS or (
                kind == "temperature" and not self.column_meanings[at[0]].joint
            )
            values[kind] = block[:, 0] if single else block
        values["t"] = self.build_time(values, units.get("t", ("",))[0])
        run, sheet = self.find_columns("run"), self.sheet
        torn = sorted(self.broken_rows)
        if len(torn) > max(1.0, MAX_TORN_SHARE * len(sheet.line)):
            raise self.build_error(self.broken_rows[torn[0]], sheet.line[torn[0]])
        notices = list(
            sheet.list_left_out_notices(int(sheet.line[row]) for row in self.broken_rows)
        )
        if self.log_format.strict:  # columns that look like those of the format but are not
            notices += [
                (
                    f"{sheet.path}: column {name} is not "
                    f"used{similar_column_hint(name, HOUSE_COLUMN_NAMES)}"
                )
                for i, name in enumerate(sheet.header)
                if i not in self.column_meanings
            ]
        whole = np.delete(np.arange(len(sheet.line)), torn).tolist()
        kept = whole if torn else slice(None)
        return LogColumns(
            source=str(sheet.path),
            format_name=self.log_format.title,
            line_numbers=sheet.line[kept],
            values_by_kind={
                kind: value[kept]
                for kind, value in self.select_values_of_joint_count(values).items()
            },
            column_names_by_kind=headers,
            units_by_kind=units,
            joint_names=self.find_joint_names(),
            run_labels=tuple(sheet.cells[row][run[0]] for row in whole) if run else (),
            notices=tuple(notices),
            is_simulated=sheet.is_marked_simulated,
        )

    def build_error(self, text: str, line: int = 1) -> DataError:
        """What is wrong, and where."""
        return DataError(f"{self.sheet.path}:{line}: {text}")

    def find_columns(self, kind: str) -> list[int]:
        """The columns of a kind."""
        return [i for i, place in self.column_meanings.items() if place.kind == kind]

    def list_joint_keys(self) -> list[str]:
        """What tells the joints of a file apart, in order.  Raises DataError."""
        columns = {
            self.column_meanings[i].joint: self.sheet.header[i] for i in self.find_columns("q")
        }
        columns.pop("", None)
        if not all(key.isdigit() for key in columns):
            return list(columns)
        keys = sorted(columns, key=int)
        for expected, key in enumerate(keys, self.log_format.first):
            if int(key) != expected or expected > MAX_LOG_JOINTS:
                raise self.build_error(
                    f"joint {expected} has no column, but {columns[keys[-1]]} is there; number "
                    f"the joints from {self.log_format.first} on"
                )
        return keys

    def find_columns_by_joint(self, kind: str) -> list[int]:
        """The columns of a kind, in the joints' order; none where joints lack.

        Raises DataError.
        """
        mine, header = self.find_columns(kind), self.sheet.header
        alone = [i for i in mine if not self.column_meanings[i].joint]
        if kind in SINGLE_COLUMN_KINDS or (kind == "temperature" and alone):
            return alone[:1]
        if kind == "q" and {"rad", "deg"} <= {self.column_meanings[i].unit for i in mine}:
            raise self.build_error("joint columns mix _rad and _deg; use one of them")
        by_joint: dict[str, int] = {}
        for i in mine:
            if (first := by_joint.setdefault(self.column_meanings[i].joint, i)) != i:
                raise self.build_error(
                    f"{header[first]} and {header[i]} are one column; keep one of them"
                )
        joints = self.list_joint_keys() or [""]  # a vector in each cell
        lost = [joint for joint in joints if joint not in by_joint]
        if kind in ("tau", "i") and 0 < len(lost) < len(joints):
            i = next(i for i in self.find_columns("q") if self.column_meanings[i].joint == lost[0])
            raise self.build_error(
                f"joint column {header[i]} has no torque or current beside {header[mine[0]]}; "
                "add it"
            )
        return [] if lost else [by_joint[joint] for joint in joints]

    def find_unit(self, column_index: int) -> str:
        """The unit of a column.  Raises DataError where nobody tells it."""
        place = self.column_meanings[column_index]
        kind = "q" if place.kind in ("q", "qd", "qdd", "q_cmd") else place.kind
        unit = self.unit_by_kind.get(kind, "") or place.unit
        if not unit and kind == "q":
            name = self.sheet.header[column_index]
            raise DataError(
                f"{self.sheet.path}: column {name}: has no unit; add units='q=deg' or "
                f"units='q=rad', or name it {name} [deg] or {name} [rad]"
            )
        return unit

    def select_values_of_joint_count(self, values: dict[str, Array]) -> dict[str, Array]:
        """The values, without derivatives of other joints than q has.  Raises DataError."""
        n = values["q"].shape[1]
        for kind in ("tau", "i"):
            if kind in values and values[kind].shape[1] != n:
                raise DataError(
                    f"{self.sheet.path}: holds {n} joint values but {values[kind].shape[1]} "
                    "torques or currents a row; log as many of both"
                )
        fits = {k: v for k, v in values.items() if v.ndim == 1 or v.shape[1] == n}
        return {kind: value for kind, value in fits.items() if kind not in ("sec", "nanosec")}

    def find_joint_names(self) -> tuple[str, ...]:
        """Names of the joints: those in columns of names, or those that columns are called by.

        Raises DataError where names change along the file.
        """
        joints, cells = self.list_joint_keys(), self.sheet.cells
        called = {self.column_meanings[i].joint: i for i in self.find_columns("name")}
        if not joints or not set(joints) <= set(called):
            return () if all(joint.isdigit() for joint in joints) else tuple(joints)
        first = [cells[0][called[joint]] for joint in joints]
        for line, row in zip(self.sheet.line, cells, strict=True):
            for joint, name in zip(joints, first, strict=True):
                if (found := row[called[joint]]) != name:
                    raise self.build_error(
                        f"column {self.sheet.header[called[joint]]}: {found!r} follows {name!r}: "
                        "joints of two topics; keep one of them",
                        line,
                    )
        return tuple(first)

    def read_number_block(self, column_index: int) -> Array:
        """(m, 1) numbers of a column, or (m, k) of one that holds a list in each cell."""
        if self.sheet.block is not None:
            values = self.sheet.block[:, [column_index]]
            if (np.abs(values) <= self.find_max_number(column_index)).all():
                return values
        cells = [row[column_index] for row in self.sheet.cells]
        if not any(cell.startswith("[") for cell in cells[:MAX_SHOWN_LOG_LINES]):
            return self.parse_numbers(column_index, cells)[:, None]
        rows = [cell.strip("[]").replace(",", " ").split() for cell in cells]
        k = max(map(len, rows))
        whole = [parts if len(parts) == k else [cell or "[]"] * k
                 for parts, cell in zip(rows, cells, strict=True)]  # fmt: skip
        return np.stack(
            [self.parse_numbers(column_index, [row[j] for row in whole]) for j in range(k)], axis=1
        )

    def find_max_number(self, column_index: int) -> float:
        """The size that no number of a column has."""
        return (
            MAX_TIME_STAMP
            if self.column_meanings[column_index].kind in TIME_COLUMN_KINDS
            else MAX_LOG_NUMBER
        )

    def parse_numbers(self, column_index: int, cells: Sequence[str]) -> Array:
        """(m,) numbers, NaN where there is none."""
        out = parse_numbers(cells, self.sheet.decimal)
        wild = np.abs(out) > self.find_max_number(column_index)
        for row in np.flatnonzero(np.isnan(out) | wild).tolist():
            cell = cells[row][:40]
            if wild[row] or cell.lower().strip("+-") not in ("", "nan"):
                why = (
                    f"{cell} cannot be; check the number and its unit"
                    if wild[row]
                    else f"{cell!r} is no number; mend it or delete the row"
                )
                self.broken_rows.setdefault(row, f"column {self.sheet.header[column_index]}: {why}")
        return np.where(np.isfinite(out), out, np.nan)

    def build_time(self, values: Mapping[str, Array], unit: str) -> Array:
        """(m,) seconds since the first row.  Raises DataError."""
        path = self.sheet.path
        if "sec" in values and "nanosec" in values:
            sec, fine = values["sec"], values["nanosec"]
            return np.asarray(sec - sec[np.isfinite(sec)][:1].sum() + 1e-9 * fine)
        if "t" not in values:
            raise DataError(f"{path}:1: no column of time; name it t_s")
        finite = values["t"][np.isfinite(values["t"])]
        time, steps = values["t"] - finite[:1].sum(), np.abs(np.diff(finite))
        step = float(np.median(steps[steps > 0.0])) if steps.any() else 0.0
        fits = [
            u
            for u, f in SECONDS_PER_TIME_UNIT.items()
            if MIN_LOG_TIME_STEP <= f * step <= MAX_LOG_TIME_STEP
        ]
        other = fits[0] if fits else ""
        unit = unit or other
        if step > 0.0 and unit not in fits:
            mend = f"; name it t_{other} if it is in {other}" if other else "; log 50 rows a second"
            raise DataError(
                f"{path}: column of time: steps of {step:.3g} {unit or '(no unit)'} are no "
                f"log of a motion{mend}"
            )
        return np.asarray(SECONDS_PER_TIME_UNIT.get(unit, 1.0) * time)


# ---- a run in the making -------------------------------------------------------------------------


ANGLE_OF_TURN = 2.0 * np.pi
JOINT_COMMAND_KIND = "q_cmd"
DERIVATIVE_WORDS = {"qd": "speeds", "qdd": "accelerations"}
UNIT_BY_TORQUE_KIND = {"tau": TORQUE_UNIT, "i": CURRENT_UNIT, JOINT_COMMAND_KIND: NO_TORQUE_UNIT}


@dataclass(frozen=True, eq=False, kw_only=True)
class DraftRun(Run):
    """A run whose rows are still those of a log.

    log: the file's columns.  torque_kind: of its torque columns, tau or i, else q_cmd.
    log_row_indices: (m,) rows of the log.
    """

    log: LogColumns
    torque_kind: str
    log_row_indices: Array

    @property
    def has_torques(self) -> bool:
        """Whether torques or currents were logged; else commands stand in their place."""
        return self.torque_kind != JOINT_COMMAND_KIND

    @property
    def reported_payloads(self) -> list[float]:
        """The masses at the flange that its rows report, each once [kg]."""
        told = self.log.values_by_kind.get("payload", np.empty(0))
        told = told[self.log_row_indices] if len(told) else told
        return [float(mass) for mass in np.unique(told[np.isfinite(told)])]

    def with_notices(self, *notices: str) -> DraftRun:
        """With more notices."""
        where = f"{self.log.source}: " + (f"run {self.name}: " if self.log.run_labels else "")
        return replace(self, notices=(*self.notices, *(where + text for text in notices)))

    def find_column_name(self, kind: str, joint_index: int) -> str:
        """The name of a joint's column in the file."""
        return self.log.column_names_by_kind[kind][joint_index]

    def build_error(self, text: str, row_index: int | None = None) -> DataError:
        """What is wrong, and where."""
        at = (
            ""
            if row_index is None
            else f":{self.log.line_numbers[self.log_row_indices[row_index]]}"
        )
        inside = f"run {self.name}: " if self.log.run_labels and row_index is None else ""
        return DataError(f"{self.log.source}{at}: {inside}{text}")

    def select_rows_and_log_rows(self, row_mask: Array) -> DraftRun:
        """The same at some rows only.  row_mask: (m,) mask."""
        return replace(
            self, **select_field_rows(self, (*RUN_ROW_FIELDS, "log_row_indices"), row_mask)
        )

    def format_line_numbers(self, row_indices: Array) -> str:
        """Some lines of the file, to people."""
        some = ", ".join(
            map(str, self.log.line_numbers[self.log_row_indices[row_indices[:MAX_SHOWN_LOG_LINES]]])
        )
        return f"line{'s' * (len(row_indices) > 1)} {some}" + (
            " ..." if len(row_indices) > MAX_SHOWN_LOG_LINES else ""
        )

    def build_run_of_one_payload(self) -> Run:
        """The finished run.  Raises DataError for a payload that changes."""
        values = {
            kind: value[self.log_row_indices] for kind, value in self.log.values_by_kind.items()
        }
        payload = self.reported_payloads
        if len(payload) > 1:
            raise self.build_error(
                f"the payload changes from {payload[0]:g} to {payload[-1]:g} kg within a run; give "
                "each payload a run of its own"
            )
        warmth, command = values.get("temperature"), values.get(JOINT_COMMAND_KIND)
        if command is not None:
            if command.shape == self.q.shape and np.isfinite(command).all():
                command = command + ANGLE_OF_TURN * np.round(
                    (self.q - command) / ANGLE_OF_TURN
                )  # less whole turns
            else:
                command = None
        more = {
            "torque": self.torque if self.has_torques else 0.0 * self.torque,
            "payload": payload[0] if payload else None,
            "temperature": warmth if warmth is not None and np.isfinite(warmth).all() else None,
            "command": command,
        }
        return Run(**{each.name: getattr(self, each.name) for each in fields(Run)} | more)


def split_log_into_runs(log: LogColumns, file_name: str) -> list[DraftRun]:
    """The trajectories of a log, in the order of their first rows.  Raises DataError."""
    kind = find_torque_kind(log)
    values = log.values_by_kind
    labels = np.array(log.run_labels or [""] * len(log.line_numbers))
    needed = {"time": values["t"][:, None], "joint value": values["q"], "torque": values[kind]}
    held = {what: np.isfinite(block).all(axis=1) for what, block in needed.items()}
    whole = np.all(list(held.values()), axis=0)
    if not whole.any():
        what = next((what for what, rows in held.items() if not rows.any()), "value")
        raise DataError(f"{log.source}: no row holds a {what} of every joint; log them together")
    out = []
    for label in dict.fromkeys(labels):
        mine = labels == label
        row = np.flatnonzero(mine & whole)
        if not len(row):
            raise DataError(f"{log.source}: run {label} holds no whole row; delete it")
        own = {each: block[row] for each, block in values.items()}
        torn = [
            each for each in DERIVATIVE_WORDS if each in own and not np.isfinite(own[each]).all()
        ]
        qd, qdd = (None if each in torn else own.get(each) for each in DERIVATIVE_WORDS)
        title, time = f"{file_name}:{label}" if label else file_name, own["t"] - own["t"][0]
        draft = DraftRun(
            title,
            log.source,
            time,
            own["q"],
            qd,
            qdd,
            own[kind],
            UNIT_BY_TORQUE_KIND[kind],
            notices=log.notices,
            log=log,
            torque_kind=kind,
            log_row_indices=row,
        )
        if lost_rows := int(mine.sum()) - len(row):
            lacking = f"{lost_rows} of {mine.sum()} rows lack a joint value or torque"
            draft = draft.with_notices(f"{lacking}: left out")
        said = (f"{DERIVATIVE_WORDS[each]} lack in some rows: not used" for each in torn)
        out.append(draft.with_notices(*said))
    return out


def find_torque_kind(log: LogColumns) -> str:
    """Which columns hold what the drives did.  Raises DataError where none do."""
    for kind in ("tau", "i"):
        if kind in log.values_by_kind and np.isfinite(log.values_by_kind[kind]).any():
            return kind
    if (
        JOINT_COMMAND_KIND in log.values_by_kind
        and log.values_by_kind[JOINT_COMMAND_KIND].shape == log.values_by_kind["q"].shape
    ):
        return JOINT_COMMAND_KIND
    if log.values_by_kind.keys() & {"tau_cmd", "i_cmd"}:
        name = next(
            log.column_names_by_kind[k][0] for k in ("tau_cmd", "i_cmd") if k in log.values_by_kind
        )
        raise DataError(
            f"{log.source}:1: {name} is the command; add the measured torque or current (tau1_Nm, "
            "i1_A)"
        )
    raise DataError(
        f"{log.source}:1: no column of torque or current; drive this motion and log tau1_Nm (or "
        "i1_A), tau2_Nm, ..."
    )
