"""Joint targets in the text of controllers' programs: KRL, RAPID, URScript, FANUC's LS."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.display_text import format_first_names, replace_matches_with_spaces
from minimax_cal.core.errors import DataError
from minimax_cal.measuring.importers.column_tables import (
    ImportedColumn,
    ImportedTable,
    ImportOptions,
)
from minimax_cal.reading.text_sheet import CELL_NUMBER_PATTERN, Sheet

RAPID_IGNORED_PATTERN = re.compile(r'"[^"\r\n]*"|![^\r\n]*')  # strings and comments
KRL_IGNORED_PATTERN = re.compile(r'"[^"\r\n]*"|;[^\r\n]*')
UNUSED_AXIS_VALUES = {0.0, 9e9}  # of an axis that is not there; RAPID writes 9E9
MAX_ROBOT_AXES = 6


@dataclass(frozen=True)
class ProgramTarget:
    """name: '' where it has none.  at: place in the text.  axes: its values by axis."""

    name: str
    at: int
    axes: Mapping[str, str]


def merge_values_by_axis(axis_value_pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Values by axis; of an axis that is there twice both, which is no number."""
    out: dict[str, str] = {}
    for axis, value in axis_value_pairs:
        name = axis.upper()
        out[name] = f"{out[name]} and {value}" if name in out else value
    return out


# ---- KUKA --------------------------------------------------------------------------------------

KRL_JOINT_TARGET_PATTERN = re.compile(
    r"(?:\b(\w++)\s*+=\s*+)?\{\s*+(?:(?:E6AXIS|AXIS)\s*+:)?\s*+(A1\s[^{}]*+)\}", re.IGNORECASE
)
KRL_AXIS_PATTERN = re.compile(r"\b([AE]\d)\s+([^\s,{}]+)", re.IGNORECASE)
KRL_EDITOR_NAME_PATTERN = re.compile(r"[Xx]([A-Za-z_]\w*)")  # the editor calls the values of P1 XP1


def find_krl_targets(program_text: str) -> Iterator[ProgramTarget]:
    """`{A1 ..., A2 ...}`, declared or in a motion."""
    for found in KRL_JOINT_TARGET_PATTERN.finditer(program_text):
        axes = merge_values_by_axis(KRL_AXIS_PATTERN.findall(found[2]))
        own = KRL_EDITOR_NAME_PATTERN.fullmatch(found[1] or "")
        yield ProgramTarget(own[1] if own else found[1] or "", found.start(2), axes)


# ---- ABB ---------------------------------------------------------------------------------------

RAPID_JOINT_TARGET_PATTERN = re.compile(r"\bjointtarget\s+(\w+)", re.IGNORECASE)
RAPID_VALUES_PATTERN = re.compile(r"[\[{]\s*+([^\[\]{}]++)[\]}]")


def find_rapid_targets(program_text: str) -> Iterator[ProgramTarget]:
    """`jointtarget j1:=[[...],[...]]`, or `j:{...}`."""
    found = list(RAPID_JOINT_TARGET_PATTERN.finditer(program_text))
    ends = [*(one.start() for one in found), len(program_text)][1:]
    for here, end in zip(found, ends, strict=False):
        body = program_text[here.end() : end]
        values = RAPID_VALUES_PATTERN.search(body.split(";")[0])
        cells = [c.strip() for c in values[1].strip().strip(" ,").split(",")] if values else []
        yield ProgramTarget(
            here[1], here.start(), {f"axis {i + 1}": c for i, c in enumerate(cells)}
        )


# ---- Universal Robots --------------------------------------------------------------------------

UR_JOINT_LIST_PATTERN = re.compile(
    r"(?:\b(?:global\s+)?(\w++)\s*+=\s*+|\bmovej\s*\(\s*"
    r"|^[ \t]*+(?:(\w++)(?=[ \t:,;])[ \t]*+[:,;]?[ \t]*+)?)"
    rf"\[\s*({CELL_NUMBER_PATTERN.pattern}(?:\s*,\s*{CELL_NUMBER_PATTERN.pattern})+)\s*\]",
    re.MULTILINE,
)


def find_ur_targets(program_text: str) -> Iterator[ProgramTarget]:
    """`movej([...])`, `name = [...]`, or a list a line, with or without a name before it."""
    for found in UR_JOINT_LIST_PATTERN.finditer(program_text):
        cells = [cell.strip() for cell in found[3].split(",")]
        axes = {f"joint {i + 1}": cell for i, cell in enumerate(cells)}
        yield ProgramTarget(found[1] or found[2] or "", found.start(3), axes)


# ---- FANUC -------------------------------------------------------------------------------------

FANUC_TARGET_PATTERN = re.compile(r"\bP\[\s*(\d{1,9})\s*(?::[^\]{}]*)?\]\s*\{([^{}]*)\}")
FANUC_AXIS_PATTERN = re.compile(r"\b([JE]\d)\s*=\s*([^\s,]+)[ \t]*(?:deg|mm)", re.IGNORECASE)


def find_fanuc_targets(program_text: str) -> Iterator[ProgramTarget]:
    """`P[1]{ ... J1= ... deg, ...}`; points in Cartesian coordinates are none."""
    for found in FANUC_TARGET_PATTERN.finditer(program_text):
        if axes := merge_values_by_axis(FANUC_AXIS_PATTERN.findall(found[2])):
            yield ProgramTarget(f"P[{found[1]}]", found.start(2), axes)


@dataclass(frozen=True)
class ProgramLanguage:
    """A language: title, strings and comments, joint targets, Cartesian ones, unit of angles.

    cartesian: with the name in a group.  word: for a target.  least: targets that a program has;
    from two on they are alike.
    """

    title: str
    aside: re.Pattern[str]
    targets: Callable[[str], Iterator[ProgramTarget]]
    cartesian: re.Pattern[str]
    unit: str = "deg"
    word: str = "target"
    least: int = 1


PROGRAM_LANGUAGES = (
    ProgramLanguage(
        "RAPID jointtargets",
        RAPID_IGNORED_PATTERN,
        find_rapid_targets,
        re.compile(r"\brobtarget\s+(\w+)", re.IGNORECASE),
        word="jointtarget",
    ),
    ProgramLanguage(
        "KRL joint targets",
        KRL_IGNORED_PATTERN,
        find_krl_targets,
        re.compile(r"\b(\w++)\s*+=\s*+\{\s*+(?:E?6?POS\s*+:\s*+)?X\s[^{}]*\bS\s", re.I),
    ),
    ProgramLanguage(
        "FANUC joint positions",
        re.compile(r"^[ \t]*+\d*+:?[ \t]*+![^\r\n]*", re.MULTILINE),
        find_fanuc_targets,
        re.compile(r"\b(P\[\s*\d{1,9}\s*(?::[^\]{}]*)?\])\s*\{[^{}]*\bX\s*="),
    ),
    ProgramLanguage(
        "URScript joint lists",
        re.compile(r'"[^"\r\n]*"|#[^\r\n]*'),
        find_ur_targets,
        re.compile(r"\b(\w++)\s*+=\s*+p\["),
        unit="rad",
        least=2,
    ),
)


class ProgramWithTargets(NamedTuple):
    """Language of a program, its joint targets, and its text without strings and comments."""

    language: ProgramLanguage
    targets: list[ProgramTarget]
    bare_text: str


def detect_language_and_targets(
    program_text: str,
) -> ProgramWithTargets | None:
    """The language of a program, its joint targets, and its text without strings and comments."""
    for language in PROGRAM_LANGUAGES:
        bare = replace_matches_with_spaces(program_text, language.aside)
        found = list(language.targets(bare))
        if len(found) >= language.least and (
            language.least == 1 or len({len(target.axes) for target in found}) == 1
        ):
            return ProgramWithTargets(language, found, bare)
    return None


def import_robot_program(
    sheet: Sheet, options: ImportOptions, holds_joints: bool
) -> ImportedTable | None:
    """One row a target, their names the key where all have one; None without joint targets.

    Raises DataError.
    """
    program = detect_language_and_targets(sheet.text)
    if program is None:
        return None
    language, targets, bare = program
    lines = [bare.count("\n", 0, target.at) + 1 for target in targets]
    check_program_targets(sheet, language.word, targets, lines)
    names = tuple(target.name for target in targets)
    columns = [ImportedColumn("name", "pose", "", names)] if all(names) else []
    number = 0
    for i, axis in enumerate(targets[0].axes):
        cells = tuple(target.axes[axis] for target in targets)
        further = axis[0] == "E" or i >= MAX_ROBOT_AXES
        if (
            further
            and language.unit == "deg"
            and {float(cell) for cell in cells} <= UNUSED_AXIS_VALUES
        ):
            columns.append(ImportedColumn(axis, "", "", cells, "", "an axis that does not move"))
            continue
        number += 1
        unit, known = ("", "") if axis[0] == "E" else (language.unit, "format")
        columns.append(ImportedColumn(axis, f"q{number}", unit, cells, known))
    text = replace(sheet, delimiter="", decimal=".", header=(), cells=())
    reading = ImportedTable(language.title, text, tuple(columns), np.array(lines))
    others = language.cartesian.findall(bare)
    said = f"targets without joint values are left out: {format_first_names(others)}"
    return reading.with_notices(said) if others else reading


def check_program_targets(
    sheet: Sheet, target_word: str, targets: list[ProgramTarget], lines: list[int]
) -> None:
    """Raise DataError for a target without numbers, of other axes, or of another's name."""
    first, seen = targets[0], set[str]()
    for target, line in zip(targets, lines, strict=True):
        where = f"{sheet.path}:{line}: {target_word} {target.name}".rstrip()
        if len(target.axes) < 2:
            raise DataError(f"{where} has no joint values; write them, or delete it")
        for axis, value in target.axes.items():
            if not CELL_NUMBER_PATTERN.fullmatch(value):
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
