"""Columns by position or name, as the user maps them: `smr1_mm,smr2_mm,q_deg`, `1-3=smr1,4-9=q`."""

from __future__ import annotations

import re

from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.importers.reading import Column, Given, Reading, checked
from minimax_cal.reading.sheet import Sheet
from minimax_cal.reading.words import kind_of, plain, split_unit

TITLE = "columns as mapped"
SKIP = re.compile(r"(?:-|skip)(?:\*(\d+))?")
SPAN = re.compile(r"(\d+)(?:-(\d+))?")
SMR = re.compile(r"smr(\d+)")


def read(sheet: Sheet, given: Given, joints: bool) -> Reading:
    """The file under the mapping.  Raises OptionError."""
    tokens = [token.strip() for token in given.columns.split(",") if token.strip()]
    placed = any("=" in token for token in tokens)
    found = by_place(sheet, tokens) if placed else in_order(sheet, tokens)
    columns = []
    for i in range(sheet.width):
        name = sheet.header[i] if sheet.header else f"column {i + 1}"
        what, unit = found.get(i, ("", ""))
        known = "given" if unit else ""
        if what and not unit and sheet.header and (unit := split_unit(name)[1]):
            known = "header"
        columns.append(Column(name, what, unit, tuple(row[i] for row in sheet.cells), known))
    return checked(Reading(TITLE, sheet, tuple(columns), sheet.line))


def expand(token: str, room: int) -> list[tuple[str, str]]:
    """Meanings and unit of the columns a token stands for.  room: how many `q` may take."""
    stem, unit = split_unit(token)
    if skip := SKIP.fullmatch(token):
        return [("", "")] * int(skip[1] or 1)
    if stem == "q":
        return [(f"q{i + 1}", unit) for i in range(room)]
    if SMR.fullmatch(stem):
        return [(f"{stem}_{axis}", unit) for axis in "xyz"]
    if what := stem if kind_of(stem) else plain(stem):
        return [(what, unit)]
    raise OptionError(
        f"columns=: {token!r} is not known; write smr1, smr1_mm, q_deg, q1_deg, u95_mm, "
        "temperature_C, time_s, pose, target, order or skip*3"
    )


def in_order(sheet: Sheet, tokens: list[str]) -> dict[int, tuple[str, str]]:
    """Tokens that follow each other; `q` takes what the others leave."""
    if sum(split_unit(token)[0] == "q" for token in tokens) > 1:
        raise OptionError("columns=: q stands twice; write q1_deg, q2_deg, ... for single joints")
    fixed = sum(len(expand(token, 0)) for token in tokens)
    room = sheet.width - fixed
    whole = [pair for token in tokens for pair in expand(token, max(room, 0))]
    if len(whole) != sheet.width:
        raise OptionError(
            f"columns=: means {len(whole)} columns, but {sheet.path} has {sheet.width}; "
            "use skip (or skip*3) for columns to leave out"
        )
    return dict(enumerate(whole))


def by_place(sheet: Sheet, tokens: list[str]) -> dict[int, tuple[str, str]]:
    """Tokens with a place: `1-3=smr1_mm` or a header's name: `X=smr1_x_mm`."""
    found: dict[int, tuple[str, str]] = {}
    for token in tokens:
        place, equals, what = (part.strip() for part in token.partition("="))
        if not equals:
            raise OptionError(f"columns=: {token!r} has no place; write 1-3={token}")
        if place in sheet.header:
            first = last = sheet.header.index(place)
        elif span := SPAN.fullmatch(place):
            first, last = int(span[1]) - 1, int(span[2] or span[1]) - 1
        else:
            raise OptionError(f"columns=: {sheet.path} has no column {place!r}")
        if not 0 <= first <= last < sheet.width:
            raise OptionError(
                f"columns=: {place}: {sheet.path} has columns 1 to {sheet.width} only"
            )
        whole = expand(what, last - first + 1)
        if len(whole) != last - first + 1:
            raise OptionError(
                f"columns=: {token}: {what} takes {len(whole)} columns, {place} are "
                f"{last - first + 1}"
            )
        if twice := found.keys() & set(range(first, last + 1)):
            raise OptionError(f"columns=: {token}: column {min(twice) + 1} is placed twice")
        found |= dict(zip(range(first, last + 1), whole, strict=True))
    return found
