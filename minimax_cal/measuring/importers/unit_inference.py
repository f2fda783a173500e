"""Units of numbers: given, by the header, or proven by what an arm can be; times and temperatures.

The lever is the largest ratio of how far a target moved to how far the joints turned: no longer
than the arm with its tool, and not much shorter either.  Wrong units miss it by 57 or 1000 times.
"""

from __future__ import annotations

from datetime import datetime
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.measuring.importers.column_tables import ImportedColumn, ImportedTable
from minimax_cal.reading.column_words import (
    COLUMN_SECONDS_PER_TIME_UNIT,
    METRES_PER_LENGTH_UNIT,
    RADIANS_PER_ANGLE_UNIT,
)

MAX_RADIAN_JOINT_VALUE = 4.0 * np.pi  # a joint that turned farther was not written in radians
MAX_TRACKER_DISTANCE = 200.0  # farther than any tracker measures [m]
MIN_ARM_LEVER, MAX_ARM_LEVER = 0.02, 8.0  # lever of an arm [m]; real arms: 0.16 to 2.2
MIN_COMPARED_TURN_SHARE = 0.05  # share of the largest turn; closer pairs show only noise
MIN_TARGET_MOTION = 0.05  # a target that moves less does not calibrate an arm [m]
MAX_COMPARED_POSES = 300  # poses whose pairs are looked at
CANDIDATE_UNITS = (("rad", "deg"), ("mm", "m"))
TIME_STAMPS_TEXT = "time stamps"
CLOCK_FORMATS = ("%H:%M:%S.%f", "%H:%M:%S", "%H:%M", "%I:%M:%S.%f %p", "%I:%M:%S %p", "%I:%M %p")
DATE_FORMATS_BY_ORDER = {
    "dmy": ("%d.%m.%Y ", "%d/%m/%Y ", "%d-%m-%Y "),
    "mdy": ("%m/%d/%Y ", "%m-%d-%Y "),
    "ymd": ("%Y-%m-%d ", "%Y-%m-%dT", "%Y/%m/%d ", "%Y.%m.%d "),
    "": ("",),
}
SECONDS_PER_DAY, SECONDS_PER_HOUR = 86400.0, 3600.0
CLOCK_EPOCH = datetime(1900, 1, 1)  # where a clock without a date starts
COMPACT_STAMP_FORMAT = "%Y%m%d%H%M%S"
CELSIUS_CONVERSIONS = {"C": (1.0, 0.0), "K": (1.0, -273.15), "F": (5.0 / 9.0, -160.0 / 9.0)}
ROOM_TEMPERATURE_RANGES = {
    "C": (5.0, 45.0),
    "F": (50.0, 113.0),
    "K": (278.0, 318.0),
}  # where people measure


def decide_units(
    q: Array, y: Array, q_unit: str, y_unit: str, sliding_joints: Array, paths: tuple[Path, Path]
) -> tuple[str, str, str, str]:
    """Units of the joints and points, and how each is known beyond what was given.

    q: (m, n), y: (m, k, 3) as in the files; q_unit, y_unit: '' where unknown.  paths: the files of
    the joints and of the points.  Raises DataError naming the option to add.
    """
    turned = np.abs(q[:, ~sliding_joints]).max(initial=0.0)
    far = np.nanmax(np.abs(y), initial=0.0)
    if q_unit == "rad" and turned > MAX_RADIAN_JOINT_VALUE:
        raise DataError(
            f"{paths[0]}: a joint at {turned:g} cannot be in rad; add units='q=deg' if it is in "
            "degrees"
        )
    if y_unit == "m" and far > MAX_TRACKER_DISTANCE:
        raise DataError(
            f"{paths[1]}: a point {far:g} m away was not measured; add units='smr=mm' if it is "
            "in mm"
        )
    if q_unit and y_unit:
        return q_unit, y_unit, "", ""
    ways = max_target_spread(y)
    q_able = (
        [q_unit]
        if q_unit
        else [u for u in CANDIDATE_UNITS[0] if u == "deg" or turned <= MAX_RADIAN_JOINT_VALUE]
    )
    y_able = [y_unit] if y_unit else possible_length_units(ways, far)
    found = max_lever_ratio(q, y, sliding_joints)
    long = {
        (a, b): found * METRES_PER_LENGTH_UNIT[b] / RADIANS_PER_ANGLE_UNIT[a]
        for a, b in product(q_able, y_able)
    }
    # where nothing tells, a length is NaN, and may be
    plausible = [
        way for way in long if not (long[way] < MIN_ARM_LEVER or long[way] > MAX_ARM_LEVER)
    ]
    if len(plausible) != 1:
        raise DataError(
            describe_unit_question(paths, q_able, y_able or list(CANDIDATE_UNITS[1]), turned, far)
        )
    ((a, b),) = plausible
    arm = f"else the arm would not be {long[a, b]:.2g} m long"
    why_q = arm if len(q_able) > 1 else f"|q| up to {turned:.4g} is beyond 4 pi"
    why_y = arm if len(y_able) > 1 else f"points over {ways:.4g}, up to {far:.4g} away"
    return a, b, "" if q_unit else why_q, "" if y_unit else why_y


def possible_length_units(point_spread: float, max_distance: float) -> list[str]:
    """Units of length in which an arm can have moved a target so far.  point_spread: between the
    points.
    """
    able = []
    if not point_spread * METRES_PER_LENGTH_UNIT["mm"] < MIN_TARGET_MOTION:
        able.append("mm")
    if max_distance <= MAX_TRACKER_DISTANCE and not point_spread > 2.0 * MAX_ARM_LEVER:
        able.append("m")
    return able


def max_target_spread(points: Array) -> float:
    """Diagonal of the box around a target's points, the largest; NaN for a single pose."""
    if len(points) < 2:
        return float("nan")
    given = np.where(np.isnan(points), np.nanmean(points, axis=(0, 1)), points)
    return float(np.linalg.norm(np.ptp(given, axis=0), axis=-1).max())


def describe_unit_question(
    paths: tuple[Path, Path],
    angle_unit_choices: list[str],
    length_unit_choices: list[str],
    max_joint_value: float,
    max_distance: float,
) -> str:
    """What to ask, with the exact options."""
    joints = (
        f"{paths[0]}: joints (up to {max_joint_value:.4g}) "
        f"may be in {' or '.join(angle_unit_choices)}"
    )
    points = (
        f"{paths[1]}: points (up to {max_distance:.4g}) may "
        f"be in {' or '.join(length_unit_choices)}"
    )
    add_q = " or ".join(f"units='q={unit}'" for unit in angle_unit_choices)
    add_y = " or ".join(f"units='smr={unit}'" for unit in length_unit_choices)
    if len(length_unit_choices) == 1:
        return f"{joints}; add {add_q}"
    if len(angle_unit_choices) == 1:
        return f"{points}; add {add_y}"
    return f"{joints}, and {points}; add {add_q}, and {add_y}"


def max_lever_ratio(q: Array, y: Array, sliding_joints: Array) -> float:
    """Largest ratio of a target's way to the sum of the joints' ways; NaN if nothing tells."""
    if sliding_joints.any() or len(q) < 2:
        return float("nan")
    some = np.unique(np.linspace(0, len(q) - 1, MAX_COMPARED_POSES).astype(int))
    q, y = q[some], y[some]
    turn = np.abs(q[:, None] - q[None]).sum(axis=-1)
    way = np.linalg.norm(y[:, None] - y[None], axis=-1)  # (m, m, k)
    apart = turn > max(MIN_COMPARED_TURN_SHARE * turn.max(), 1e-12)
    ratio = way[apart] / turn[apart][:, None]
    ratio = ratio[np.isfinite(ratio)]
    return float(ratio.max()) if len(ratio) else float("nan")


class TimeColumn(NamedTuple):
    """Times (m,) [s], NaN where empty, and how they are known."""

    seconds: Array
    source: str


def parse_time_column(
    table: ImportedTable, column: ImportedColumn, unit_or_date_order: str
) -> TimeColumn:
    """(m,) seconds, NaN where empty, and how they are known; of stamps, since 1900.

    An empty array and a remark, where the column tells no time.  unit_or_date_order: a unit (s,
    ms), or the order of a date (dmy, mdy, ymd).  Raises DataError.
    """
    cells = [cell.strip().lstrip("'").replace(",", ".") for cell in column.cells]
    filled = [cell for cell in cells if cell]
    if len(set(filled)) < 2:
        return TimeColumn(np.empty(0), "the same in all rows")
    if (
        unit := unit_or_date_order
        if unit_or_date_order in COLUMN_SECONDS_PER_TIME_UNIT
        else column.unit
    ):
        if unit not in COLUMN_SECONDS_PER_TIME_UNIT:
            raise DataError(f"{table.sheet.path}: column {column.name}: {unit} is no unit of time")
        return TimeColumn(
            table.column_numbers(column) * COLUMN_SECONDS_PER_TIME_UNIT[unit],
            "given" if unit_or_date_order else column.known,
        )
    found: dict[tuple[float, ...], tuple[Array, str]] = {}
    for order, days in DATE_FORMATS_BY_ORDER.items():
        if unit_or_date_order and unit_or_date_order != order:
            continue
        for form in (
            *(day + clock for day in days for clock in CLOCK_FORMATS),
            COMPACT_STAMP_FORMAT,
        ):
            if (stamps := parse_time_stamps(cells, form)) is not None:
                since = np.nan_to_num(stamps - np.nanmin(stamps))
                found.setdefault(tuple(since), (stamps, form.strip()))
    if len(found) == 1:
        stamps, form = next(iter(found.values()))
        if np.nanmax(stamps) < SECONDS_PER_DAY:  # a clock without a date
            stamps = unwrap_clock_at_midnight(table, column, stamps)
        return TimeColumn(stamps, f"{TIME_STAMPS_TEXT} {form}")
    if found:
        raise DataError(
            f"{table.sheet.path}: column {column.name}: {filled[0]} may be day or month first; "
            "add units='time=dmy' or units='time=mdy'"
        )
    if unit_or_date_order:
        raise DataError(
            f"{table.sheet.path}: column {column.name}: {filled[0]!r}"
            f" is not a time as {unit_or_date_order}"
        )
    return TimeColumn(
        np.empty(0), "no time stamps that are understood; if seconds, add units='time=s'"
    )


def unwrap_clock_at_midnight(table: ImportedTable, column: ImportedColumn, clock: Array) -> Array:
    """Seconds of a clock without a date, on over midnight.  Raises DataError for half a clock.

    Rows may be in any order.  Where half a day holds no time, and rows fall across it, the early
    times are of the next day; else those after a single fall, if they end before the first began.
    """
    rows = np.flatnonzero(np.isfinite(clock))
    time = clock[rows]
    fall = 1 + np.flatnonzero(np.diff(time) < -0.5 * SECONDS_PER_DAY)
    halves = (time[:-1] // SECONDS_PER_HOUR == 12.0) & (time[1:] // SECONDS_PER_HOUR == 1.0)
    if (hour := time // SECONDS_PER_HOUR).min() >= 1.0 and hour.max() <= 12.0 and halves.any():
        at = 1 + int(np.argmax(halves))
        raise DataError(
            f"{table.sheet.path}:{table.line[rows[at]]}: column {column.name}: "
            f"{column.cells[rows[at]]} follows {column.cells[rows[at - 1]]}: a clock of twelve "
            "hours? write AM or PM, or the date"
        )
    if not len(fall):
        return clock
    steps = np.sort(time)
    widest = int(np.argmax(np.diff(steps)))
    if steps[widest + 1] - steps[widest] > 0.5 * SECONDS_PER_DAY:
        return np.where(clock <= steps[widest], clock + SECONDS_PER_DAY, clock)
    if len(fall) == 1 and time[fall[0] :].max() <= time[: fall[0]].min():
        out = clock.copy()
        out[rows[fall[0] :]] += SECONDS_PER_DAY
        return out
    return clock  # rows in another order than that of time: targets one after the other


def parse_time_stamps(cells: list[str], stamp_format: str) -> Array | None:
    """Seconds since 1900 of stamps in a form, or None."""
    out = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if not cell:
            continue
        try:
            stamp = datetime.strptime(cell, stamp_format)
        except ValueError:
            return None
        out[i] = (stamp - CLOCK_EPOCH).total_seconds()
    return out


class TemperatureColumn(NamedTuple):
    """Temperatures (m,) [degrees Celsius], the unit of the file, and how it is known."""

    celsius: Array
    unit: str
    source: str


def parse_temperature_column(
    table: ImportedTable, column: ImportedColumn, given_unit: str
) -> TemperatureColumn:
    """(m,) temperatures in degrees Celsius, the unit found, and how.  Raises DataError."""
    values = table.column_numbers(column)
    if not np.isfinite(values).any():
        return TemperatureColumn(np.empty(0), "", "empty")
    unit, known = given_unit or column.unit, "given" if given_unit else column.known
    if not unit:
        low, high = np.nanmin(values), np.nanmax(values)
        fit = [
            name
            for name, (least, most) in ROOM_TEMPERATURE_RANGES.items()
            if least <= low and high <= most
        ]
        if len(fit) != 1:
            raise DataError(
                f"{table.sheet.path}: column {column.name}: {low:g} to {high:g} may be in C, F "
                "or K; add units='temperature=C'"
            )
        unit, known = fit[0], "as rooms are"
    if unit not in CELSIUS_CONVERSIONS:
        raise DataError(
            f"{table.sheet.path}: column {column.name}: {unit} is no unit of temperature"
        )
    factor, shift = CELSIUS_CONVERSIONS[unit]
    return TemperatureColumn(values * factor + shift, unit, known)
