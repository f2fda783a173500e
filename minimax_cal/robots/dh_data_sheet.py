"""A robot's data sheet as a table: a row a joint, units in the header, as the file schema has it.

The convention is in a column `convention`, in a line above the header (``# convention: modified``),
or in Craig's own names (``a_i-1``, ``alpha(i-1)``): what it is cannot be guessed.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from minimax_cal.core.errors import DataError, RobotError
from minimax_cal.reading.column_words import fold_case_and_accents, split_name_and_unit
from minimax_cal.reading.text_sheet import parse_number, parse_sheet_table, read_text_sheet

SHEET_LENGTH_UNITS, SHEET_ANGLE_UNITS = ("mm", "m"), ("deg", "rad")
CONVENTION_COLUMN_NAMES = ("convention", "konvention")  # that say it in each row
JOINT_NUMBER_COLUMN_NAMES = (
    "joint",
    "i",
    "link",
    "axis",
    "no",
    "no.",
    "j",
    "gelenk",
    "achse",
    "nr",
    "nr.",
    "glied",
    "axe",
    "articulation",
    "eje",
    "articulacion",
    "\u5173\u8282",
    "\u8f74",
)
# of a header's cell, folded: the schema's key
SCHEMA_KEY_BY_HEADER = dict.fromkeys((*JOINT_NUMBER_COLUMN_NAMES, *CONVENTION_COLUMN_NAMES), "") | {
    "angle offset": "offset", "versatz": "offset", "vorzeichen": "sign", "mass": "mass_kg",
    "min": "lower", "max": "upper", "untergrenze": "lower", "obergrenze": "upper",
    "joint type": "type", "typ": "type", "bezeichnung": "name", "masse": "mass_kg",
}  # fmt: skip
SHEET_NUMBER_KEYS = (
    "a",
    "d",
    "theta",
    "alpha",
    "beta",
    "offset",
    "sign",
    "lower",
    "upper",
    "ratio",
    "mass_kg",
)
JOINT_TYPE_BY_WORD = {
    "r": "revolute",
    "rotation": "revolute",
    "rotary": "revolute",
    "p": "prismatic",
}
JOINT_TYPE_BY_WORD |= {"linear": "prismatic", "revolute": "revolute", "prismatic": "prismatic"}
STATED_LINE_TEMPLATE = r"[#%]?\s*(?:{})\s*[:=;,\t]\s*(.*\w[.)]*)"  # of a line above the header
CONVENTION_LINE_PATTERN, ROBOT_NAME_LINE_PATTERN = (
    re.compile(STATED_LINE_TEMPLATE.format(w), re.I) for w in ("[ck]onvention", r"name|robot\w*")
)
GREEK_TO_LATIN = str.maketrans({"\u03b1": "alpha", "\u03b2": "beta", "\u03b8": "theta"})
CRAIG_PREVIOUS_INDEX_PATTERN = re.compile(
    r"(a|alpha)\s*[_ ]?[({\[]?\s*i\s*-\s*1\s*[)}\]]?"
)  # Craig's a_(i-1)
ROW_INDEX_PATTERN = re.compile(r"(a|d|theta|alpha)\s*[_ ]?[({\[]?\s*i\s*[)}\]]?")


def read_dh_data_sheet(path: Path) -> dict[str, Any]:
    """The robot in the file schema.  Raises RobotError."""
    try:
        sheet = parse_sheet_table(read_text_sheet(path), max_torn_share=0.0)
    except DataError as error:
        raise RobotError(str(error)) from error
    known = [parse_header_cell(path, name) for name in sheet.header]
    keys = [key for key, *_ in known]
    if twice := [key for key in keys if key and keys.count(key) > 1]:
        raise RobotError(f"{path}: column {twice[0]} stands twice; keep one of them")
    if lacking := [key for key in ("a", "d", "theta", "alpha") if key not in keys]:
        raise RobotError(
            f"{path}: no column {lacking[0]}; expected a_mm, d_mm, theta_deg, alpha_deg, one row a "
            "joint"
        )
    above = [line.strip() for line in sheet.text.splitlines()[: int(sheet.line[0]) - 1]]
    told, names = (
        [m[1] for line in above if (m := p.match(line))]
        for p in (CONVENTION_LINE_PATTERN, ROBOT_NAME_LINE_PATTERN)
    )
    at = [
        i
        for i, name in enumerate(sheet.header)
        if fold_case_and_accents(name) in CONVENTION_COLUMN_NAMES
    ]
    told += [row[i] for row in sheet.cells for i in at if row[i]]
    told += ["modified"] * any(craig for *_, craig in known)
    return {
        "name": names[0] if names else path.stem,
        "convention": resolve_dh_convention(path, told),
        "units": {
            "length": find_common_unit(path, known, SHEET_LENGTH_UNITS, ("a", "d")),
            "angle": find_common_unit(path, known, SHEET_ANGLE_UNITS, ("theta", "alpha", "beta")),
        },
        "joints": [
            {
                key: parse_sheet_cell(f"{path}:{line}: ", key, cell, sheet.decimal)
                for key, cell in zip(keys, row, strict=True)
                if key and cell
            }
            for line, row in zip(sheet.line, sheet.cells, strict=True)
        ],
    }


class HeaderCell(NamedTuple):
    """The schema's key of a header's cell, its unit, and whether the name is Craig's."""

    key: str
    unit: str
    is_craig: bool


def parse_header_cell(path: Path, header_cell: str) -> HeaderCell:
    """The schema's key of a header's cell, its unit, and whether it is one of Craig's names."""
    stem, unit = split_name_and_unit(header_cell)
    stem = fold_case_and_accents(stem.translate(GREEK_TO_LATIN))
    craig = bool(found := CRAIG_PREVIOUS_INDEX_PATTERN.fullmatch(stem))
    if found or (found := ROW_INDEX_PATTERN.fullmatch(stem)):
        stem = found[1]
    key = SCHEMA_KEY_BY_HEADER.get(stem, stem)
    said = [
        word for word in re.findall(r"\w+", key) if word in SHEET_NUMBER_KEYS
    ]  # as in: length a
    key = said[0] if len(said) == 1 else key
    if unit not in ("", "kg", *SHEET_LENGTH_UNITS, *SHEET_ANGLE_UNITS) or (
        key and key not in (*SHEET_NUMBER_KEYS, "type", "name")
    ):
        (near,) = difflib.get_close_matches(key, SHEET_NUMBER_KEYS, 1, cutoff=0.0)
        raise RobotError(f"{path}: unknown column {header_cell!r}; did you mean {near}?")
    return HeaderCell(key, unit, craig)


def find_common_unit(
    path: Path,
    parsed_headers: Sequence[tuple[str, str, bool]],
    allowed_units: Sequence[str],
    keys: Sequence[str],
) -> str:
    """The unit of columns of one kind.  Raises RobotError where there is none, or two."""
    found = {unit for key, unit, _ in parsed_headers if key in keys}
    if len(found) == 1 and (unit := found.pop()) in allowed_units:
        return unit
    example = ", ".join(f"{key}_{allowed_units[0]}" for key in keys[:2])
    raise RobotError(f"{path}: one unit for {' and '.join(keys[:2])}, please: {example}")


def parse_sheet_cell(location: str, key: str, cell: str, decimal_mark: str) -> object:
    """A cell as the schema has it.  Raises RobotError."""
    if key == "name":
        return cell
    if key == "type":
        if cell.lower() not in JOINT_TYPE_BY_WORD:
            raise RobotError(f"{location}type {cell!r}; write revolute or prismatic")
        return JOINT_TYPE_BY_WORD[cell.lower()]
    value = parse_number(cell, decimal_mark)
    if value != value:
        raise RobotError(f"{location}column {key}: {cell!r} is not a number")
    return int(value) if key == "sign" and value in (1.0, -1.0) else value


def resolve_dh_convention(path: Path, stated_conventions: Sequence[str]) -> str:
    """The convention, if the file says one.  Raises RobotError."""
    found = list(
        dict.fromkeys(
            fold_case_and_accents(word).replace("modifiziert", "modified")
            for word in stated_conventions
        )
    )
    if len(found) == 1:
        return found[0]
    if found:
        raise RobotError(f"{path}: says {' and '.join(found)} of its convention; keep one of them")
    raise RobotError(
        f"{path}: does not say whether its rows are standard or modified (Craig's) DH; add a first "
        "line '# convention: standard' or '# convention: modified'"
    )
