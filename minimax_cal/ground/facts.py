"""Facts of a result: how a field, or a property, stands in its file, and what people read of it.

Said once, where the field is declared.  From there read what writes and reads the file, its JSON
schema, the terminal, the report and the page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cache, cached_property
from typing import Any, TypeVar

Value = TypeVar("Value")
METADATA = "fact"


@dataclass(frozen=True)
class Fact:
    """A value in a file and in words.

    words: of the number in the file's unit, as "{:.2f} s"; what has none is not shown to people.
    key: in the JSON, the field's own name unless given.  scale: what a number is multiplied by
    there, as 1e3 for millimetres.
    """

    words: str = ""
    key: str = ""
    scale: float = 1.0


def fact(words: str = "", key: str = "", scale: float = 1.0) -> Mapping[str, Fact]:
    """Metadata of a field of a dataclass that is a fact of it: see `Fact`."""
    return {METADATA: Fact(words, key, scale)}


class Derived(cached_property[Value]):
    """A property that is a fact too: written and shown, not read, for other facts determine it."""

    fact: Fact


def derived(
    words: str = "", key: str = "", scale: float = 1.0
) -> Callable[[Callable[[Any], Value]], Derived[Value]]:
    """Make a property a fact: see `Fact`."""

    def made(worked_out: Callable[[Any], Value]) -> Derived[Value]:
        found = Derived(worked_out)
        found.fact = Fact(words, key, scale)
        return found

    return made


# ---- which there are ---------------------------------------------------------------------------

Facts = Mapping[str, Fact]  # by the name of the field


@cache
def stored_facts(kind: type) -> Facts:
    """Fields of a dataclass that are facts."""
    return {own.name: own.metadata[METADATA] for own in fields(kind) if METADATA in own.metadata}


@cache
def derived_facts(kind: type) -> Facts:
    """Properties of a class that are facts."""
    return {name: each.fact for name, each in vars(kind).items() if isinstance(each, Derived)}


@cache
def record_facts(kind: type) -> Facts:
    """All fields of a dataclass that is in a file as a whole, each under its name unless said."""
    return {own.name: own.metadata.get(METADATA, Fact()) for own in fields(kind)}


# ---- what is done with them --------------------------------------------------------------------


def in_file(record: Any, facts: Facts) -> dict[str, Any]:
    """Values of a record by their keys in the file, in its units."""
    return {
        known.key or name: scaled(getattr(record, name), known.scale)
        for name, known in facts.items()
    }


def from_file(part: Any, facts: Facts) -> dict[str, Any]:
    """The inverse of `in_file`: SI, by the names of the fields.  part: has these names already."""
    return {name: scaled(getattr(part, name), 1.0 / known.scale) for name, known in facts.items()}


def scaled(value: Any, factor: float) -> Any:
    """A number, a tuple of some, or an array, times a factor; anything else where that is one."""
    if factor == 1.0:
        return value
    if isinstance(value, tuple):
        return tuple(scaled(part, factor) for part in value)
    return value * factor


def facts_in_words(record: object) -> str:
    """What people are shown of a record, as "condition 80, 12 iterations, 0.05 s"."""
    kind: type = type(record)
    return ", ".join(
        known.words.format(scaled(getattr(record, name), known.scale))
        for name, known in {**stored_facts(kind), **derived_facts(kind)}.items()
        if known.words
    )
