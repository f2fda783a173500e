"""Points that were measured and take no part: who set them aside, and why.

A file of measurements holds them as all others, with the reason in a column `set_aside`; the reader
keeps them beside the points that count (`Measurements.aside`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.words import name_first, one_line
from minimax_cal.measuring.measurements import FILE, TOOL, USER, Measurements, SetAside, check_seen

COLUMN = "set_aside"
TARGET = r"smr\d+(?:@[\w.-]+)?"  # smr1, or smr1@gripper where there are several tools
POINT = re.compile(rf"(\d+)(?::({TARGET}))?")
# a cell holds one of these for each target, or one for the whole pose
ENTRY = re.compile(rf"(?:({TARGET})\s*:)?\s*(.*?)\s*(?:\[({USER}|{FILE}|{TOOL})\])?")
WHO = {USER: "the user", FILE: "the measurement file", TOOL: "the program"}  # in sentences
NO_REASON = "no reason was given"
MOST_LETTERS = 200  # of a reason
NAMED = 5  # points that a notice names


def set_aside(data: Measurements, points: Array, why: str, by: str) -> Measurements:
    """The measurements with some points beside those that count.

    points: (m, k) True for those.  why: the reason.  by: USER, FILE or TOOL.
    """
    points = points & data.seen
    if not points.any():
        return data
    every = np.union1d(data.line, data.aside.line if data.aside else data.line)
    place = np.searchsorted(every, data.line) + 1
    new = tuple(SetAside(int(data.line[row]), int(place[row]), data.target_names[target], why, by)
                for row, target in np.argwhere(points))  # fmt: skip
    shown = np.where(points[..., None], data.y, np.nan)
    aside = replace(data, y=shown, aside=None, set_aside=(), notices=())
    aside = aside.take(np.asarray(points.any(axis=1)))
    rest = data.with_y(np.where(points[..., None], np.nan, data.y))
    rest = rest.take(np.asarray(rest.seen.any(axis=1)))
    aside = merged(data.aside, aside) if data.aside else aside
    return replace(rest, aside=aside, set_aside=(*data.set_aside, *new))


def merged(one: Measurements, other: Measurements) -> Measurements:
    """The points of two parts of one file, by line; rows that both have come once."""
    both = np.isin(other.line, one.line)
    y = one.y.copy()
    at = np.searchsorted(one.line, other.line[both], sorter=np.argsort(one.line))
    rows = np.argsort(one.line)[at]
    y[rows] = np.where(np.isfinite(y[rows]), y[rows], other.y[both])
    whole = one.with_y(y).followed_by(other.take(~both))
    return whole.take(np.argsort(whole.line, kind="stable"))


def whole(data: Measurements) -> Measurements:
    """All points, those set aside too, with the reasons in the column `set_aside`."""
    if data.aside is None:
        return data
    every = merged(replace(data, aside=None, set_aside=()), data.aside)
    cells = {int(line): "" for line in every.line}
    for point in data.set_aside:
        if point.row in cells:
            who = "" if point.by == USER else f" [{point.by}]"
            entry = f"{point.target}: {point.why}{who}"
            cells[point.row] += f"; {entry}" if cells[point.row] else entry
    return replace(every, columns={**every.columns, COLUMN: np.array(list(cells.values()))})


def from_column(data: Measurements) -> Measurements:
    """The measurements without the points that their column `set_aside` names.  Raises DataError.

    A cell holds the reason, for the whole pose or after a target's name, as ``smr2: nest knocked``;
    several with semicolons.  ``[file]`` at its end says that the tracker's file marks the point.
    """
    cells = data.columns.get(COLUMN)
    if cells is None:
        return data
    data = replace(data, columns={k: v for k, v in data.columns.items() if k != COLUMN})
    groups: dict[tuple[str, str], Array] = {}
    for row, cell in enumerate(cells):
        for target, why, by in entries(str(cell)):
            if not any(is_meant(target, name) for name in data.target_names):
                raise DataError(
                    f"{data.source}:{data.line[row]}: column {COLUMN}: no target {target}; there "
                    f"are {', '.join(data.target_names)}"
                )
            points = groups.setdefault((why, by), np.zeros(data.seen.shape, dtype=bool))
            points[row] |= [is_meant(target, name) for name in data.target_names]
    lines = data.line
    for (why, by), points in groups.items():
        kept = np.isin(lines, data.line)  # rows of which nothing was left are gone
        data = set_aside(data, points[kept], why, by)
    return sound(data)


def is_meant(said: str, target: str) -> bool:
    """Whether a target is meant: by its name, by smr1 for smr1@gripper, or as one of all."""
    return said in ("", target, target.partition("@")[0])


def entries(cell: str) -> list[tuple[str, str, str]]:
    """Target ('' for the whole pose), reason and who, of each entry of a cell."""
    out = []
    for part in filter(None, map(str.strip, cell.split(";"))):
        found = ENTRY.fullmatch(part)
        target, why, by = found.groups() if found else (None, part, None)
        out.append((target or "", why or NO_REASON, by or USER))
    return out


def sound(data: Measurements) -> Measurements:
    """The data, if a point of each target counts.  Raises DataError."""
    but = ", but for points that are set aside"
    return check_seen(data, "every measured point is set aside", but)


def left_out(data: Measurements, points: Iterable[str]) -> Measurements:
    """The measurements with points set aside by the user.

    points: each as 12:smr2 (of the pose in line 12 of the file), or 12 for all of that pose;
    several with commas; with the reason after an equals sign, as ``12:smr2,40=nest knocked``.
    Raises OptionError.
    """
    groups: dict[str, Array] = {}
    lines = data.line
    for text in points:
        named, _, why = text.partition("=")
        why = reason(why)
        for name in filter(None, map(str.strip, named.split(","))):
            chosen = groups.setdefault(why, np.zeros(data.seen.shape, dtype=bool))
            chosen |= of_name(data, name)
    count = len(data.set_aside)
    for why, chosen in groups.items():
        data = set_aside(data, chosen[np.isin(lines, data.line)], why, USER)
    new = data.set_aside[count:]
    if not new:
        return data
    named = name_first([f"{point.row}:{point.target}" for point in new], NAMED, " ")
    said = f"{len(new)} points set aside: {named}"
    return sound(replace(data, notices=(*data.notices, said)))


def reason(text: str) -> str:
    """A reason as a file can hold it."""
    return one_line(text).replace(";", ",").strip()[:MOST_LETTERS] or NO_REASON


def of_name(data: Measurements, name: str) -> Array:
    """(m, k) True for the points of a name, as 12:smr2 or 12.  Raises OptionError."""
    found = POINT.fullmatch(name)
    if not found:
        raise OptionError(f"leave out {name!r}: write LINE:TARGET, as 12:smr2, or LINE")
    rows = data.line == int(found[1])
    if not rows.any():
        lines = f"{data.line.min()} to {data.line.max()}" if data.poses else "none"
        raise OptionError(f"leave out {name}: no pose stands in line {found[1]} (but {lines})")
    if not any(is_meant(found[2] or "", name) for name in data.target_names):
        known = ", ".join(data.target_names)
        raise OptionError(f"leave out {name}: no such target; there are {known}")
    targets = np.array([is_meant(found[2] or "", target) for target in data.target_names])
    return np.asarray(rows[:, None] & targets)


def counted(points: Sequence[SetAside]) -> str:
    """How many points, and by whom they were set aside, as 8 points set aside by the user."""
    count = Counter(point.by for point in points)
    several = len(count) > 1
    named = ", ".join(
        f"{count[by]} by {who}" if several else f"by {who}" for by, who in WHO.items() if count[by]
    )
    total = f"{len(points)} point{'s' * (len(points) != 1)} set aside"
    return f"{total} ({named})" if several else f"{total} {named}"
