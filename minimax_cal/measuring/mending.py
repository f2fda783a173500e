"""Mends of whole files that the user asks for, as the messages on slips name them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.slips import (
    with_joints_ordered,
    with_points_moved,
    with_points_reversed,
)

SPAN = re.compile(r"(-?\d+)(?:@(\d*)\.\.(\d*))?")
WAYS = "shift=1, shift=-1@40.. (from line 40 on), reverse, joints=1:3:2, scale=0.999"
MOST_SCALE = 1e3


def mended(data: Measurements, how: Iterable[str]) -> Measurements:
    """The data with mends made, one after the other.

    how: shift=N (each row takes the points of the row N further on; @A..B in lines A to B alone),
    reverse (points in the opposite order), joints=1:3:2 (which column each joint's values stand
    in), scale=S (of the points).  Raises OptionError.
    """
    for text in how:
        name, _, value = text.strip().partition("=")
        if name not in MENDS:
            raise OptionError(f"mend={text!r}: write {WAYS}")
        if data.aside is not None:
            raise OptionError(f"mend={text!r}: mend the file before points are set aside in it")
        data = MENDS[name](data, value)
    return data


def shifted(data: Measurements, value: str) -> Measurements:
    """Points moved by rows, in some lines or in all."""
    found = SPAN.fullmatch(value)
    if not found or not 0 < abs(int(found[1])) < data.poses:
        raise OptionError(f"mend='shift={value}': write shift=1, shift=-2 or shift=1@40..")
    first, last = int(found[2] or 0), int(found[3] or data.line.max())
    inside = (data.line >= first) & (data.line <= last)
    if not inside.any():
        raise OptionError(
            f"mend='shift={value}': no row stands there; lines are {data.line.min()} to "
            f"{data.line.max()}"
        )
    moved = with_points_moved(data.take(inside), int(found[1]))
    return data.take(data.line < first).followed_by(moved, data.take(data.line > last))


def reversed_points(data: Measurements, value: str) -> Measurements:
    """Points in the opposite order."""
    return with_points_reversed(data)


def ordered(data: Measurements, value: str) -> Measurements:
    """Joint columns in another order."""
    n = data.q.shape[1]
    order = [int(part) - 1 for part in value.split(":") if part.isdigit()]
    if sorted(order) != list(range(n)):
        raise OptionError(
            f"mend='joints={value}': name each of the {n} columns once, as "
            f"joints={':'.join(str(i + 1) for i in range(n))}"
        )
    return with_joints_ordered(data, order)


def scaled(data: Measurements, value: str) -> Measurements:
    """Points times a factor."""
    try:
        factor = float(value)
    except ValueError:
        factor = 0.0
    if not 1.0 / MOST_SCALE < factor < MOST_SCALE:
        raise OptionError(f"mend='scale={value}': write a factor, as scale=0.999")
    return data.with_y(factor * data.y)


MENDS: dict[str, Callable[[Measurements, str], Measurements]] = {
    "shift": shifted,
    "reverse": reversed_points,
    "joints": ordered,
    "scale": scaled,
}
