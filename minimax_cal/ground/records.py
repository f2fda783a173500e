"""Parts of result files: numbers that may be missing, arrays of them, checked records."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Annotated, Any, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    WithJsonSchema,
)
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_before_validator_function

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, said
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
    if content.get("schema", 1) != known:
        raise CalibrationError(
            f"{source}: is of schema {content['schema']!r}, this version knows {known}; update "
            "minimax-cal"
        )


class Part(BaseModel):
    """A part of a file, as it was written; what later versions add is left alone."""

    model_config = ConfigDict(frozen=True, extra="ignore")


@dataclass(frozen=True)
class Gaps:
    """Numbers of a dataclass that are null in a file, or missing there unless required, are NaN."""

    required: tuple[str, ...] = ()

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """That of the dataclass, its gaps filled first."""
        floats = {field.name for field in fields(kind) if field.type in ("float", float)}
        unknown = dict.fromkeys(floats.difference(self.required), math.nan)

        def filled(value: object) -> object:
            if not isinstance(value, Mapping):
                return value
            null = {key: math.nan for key in floats if value.get(key, 0.0) is None}
            return {**unknown, **value, **null}

        return no_info_before_validator_function(filled, handler(kind))

    def __get_pydantic_json_schema__(
        self, core: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """That of the dataclass; only what is no number, or required, has to be there."""
        made = handler(core)
        inner: dict[str, Any] = handler.resolve_ref_schema(made)
        numbers = {
            name
            for name, part in inner.get("properties", {}).items()
            if part.get("type") == "number"
        }
        gone = numbers.difference(self.required)
        inner["required"] = [name for name in inner.get("required", ()) if name not in gone]
        return made


Kind = TypeVar("Kind")
Recorded = Annotated[Kind, Gaps()]  # a dataclass as it stands in a file, by its own annotations


Model = TypeVar("Model", bound=Part)


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
