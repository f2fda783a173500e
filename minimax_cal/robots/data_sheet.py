"""A robot's data sheet as a table: a row a joint, units in the header, as the file schema has it.

The convention is in a column `convention`, in a line above the header (``# convention: modified``),
or in Craig's own names (``a_i-1``, ``alpha(i-1)``): what it is cannot be guessed.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from minimax_cal.ground.errors import DataError, RobotError
from minimax_cal.reading.sheet import cut, number_of, open_text
from minimax_cal.reading.words import folded, split_unit

LENGTHS, ANGLES = ("mm", "m"), ("deg", "rad")
COLUMNS = ("convention", "konvention")  # that say it in each row
COUNTED = ("joint", "i", "link", "axis", "no", "no.", "j", "gelenk", "achse", "nr", "nr.", "glied",
           "axe", "articulation", "eje", "articulacion", "\u5173\u8282", "\u8f74")  # fmt: skip
NAMES = dict.fromkeys((*COUNTED, *COLUMNS), "") | {  # of a header's cell, folded: the schema's key
    "angle offset": "offset", "versatz": "offset", "vorzeichen": "sign", "mass": "mass_kg",
    "min": "lower", "max": "upper", "untergrenze": "lower", "obergrenze": "upper",
    "joint type": "type", "typ": "type", "bezeichnung": "name", "masse": "mass_kg",
}  # fmt: skip
KEYS = ("a", "d", "theta", "alpha", "beta", "offset", "sign", "lower", "upper", "ratio", "mass_kg")
TYPES = {"r": "revolute", "rotation": "revolute", "rotary": "revolute", "p": "prismatic"}
TYPES |= {"linear": "prismatic", "revolute": "revolute", "prismatic": "prismatic"}
STATED = r"[#%]?\s*(?:{})\s*[:=;,\t]\s*(.*\w[.)]*)"  # of a line above the header
CONVENTION, NAME = (re.compile(STATED.format(w), re.I) for w in ("[ck]onvention", r"name|robot\w*"))
GREEK = str.maketrans({"\u03b1": "alpha", "\u03b2": "beta", "\u03b8": "theta"})
BEFORE = re.compile(r"(a|alpha)\s*[_ ]?[({\[]?\s*i\s*-\s*1\s*[)}\]]?")  # Craig's a_(i-1)
OF_ROW = re.compile(r"(a|d|theta|alpha)\s*[_ ]?[({\[]?\s*i\s*[)}\]]?")


def content_of(path: Path) -> dict[str, Any]:
    """The robot in the file schema.  Raises RobotError."""
    try:
        sheet = cut(open_text(path), most_torn=0.0)
    except DataError as error:
        raise RobotError(str(error)) from error
    known = [key_of(path, name) for name in sheet.header]
    keys = [key for key, *_ in known]
    if twice := [key for key in keys if key and keys.count(key) > 1]:
        raise RobotError(f"{path}: column {twice[0]} stands twice; keep one of them")
    if lacking := [key for key in ("a", "d", "theta", "alpha") if key not in keys]:
        raise RobotError(
            f"{path}: no column {lacking[0]}; expected a_mm, d_mm, theta_deg, alpha_deg, one row a "
            "joint"
        )
    above = [line.strip() for line in sheet.text.splitlines()[: int(sheet.line[0]) - 1]]
    told, names = ([m[1] for line in above if (m := p.match(line))] for p in (CONVENTION, NAME))
    at = [i for i, name in enumerate(sheet.header) if folded(name) in COLUMNS]
    told += [row[i] for row in sheet.cells for i in at if row[i]]
    told += ["modified"] * any(craig for *_, craig in known)
    return {
        "name": names[0] if names else path.stem,
        "convention": one_of(path, told),
        "units": {
            "length": unit_of(path, known, LENGTHS, ("a", "d")),
            "angle": unit_of(path, known, ANGLES, ("theta", "alpha", "beta")),
        },
        "joints": [
            {
                key: value_of(f"{path}:{line}: ", key, cell, sheet.decimal)
                for key, cell in zip(keys, row, strict=True)
                if key and cell
            }
            for line, row in zip(sheet.line, sheet.cells, strict=True)
        ],
    }


def key_of(path: Path, name: str) -> tuple[str, str, bool]:
    """The schema's key of a header's cell, its unit, and whether it is one of Craig's names."""
    stem, unit = split_unit(name)
    stem = folded(stem.translate(GREEK))
    craig = bool(found := BEFORE.fullmatch(stem))
    if found or (found := OF_ROW.fullmatch(stem)):
        stem = found[1]
    key = NAMES.get(stem, stem)
    said = [word for word in re.findall(r"\w+", key) if word in KEYS]  # as in: length a
    key = said[0] if len(said) == 1 else key
    if unit not in ("", "kg", *LENGTHS, *ANGLES) or (key and key not in (*KEYS, "type", "name")):
        (near,) = difflib.get_close_matches(key, KEYS, 1, cutoff=0.0)
        raise RobotError(f"{path}: unknown column {name!r}; did you mean {near}?")
    return key, unit, craig


def unit_of(
    path: Path, known: Sequence[tuple[str, str, bool]], units: Sequence[str], keys: Sequence[str]
) -> str:
    """The unit of columns of one kind.  Raises RobotError where there is none, or two."""
    found = {unit for key, unit, _ in known if key in keys}
    if len(found) == 1 and (unit := found.pop()) in units:
        return unit
    example = ", ".join(f"{key}_{units[0]}" for key in keys[:2])
    raise RobotError(f"{path}: one unit for {' and '.join(keys[:2])}, please: {example}")


def value_of(where: str, key: str, cell: str, decimal: str) -> object:
    """A cell as the schema has it.  Raises RobotError."""
    if key == "name":
        return cell
    if key == "type":
        if cell.lower() not in TYPES:
            raise RobotError(f"{where}type {cell!r}; write revolute or prismatic")
        return TYPES[cell.lower()]
    value = number_of(cell, decimal)
    if value != value:
        raise RobotError(f"{where}column {key}: {cell!r} is not a number")
    return int(value) if key == "sign" and value in (1.0, -1.0) else value


def one_of(path: Path, told: Sequence[str]) -> str:
    """The convention, if the file says one.  Raises RobotError."""
    found = list(dict.fromkeys(folded(word).replace("modifiziert", "modified") for word in told))
    if len(found) == 1:
        return found[0]
    if found:
        raise RobotError(f"{path}: says {' and '.join(found)} of its convention; keep one of them")
    raise RobotError(
        f"{path}: does not say whether its rows are standard or modified (Craig's) DH; add a first "
        "line '# convention: standard' or '# convention: modified'"
    )
