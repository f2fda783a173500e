"""Units of numbers: given, by the header, or proven by what an arm can be; times and temperatures.

The lever is the largest ratio of how far a target moved to how far the joints turned: no longer
than the arm with its tool, and not much shorter either.  Wrong units miss it by 57 or 1000 times.
"""

from __future__ import annotations

from datetime import datetime
from itertools import product
from pathlib import Path

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.tables import Column, Reading
from minimax_cal.reading.words import ANGLES, LENGTHS, TIMES

MOST_TURN = 4.0 * np.pi  # a joint that turned farther was not written in radians
FARTHEST_POINT = 200.0  # farther than any tracker measures [m]
SHORTEST, LONGEST = 0.02, 8.0  # lever of an arm [m]; real arms: 0.16 to 2.2
APART = 0.05  # share of the largest turn; closer pairs show only noise
LEAST_WAY = 0.05  # a target that moves less does not calibrate an arm [m]
COMPARED = 300  # poses whose pairs are looked at
BOTH = (("rad", "deg"), ("mm", "m"))
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


def decide(
    q: Array, y: Array, q_unit: str, y_unit: str, sliding: Array, where: tuple[Path, Path]
) -> tuple[str, str, str, str]:
    """Units of the joints and points, and how each is known beyond what was given.

    q: (m, n), y: (m, k, 3) as in the files; q_unit, y_unit: '' where unknown.  where: the files of
    the joints and of the points.  Raises DataError naming the option to add.
    """
    turned = np.abs(q[:, ~sliding]).max(initial=0.0)
    far = np.nanmax(np.abs(y), initial=0.0)
    if q_unit == "rad" and turned > MOST_TURN:
        raise DataError(
            f"{where[0]}: a joint at {turned:g} cannot be in rad; add units='q=deg' if it is in "
            "degrees"
        )
    if y_unit == "m" and far > FARTHEST_POINT:
        raise DataError(
            f"{where[1]}: a point {far:g} m away was not measured; add units='smr=mm' if it is "
            "in mm"
        )
    if q_unit and y_unit:
        return q_unit, y_unit, "", ""
    ways = spread(y)
    q_able = [q_unit] if q_unit else [u for u in BOTH[0] if u == "deg" or turned <= MOST_TURN]
    y_able = [y_unit] if y_unit else lengths(ways, far)
    found = lever(q, y, sliding)
    long = {(a, b): found * LENGTHS[b] / ANGLES[a] for a, b in product(q_able, y_able)}
    # where nothing tells, a length is NaN, and may be
    plausible = [way for way in long if not (long[way] < SHORTEST or long[way] > LONGEST)]
    if len(plausible) != 1:
        raise DataError(question(where, q_able, y_able or list(BOTH[1]), turned, far))
    ((a, b),) = plausible
    arm = f"else the arm would not be {long[a, b]:.2g} m long"
    why_q = arm if len(q_able) > 1 else f"|q| up to {turned:.4g} is beyond 4 pi"
    why_y = arm if len(y_able) > 1 else f"points over {ways:.4g}, up to {far:.4g} away"
    return a, b, "" if q_unit else why_q, "" if y_unit else why_y


def lengths(ways: float, far: float) -> list[str]:
    """Units of length in which an arm can have moved a target so far.  ways: between the points."""
    able = []
    if not ways * LENGTHS["mm"] < LEAST_WAY:
        able.append("mm")
    if far <= FARTHEST_POINT and not ways > 2.0 * LONGEST:
        able.append("m")
    return able


def spread(y: Array) -> float:
    """Diagonal of the box around a target's points, the largest; NaN for a single pose."""
    if len(y) < 2:
        return float("nan")
    given = np.where(np.isnan(y), np.nanmean(y, axis=(0, 1)), y)
    return float(np.linalg.norm(np.ptp(given, axis=0), axis=-1).max())


def question(
    where: tuple[Path, Path], q_able: list[str], y_able: list[str], turned: float, far: float
) -> str:
    """What to ask, with the exact options."""
    joints = f"{where[0]}: joints (up to {turned:.4g}) may be in {' or '.join(q_able)}"
    points = f"{where[1]}: points (up to {far:.4g}) may be in {' or '.join(y_able)}"
    add_q = " or ".join(f"units='q={unit}'" for unit in q_able)
    add_y = " or ".join(f"units='smr={unit}'" for unit in y_able)
    if len(y_able) == 1:
        return f"{joints}; add {add_q}"
    if len(q_able) == 1:
        return f"{points}; add {add_y}"
    return f"{joints}, and {points}; add {add_q}, and {add_y}"


def lever(q: Array, y: Array, sliding: Array) -> float:
    """Largest ratio of a target's way to the sum of the joints' ways; NaN if nothing tells."""
    if sliding.any() or len(q) < 2:
        return float("nan")
    some = np.unique(np.linspace(0, len(q) - 1, COMPARED).astype(int))
    q, y = q[some], y[some]
    turn = np.abs(q[:, None] - q[None]).sum(axis=-1)
    way = np.linalg.norm(y[:, None] - y[None], axis=-1)  # (m, m, k)
    apart = turn > max(APART * turn.max(), 1e-12)
    ratio = way[apart] / turn[apart][:, None]
    ratio = ratio[np.isfinite(ratio)]
    return float(ratio.max()) if len(ratio) else float("nan")


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
