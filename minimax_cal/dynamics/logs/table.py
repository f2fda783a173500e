"""A run, and how it is made of a log: its columns in SI, whatever tool wrote it, cut into runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.reading.formats import FORMATS, Format, Place, format_of
from minimax_cal.reading.sheet import MOST_TORN, Sheet, cut, numbers_of, open_text
from minimax_cal.reading.words import SIZES, near

TORQUE = "N m"  # of a revolute joint; N of one that slides
CURRENT = "A"
NOTHING = ""  # where neither was logged, but commands
ROWS = ("time", "q", "qd", "qdd", "torque", "temperature", "command")  # what has a value a row


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
        return replace(self, **rows_of(self, ROWS, rows))


def rows_of(record: Any, names: Sequence[str], rows: Array) -> dict[str, Any]:
    """Some rows of fields of a record, None where it has none."""
    every = {name: getattr(record, name) for name in names}
    return {name: None if value is None else value[rows] for name, value in every.items()}


# ---- a table -------------------------------------------------------------------------------------


MOST_JOINTS = 100  # of any machine; guards against a number that is none of a joint
MOST = 1e6  # of a joint value, speed, acceleration, torque or current, in any unit
MOST_TIME = 1e20  # nanoseconds since 1970 are 2e18
SHORTEST_STEP, LONGEST_STEP = 5e-5, 0.5  # between rows of any log of a motion [s]
FACTORS = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3, "mA": 1e-3}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
WORDS = ("name", "run")  # columns of text
CLOCKS = ("t", "sec", "nanosec")
SINGLE = ("t", "sec", "nanosec", "payload")  # kinds of which a file has one column
KNOWN = ("t_s", "payload_kg", "run", "q1_rad", "q1_deg", "qd1_rad_s", "qdd1_rad_s2", "tau1_Nm",
         "i1_A", "q1_cmd_rad", "tau1_cmd_Nm", "temperature1_C")  # fmt: skip
SHOWN = 3  # lines or names that a notice gives


@dataclass(frozen=True, eq=False)
class Log:
    """A file's columns.

    line: (m,) of each row.  values: by kind, (m, n) where joints have a column each, else (m,), in
    SI, NaN where empty.  headers: by kind, the columns' names.  units: by kind and joint, as named.
    joints: (n,) names of the joints, or empty.  run: (m,) labels, or empty.
    """

    source: str
    title: str
    line: Array
    values: Mapping[str, Array]
    headers: Mapping[str, tuple[str, ...]]
    units: Mapping[str, tuple[str, ...]]
    joints: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    simulated: bool = False

    @property
    def sliding(self) -> Array:
        """(n,) True where a joint's column has a unit of length."""
        return np.array([unit in SIZES for unit in self.units["q"]])

    def taking(self, order: Sequence[int]) -> Log:
        """The log of some joints, in an order."""
        n, at = self.values["q"].shape[1], list(order)

        def some(columns: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(columns[i] for i in at) if len(columns) == n else columns

        values = {kind: value[:, at] if value.shape[1:] == (n,) else value
                  for kind, value in self.values.items()}  # fmt: skip
        headers = {kind: some(names) for kind, names in self.headers.items()}
        units = {kind: some(names) for kind, names in self.units.items()}
        return replace(self, values=values, headers=headers, units=units, joints=some(self.joints))


def log_sheet(path: Path, lines: int | None = None) -> Sheet:
    """The rows of a log, with a header also where a recorder writes none.  Raises DataError.

    lines: how many are looked at, torn or not; all unless given.
    """
    text = open_text(path)
    body = text.text.lstrip("%")  # of rostopic echo -p, whose header is no comment
    head = body if lines is None else "\n".join(body.splitlines()[:lines])
    sheet = cut(replace(text, text=head), most_torn=MOST_TORN if lines is None else 1.0)
    if sheet.header or not sheet.cells:
        return sheet
    return replace(sheet, header=topic_header(sheet.cells[0]))


def topic_header(first: Sequence[str]) -> tuple[str, ...]:
    """The names of what `ros2 topic echo --csv` writes of JointState, or nothing.

    Stamp, frame, names, and up to three arrays.  first: the first row.
    """
    n = sum(bool(re.fullmatch(r"[A-Za-z]\w*", cell)) for cell in first[3:])
    held = ("name", "position", "velocity", "effort")[: (len(first) - 3) // max(n, 1)]
    if len(held) < 2 or len(first) != 3 + len(held) * n:
        return ()
    stamp = ("header.stamp.sec", "header.stamp.nanosec", "frame")
    return (*stamp, *(f"{kind}[{i}]" for kind in held for i in range(n)))


def read_table(path: Path, units: Mapping[str, str]) -> Log:
    """A text file's columns.  units: that the file does not tell, as {"q": "deg"}.

    Raises DataError.
    """
    sheet = log_sheet(path)
    if not len(sheet.line):
        raise DataError(f"{path}: holds a header but no whole row")
    if not sheet.header:
        raise DataError(
            f"{path}: has no header; name the columns t_s, q1_rad, ..., and tau1_Nm or i1_A"
        )
    if found := format_of(sheet.header):
        return Columns(sheet, *found, units).log()
    names = ", ".join(sheet.header[:6]) + (" ..." if len(sheet.header) > 6 else "")
    raise DataError(
        f"{path}:1: no joint columns among {names}; name them q1_rad (or q1_deg), q2_rad, ..., or "
        f"as {', '.join(form.title for form in FORMATS[1:-1])} do"
    )


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of a sheet, whose format is known.

    places: what they hold.  given: units that the user tells.  broken: rows with a cell that is no
    number, and what it holds.
    """

    sheet: Sheet
    form: Format
    places: Mapping[int, Place]
    given: Mapping[str, str]
    broken: dict[int, str] = field(default_factory=dict)

    def log(self) -> Log:
        """The columns in SI.  Raises DataError."""
        values: dict[str, Array] = {}
        headers: dict[str, tuple[str, ...]] = {}
        units: dict[str, tuple[str, ...]] = {}
        for kind in dict.fromkeys(place.kind for place in self.places.values()):
            at = [] if kind in WORDS else self.of_joints(kind)
            if not at:
                continue
            blocks = [self.block(i) for i in at]
            wide = [block.shape[1] for block in blocks]
            units[kind] = tuple(np.repeat([self.unit(i) for i in at], wide).tolist())
            factors = [FACTORS.get(unit, 1.0) for unit in units[kind]]
            block = np.concatenate(blocks, axis=1) * factors
            names = [self.sheet.header[i] for i in at]
            of_list = tuple(f"{names[0]}[{j}]" for j in range(wide[0]))
            headers[kind] = of_list if wide[0] > 1 else tuple(names)
            single = kind in SINGLE or (kind == "temperature" and not self.places[at[0]].joint)
            values[kind] = block[:, 0] if single else block
        values["t"] = self.time(values, units.get("t", ("",))[0])
        run, sheet = self.of_kind("run"), self.sheet
        torn = sorted(self.broken)
        if len(torn) > max(1.0, MOST_TORN * len(sheet.line)):
            raise self.error(self.broken[torn[0]], sheet.line[torn[0]])
        notices = list(sheet.left_out(int(sheet.line[row]) for row in self.broken))
        if self.form.strict:  # columns that look like those of the format but are not
            notices += [f"{sheet.path}: column {name} is not used{near(name, KNOWN)}"
                        for i, name in enumerate(sheet.header) if i not in self.places]  # fmt: skip
        whole = np.delete(np.arange(len(sheet.line)), torn).tolist()
        kept = whole if torn else slice(None)
        return Log(
            source=str(sheet.path),
            title=self.form.title,
            line=sheet.line[kept],
            values={kind: value[kept] for kind, value in self.same_width(values).items()},
            headers=headers,
            units=units,
            joints=self.names(),
            run=tuple(sheet.cells[row][run[0]] for row in whole) if run else (),
            notices=tuple(notices),
            simulated=sheet.simulated,
        )

    def error(self, text: str, line: int = 1) -> DataError:
        """What is wrong, and where."""
        return DataError(f"{self.sheet.path}:{line}: {text}")

    def of_kind(self, kind: str) -> list[int]:
        """The columns of a kind."""
        return [i for i, place in self.places.items() if place.kind == kind]

    def joints(self) -> list[str]:
        """What tells the joints of a file apart, in order.  Raises DataError."""
        columns = {self.places[i].joint: self.sheet.header[i] for i in self.of_kind("q")}
        columns.pop("", None)
        if not all(key.isdigit() for key in columns):
            return list(columns)
        keys = sorted(columns, key=int)
        for expected, key in enumerate(keys, self.form.first):
            if int(key) != expected or expected > MOST_JOINTS:
                raise self.error(
                    f"joint {expected} has no column, but {columns[keys[-1]]} is there; number "
                    f"the joints from {self.form.first} on"
                )
        return keys

    def of_joints(self, kind: str) -> list[int]:
        """The columns of a kind, in the joints' order; none where joints lack.

        Raises DataError.
        """
        mine, header = self.of_kind(kind), self.sheet.header
        alone = [i for i in mine if not self.places[i].joint]
        if kind in SINGLE or (kind == "temperature" and alone):
            return alone[:1]
        if kind == "q" and {"rad", "deg"} <= {self.places[i].unit for i in mine}:
            raise self.error("joint columns mix _rad and _deg; use one of them")
        by_joint: dict[str, int] = {}
        for i in mine:
            if (first := by_joint.setdefault(self.places[i].joint, i)) != i:
                raise self.error(
                    f"{header[first]} and {header[i]} are one column; keep one of them"
                )
        joints = self.joints() or [""]  # a vector in each cell
        lost = [joint for joint in joints if joint not in by_joint]
        if kind in ("tau", "i") and 0 < len(lost) < len(joints):
            i = next(i for i in self.of_kind("q") if self.places[i].joint == lost[0])
            raise self.error(
                f"joint column {header[i]} has no torque or current beside {header[mine[0]]}; "
                "add it"
            )
        return [] if lost else [by_joint[joint] for joint in joints]

    def unit(self, at: int) -> str:
        """The unit of a column.  Raises DataError where nobody tells it."""
        place = self.places[at]
        kind = "q" if place.kind in ("q", "qd", "qdd", "q_cmd") else place.kind
        unit = self.given.get(kind, "") or place.unit
        if not unit and kind == "q":
            name = self.sheet.header[at]
            raise DataError(
                f"{self.sheet.path}: column {name}: has no unit; add units='q=deg' or "
                f"units='q=rad', or name it {name} [deg] or {name} [rad]"
            )
        return unit

    def same_width(self, values: dict[str, Array]) -> dict[str, Array]:
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

    def names(self) -> tuple[str, ...]:
        """Names of the joints: those in columns of names, or those that columns are called by.

        Raises DataError where names change along the file.
        """
        joints, cells = self.joints(), self.sheet.cells
        called = {self.places[i].joint: i for i in self.of_kind("name")}
        if not joints or not set(joints) <= set(called):
            return () if all(joint.isdigit() for joint in joints) else tuple(joints)
        first = [cells[0][called[joint]] for joint in joints]
        for line, row in zip(self.sheet.line, cells, strict=True):
            for joint, name in zip(joints, first, strict=True):
                if (found := row[called[joint]]) != name:
                    raise self.error(
                        f"column {self.sheet.header[called[joint]]}: {found!r} follows {name!r}: "
                        "joints of two topics; keep one of them",
                        line,
                    )
        return tuple(first)

    def block(self, at: int) -> Array:
        """(m, 1) numbers of a column, or (m, k) of one that holds a list in each cell."""
        if self.sheet.block is not None:
            values = self.sheet.block[:, [at]]
            if (np.abs(values) <= self.most(at)).all():
                return values
        cells = [row[at] for row in self.sheet.cells]
        if not any(cell.startswith("[") for cell in cells[:SHOWN]):
            return self.numbers(at, cells)[:, None]
        rows = [cell.strip("[]").replace(",", " ").split() for cell in cells]
        k = max(map(len, rows))
        whole = [parts if len(parts) == k else [cell or "[]"] * k
                 for parts, cell in zip(rows, cells, strict=True)]  # fmt: skip
        return np.stack([self.numbers(at, [row[j] for row in whole]) for j in range(k)], axis=1)

    def most(self, at: int) -> float:
        """The size that no number of a column has."""
        return MOST_TIME if self.places[at].kind in CLOCKS else MOST

    def numbers(self, at: int, cells: Sequence[str]) -> Array:
        """(m,) numbers, NaN where there is none."""
        out = numbers_of(cells, self.sheet.decimal)
        wild = np.abs(out) > self.most(at)
        for row in np.flatnonzero(np.isnan(out) | wild).tolist():
            cell = cells[row][:40]
            if wild[row] or cell.lower().strip("+-") not in ("", "nan"):
                why = (
                    f"{cell} cannot be; check the number and its unit"
                    if wild[row]
                    else f"{cell!r} is no number; mend it or delete the row"
                )
                self.broken.setdefault(row, f"column {self.sheet.header[at]}: {why}")
        return np.where(np.isfinite(out), out, np.nan)

    def time(self, values: Mapping[str, Array], unit: str) -> Array:
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
        fits = [u for u, f in TIMES.items() if SHORTEST_STEP <= f * step <= LONGEST_STEP]
        other = fits[0] if fits else ""
        unit = unit or other
        if step > 0.0 and unit not in fits:
            mend = f"; name it t_{other} if it is in {other}" if other else "; log 50 rows a second"
            raise DataError(
                f"{path}: column of time: steps of {step:.3g} {unit or '(no unit)'} are no "
                f"log of a motion{mend}"
            )
        return np.asarray(TIMES.get(unit, 1.0) * time)


# ---- a run in the making -------------------------------------------------------------------------


TURN = 2.0 * np.pi
COMMANDS = "q_cmd"
DERIVATIVES = {"qd": "speeds", "qdd": "accelerations"}
UNITS = {"tau": TORQUE, "i": CURRENT, COMMANDS: NOTHING}


@dataclass(frozen=True, eq=False, kw_only=True)
class Draft(Run):
    """A run whose rows are still those of a log.

    log: the file's columns.  kind: of its torque columns, tau or i, else q_cmd.  row: (m,) rows of
    the log.
    """

    log: Log
    kind: str
    row: Array

    @property
    def measured(self) -> bool:
        """Whether torques or currents were logged; else commands stand in their place."""
        return self.kind != COMMANDS

    @property
    def payloads(self) -> list[float]:
        """The masses at the flange that its rows report, each once [kg]."""
        told = self.log.values.get("payload", np.empty(0))
        told = told[self.row] if len(told) else told
        return [float(mass) for mass in np.unique(told[np.isfinite(told)])]

    def saying(self, *notices: str) -> Draft:
        """With more notices."""
        where = f"{self.log.source}: " + (f"run {self.name}: " if self.log.run else "")
        return replace(self, notices=(*self.notices, *(where + text for text in notices)))

    def column(self, kind: str, joint: int) -> str:
        """The name of a joint's column in the file."""
        return self.log.headers[kind][joint]

    def error(self, text: str, row: int | None = None) -> DataError:
        """What is wrong, and where."""
        at = "" if row is None else f":{self.log.line[self.row[row]]}"
        inside = f"run {self.name}: " if self.log.run and row is None else ""
        return DataError(f"{self.log.source}{at}: {inside}{text}")

    def keeping(self, rows: Array) -> Draft:
        """The same at some rows only.  rows: (m,) mask."""
        return replace(self, **rows_of(self, (*ROWS, "row"), rows))

    def lines(self, rows: Array) -> str:
        """Some lines of the file, to people."""
        some = ", ".join(map(str, self.log.line[self.row[rows[:SHOWN]]]))
        return f"line{'s' * (len(rows) > 1)} {some}" + (" ..." if len(rows) > SHOWN else "")

    def run(self) -> Run:
        """The finished run.  Raises DataError for a payload that changes."""
        values = {kind: value[self.row] for kind, value in self.log.values.items()}
        payload = self.payloads
        if len(payload) > 1:
            raise self.error(
                f"the payload changes from {payload[0]:g} to {payload[-1]:g} kg within a run; give "
                "each payload a run of its own"
            )
        warmth, command = values.get("temperature"), values.get(COMMANDS)
        if command is not None:
            if command.shape == self.q.shape and np.isfinite(command).all():
                command = command + TURN * np.round((self.q - command) / TURN)  # less whole turns
            else:
                command = None
        more = {
            "torque": self.torque if self.measured else 0.0 * self.torque,
            "payload": payload[0] if payload else None,
            "temperature": warmth if warmth is not None and np.isfinite(warmth).all() else None,
            "command": command,
        }
        return Run(**{each.name: getattr(self, each.name) for each in fields(Run)} | more)


def drafts_of(log: Log, name: str) -> list[Draft]:
    """The trajectories of a log, in the order of their first rows.  Raises DataError."""
    kind = torque_kind(log)
    values = log.values
    labels = np.array(log.run or [""] * len(log.line))
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
        torn = [each for each in DERIVATIVES if each in own and not np.isfinite(own[each]).all()]
        qd, qdd = (None if each in torn else own.get(each) for each in DERIVATIVES)
        title, time = f"{name}:{label}" if label else name, own["t"] - own["t"][0]
        draft = Draft(title, log.source, time, own["q"], qd, qdd, own[kind], UNITS[kind],
                      notices=log.notices, log=log, kind=kind, row=row)  # fmt: skip
        if lost_rows := int(mine.sum()) - len(row):
            lacking = f"{lost_rows} of {mine.sum()} rows lack a joint value or torque"
            draft = draft.saying(f"{lacking}: left out")
        said = (f"{DERIVATIVES[each]} lack in some rows: not used" for each in torn)
        out.append(draft.saying(*said))
    return out


def torque_kind(log: Log) -> str:
    """Which columns hold what the drives did.  Raises DataError where none do."""
    for kind in ("tau", "i"):
        if kind in log.values and np.isfinite(log.values[kind]).any():
            return kind
    if COMMANDS in log.values and log.values[COMMANDS].shape == log.values["q"].shape:
        return COMMANDS
    if log.values.keys() & {"tau_cmd", "i_cmd"}:
        name = next(log.headers[k][0] for k in ("tau_cmd", "i_cmd") if k in log.values)
        raise DataError(
            f"{log.source}:1: {name} is the command; add the measured torque or current (tau1_Nm, "
            "i1_A)"
        )
    raise DataError(
        f"{log.source}:1: no column of torque or current; drive this motion and log tau1_Nm (or "
        "i1_A), tau2_Nm, ..."
    )
