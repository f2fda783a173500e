"""Joint targets in the text of controllers' programs: KRL, RAPID, URScript, FANUC's LS."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import blanked, name_first
from minimax_cal.measuring.importers.tables import Column, Given, Reading
from minimax_cal.reading.sheet import POINT, Sheet

RAPID_ASIDE = re.compile(r'"[^"\r\n]*"|![^\r\n]*')  # strings and comments
KRL_ASIDE = re.compile(r'"[^"\r\n]*"|;[^\r\n]*')
UNUSED = {0.0, 9e9}  # of an axis that is not there; RAPID writes 9E9
ROBOT_AXES = 6


@dataclass(frozen=True)
class Target:
    """name: '' where it has none.  at: place in the text.  axes: its values by axis."""

    name: str
    at: int
    axes: Mapping[str, str]


def by_axis(pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Values by axis; of an axis that is there twice both, which is no number."""
    out: dict[str, str] = {}
    for axis, value in pairs:
        name = axis.upper()
        out[name] = f"{out[name]} and {value}" if name in out else value
    return out


# ---- KUKA --------------------------------------------------------------------------------------

KRL_TARGET = re.compile(
    r"(?:\b(\w++)\s*+=\s*+)?\{\s*+(?:(?:E6AXIS|AXIS)\s*+:)?\s*+(A1\s[^{}]*+)\}", re.IGNORECASE
)
KRL_AXIS = re.compile(r"\b([AE]\d)\s+([^\s,{}]+)", re.IGNORECASE)
OF_EDITOR = re.compile(r"[Xx]([A-Za-z_]\w*)")  # the editor calls the values of P1 XP1


def krl_targets(text: str) -> Iterator[Target]:
    """`{A1 ..., A2 ...}`, declared or in a motion."""
    for found in KRL_TARGET.finditer(text):
        axes = by_axis(KRL_AXIS.findall(found[2]))
        own = OF_EDITOR.fullmatch(found[1] or "")
        yield Target(own[1] if own else found[1] or "", found.start(2), axes)


# ---- ABB ---------------------------------------------------------------------------------------

RAPID_TARGET = re.compile(r"\bjointtarget\s+(\w+)", re.IGNORECASE)
RAPID_VALUES = re.compile(r"[\[{]\s*+([^\[\]{}]++)[\]}]")


def rapid_targets(text: str) -> Iterator[Target]:
    """`jointtarget j1:=[[...],[...]]`, or `j:{...}`."""
    found = list(RAPID_TARGET.finditer(text))
    ends = [*(one.start() for one in found), len(text)][1:]
    for here, end in zip(found, ends, strict=False):
        body = text[here.end() : end]
        values = RAPID_VALUES.search(body.split(";")[0])
        cells = [c.strip() for c in values[1].strip().strip(" ,").split(",")] if values else []
        yield Target(here[1], here.start(), {f"axis {i + 1}": c for i, c in enumerate(cells)})


# ---- Universal Robots --------------------------------------------------------------------------

UR_LIST = re.compile(
    r"(?:\b(?:global\s+)?(\w++)\s*+=\s*+|\bmovej\s*\(\s*"
    r"|^[ \t]*+(?:(\w++)(?=[ \t:,;])[ \t]*+[:,;]?[ \t]*+)?)"
    rf"\[\s*({POINT.pattern}(?:\s*,\s*{POINT.pattern})+)\s*\]",
    re.MULTILINE,
)


def ur_targets(text: str) -> Iterator[Target]:
    """`movej([...])`, `name = [...]`, or a list a line, with or without a name before it."""
    for found in UR_LIST.finditer(text):
        cells = [cell.strip() for cell in found[3].split(",")]
        axes = {f"joint {i + 1}": cell for i, cell in enumerate(cells)}
        yield Target(found[1] or found[2] or "", found.start(3), axes)


# ---- FANUC -------------------------------------------------------------------------------------

LS_TARGET = re.compile(r"\bP\[\s*(\d{1,9})\s*(?::[^\]{}]*)?\]\s*\{([^{}]*)\}")
LS_AXIS = re.compile(r"\b([JE]\d)\s*=\s*([^\s,]+)[ \t]*(?:deg|mm)", re.IGNORECASE)


def ls_targets(text: str) -> Iterator[Target]:
    """`P[1]{ ... J1= ... deg, ...}`; points in Cartesian coordinates are none."""
    for found in LS_TARGET.finditer(text):
        if axes := by_axis(LS_AXIS.findall(found[2])):
            yield Target(f"P[{found[1]}]", found.start(2), axes)


@dataclass(frozen=True)
class Language:
    """A language: title, strings and comments, joint targets, Cartesian ones, unit of angles.

    cartesian: with the name in a group.  word: for a target.  least: targets that a program has;
    from two on they are alike.
    """

    title: str
    aside: re.Pattern[str]
    targets: Callable[[str], Iterator[Target]]
    cartesian: re.Pattern[str]
    unit: str = "deg"
    word: str = "target"
    least: int = 1


LANGUAGES = (
    Language(
        "RAPID jointtargets",
        RAPID_ASIDE,
        rapid_targets,
        re.compile(r"\brobtarget\s+(\w+)", re.IGNORECASE),
        word="jointtarget",
    ),
    Language(
        "KRL joint targets",
        KRL_ASIDE,
        krl_targets,
        re.compile(r"\b(\w++)\s*+=\s*+\{\s*+(?:E?6?POS\s*+:\s*+)?X\s[^{}]*\bS\s", re.I),
    ),
    Language(
        "FANUC joint positions",
        re.compile(r"^[ \t]*+\d*+:?[ \t]*+![^\r\n]*", re.MULTILINE),
        ls_targets,
        re.compile(r"\b(P\[\s*\d{1,9}\s*(?::[^\]{}]*)?\])\s*\{[^{}]*\bX\s*="),
    ),
    Language(
        "URScript joint lists",
        re.compile(r'"[^"\r\n]*"|#[^\r\n]*'),
        ur_targets,
        re.compile(r"\b(\w++)\s*+=\s*+p\["),
        unit="rad",
        least=2,
    ),
)


def language_of(text: str) -> tuple[Language, list[Target], str] | None:
    """The language of a program, its joint targets, and its text without strings and comments."""
    for language in LANGUAGES:
        bare = blanked(text, language.aside)
        found = list(language.targets(bare))
        if len(found) >= language.least and (
            language.least == 1 or len({len(target.axes) for target in found}) == 1
        ):
            return language, found, bare
    return None


def read(sheet: Sheet, given: Given, joints: bool) -> Reading | None:
    """One row a target, their names the key where all have one; None without joint targets.

    Raises DataError.
    """
    program = language_of(sheet.text)
    if program is None:
        return None
    language, targets, bare = program
    lines = [bare.count("\n", 0, target.at) + 1 for target in targets]
    check_targets(sheet, language.word, targets, lines)
    names = tuple(target.name for target in targets)
    columns = [Column("name", "pose", "", names)] if all(names) else []
    number = 0
    for i, axis in enumerate(targets[0].axes):
        cells = tuple(target.axes[axis] for target in targets)
        further = axis[0] == "E" or i >= ROBOT_AXES
        if further and language.unit == "deg" and {float(cell) for cell in cells} <= UNUSED:
            columns.append(Column(axis, "", "", cells, "", "an axis that does not move"))
            continue
        number += 1
        unit, known = ("", "") if axis[0] == "E" else (language.unit, "format")
        columns.append(Column(axis, f"q{number}", unit, cells, known))
    text = replace(sheet, delimiter="", decimal=".", header=(), cells=())
    reading = Reading(language.title, text, tuple(columns), np.array(lines))
    others = language.cartesian.findall(bare)
    said = f"targets without joint values are left out: {name_first(others)}"
    return reading.saying(said) if others else reading


def check_targets(sheet: Sheet, word: str, targets: list[Target], lines: list[int]) -> None:
    """Raise DataError for a target without numbers, of other axes, or of another's name."""
    first, seen = targets[0], set[str]()
    for target, line in zip(targets, lines, strict=True):
        where = f"{sheet.path}:{line}: {word} {target.name}".rstrip()
        if len(target.axes) < 2:
            raise DataError(f"{where} has no joint values; write them, or delete it")
        for axis, value in target.axes.items():
            if not POINT.fullmatch(value):
                raise DataError(
                    f"{where}: {axis}: {value!r} is not a number; mend it or delete the line"
                )
        if target.axes.keys() != first.axes.keys():
            raise DataError(
                f"{where} has {len(target.axes)} joint values ({', '.join(target.axes)}), the "
                f"first {len(first.axes)}; complete it or delete the line"
            )
        if target.name and target.name in seen:
            raise DataError(f"{where} is set twice; rename or delete one")
        seen.add(target.name)
