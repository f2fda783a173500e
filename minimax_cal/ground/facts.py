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
class Fact:
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

    def key_of(self, name: str) -> str:
        """Its key where the field has a name."""
        return self.key or (f"{name}_{self.unit}" if self.unit else name)


APART = Fact(apart=True)
Apart = Annotated[Value, APART]
Milli = Annotated[Value, Fact(scale=1e3, unit="mm")]  # metres, in millimetres in files
Mm = Milli[float]


class Derived(cached_property[Value]):
    """A property that is a fact too: written and shown, not read, for other facts determine it."""

    fact: Fact


def derived(words: str = "", **told: Any) -> Callable[[Callable[[Any], Value]], Derived[Value]]:
    """Make a property a fact: see `Fact`."""

    def made(worked_out: Callable[[Any], Value]) -> Derived[Value]:
        found = Derived(worked_out)
        found.fact = Fact(words, **told)
        return found

    return made


class Later(Generic[Value]):
    """A fact that is worked out when it is first asked for."""

    def __init__(self, made: Callable[[], Value]) -> None:
        self.made = made

    @cached_property
    def value(self) -> Value:
        """The fact."""
        return self.made()


@cache
def hints_of(kind: type) -> Mapping[str, Any]:
    """Types of the fields of a class."""
    return get_type_hints(kind, include_extras=True)


@cache
def stored_facts(kind: type) -> Mapping[str, Fact]:
    """Of every field of a dataclass that its file holds by itself, by the field's name."""
    hints = hints_of(kind)
    every = {own.name: fact_of(hints[own.name]) for own in fields(kind)}
    return {name: known for name, known in every.items() if not known.apart}


def fact_of(hint: Any) -> Fact:
    """What the annotation of a field says."""
    told = (one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Fact))
    return next(told, Fact())


@cache
def derived_facts(kind: type) -> Mapping[str, Fact]:
    """Of the properties of a class that are facts, those of its bases first."""
    every = [vars(base).items() for base in reversed(kind.__mro__)]
    return {name: each.fact for own in every for name, each in own if isinstance(each, Derived)}


@cache
def all_facts(kind: type) -> Mapping[str, Fact]:
    """Of the fields and of the properties of a class, none where it is no dataclass."""
    return {**stored_facts(kind), **derived_facts(kind)} if is_dataclass(kind) else {}


def in_file(record: Any) -> dict[str, Any]:
    """Values of a record by their keys in the file, in its units."""
    kind: type = type(record)
    out: dict[str, Any] = {}
    for name, known in all_facts(kind).items():
        value = getattr(record, name)
        if known.brief and (value is None or (isinstance(value, Sized) and not len(value))):
            continue
        *inner, last = known.key_of(name).split(".")
        at = out
        for step in inner:
            at = at.setdefault(step, {})
        at[last] = in_digits(scaled(value, known.scale)) if known.scale != 1.0 else value
    return out


def in_digits(value: Any) -> Any:
    """Numbers in 15 digits: read in another unit and written again they are the same text."""
    if isinstance(value, float):
        return float(f"{value:.15g}")
    if isinstance(value, Mapping):
        return {key: in_digits(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        parts = map(in_digits, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return in_digits(value.tolist()) if hasattr(value, "tolist") else value


def scaled(value: Any, factor: float) -> Any:
    """Numbers times a factor: one, an array, or those of a tuple or mapping; None stays."""
    if factor == 1.0 or value is None:
        return value
    if isinstance(value, Mapping):
        return {key: scaled(part, factor) for key, part in value.items()}
    if isinstance(value, tuple):
        parts = (scaled(part, factor) for part in value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value * factor


def facts_in_words(record: object) -> str:
    """What people are shown of a record, as "condition 80, 12 iterations, 0.05 s"."""
    kind: type = type(record)
    return ", ".join(
        known.words.format(scaled(getattr(record, name), known.scale))
        for name, known in all_facts(kind).items()
        if known.words
    )
