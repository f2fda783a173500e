"""Records of files: frozen dataclasses read, and described to other programs, by their annotations.

What writes them is `files.convert_to_plain_json`.  A class with `to_dict` and `from_dict(content,
source)` stands in a file in its own way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, describe_file_content_error
from minimax_cal.core.files import MAX_JSON_NUMBER, array_from_json, convert_to_plain_json
from minimax_cal.core.record_fields import (
    FieldFormat,
    LazyValue,
    all_field_formats,
    field_type_hints,
    scale_numbers,
    stored_field_formats,
)

WRITE_AGAIN_ADVICE = "write it again with minimax-cal"
FILE_CONTENT_ERRORS = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)
MISSING_VALUE = object()
TYPE_DESCRIPTIONS = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}

RecordType = TypeVar("RecordType")


# ---- reading -----------------------------------------------------------------------------------


def parse_record(record_type: type[RecordType], content: Any, location: str = "") -> RecordType:
    """A record from its JSON; keys that it does not know are left alone.

    location: its place in the file.  Raises ValueError, which names the place.
    """
    return record_type(**parse_record_fields(record_type, content, location))


def parse_record_fields(record_type: type, content: Any, location: str = "") -> dict[str, Any]:
    """What a record holds by itself, SI, by the names of its fields.  Raises ValueError."""
    if not isinstance(content, Mapping):
        raise ValueError(f"{location or 'it'}: should be an object")
    own = {each.name: each for each in fields(record_type)}
    out: dict[str, Any] = {}
    for name, known in stored_field_formats(record_type).items():
        key = known.json_key(name)
        there = f"{location}.{key}" if location else key
        value = find_by_dotted_key(content, key)
        if value is MISSING_VALUE:
            given = (own[name].default, own[name].default_factory)
            if given != (MISSING, MISSING):
                continue
            if not known.brief:
                raise ValueError(f"{there}: is missing")
            value = None
        try:
            out[name] = scale_numbers(
                parse_as_type(field_type_hints(record_type)[name], value, known, there),
                1 / known.scale,
            )
        except CalibrationError as error:  # of a class that reads itself
            raise ValueError(str(error)) from error
    return out


def find_by_dotted_key(content: Any, dotted_key: str) -> Any:
    """What stands at a key, or at keys in each other, MISSING_HERE where nothing does."""
    for step in dotted_key.split("."):
        if not isinstance(content, Mapping) or step not in content:
            return MISSING_VALUE
        content = content[step]
    return content


def parse_as_type(annotation: Any, value: Any, field_format: FieldFormat, location: str) -> Any:
    """JSON as a type: null is NaN where a number may be none.  Raises ValueError."""
    origin, args = get_origin(annotation), get_args(annotation)
    if annotation in (Any, object):
        return value
    if origin is Annotated:
        return parse_as_type(args[0], value, field_format, location)
    if annotation in TYPE_DESCRIPTIONS:
        return (
            check_one_of_choices(value, field_format.among, location)
            if field_format.among
            else parse_scalar(annotation, value, field_format, location)
        )
    if annotation == Array:
        return parse_array(value, location)
    if origin in (Union, UnionType):
        return parse_union(args, value, field_format, location)
    if origin is Literal:
        return check_one_of_choices(value, args, location)
    if origin is LazyValue:
        now = parse_as_type(args[0], value, field_format, location)
        return LazyValue(lambda: now)
    if origin is tuple or (origin is not None and issubclass(origin, Sequence)):
        return parse_tuple(args, value, field_format, location)
    if origin is not None and issubclass(origin, Mapping):
        each = (
            value.items() if isinstance(value, Mapping) else raise_wrong_kind(location, "an object")
        )
        return {
            key: parse_as_type(args[1], part, field_format, f"{location}.{key}")
            for key, part in each
        }
    if hasattr(annotation, "from_dict"):
        return annotation.from_dict(value, location)
    if isinstance(annotation, type) and is_dataclass(annotation):
        return parse_record(annotation, value, location)
    if hasattr(annotation, "_fields"):  # of two or three numbers with names
        part = value if isinstance(value, Mapping) else raise_wrong_kind(location, "an object")
        kinds = field_type_hints(annotation)
        missing = [name for name in annotation._fields if name not in part]
        if missing:
            raise ValueError(f"{location}.{missing[0]}: is missing")
        return annotation(
            *(
                parse_as_type(kinds[n], part[n], field_format, f"{location}.{n}")
                for n in annotation._fields
            )
        )
    if issubclass(annotation, Enum):
        return annotation(
            check_one_of_choices(value, tuple(one.value for one in annotation), location)
        )
    raise TypeError(f"{location}: no file holds a {annotation}")


def raise_wrong_kind(location: str, expected_kind: str) -> NoReturn:
    """Raise ValueError for a value of another kind."""
    raise ValueError(f"{location}: should be {expected_kind}")


def parse_scalar(scalar_type: type, value: Any, field_format: FieldFormat, location: str) -> Any:
    """A number, text or truth value.  Raises ValueError."""
    if scalar_type is float and value is None:
        return math.nan
    right = (float, int) if scalar_type is float else scalar_type
    if not isinstance(value, right) or (isinstance(value, bool) and scalar_type is not bool):
        raise ValueError(f"{location}: should be {TYPE_DESCRIPTIONS[scalar_type]}")
    if isinstance(value, int | float) and not field_format.least <= value <= MAX_JSON_NUMBER:
        raise ValueError(f"{location}: cannot be {value:.6g}")
    return scalar_type(value)


def check_one_of_choices(value: Any, choices: tuple[Any, ...], location: str) -> Any:
    """One of some values.  Raises ValueError."""
    if value not in choices or isinstance(value, bool):
        raise ValueError(f"{location}: should be one of {', '.join(map(str, choices))}")
    return value


def parse_union(
    member_types: tuple[Any, ...], value: Any, field_format: FieldFormat, location: str
) -> Any:
    """A value of one of several types.  Raises ValueError of the last of them."""
    if value is None and NoneType in member_types:
        return None
    some = [one for one in member_types if one is not NoneType]
    for kind in some[:-1]:
        try:
            return parse_as_type(kind, value, field_format, location)
        except ValueError:
            continue
    return parse_as_type(some[-1], value, field_format, location)


def parse_tuple(
    item_types: tuple[Any, ...], value: Any, field_format: FieldFormat, location: str
) -> tuple[Any, ...]:
    """A tuple from a list; of numbers all NaN from null.  Raises ValueError."""
    if item_types[-1] is ... or len(item_types) == 1:
        if not isinstance(value, list | tuple) or len(value) < field_format.fewest:
            raise_wrong_kind(
                location,
                "a list" + (f" of {field_format.fewest} or more" if field_format.fewest else ""),
            )
        return tuple(
            parse_as_type(item_types[0], part, field_format, f"{location}[{i}]")
            for i, part in enumerate(value)
        )
    if value is None and set(item_types) == {float}:
        return (math.nan,) * len(item_types)
    if not isinstance(value, list | tuple) or len(value) != len(item_types):
        raise_wrong_kind(location, f"a list of {len(item_types)}")
    pairs = enumerate(zip(item_types, value, strict=True))
    return tuple(
        parse_as_type(kind, part, field_format, f"{location}[{i}]") for i, (kind, part) in pairs
    )


def parse_array(value: Any, location: str) -> Array:
    """An array of numbers, null for NaN.  Raises ValueError."""
    try:
        return array_from_json(value)
    except (TypeError, ValueError) as error:
        what = "holds something else than numbers in rows of one length"
        raise ValueError(f"{location}: {what}") from error


@contextmanager
def raise_read_errors_as_calibration_error(source: str, part: str = "") -> Iterator[None]:
    """Turns what goes wrong while a file, or a part of it, is used into one line for people."""
    try:
        yield
    except FILE_CONTENT_ERRORS as error:
        what = f"its {part} " if part else ""
        raise CalibrationError(
            f"{source}: {what}cannot be read ({describe_file_content_error(error)}); "
            f"{WRITE_AGAIN_ADVICE}"
        ) from error


def check_schema_version(content: Mapping[str, Any], source: str, supported_version: int) -> None:
    """Raise CalibrationError for a file of another version."""
    if "schema" not in content:
        raise CalibrationError(
            f"{source}: does not say of which schema it is; {WRITE_AGAIN_ADVICE}"
        )
    if content["schema"] != supported_version:
        raise CalibrationError(
            f"{source}: is of schema {content['schema']!r}, this version "
            f"knows {supported_version}; {WRITE_AGAIN_ADVICE} of "
            "this version"
        )


# ---- for other programs ------------------------------------------------------------------------


def build_json_schema(result_type: Any) -> dict[str, Any]:
    """The JSON schema of a file, for editors and other programs; of a result with what it says."""
    known = isinstance(result_type, type) and is_dataclass(result_type)
    whole = (
        build_record_schema(result_type)
        if known
        else convert_to_plain_json(result_type.model_json_schema())
    )
    title = f"Result of minimax-cal {result_type.COMMAND}" if known else "Robot file of minimax-cal"
    if known:
        marks = {"schema": {"const": result_type.SCHEMA}, "kind": {"const": result_type.KIND}}
        whole["properties"] = {**marks, **whole["properties"]}
        whole["required"] = [*marks, *whole["required"]]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **whole, "title": title}


def build_record_schema(record_type: type) -> dict[str, Any]:
    """That of a dataclass: required is what it does not fill in itself."""
    own = {each.name: each for each in fields(record_type)}
    out: dict[str, Any] = {"type": "object", "properties": {}, "required": []}
    if record_type.__doc__ and not record_type.__doc__.startswith(f"{record_type.__name__}("):
        out["description"] = record_type.__doc__.partition("\n")[0]
    for name, known in all_field_formats(record_type).items():
        *inner, last = known.json_key(name).split(".")
        at = out
        fills = name not in own or known.brief
        fills = fills or (own[name].default, own[name].default_factory) != (MISSING, MISSING)
        for step in inner:
            at["required"] += [step] if step not in at["required"] and not fills else []
            empty = {"type": "object", "properties": {}, "required": []}
            at = at["properties"].setdefault(step, empty)
        at["properties"][last] = (
            build_type_schema(field_type_hints(record_type)[name], known) if name in own else {}
        )
        at["required"] += [] if fills else [last]
    return out


def build_type_schema(annotation: Any, field_format: FieldFormat) -> dict[str, Any]:
    """That of a type; null stands for no number."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return build_type_schema(args[0], field_format)
    least = {"minimum": field_format.least} if math.isfinite(field_format.least) else {}
    simple = {float: ["number", "null"], int: "integer", str: "string", bool: "boolean"}
    if field_format.among and annotation is str:
        return {"enum": list(field_format.among)}
    if annotation in simple:
        return {"type": simple[annotation], **(least if annotation in (float, int) else {})}
    if origin in (Union, UnionType):
        none = [{"type": "null"}] if NoneType in args else []
        return {
            "anyOf": [
                *(build_type_schema(one, field_format) for one in args if one is not NoneType),
                *none,
            ]
        }
    if origin is Literal:
        return {"enum": list(args)}
    if origin is LazyValue:
        return build_type_schema(args[0], field_format)
    if origin is tuple and args[-1] is not ...:
        each = [build_type_schema(one, field_format) for one in args]
        kinds = ["array", "null"] if set(args) == {float} else "array"
        return {"type": kinds, "prefixItems": each, "minItems": len(each), "maxItems": len(each)}
    if origin is not None and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": build_type_schema(args[1], field_format)}
    if origin is not None and issubclass(origin, Sequence):
        fewest = {"minItems": field_format.fewest} if field_format.fewest else {}
        return {"type": "array", "items": build_type_schema(args[0], field_format), **fewest}
    if annotation == Array:
        return {"type": "array"}
    if hasattr(annotation, "from_dict"):
        return {}
    if isinstance(annotation, type) and is_dataclass(annotation):
        return build_record_schema(annotation)
    if hasattr(annotation, "_fields"):
        parts = {
            name: build_type_schema(one, field_format)
            for name, one in field_type_hints(annotation).items()
        }
        return {"type": "object", "properties": parts, "required": list(parts)}
    return (
        {"enum": [convert_to_plain_json(one.value) for one in annotation]}
        if isinstance(annotation, type(Enum))
        else {}
    )
