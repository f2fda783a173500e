"""Time stamps and temperatures as trackers write them, in seconds and degrees Celsius."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.reading import Column, Reading
from minimax_cal.reading.words import TIMES

STAMPED = "time stamps"
CLOCKS = ("%H:%M:%S.%f", "%H:%M:%S", "%H:%M", "%I:%M:%S.%f %p", "%I:%M:%S %p", "%I:%M %p")
DAYS = {
    "dmy": ("%d.%m.%Y ", "%d/%m/%Y ", "%d-%m-%Y "),
    "mdy": ("%m/%d/%Y ", "%m-%d-%Y "),
    "ymd": ("%Y-%m-%d ", "%Y-%m-%dT", "%Y/%m/%d ", "%Y.%m.%d "),
    "": ("",),
}
DAY, HOUR = 86400.0, 3600.0
START = datetime(1900, 1, 1)  # where a clock without a date starts
COMPACT = "%Y%m%d%H%M%S"
CELSIUS = {"C": (1.0, 0.0), "K": (1.0, -273.15), "F": (5.0 / 9.0, -160.0 / 9.0)}
ROOM = {"C": (5.0, 45.0), "F": (50.0, 113.0), "K": (278.0, 318.0)}  # where people measure


def seconds(reading: Reading, column: Column, given: str) -> tuple[Array, str]:
    """(m,) seconds, NaN where empty, and how they are known; of stamps, since 1900.

    An empty array and a remark, where the column tells no time.  given: a unit (s, ms), or the
    order of a date (dmy, mdy, ymd).  Raises DataError.
    """
    cells = [cell.strip().lstrip("'").replace(",", ".") for cell in column.cells]
    filled = [cell for cell in cells if cell]
    if len(set(filled)) < 2:
        return np.empty(0), "the same in all rows"
    if unit := given if given in TIMES else column.unit:
        if unit not in TIMES:
            raise DataError(
                f"{reading.sheet.path}: column {column.name}: {unit} is no unit of time"
            )
        return reading.numbers(column) * TIMES[unit], "given" if given else column.known
    found: dict[tuple[float, ...], tuple[Array, str]] = {}
    for order, days in DAYS.items():
        if given and given != order:
            continue
        for form in (*(day + clock for day in days for clock in CLOCKS), COMPACT):
            if (stamps := parsed(cells, form)) is not None:
                since = np.nan_to_num(stamps - np.nanmin(stamps))
                found.setdefault(tuple(since), (stamps, form.strip()))
    if len(found) == 1:
        stamps, form = next(iter(found.values()))
        if np.nanmax(stamps) < DAY:  # a clock without a date
            stamps = over_midnight(reading, column, stamps)
        return stamps, f"{STAMPED} {form}"
    if found:
        raise DataError(
            f"{reading.sheet.path}: column {column.name}: {filled[0]} may be day or month first; "
            "add units='time=dmy' or units='time=mdy'"
        )
    if given:
        raise DataError(
            f"{reading.sheet.path}: column {column.name}: {filled[0]!r} is not a time as {given}"
        )
    return np.empty(0), "no time stamps that are understood; if seconds, add units='time=s'"


def over_midnight(reading: Reading, column: Column, clock: Array) -> Array:
    """Seconds of a clock without a date, on over midnight.  Raises DataError for half a clock.

    Rows may be in any order.  Where half a day holds no time, and rows fall across it, the early
    times are of the next day; else those after a single fall, if they end before the first began.
    """
    rows = np.flatnonzero(np.isfinite(clock))
    time = clock[rows]
    fall = 1 + np.flatnonzero(np.diff(time) < -0.5 * DAY)
    halves = (time[:-1] // HOUR == 12.0) & (time[1:] // HOUR == 1.0)
    if (hour := time // HOUR).min() >= 1.0 and hour.max() <= 12.0 and halves.any():
        at = 1 + int(np.argmax(halves))
        raise DataError(
            f"{reading.sheet.path}:{reading.line[rows[at]]}: column {column.name}: "
            f"{column.cells[rows[at]]} follows {column.cells[rows[at - 1]]}: a clock of twelve "
            "hours? write AM or PM, or the date"
        )
    if not len(fall):
        return clock
    steps = np.sort(time)
    widest = int(np.argmax(np.diff(steps)))
    if steps[widest + 1] - steps[widest] > 0.5 * DAY:
        return np.where(clock <= steps[widest], clock + DAY, clock)
    if len(fall) == 1 and time[fall[0] :].max() <= time[: fall[0]].min():
        out = clock.copy()
        out[rows[fall[0] :]] += DAY
        return out
    return clock  # rows in another order than that of time: targets one after the other


def parsed(cells: list[str], form: str) -> Array | None:
    """Seconds since 1900 of stamps in a form, or None."""
    out = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if not cell:
            continue
        try:
            stamp = datetime.strptime(cell, form)
        except ValueError:
            return None
        out[i] = (stamp - START).total_seconds()
    return out


def celsius(reading: Reading, column: Column, given: str) -> tuple[Array, str, str]:
    """(m,) temperatures in degrees Celsius, the unit found, and how.  Raises DataError."""
    values = reading.numbers(column)
    if not np.isfinite(values).any():
        return np.empty(0), "", "empty"
    unit, known = given or column.unit, "given" if given else column.known
    if not unit:
        low, high = np.nanmin(values), np.nanmax(values)
        fit = [name for name, (least, most) in ROOM.items() if least <= low and high <= most]
        if len(fit) != 1:
            raise DataError(
                f"{reading.sheet.path}: column {column.name}: {low:g} to {high:g} may be in C, F "
                "or K; add units='temperature=C'"
            )
        unit, known = fit[0], "as rooms are"
    if unit not in CELSIUS:
        raise DataError(
            f"{reading.sheet.path}: column {column.name}: {unit} is no unit of temperature"
        )
    factor, shift = CELSIUS[unit]
    return values * factor + shift, unit, known
