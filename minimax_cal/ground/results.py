"""What every result can do: JSON and its file, plain text, a notebook."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, ClassVar, Self

from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.facts import in_file
from minimax_cal.ground.files import json_text, plain, saved_content, write_whole
from minimax_cal.ground.records import AGAIN, check_schema, reading, stored
from minimax_cal.ground.tables import Table


class Record:
    """A dataclass of facts that users look into: it tells itself as a file would."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dict(plain(in_file(self)))


class Result:
    """A record that people and programs read: a dataclass with `headline` and `tables`.

    KIND: what its file says that it is.  COMMAND: what writes such a file.
    """

    SCHEMA: ClassVar[int] = 1
    KIND: ClassVar[str]
    COMMAND: ClassVar[str] = ""

    @abstractmethod
    def headline(self) -> str:
        """The result in a sentence or two."""

    def table(self) -> Table:
        """The table of a result that has one alone."""
        raise NotImplementedError

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        return (self.table(),)

    def first_tables(self) -> Sequence[Table]:
        """What stands on a first screen."""
        return (self.tables()[0].brief(),)

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """What of its file its fields do not tell by themselves.

        poses: whether with what was measured, which of many poses is nearly all of it.
        """
        return {}

    @classmethod
    def told_beside(
        cls, content: Mapping[str, Any], told: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """The fields that are `apart`, and others put right, from a file.

        told: what its other fields hold.  Raises CalibrationError, or one of `records.FAULTS`.
        """
        return {}

    def to_dict(self, *, poses: bool = True) -> dict[str, Any]:
        """The JSON of the contract, and more; `from_dict` reads it back.  poses: see `beside`."""
        named = {"schema": self.SCHEMA, "kind": self.KIND}
        return merged(merged(named, plain(in_file(self))), plain(self.beside(poses=poses)))

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: str = "") -> Self:
        """From `to_dict`.  Raises CalibrationError."""
        source = source or cls.KIND.replace("_", " ")
        check_schema(content, source, cls.SCHEMA)
        if content.get("kind") != cls.KIND:
            raise CalibrationError(f"{source}: is no {cls.KIND}; {AGAIN} {cls.COMMAND}".rstrip())
        with reading(source):
            told = stored(cls, content)
            return cls(**{**told, **cls.told_beside(content, told, source)})

    @classmethod
    def load(cls, path: Self | Path | str) -> Self:
        """From its file; a result stays as it is.  Raises CalibrationError."""
        if isinstance(path, Path | str):
            return cls.from_dict(saved_content(path), str(path))
        return path

    def json(self, *, poses: bool = True) -> str:
        """`to_dict` as text."""
        return json_text(self.to_dict(poses=poses))

    def save(self, path: Path | str, *, poses: bool = True) -> None:
        """Write the JSON; never a half-written file."""
        write_whole(path, self.json(poses=poses))

    def summary(self, width: int = 110) -> str:
        """The result as plain text."""
        return "\n\n".join([self.headline(), *(table.text(width) for table in self.tables())])

    def _repr_html_(self) -> str:
        """For a notebook."""
        tables = "\n".join(table.html() for table in self.tables())
        return f"<p>{escape(self.headline())}</p>\n{tables}"


def merged(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Two objects in one, those that both hold likewise."""
    both = {k: merged(one[k], v) for k, v in other.items() if isinstance(one.get(k), Mapping)}
    return {**one, **other, **both}
