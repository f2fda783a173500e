"""Records of files: frozen dataclasses read, and described to other programs, by their annotations.

What writes them is `files.plain`.  A class with `to_dict` and `from_dict(content, source)` stands
in a file in its own way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, said
from minimax_cal.ground.facts import (
    Fact,
    Later,
    all_facts,
    hints_of,
    scaled,
    stored_facts,
)
from minimax_cal.ground.files import MOST, numbers, plain

AGAIN = "write it again with minimax-cal"
FAULTS = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)
MISSING_HERE = object()
WORDS = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}

Kind = TypeVar("Kind")


# ---- reading -----------------------------------------------------------------------------------


def read(kind: type[Kind], content: Any, at: str = "") -> Kind:
    """A record from its JSON; keys that it does not know are left alone.

    at: its place in the file.  Raises ValueError, which names the place.
    """
    return kind(**stored(kind, content, at))


def stored(kind: type, content: Any, at: str = "") -> dict[str, Any]:
    """What a record holds by itself, SI, by the names of its fields.  Raises ValueError."""
    if not isinstance(content, Mapping):
        raise ValueError(f"{at or 'it'}: should be an object")
    own = {each.name: each for each in fields(kind)}
    out: dict[str, Any] = {}
    for name, known in stored_facts(kind).items():
        key = known.key_of(name)
        there = f"{at}.{key}" if at else key
        value = found_at(content, key)
        if value is MISSING_HERE:
            given = (own[name].default, own[name].default_factory)
            if given != (MISSING, MISSING):
                continue
            if not known.brief:
                raise ValueError(f"{there}: is missing")
            value = None
        try:
            out[name] = scaled(as_kind(hints_of(kind)[name], value, known, there), 1 / known.scale)
        except CalibrationError as error:  # of a class that reads itself
            raise ValueError(str(error)) from error
    return out


def found_at(content: Any, key: str) -> Any:
    """What stands at a key, or at keys in each other, MISSING_HERE where nothing does."""
    for step in key.split("."):
        if not isinstance(content, Mapping) or step not in content:
            return MISSING_HERE
        content = content[step]
    return content


def as_kind(hint: Any, value: Any, known: Fact, at: str) -> Any:
    """JSON as a type: null is NaN where a number may be none.  Raises ValueError."""
    origin, args = get_origin(hint), get_args(hint)
    if hint in (Any, object):
        return value
    if origin is Annotated:
        return as_kind(args[0], value, known, at)
    if hint in WORDS:
        return among(value, known.among, at) if known.among else one_of(hint, value, known, at)
    if hint == Array:
        return array(value, at)
    if origin in (Union, UnionType):
        return in_union(args, value, known, at)
    if origin is Literal:
        return among(value, args, at)
    if origin is Later:
        now = as_kind(args[0], value, known, at)
        return Later(lambda: now)
    if origin is tuple or (origin is not None and issubclass(origin, Sequence)):
        return in_row(args, value, known, at)
    if origin is not None and issubclass(origin, Mapping):
        each = value.items() if isinstance(value, Mapping) else told(at, "an object")
        return {key: as_kind(args[1], part, known, f"{at}.{key}") for key, part in each}
    if hasattr(hint, "from_dict"):
        return hint.from_dict(value, at)
    if isinstance(hint, type) and is_dataclass(hint):
        return read(hint, value, at)
    if hasattr(hint, "_fields"):  # of two or three numbers with names
        part = value if isinstance(value, Mapping) else told(at, "an object")
        kinds = hints_of(hint)
        missing = [name for name in hint._fields if name not in part]
        if missing:
            raise ValueError(f"{at}.{missing[0]}: is missing")
        return hint(*(as_kind(kinds[n], part[n], known, f"{at}.{n}") for n in hint._fields))
    if issubclass(hint, Enum):
        return hint(among(value, tuple(one.value for one in hint), at))
    raise TypeError(f"{at}: no file holds a {hint}")


def told(at: str, what: str) -> Any:
    """Raise ValueError for a value of another kind."""
    raise ValueError(f"{at}: should be {what}")


def one_of(hint: type, value: Any, known: Fact, at: str) -> Any:
    """A number, text or truth value.  Raises ValueError."""
    if hint is float and value is None:
        return math.nan
    right = (float, int) if hint is float else hint
    if not isinstance(value, right) or (isinstance(value, bool) and hint is not bool):
        raise ValueError(f"{at}: should be {WORDS[hint]}")
    if isinstance(value, int | float) and not known.least <= value <= MOST:
        raise ValueError(f"{at}: cannot be {value:.6g}")
    return hint(value)


def among(value: Any, known: tuple[Any, ...], at: str) -> Any:
    """One of some values.  Raises ValueError."""
    if value not in known or isinstance(value, bool):
        raise ValueError(f"{at}: should be one of {', '.join(map(str, known))}")
    return value


def in_union(args: tuple[Any, ...], value: Any, known: Fact, at: str) -> Any:
    """A value of one of several types.  Raises ValueError of the last of them."""
    if value is None and NoneType in args:
        return None
    some = [one for one in args if one is not NoneType]
    for kind in some[:-1]:
        try:
            return as_kind(kind, value, known, at)
        except ValueError:
            continue
    return as_kind(some[-1], value, known, at)


def in_row(args: tuple[Any, ...], value: Any, known: Fact, at: str) -> tuple[Any, ...]:
    """A tuple from a list; of numbers all NaN from null.  Raises ValueError."""
    if args[-1] is ... or len(args) == 1:
        if not isinstance(value, list | tuple) or len(value) < known.fewest:
            told(at, "a list" + (f" of {known.fewest} or more" if known.fewest else ""))
        return tuple(as_kind(args[0], part, known, f"{at}[{i}]") for i, part in enumerate(value))
    if value is None and set(args) == {float}:
        return (math.nan,) * len(args)
    if not isinstance(value, list | tuple) or len(value) != len(args):
        told(at, f"a list of {len(args)}")
    pairs = enumerate(zip(args, value, strict=True))
    return tuple(as_kind(kind, part, known, f"{at}[{i}]") for i, (kind, part) in pairs)


def array(value: Any, at: str) -> Array:
    """An array of numbers, null for NaN.  Raises ValueError."""
    try:
        return numbers(value)
    except (TypeError, ValueError) as error:
        what = "holds something else than numbers in rows of one length"
        raise ValueError(f"{at}: {what}") from error


@contextmanager
def reading(source: str, part: str = "") -> Iterator[None]:
    """Turns what goes wrong while a file, or a part of it, is used into one line for people."""
    try:
        yield
    except FAULTS as error:
        what = f"its {part} " if part else ""
        raise CalibrationError(
            f"{source}: {what}cannot be read ({said(error)}); {AGAIN}"
        ) from error


def check_schema(content: Mapping[str, Any], source: str, known: int) -> None:
    """Raise CalibrationError for a file of another version."""
    if "schema" not in content:
        raise CalibrationError(f"{source}: does not say of which schema it is; {AGAIN}")
    if content["schema"] != known:
        raise CalibrationError(
            f"{source}: is of schema {content['schema']!r}, this version knows {known}; {AGAIN} of "
            "this version"
        )


# ---- for other programs ------------------------------------------------------------------------


def json_schema(kind: Any) -> dict[str, Any]:
    """The JSON schema of a file, for editors and other programs; of a result with what it says."""
    known = isinstance(kind, type) and is_dataclass(kind)
    whole = record_schema(kind) if known else plain(kind.model_json_schema())
    title = f"Result of minimax-cal {kind.COMMAND}" if known else "Robot file of minimax-cal"
    if known:
        marks = {"schema": {"const": kind.SCHEMA}, "kind": {"const": kind.KIND}}
        whole["properties"] = {**marks, **whole["properties"]}
        whole["required"] = [*marks, *whole["required"]]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **whole, "title": title}


def record_schema(kind: type) -> dict[str, Any]:
    """That of a dataclass: required is what it does not fill in itself."""
    own = {each.name: each for each in fields(kind)}
    out: dict[str, Any] = {"type": "object", "properties": {}, "required": []}
    if kind.__doc__ and not kind.__doc__.startswith(f"{kind.__name__}("):
        out["description"] = kind.__doc__.partition("\n")[0]
    for name, known in all_facts(kind).items():
        *inner, last = known.key_of(name).split(".")
        at = out
        fills = name not in own or known.brief
        fills = fills or (own[name].default, own[name].default_factory) != (MISSING, MISSING)
        for step in inner:
            at["required"] += [step] if step not in at["required"] and not fills else []
            empty = {"type": "object", "properties": {}, "required": []}
            at = at["properties"].setdefault(step, empty)
        at["properties"][last] = kind_schema(hints_of(kind)[name], known) if name in own else {}
        at["required"] += [] if fills else [last]
    return out


def kind_schema(hint: Any, known: Fact) -> dict[str, Any]:
    """That of a type; null stands for no number."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return kind_schema(args[0], known)
    least = {"minimum": known.least} if math.isfinite(known.least) else {}
    simple = {float: ["number", "null"], int: "integer", str: "string", bool: "boolean"}
    if known.among and hint is str:
        return {"enum": list(known.among)}
    if hint in simple:
        return {"type": simple[hint], **(least if hint in (float, int) else {})}
    if origin in (Union, UnionType):
        none = [{"type": "null"}] if NoneType in args else []
        return {"anyOf": [*(kind_schema(one, known) for one in args if one is not NoneType), *none]}
    if origin is Literal:
        return {"enum": list(args)}
    if origin is Later:
        return kind_schema(args[0], known)
    if origin is tuple and args[-1] is not ...:
        each = [kind_schema(one, known) for one in args]
        kinds = ["array", "null"] if set(args) == {float} else "array"
        return {"type": kinds, "prefixItems": each, "minItems": len(each), "maxItems": len(each)}
    if origin is not None and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": kind_schema(args[1], known)}
    if origin is not None and issubclass(origin, Sequence):
        fewest = {"minItems": known.fewest} if known.fewest else {}
        return {"type": "array", "items": kind_schema(args[0], known), **fewest}
    if hint == Array:
        return {"type": "array"}
    if hasattr(hint, "from_dict"):
        return {}
    if isinstance(hint, type) and is_dataclass(hint):
        return record_schema(hint)
    if hasattr(hint, "_fields"):
        parts = {name: kind_schema(one, known) for name, one in hints_of(hint).items()}
        return {"type": "object", "properties": parts, "required": list(parts)}
    return {"enum": [plain(one.value) for one in hint]} if isinstance(hint, type(Enum)) else {}
