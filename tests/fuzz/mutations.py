"""Seeded ways to break a file or a command line."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import yaml

from minimax_cal.robots.robot import NOTE_KEY_PREFIXES

MOST = 10**300  # a longer integer is no float
Rng = np.random.Generator
MARKUP = "<script>alert(1)</script>"
ESCAPE = "\x1b]0;owned\x07"
CELLS = (
    "", "nan", "inf", "-inf", "1e400", "1e308", "-1e308", "1e-320", "-0", "0", "1e18", "1,5",
    "abc", "=1+1", ESCAPE, "\u0663.\u0665", "0x1F", "1_0", "9" * 5000, MARKUP, '"', "NULL", " 1 ",
    "-", "1e",    "\u202e1",
)  # fmt: skip
LEAVES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 1e308, -1e308, 1e-308, float("nan"), float("inf"), "", "x", [], {}, [[]],
    [1, 2], [None], MARKUP, ESCAPE, 10**400, "9" * 4000, {"a": {"b": []}}, "1", -0.0, 1e18, "$x_{$",
)  # fmt: skip
VALUES = (
    "", "-1", "0", "1", "2", "0.5", "1e308", "nan", "inf", "-inf", "1e-300", "abc", "\u0663",
    "1,2,3", "1:0", "../x", "a" * 3000, ESCAPE, "0x10", "1_000", "99999999999999999999", "=cmd",
    "null", "J2=1:0", "J9=0:1", ",", ":", "*", "%s", "{}", "a2=1mm", "beta*", "smr1", "0,0,0", "a2",
    "data.csv", ".",
    "no/such/folder/x", "joint_compliance:J2", "joint_compliance:J99", "backlash", MARKUP, "$x_{$",
)  # fmt: skip


def pick(rng: Rng, choices: Any) -> Any:
    """One of them."""
    return choices[int(rng.integers(len(choices)))]


# ---- bytes -----------------------------------------------------------------------------------


def flipped(raw: bytes, rng: Rng) -> bytes:
    """Some bytes are others."""
    out = bytearray(raw)
    for at in rng.integers(len(out), size=int(rng.integers(1, 9))):
        out[at] = int(rng.integers(256))
    return bytes(out)


def cut(raw: bytes, rng: Rng) -> bytes:
    """The end is missing."""
    return raw[: int(rng.integers(len(raw)))]


def patched(raw: bytes, rng: Rng) -> bytes:
    """A stretch stands again, or is gone."""
    a, b = sorted(rng.integers(len(raw), size=2))
    return raw[:b] + raw[a:] if rng.random() < 0.5 else raw[:a] + raw[b:]


def foreign(raw: bytes, rng: Rng) -> bytes:
    """Something else altogether."""
    made = (
        b"", b"\0" * 100, b"\xff\xfe" + raw, raw.decode().encode("utf-16"), b"[" * 100_000,
        b"{}", b"[]", b"null", b"PK\x03\x04", b"\n" * 1000, b"," * 10_000, rng.bytes(500),
        b'"', b"a: &a [*a, *a]\n",
        b"<?xml version='1.0'?><!DOCTYPE r [<!ENTITY a 'x'><!ENTITY b '&a;'>]><robot>&b;</robot>",
    )  # fmt: skip
    return bytes(pick(rng, made))


BYTES: tuple[Callable[[bytes, Rng], bytes], ...] = (flipped, cut, patched, foreign)


# ---- tables ----------------------------------------------------------------------------------


def table(raw: bytes) -> list[list[str]]:
    """Cells of a CSV file."""
    return list(csv.reader(io.StringIO(raw.decode())))


def text_of(rows: list[list[str]]) -> bytes:
    """Cells as a CSV file."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue().encode()


def odd_cells(raw: bytes, rng: Rng) -> bytes:
    """Up to three cells hold something else."""
    rows = table(raw)
    for _ in range(int(rng.integers(1, 4))):
        row = pick(rng, rows)
        row[int(rng.integers(len(row)))] = pick(rng, CELLS)
    return text_of(rows)


def nudged(raw: bytes, rng: Rng) -> bytes:
    """Some numbers are a little or a lot off."""
    rows = table(raw)
    for _ in range(int(rng.integers(1, 6))):
        row = pick(rng, rows[1:])
        at = int(rng.integers(len(row)))
        row[at] = repr(float(row[at]) * float(pick(rng, (-1.0, 0.0, 0.9, 1.001, 1.5, 1e3))))
    return text_of(rows)


def odd_column(raw: bytes, rng: Rng) -> bytes:
    """A column holds the same odd thing throughout, with a known name or an odd one."""
    names = (
        "temperature_C", "payload_kg", "u95_mm", "split", "pose", "session", "time_s",
        "order", "tau1_Nm", "approach1", "qread1_rad", "base1_x_mm", "note", "smr99_x_mm", "q7_rad",
        "Q1_rad",        ESCAPE, "=1", "", "split ", "smr1_x_in", "q2_deg",
    )  # fmt: skip
    rows, name, cell = table(raw), pick(rng, names), pick(rng, CELLS)
    varied = rng.random() < 0.5
    body = (str(int(rng.integers(3))) if varied else cell for _ in rows[1:])
    return text_of(
        [[*rows[0], name], *([*row, each] for row, each in zip(rows[1:], body, strict=True))]
    )


def moved_columns(raw: bytes, rng: Rng) -> bytes:
    """A column is gone, stands twice, or has the name of another."""
    rows = table(raw)
    a, b = (int(x) for x in rng.integers(len(rows[0]), size=2))
    how = int(rng.integers(3))
    if how == 2:
        rows[0][a], rows[0][b] = rows[0][b], rows[0][a]
        return text_of(rows)
    return text_of([row[:a] + row[a + 1 :] if how else [*row, row[a]] for row in rows])


def fewer_rows(raw: bytes, rng: Rng) -> bytes:
    """Hardly any rows, or one of them throughout."""
    head, *rows = table(raw)
    count = int(rng.integers(6))
    return text_of([head, *(rows[:count] if rng.random() < 0.7 else [rows[0]] * len(rows))])


def ragged(raw: bytes, rng: Rng) -> bytes:
    """Rows of another length."""
    rows = table(raw)
    row = pick(rng, rows)
    if rng.random() < 0.5:
        row.append(pick(rng, CELLS))
    elif len(row) > 1:
        row.pop()
    return text_of(rows)


TABLES: tuple[Callable[[bytes, Rng], bytes], ...] = (
    odd_cells, nudged, odd_column, moved_columns, fewer_rows, ragged,
)  # fmt: skip


# ---- trees -----------------------------------------------------------------------------------


def places(tree: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a tree; of long lists the first few."""
    found: list[tuple[Any, Any]] = []
    if isinstance(tree, dict):
        keys: list[Any] = list(tree)
    else:
        keys = list(range(min(len(tree), 8))) if isinstance(tree, list) else []
    for key in keys:
        found += [(tree, key), *places(tree[key])]
    return found


def changed(tree: Any, rng: Rng) -> Any:
    """Leaves or branches are others, gone, or new."""
    for _ in range(int(rng.integers(1, 4))):
        at = places(tree)
        if not at:
            break
        holder, key = pick(rng, at)
        how, old = rng.random(), holder[key]
        if how < 0.5 and isinstance(old, int | float):
            size = max(-MOST, min(old, MOST)) if isinstance(old, int) else old
            holder[key] = size * float(pick(rng, (-1.0, 0.9, 1.0 + 1e-9, 2.0, 1e3)))
        elif how < 0.6:
            holder[key] = pick(rng, LEAVES)
        elif how < 0.8:
            del holder[key]
        elif isinstance(holder, dict):
            holder[pick(rng, ("new", MARKUP, ESCAPE, "", "q" * 500))] = pick(rng, LEAVES)
        else:
            holder.append(pick(rng, LEAVES))
    return tree


def json_tree(raw: bytes, rng: Rng) -> bytes:
    """JSON of another content; a NaN in it is no JSON."""
    return json.dumps(changed(json.loads(raw), rng)).encode()


def misspelt(raw: bytes, rng: Rng) -> tuple[bytes, str]:
    """JSON with one key of one object misspelt, and which; a key of a note's own is not spoilt."""
    tree = json.loads(raw)
    found = [(part, key) for part, key in places(tree) if isinstance(part, dict)]
    found = [(part, key) for part, key in found if not str(key).startswith(NOTE_KEY_PREFIXES)]
    part, key = found[int(rng.integers(len(found)))]
    at = int(rng.integers(len(key)))
    slip = str(pick(rng, (key + "s", key[:at] + "q" + key[at:], key.upper())))
    part[slip] = part.pop(key)
    return json.dumps(tree).encode(), f"key {key} as {slip}"


def yaml_tree(raw: bytes, rng: Rng) -> bytes:
    """YAML of another content."""
    return yaml.safe_dump(changed(yaml.safe_load(raw), rng)).encode()


def odd_words(raw: bytes, rng: Rng) -> bytes:
    """A word between quotes or after = is another."""
    text = raw.decode()
    marks = [i for i, letter in enumerate(text) if letter in '"=']
    at = int(pick(rng, marks)) + 1
    end = min((i for i in marks if i > at), default=len(text))
    return (text[:at] + str(pick(rng, CELLS)) + text[end:]).encode()


OF_KIND: dict[str, tuple[Callable[[bytes, Rng], bytes], ...]] = {
    "csv": TABLES,
    "json": (json_tree,),
    "yaml": (yaml_tree,),
    "toml": (odd_words,),
    "urdf": (odd_words,),
    "xml": (odd_words,),
    "mod": (odd_words,),
    "src": (odd_words,),
    "dat": (odd_words,),
}


def broken(name: str, raw: bytes, rng: Rng) -> tuple[bytes, str]:
    """A file broken in one way, and the word for it."""
    own = OF_KIND[name.rsplit(".", 1)[1]]
    way = pick(rng, BYTES if rng.random() < 0.2 else own)
    try:
        return way(raw, rng), f"{name}: {way.__name__}"
    except (ValueError, IndexError, RecursionError, csv.Error, yaml.YAMLError):  # broken already
        return raw[::-1], f"{name}: backwards"
