"""A table of a log as columns in SI, whatever tool wrote it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.reading.formats import FORMATS, Format, Place, format_of
from minimax_cal.reading.sheet import Sheet, cut, numbers_of, open_text
from minimax_cal.reading.words import SIZES, near

MOST_TORN = 0.01  # share of rows that a log may lose to torn lines
MOST_JOINTS = 100  # of any machine; guards against a number that is none of a joint
MOST = 1e6  # of a joint value, speed, acceleration, torque or current, in any unit
MOST_TIME = 1e20  # nanoseconds since 1970 are 2e18
SHORTEST_STEP, LONGEST_STEP = 5e-5, 0.5  # between rows of any log of a motion [s]
FACTORS = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3, "mA": 1e-3}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
WORDS = ("name", "run")  # columns of text
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

        return replace(
            self,
            values={
                kind: value[:, at] if value.ndim == 2 and value.shape[1] == n else value
                for kind, value in self.values.items()
            },
            headers={kind: some(names) for kind, names in self.headers.items()},
            units={kind: some(names) for kind, names in self.units.items()},
            joints=some(self.joints),
        )


def read_table(path: Path, units: Mapping[str, str]) -> Log:
    """A text file's columns.  units: that the file does not tell, as {"q": "deg"}.

    Raises DataError.
    """
    text = open_text(path)
    if text.text.startswith("%"):  # rostopic echo -p, whose header is no comment
        text = replace(text, text=text.text[1:])
    sheet = cut(text, most_torn=MOST_TORN)
    if not len(sheet.line):
        raise DataError(f"{path}: holds a header but no whole row")
    if not sheet.header:
        return headless(sheet)
    found = format_of(sheet.header)
    if not found:
        names = ", ".join(sheet.header[:6])
        more = " ..." if len(sheet.header) > 6 else ""
        raise DataError(
            f"{path}:1: no joint columns among {names}{more}; name them q1_rad (or q1_deg), "
            f"q2_rad, ..., or as {', '.join(form.title for form in FORMATS[1:])} do"
        )
    return of_format(sheet, *found, units)


def headless(sheet: Sheet) -> Log:
    """What `ros2 topic echo --csv` writes of JointState: stamp, frame, names, and three arrays.

    Raises DataError.
    """
    first = sheet.cells[0]
    names = [cell for cell in first[3:] if re.fullmatch(r"[A-Za-z]\w*", cell)]
    n = len(names)
    if not n or len(first) not in (3 + 2 * n, 3 + 3 * n, 3 + 4 * n):
        raise DataError(
            f"{sheet.path}: has no header; name the columns t_s, q1_rad, ..., and tau1_Nm or i1_A"
        )
    held = [
        kind
        for i, kind in enumerate(("position", "velocity", "effort"))
        if len(first) > 3 + (i + 1) * n
    ]
    header = ["header.stamp.sec", "header.stamp.nanosec", "frame"]
    header += [f"name[{i}]" for i in range(n)]
    header += [f"{kind}[{i}]" for kind in held for i in range(n)]
    found = format_of(header)
    assert found
    return of_format(replace(sheet, header=tuple(header)), *found, {})


def of_format(
    sheet: Sheet, form: Format, places: Mapping[int, Place], units: Mapping[str, str]
) -> Log:
    """The columns of a sheet whose format is known.  Raises DataError."""
    reading = Cells(sheet)
    joints = joint_keys(sheet, form, places)
    values: dict[str, Array] = {}
    headers: dict[str, tuple[str, ...]] = {}
    own: dict[str, tuple[str, ...]] = {}
    for kind in dict.fromkeys(place.kind for place in places.values()):
        at = [] if kind in WORDS else columns_of(sheet, kind, places, joints)
        if not at:
            continue
        most = MOST_TIME if kind in ("t", "sec", "nanosec") else MOST
        blocks = [reading.block(i, most) for i in at]
        units_of = [unit_of(sheet, i, places[i], units) for i in at]
        wide = [block.shape[1] for block in blocks]
        own[kind] = tuple(np.repeat(units_of, wide).tolist())
        block = np.concatenate(blocks, axis=1) * [FACTORS.get(unit, 1.0) for unit in own[kind]]
        names = [sheet.header[i] for i in at]
        of_list = tuple(f"{names[0]}[{j}]" for j in range(wide[0]))
        headers[kind] = of_list if wide[0] > 1 else tuple(names)
        single = kind in SINGLE or (kind == "temperature" and not places[at[0]].joint)
        values[kind] = block[:, 0] if single else block
    values["t"] = reading.time(values, own.get("t", ("",))[0])
    run = next((i for i, place in places.items() if place.kind == "run"), None)
    whole = [row for row in range(len(sheet.line)) if row not in reading.broken]
    values = same_width(sheet, values)
    return Log(
        source=str(sheet.path),
        title=form.title,
        line=sheet.line[whole],
        values={kind: value[whole] for kind, value in values.items()},
        headers=headers,
        units=own,
        joints=names_of(sheet, places, joints),
        run=() if run is None else tuple(sheet.cells[row][run] for row in whole),
        notices=(*reading.notices(), *unused(sheet, form, places)),
        simulated=sheet.simulated,
    )


def unit_of(sheet: Sheet, at: int, place: Place, units: Mapping[str, str]) -> str:
    """The unit of a column.  Raises DataError where nobody tells it."""
    kind = "q" if place.kind in ("q", "qd", "qdd", "q_cmd") else place.kind
    unit = units.get(kind, "") or place.unit
    if not unit and kind == "q":
        raise DataError(
            f"{sheet.path}: column {sheet.header[at]}: has no unit; add units='q=deg' or "
            "units='q=rad'"
        )
    return unit


def joint_keys(sheet: Sheet, form: Format, places: Mapping[int, Place]) -> list[str]:
    """What tells the joints of a file apart, in order.  Raises DataError."""
    keys = list(dict.fromkeys(p.joint for p in places.values() if p.kind == "q" and p.joint))
    if not keys or not all(key.isdigit() for key in keys):
        return keys
    numbers = sorted(map(int, keys))
    for expected, number in enumerate(numbers, form.first):
        if number != expected or number > MOST_JOINTS:
            example = next(
                sheet.header[i]
                for i, p in places.items()
                if p.joint == str(numbers[-1]) and p.kind == "q"
            )
            raise DataError(
                f"{sheet.path}:1: joint {expected} has no column, but {example} is there; number "
                f"the joints from {form.first} on"
            )
    return [key for number in numbers for key in keys if int(key) == number]


def columns_of(
    sheet: Sheet, kind: str, places: Mapping[int, Place], joints: Sequence[str]
) -> list[int]:
    """The columns of a kind, in the joints' order; none where joints lack.  Raises DataError."""
    mine = [i for i, place in places.items() if place.kind == kind]
    if kind in SINGLE:
        return mine[:1]
    if kind == "temperature" and any(not places[i].joint for i in mine):
        return [i for i in mine if not places[i].joint][:1]
    if kind == "q" and {"rad", "deg"} <= {places[i].unit for i in mine}:
        raise DataError(f"{sheet.path}:1: joint columns mix _rad and _deg; use one of them")
    by_joint: dict[str, int] = {}
    for i in mine:
        first = by_joint.setdefault(places[i].joint, i)
        if first != i:
            raise DataError(
                f"{sheet.path}:1: {sheet.header[first]} and {sheet.header[i]} are one column; "
                "keep one of them"
            )
    if not joints:  # a vector in each cell
        return [by_joint[""]]
    lost = [joint for joint in joints if joint not in by_joint]
    if not lost:
        return [by_joint[joint] for joint in joints]
    if kind in ("tau", "i") and len(lost) < len(joints):
        i = next(i for i, p in places.items() if p.kind == "q" and p.joint == lost[0])
        raise DataError(
            f"{sheet.path}:1: joint column {sheet.header[i]} has no torque or current beside "
            f"{sheet.header[mine[0]]}; add it"
        )
    return []


def same_width(sheet: Sheet, values: dict[str, Array]) -> dict[str, Array]:
    """The values, without derivatives of other joints than q has.  Raises DataError."""
    n = values["q"].shape[1]
    for kind in ("tau", "i"):
        if kind in values and values[kind].shape[1] != n:
            raise DataError(
                f"{sheet.path}: holds {n} joint values but {values[kind].shape[1]} torques or "
                "currents a row; log as many of both"
            )
    fits = {k: v for k, v in values.items() if v.ndim == 1 or v.shape[1] == n}
    return {kind: value for kind, value in fits.items() if kind not in ("sec", "nanosec")}


def names_of(sheet: Sheet, places: Mapping[int, Place], joints: Sequence[str]) -> tuple[str, ...]:
    """Names of the joints: those in columns of names, or those that columns are called by.

    Raises DataError where names change along the file.
    """
    called = {place.joint: i for i, place in places.items() if place.kind == "name"}
    if set(joints) <= set(called) and joints:
        for joint in joints:
            cells = [row[called[joint]] for row in sheet.cells]
            other = next((i for i, cell in enumerate(cells) if cell != cells[0]), None)
            if other is not None:
                raise DataError(
                    f"{sheet.path}:{sheet.line[other]}: column {sheet.header[called[joint]]}: "
                    f"{cells[other]!r} follows {cells[0]!r}: joints of two topics; keep one of them"
                )
        return tuple(sheet.cells[0][called[joint]] for joint in joints)
    return () if all(joint.isdigit() for joint in joints) else tuple(joints)


def unused(sheet: Sheet, form: Format, places: Mapping[int, Place]) -> list[str]:
    """Notices of columns that look like those of the format but are not."""
    if not form.strict:
        return []
    left = [name for i, name in enumerate(sheet.header) if i not in places]
    return [f"{sheet.path}: column {name} is not used{near(name, KNOWN)}" for name in left]


@dataclass(frozen=True, eq=False)
class Cells:
    """The numbers of a sheet.  broken: rows with a cell that is none, and what it holds."""

    sheet: Sheet
    broken: dict[int, str] = field(default_factory=dict)

    def block(self, at: int, most: float) -> Array:
        """(m, 1) numbers of a column, or (m, k) of one that holds a list in each cell.

        most: size that no number has.
        """
        cells = [row[at] for row in self.sheet.cells]
        if not any(cell.startswith("[") for cell in cells[:SHOWN]):
            return self.numbers(at, cells, most)[:, None]
        rows = [cell.strip("[]").replace(",", " ").split() for cell in cells]
        k = max(map(len, rows))
        whole = [parts if len(parts) == k else [cell or "[]"] * k
                 for parts, cell in zip(rows, cells, strict=True)]  # fmt: skip
        each = [self.numbers(at, [parts[j] for parts in whole], most) for j in range(k)]
        return np.stack(each, axis=1)

    def numbers(self, at: int, cells: Sequence[str], most: float) -> Array:
        """(m,) numbers, NaN where there is none."""
        out = numbers_of(cells, self.sheet.decimal)
        wild = np.abs(out) > most
        for row in np.flatnonzero(np.isnan(out) | wild).tolist():
            cell, called = cells[row], f"column {self.sheet.header[at]}: "
            if wild[row]:
                what = f"{called}{cell[:40]} cannot be; check the number and its unit"
                self.broken.setdefault(row, what)
            elif cell and cell.lower().strip("+-") != "nan":
                what = f"{called}{cell[:40]!r} is no number; mend it or delete the row"
                self.broken.setdefault(row, what)
        return np.where(np.isfinite(out), out, np.nan)

    def time(self, values: Mapping[str, Array], unit: str) -> Array:
        """(m,) seconds since the first row.  Raises DataError."""
        path = self.sheet.path
        if "sec" in values and "nanosec" in values:
            sec, fine = values["sec"], values["nanosec"]
            return np.asarray(sec - sec[np.isfinite(sec)][:1].sum() + 1e-9 * fine)
        if "t" not in values:
            raise DataError(f"{path}:1: no column of time; name it t_s")
        time = values["t"] - values["t"][np.isfinite(values["t"])][:1].sum()
        step = typical_step(time)
        unit = unit or next((u for u, f in TIMES.items() if is_step(f * step)), "")
        if step > 0.0 and not is_step(TIMES.get(unit, np.nan) * step):
            other = next((u for u, f in TIMES.items() if is_step(f * step)), "")
            mend = f"; name it t_{other} if it is in {other}" if other else "; log 50 rows a second"
            raise DataError(
                f"{path}: column of time: steps of {step:.3g} {unit or '(no unit)'} are no "
                f"log of a motion{mend}"
            )
        return np.asarray(TIMES.get(unit, 1.0) * time)

    def notices(self) -> list[str]:
        """What is said of rows that are left out.  Raises DataError for too many."""
        path, line = self.sheet.path, self.sheet.line
        if len(self.broken) > max(1.0, MOST_TORN * len(line)):
            row, what = next(iter(sorted(self.broken.items())))
            raise DataError(f"{path}:{line[row]}: {what}")
        lines = sorted({*self.sheet.torn, *(int(line[row]) for row in self.broken)})
        if not lines:
            return []
        some = ", ".join(map(str, lines[:SHOWN])) + (" ..." if len(lines) > SHOWN else "")
        plural = "s are" if len(lines) > 1 else " is"
        return [f"{path}: {len(lines)} torn line{plural} left out ({some})"]


def typical_step(time: Array) -> float:
    """Median of the steps of time that are some; 0 where there are none."""
    steps = np.abs(np.diff(time[np.isfinite(time)]))
    steps = steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else 0.0


def is_step(seconds: float) -> bool:
    """Whether rows of a log may follow each other so."""
    return SHORTEST_STEP <= seconds <= LONGEST_STEP
