"""A robot's data sheet as CSV: a row a joint, units in the header, as the file schema has it.

The convention is in a column `convention`, in a comment above the header (``# convention:
modified``), or in Craig's own names (``a_i-1``, ``alpha(i-1)``): what it is cannot be guessed.
"""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from minimax_cal.ground.errors import RobotError

LENGTHS, ANGLES = ("mm", "m"), ("deg", "rad")
UNITS = {"mm": "mm", "m": "m", "deg": "deg", "°": "deg", "degree": "deg", "rad": "rad"}
NAMES = {  # of a header's cell, small letters: the schema's key
    "angle offset": "offset",
    "min": "lower", "max": "upper", "type": "type", "joint type": "type", "name": "name",
    "joint": "", "i": "", "link": "", "axis": "", "no": "", "no.": "", "j": "", "convention": "",
}  # fmt: skip
KEYS = ("a", "d", "theta", "alpha", "beta", "offset", "sign", "lower", "upper", "ratio", "mass_kg")
TYPES = {"r": "revolute", "rotation": "revolute", "rotary": "revolute", "p": "prismatic"}
TYPES |= {"linear": "prismatic", "revolute": "revolute", "prismatic": "prismatic"}
STATED = re.compile(r"[#%]\s*convention\s*[:=]\s*(\w+)", re.IGNORECASE)
GREEK = str.maketrans({"\u03b1": "alpha", "\u03b2": "beta", "\u03b8": "theta"})
BEFORE = re.compile(r"(a|alpha)\s*[_ ]?[({\[]?\s*i\s*-\s*1\s*[)}\]]?")  # Craig's a_(i-1)
OF_ROW = re.compile(r"(a|d|theta|alpha)\s*[_ ]?[({\[]?\s*i\s*[)}\]]?")


def content_of(path: Path, text: str) -> dict[str, Any]:
    """The robot in the file schema.  Raises RobotError."""
    lines = list(enumerate(text.lstrip("\ufeff").splitlines(), 1))
    stated = [found[1] for _, line in lines if (found := STATED.match(line.strip()))]
    rows = [(n, line) for n, line in lines if line.strip(" ,;\t") and line.strip()[0] not in "#%"]
    if len(rows) < 2:
        raise RobotError(f"{path}: holds no links; expected a header and a row for each joint")
    header = rows[0][1]
    mark = next((m for m in (";", "\t") if m in header), ",")
    names = [cell.strip() for cell in next(csv.reader([header], delimiter=mark))]
    known = [key_of(path, name) for name in names]
    twice = [key for key, *_ in known if key and [k for k, *_ in known].count(key) > 1]
    if twice:
        raise RobotError(f"{path}:{rows[0][0]}: column {twice[0]} stands twice; keep one of them")
    lacking = [key for key in ("a", "d", "theta", "alpha") if key not in [k for k, *_ in known]]
    if lacking:
        raise RobotError(
            f"{path}:{rows[0][0]}: no column {lacking[0]}; expected a_mm, d_mm, theta_deg, "
            "alpha_deg, one row a joint"
        )
    units = {
        "length": unit_of(path, known, LENGTHS, ("a", "d")),
        "angle": unit_of(path, known, ANGLES, ("theta", "alpha", "beta")),
    }
    joints, told = [], list(stated)
    for number, line in rows[1:]:
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=mark))]
        if len(cells) < len(names):
            raise RobotError(f"{path}:{number}: {len(cells)} cells, the header has {len(names)}")
        joint = {}
        for name, (key, *_), cell in zip(names, known, cells, strict=False):
            if name.lower() == "convention" and cell:
                told.append(cell)
            elif key and cell:
                joint[key] = value_of(path, number, key, cell, decimal_comma=mark != ",")
        joints.append(joint)
    told += ["modified"] * any(craig for *_, craig in known)
    return {"name": path.stem, "convention": one_of(path, told), "units": units, "joints": joints}


def key_of(path: Path, name: str) -> tuple[str, str, bool]:
    """The schema's key of a header's cell, its unit, and whether it is one of Craig's names."""
    stem, unit = name.strip().lower().translate(GREEK), ""
    if found := re.fullmatch(r"(.*?)[\s_]*[\[(]([^\])]*)[\])]", stem):
        if found[2] in UNITS:
            stem, unit = found[1].strip(), UNITS[found[2]]
    elif (found := re.fullmatch(r"(.+)[\s_](\S+)", stem)) and found[2] in UNITS:
        stem, unit = found[1].strip(), UNITS[found[2]]
    craig = bool(found := BEFORE.fullmatch(stem))
    if found or (found := OF_ROW.fullmatch(stem)):
        stem = found[1]
    key = NAMES.get(stem, stem)
    if key and key not in (*KEYS, "type", "name"):
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


def value_of(path: Path, line: int, key: str, cell: str, *, decimal_comma: bool) -> object:
    """A cell as the schema has it.  Raises RobotError."""
    if key == "name":
        return cell
    if key == "type":
        if cell.lower() not in TYPES:
            raise RobotError(f"{path}:{line}: type {cell!r}; write revolute or prismatic")
        return TYPES[cell.lower()]
    try:
        value = float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        raise RobotError(f"{path}:{line}: column {key}: {cell!r} is not a number") from None
    return int(value) if key == "sign" and value in (1.0, -1.0) else value


def one_of(path: Path, told: Sequence[str]) -> str:
    """The convention, if the file says one.  Raises RobotError."""
    found = list(dict.fromkeys(word.lower() for word in told))
    if len(found) == 1:
        return found[0]
    if found:
        raise RobotError(f"{path}: says {' and '.join(found)} of its convention; keep one of them")
    raise RobotError(
        f"{path}: does not say whether its rows are standard or modified (Craig's) DH; add a first "
        "line '# convention: standard' or '# convention: modified'"
    )
