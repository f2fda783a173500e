"""Points that were measured and take no part: who set them aside, and why.

A file of measurements holds them as all others, with the reason in a column `set_points_aside`; the
reader keeps them beside the points that count (`Measurements.aside`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import clean_and_shorten_to_one_line, format_first_names
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.measuring.measurements import (
    SET_ASIDE_BY_FILE,
    SET_ASIDE_BY_TOOL,
    SET_ASIDE_BY_USER,
    Measurements,
    SetAsidePoint,
    check_every_target_measured,
)

SET_ASIDE_COLUMN = "set_aside"
TARGET_NAME_REGEX = r"smr\d+(?:@[\w.-]+)?"  # smr1, or smr1@gripper where there are several tools
SET_ASIDE_POINT_PATTERN = re.compile(rf"(\d+)(?::({TARGET_NAME_REGEX}))?")
# a cell holds one of these for each target, or one for the whole pose
SET_ASIDE_ENTRY_PATTERN = re.compile(
    rf"(?:({TARGET_NAME_REGEX})\s*:)?\s*(.*?)\s*(?:\[({SET_ASIDE_BY_USER}|{SET_ASIDE_BY_FILE}|{SET_ASIDE_BY_TOOL})\])?"
)
WHO_SET_ASIDE_WORDS = {
    SET_ASIDE_BY_USER: "the user",
    SET_ASIDE_BY_FILE: "the measurement file",
    SET_ASIDE_BY_TOOL: "the program",
}  # in sentences
NO_REASON = "no reason was given"
MAX_REASON_LETTERS = 200  # of a reason
MAX_NAMED_POINTS = 5  # points that a notice names


def set_points_aside(
    data: Measurements, point_mask: Array, reason: str, set_by: str
) -> Measurements:
    """The measurements with some points beside those that count.

    point_mask: (m, k) True for those.  reason: the reason.  set_by: USER, FILE or TOOL.
    """
    point_mask = point_mask & data.seen
    if not point_mask.any():
        return data
    every = np.union1d(data.line, data.aside.line if data.aside else data.line)
    place = np.searchsorted(every, data.line) + 1
    new = tuple(
        SetAsidePoint(
            int(data.line[row]), int(place[row]), data.target_names[target], reason, set_by
        )
        for row, target in np.argwhere(point_mask)
    )
    shown = np.where(point_mask[..., None], data.y, np.nan)
    aside = replace(data, y=shown, aside=None, set_aside=(), notices=())
    aside = aside.take(np.asarray(point_mask.any(axis=1)))
    rest = data.with_y(np.where(point_mask[..., None], np.nan, data.y))
    rest = rest.take(np.asarray(rest.seen.any(axis=1)))
    aside = merge_rows_by_line(data.aside, aside) if data.aside else aside
    return replace(rest, aside=aside, set_aside=(*data.set_aside, *new))


def merge_rows_by_line(first: Measurements, second: Measurements) -> Measurements:
    """The points of two parts of one file, by line; rows that both have come once."""
    both = np.isin(second.line, first.line)
    y = first.y.copy()
    at = np.searchsorted(first.line, second.line[both], sorter=np.argsort(first.line))
    rows = np.argsort(first.line)[at]
    y[rows] = np.where(np.isfinite(y[rows]), y[rows], second.y[both])
    whole = first.with_y(y).append_measurements(second.take(~both))
    return whole.take(np.argsort(whole.line, kind="stable"))


def merge_set_aside_points_with_reasons(data: Measurements) -> Measurements:
    """All points, those set aside too, with the reasons in the column `set_points_aside`."""
    if data.aside is None:
        return data
    every = merge_rows_by_line(replace(data, aside=None, set_aside=()), data.aside)
    cells = {int(line): "" for line in every.line}
    for point in data.set_aside:
        if point.row in cells:
            who = "" if point.by == SET_ASIDE_BY_USER else f" [{point.by}]"
            entry = f"{point.target}: {point.why}{who}"
            cells[point.row] += f"; {entry}" if cells[point.row] else entry
    return replace(
        every, columns={**every.columns, SET_ASIDE_COLUMN: np.array(list(cells.values()))}
    )


def set_aside_points_named_in_column(data: Measurements) -> Measurements:
    """The measurements without the points that their column `set_points_aside` names.  Raises
    DataError.

    A cell holds the reason, for the whole pose or after a target's name, as ``smr2: nest knocked``;
    several with semicolons.  ``[file]`` at its end says that the tracker's file marks the point.
    """
    cells = data.columns.get(SET_ASIDE_COLUMN)
    if cells is None:
        return data
    data = replace(data, columns={k: v for k, v in data.columns.items() if k != SET_ASIDE_COLUMN})
    groups: dict[tuple[str, str], Array] = {}
    for row, cell in enumerate(cells):
        for target, why, by in parse_set_aside_cell(str(cell)):
            if not any(is_target_meant(target, name) for name in data.target_names):
                raise DataError(
                    f"{data.source}:{data.line[row]}: column "
                    f"{SET_ASIDE_COLUMN}: no target {target}; there "
                    f"are {', '.join(data.target_names)}"
                )
            points = groups.setdefault((why, by), np.zeros(data.seen.shape, dtype=bool))
            points[row] |= [is_target_meant(target, name) for name in data.target_names]
    lines = data.line
    for (why, by), points in groups.items():
        kept = np.isin(lines, data.line)  # rows of which nothing was left are gone
        data = set_points_aside(data, points[kept], why, by)
    return check_each_target_counts(data)


def is_target_meant(target_text: str, target: str) -> bool:
    """Whether a target is meant: by its name, by smr1 for smr1@gripper, or as one of all."""
    return target_text in ("", target, target.partition("@")[0])


def parse_set_aside_cell(cell: str) -> list[tuple[str, str, str]]:
    """Target ('' for the whole pose), reason and who, of each entry of a cell."""
    out = []
    for part in filter(None, map(str.strip, cell.split(";"))):
        found = SET_ASIDE_ENTRY_PATTERN.fullmatch(part)
        target, why, by = found.groups() if found else (None, part, None)
        out.append((target or "", why or NO_REASON, by or SET_ASIDE_BY_USER))
    return out


def check_each_target_counts(data: Measurements) -> Measurements:
    """The data, if a point of each target counts.  Raises DataError."""
    but = ", but for points that are set aside"
    return check_every_target_measured(data, "every measured point is set aside", but)


def set_aside_points_named_by_user(data: Measurements, point_texts: Iterable[str]) -> Measurements:
    """The measurements with points set aside by the user.

    point_texts: each as 12:smr2 (of the pose in line 12 of the file), or 12 for all of that pose;
    several with commas; with the reason after an equals sign, as ``12:smr2,40=nest knocked``.
    Raises OptionError.
    """
    groups: dict[str, Array] = {}
    lines = data.line
    for text in point_texts:
        named, _, why = text.partition("=")
        why = clean_reason_text(why)
        for name in filter(None, map(str.strip, named.split(","))):
            chosen = groups.setdefault(why, np.zeros(data.seen.shape, dtype=bool))
            chosen |= point_mask_from_text(data, name)
    count = len(data.set_aside)
    for why, chosen in groups.items():
        data = set_points_aside(data, chosen[np.isin(lines, data.line)], why, SET_ASIDE_BY_USER)
    new = data.set_aside[count:]
    if not new:
        return data
    named = format_first_names(
        [f"{point.row}:{point.target}" for point in new], MAX_NAMED_POINTS, " "
    )
    said = f"{len(new)} points set aside: {named}"
    return check_each_target_counts(replace(data, notices=(*data.notices, said)))


def clean_reason_text(text: str) -> str:
    """A reason as a file can hold it."""
    return (
        clean_and_shorten_to_one_line(text).replace(";", ",").strip()[:MAX_REASON_LETTERS]
        or NO_REASON
    )


def point_mask_from_text(data: Measurements, point_text: str) -> Array:
    """(m, k) True for the points of a name, as 12:smr2 or 12.  Raises OptionError."""
    found = SET_ASIDE_POINT_PATTERN.fullmatch(point_text)
    if not found:
        raise OptionError(f"leave out {point_text!r}: write LINE:TARGET, as 12:smr2, or LINE")
    rows = data.line == int(found[1])
    if not rows.any():
        lines = f"{data.line.min()} to {data.line.max()}" if data.poses else "none"
        raise OptionError(
            f"leave out {point_text}: no pose stands in line {found[1]} (but {lines})"
        )
    if not any(is_target_meant(found[2] or "", name) for name in data.target_names):
        known = ", ".join(data.target_names)
        raise OptionError(f"leave out {point_text}: no such target; there are {known}")
    targets = np.array([is_target_meant(found[2] or "", target) for target in data.target_names])
    return np.asarray(rows[:, None] & targets)


def format_set_aside_count(points: Sequence[SetAsidePoint]) -> str:
    """How many points, and by whom they were set aside, as 8 points set aside by the user."""
    count = Counter(point.by for point in points)
    several = len(count) > 1
    named = ", ".join(
        f"{count[by]} by {who}" if several else f"by {who}"
        for by, who in WHO_SET_ASIDE_WORDS.items()
        if count[by]
    )
    total = f"{len(points)} point{'s' * (len(points) != 1)} set aside"
    return f"{total} ({named})" if several else f"{total} {named}"
