"""Facts of a record: how a field, or a property, stands in its file, and what people read of it.

Said once, where the field is declared.  From there read what writes and reads the file, its JSON
schema, the terminal, the report and the page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sized
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, cached_property
from typing import Annotated, Any, Generic, TypeVar, get_type_hints

Value = TypeVar("Value")


@dataclass(frozen=True)
class FieldFormat:
    """A value in a file and in words: the annotation of a field that is more than its name there.

    words: of the number in the file's unit, as "{:.2f} s"; what has none is not shown to people.
    key: in the JSON, the field's own name with its unit unless given; dots where objects hold it.
    scale: what a number is multiplied by there, as 1e3 for millimetres.  unit: there, for the key.
    brief: left out where it is None or empty.  least: no number of it is smaller.
    fewest: of its parts.  among: which texts it may be.  apart: told by `results.Result.beside`.
    """

    words: str = ""
    key: str = ""
    scale: float = 1.0
    unit: str = ""
    brief: bool = False
    least: float = float("-inf")
    fewest: int = 0
    among: tuple[str, ...] = ()
    apart: bool = False

    def json_key(self, field_name: str) -> str:
        """Its key where the field has a name."""
        return self.key or (f"{field_name}_{self.unit}" if self.unit else field_name)


SEPARATE_FIELD_FORMAT = FieldFormat(apart=True)
StoredSeparately = Annotated[Value, SEPARATE_FIELD_FORMAT]
InMillimetres = Annotated[
    Value, FieldFormat(scale=1e3, unit="mm")
]  # metres, in millimetres in files
LengthInMillimetres = InMillimetres[float]


class DerivedField(cached_property[Value]):
    """A property that is a fact too: written and shown, not read, for other facts determine it."""

    field_format: FieldFormat


def derived_field(
    text_format: str = "", **format_options: Any
) -> Callable[[Callable[[Any], Value]], DerivedField[Value]]:
    """Make a property a fact: see `FieldFormat`."""

    def made(worked_out: Callable[[Any], Value]) -> DerivedField[Value]:
        found = DerivedField(worked_out)
        found.field_format = FieldFormat(text_format, **format_options)
        return found

    return made


class LazyValue(Generic[Value]):
    """A fact that is worked out when it is first asked for."""

    def __init__(self, compute: Callable[[], Value]) -> None:
        self.compute = compute

    @cached_property
    def value(self) -> Value:
        """The fact."""
        return self.compute()


@cache
def field_type_hints(record_type: type) -> Mapping[str, Any]:
    """Types of the fields of a class."""
    return get_type_hints(record_type, include_extras=True)


@cache
def stored_field_formats(record_type: type) -> Mapping[str, FieldFormat]:
    """Of every field of a dataclass that its file holds by itself, by the field's name."""
    hints = field_type_hints(record_type)
    every = {own.name: field_format_from_annotation(hints[own.name]) for own in fields(record_type)}
    return {name: known for name, known in every.items() if not known.apart}


def field_format_from_annotation(annotation: Any) -> FieldFormat:
    """What the annotation of a field says."""
    told = (one for one in getattr(annotation, "__metadata__", ()) if isinstance(one, FieldFormat))
    return next(told, FieldFormat())


@cache
def derived_field_formats(record_type: type) -> Mapping[str, FieldFormat]:
    """Of the properties of a class that are facts, those of its bases first."""
    every = [vars(base).items() for base in reversed(record_type.__mro__)]
    return {
        name: each.field_format
        for own in every
        for name, each in own
        if isinstance(each, DerivedField)
    }


@cache
def all_field_formats(record_type: type) -> Mapping[str, FieldFormat]:
    """Of the fields and of the properties of a class, none where it is no dataclass."""
    return (
        {**stored_field_formats(record_type), **derived_field_formats(record_type)}
        if is_dataclass(record_type)
        else {}
    )


def record_to_file_values(record: Any) -> dict[str, Any]:
    """Values of a record by their keys in the file, in its units."""
    kind: type = type(record)
    out: dict[str, Any] = {}
    for name, known in all_field_formats(kind).items():
        value = getattr(record, name)
        if known.brief and (value is None or (isinstance(value, Sized) and not len(value))):
            continue
        *inner, last = known.json_key(name).split(".")
        at = out
        for step in inner:
            at = at.setdefault(step, {})
        at[last] = (
            round_to_15_digits(scale_numbers(value, known.scale)) if known.scale != 1.0 else value
        )
    return out


def round_to_15_digits(value: Any) -> Any:
    """Numbers in 15 digits: read in another unit and written again they are the same text."""
    if isinstance(value, float):
        return float(f"{value:.15g}")
    if isinstance(value, Mapping):
        return {key: round_to_15_digits(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        parts = map(round_to_15_digits, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return round_to_15_digits(value.tolist()) if hasattr(value, "tolist") else value


def scale_numbers(value: Any, factor: float) -> Any:
    """Numbers times a factor: one, an array, or those of a tuple or mapping; None stays."""
    if factor == 1.0 or value is None:
        return value
    if isinstance(value, Mapping):
        return {key: scale_numbers(part, factor) for key, part in value.items()}
    if isinstance(value, tuple):
        parts = (scale_numbers(part, factor) for part in value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value * factor


def format_record_fields(record: object) -> str:
    """What people are shown of a record, as "condition 80, 12 iterations, 0.05 s"."""
    kind: type = type(record)
    return ", ".join(
        known.words.format(scale_numbers(getattr(record, name), known.scale))
        for name, known in all_field_formats(kind).items()
        if known.words
    )
