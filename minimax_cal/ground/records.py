"""Parts of result files: numbers that may be missing, arrays of them, checked records."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationError,
    WithJsonSchema,
    create_model,
)
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_after_validator_function

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, said
from minimax_cal.ground.facts import from_file, record_facts, scaled, stored_facts
from minimax_cal.ground.files import numbers, plain

AGAIN = "write it again with minimax-cal"
FAULTS = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)


def number_or_nan(value: object) -> object:
    """JSON has null where there is no number."""
    return math.nan if value is None else value


def pair_or_nan(value: object) -> object:
    """An interval that is not known."""
    return (math.nan, math.nan) if value is None else value


def array_or_fault(value: object) -> Array:
    """An array of numbers, null for NaN.  Raises ValueError."""
    try:
        return numbers(value)
    except (TypeError, ValueError) as error:
        raise ValueError("holds something else than numbers in rows of one length") from error


NUMBER = {"type": ["number", "null"]}
PAIR = {"type": ["array", "null"], "items": NUMBER, "minItems": 2, "maxItems": 2}
Number = Annotated[float, BeforeValidator(number_or_nan)]
Ends = Annotated[tuple[Number, Number], BeforeValidator(pair_or_nan), WithJsonSchema(PAIR)]
Values = Annotated[Any, BeforeValidator(array_or_fault), WithJsonSchema({"type": "array"})]
Count = Annotated[int, Field(ge=0, lt=10**9)]
Square = Annotated[float, Field(ge=0.0)]
UNKNOWN = (math.nan, math.nan)


def json_schema(kind: type[BaseModel], title: str) -> dict[str, Any]:
    """The JSON schema of a file, for editors and other programs; null stands for no number."""
    made: dict[str, Any] = plain(nullable(kind.model_json_schema()))  # null for a default NaN
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **made, "title": title}


def nullable(schema: Any) -> Any:
    """A JSON schema in which a number may be null, as it is written where there is none."""
    if isinstance(schema, list):
        return [nullable(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    made = {key: nullable(value) for key, value in schema.items()}
    return made | ({"type": ["number", "null"]} if schema.get("type") == "number" else {})


def check_schema(content: Mapping[str, Any], source: str, known: int) -> None:
    """Raise CalibrationError for a file of another version."""
    if "schema" not in content:
        raise CalibrationError(f"{source}: does not say of which schema it is; {AGAIN}")
    if content["schema"] != known:
        raise CalibrationError(
            f"{source}: is of schema {content['schema']!r}, this version knows {known}; {AGAIN} of "
            "this version"
        )


class Part(BaseModel):
    """A part of a file, as it was written; what later versions add is left alone."""

    model_config = ConfigDict(frozen=True, extra="ignore")


Kind = TypeVar("Kind")
Model = TypeVar("Model", bound=Part)


def as_read(hint: Any) -> Any:
    """A type as a file holds it: null where there is no number, records field by field."""
    if hint is float:
        return Number
    if hint == Array:
        return Values
    if isinstance(hint, type) and is_dataclass(hint):
        return Annotated[hint, Gaps()]
    inner = tuple(part if part is ... else as_read(part) for part in get_args(hint))
    if get_origin(hint) is tuple:
        return tuple.__class_getitem__(inner)
    if get_origin(hint) in (Union, UnionType):
        return Union.__getitem__(inner)
    return hint


def part_with(name: str, base: type[Model], kind: type) -> type[Model]:
    """A part of a file that holds the stored facts of a dataclass too: all but those that are None.

    Such a fact may be missing in the file, as it is not written.
    """
    hints = get_type_hints(kind, include_extras=True)
    own: dict[str, Any] = {}
    for field, known in stored_facts(kind).items():
        default: Any = None if NoneType in get_args(hints[field]) else ...
        own[field] = (as_read(hints[field]), Field(default, alias=known.key or field))
    return create_model(name, __base__=base, __module__=kind.__module__, **own)


@cache
def part_of(kind: type, required: tuple[str, ...] = ()) -> type[Part]:
    """A part of a file that holds all fields of a dataclass.

    Those with a default may miss there, and numbers too, which are NaN then, unless required.
    """
    hints, facts = get_type_hints(kind, include_extras=True), record_facts(kind)
    own: dict[str, Any] = {}
    for each in fields(kind):
        known, hint = facts[each.name], as_read(hints[each.name])
        default: Any = ...
        if each.default is not MISSING:
            default = scaled(each.default, known.scale)
        elif hint is Number and each.name not in required:
            default = math.nan
        filled = {"default": default}
        if each.default_factory is not MISSING:
            filled = {"default_factory": each.default_factory}
        own[each.name] = (hint, Field(alias=known.key or each.name, **filled))
    return create_model(kind.__name__, __base__=Part, __doc__=kind.__doc__, **own)


@dataclass(frozen=True)
class Gaps:
    """How a dataclass stands in a file: see `part_of`."""

    required: tuple[str, ...] = ()

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """That of its part of the file, which is made the dataclass."""

        def made(part: Part) -> Any:
            return kind(**from_file(part, record_facts(kind)))

        part = handler.generate_schema(part_of(kind, self.required))
        return no_info_after_validator_function(made, part)


Recorded = Annotated[Kind, Gaps()]  # a dataclass as it stands in a file, by its own annotations


def checked(model: type[Model], content: Mapping[str, Any], source: str) -> Model:
    """A file as its schema.  Raises CalibrationError."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{source}: {explain(error)}; {AGAIN}") from error


def explain(error: ValidationError) -> str:
    """The first complaint of a schema, as place and text."""
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"])
    return f"{place}: {first['msg']}" if place else str(first["msg"])


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
