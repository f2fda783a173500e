"""What every result can do: JSON and its file, plain text, a notebook."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, ClassVar, Self

from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.files import (
    convert_to_plain_json,
    format_json,
    read_saved_result_json,
    write_file_atomically,
)
from minimax_cal.core.record_fields import record_to_file_values
from minimax_cal.core.record_parsing import (
    WRITE_AGAIN_ADVICE,
    check_schema_version,
    parse_record_fields,
    raise_read_errors_as_calibration_error,
)
from minimax_cal.core.tables import Table


class JsonRecord:
    """A dataclass of facts that users look into: it tells itself as a file would."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dict(convert_to_plain_json(record_to_file_values(self)))


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
        return (self.tables()[0].shorten(),)

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """What of its file its fields do not tell by themselves.

        with_measurements: whether with what was measured, which of many poses is nearly all of it.
        """
        return {}

    @classmethod
    def parse_extra_fields(
        cls, content: Mapping[str, Any], parsed_fields: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """The fields that are `apart`, and others put right, from a file.

        parsed_fields: what its other fields hold.  Raises CalibrationError, or one of
        `records.FAULTS`.
        """
        return {}

    def to_dict(self, *, poses: bool = True) -> dict[str, Any]:
        """The JSON of the contract, and more; `from_dict` reads it back.  poses: see
        `extra_file_content`.
        """
        named = {"schema": self.SCHEMA, "kind": self.KIND}
        return merge_nested_mappings(
            merge_nested_mappings(named, convert_to_plain_json(record_to_file_values(self))),
            convert_to_plain_json(self.extra_file_content(with_measurements=poses)),
        )

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: str = "") -> Self:
        """From `to_dict`.  Raises CalibrationError."""
        source = source or cls.KIND.replace("_", " ")
        check_schema_version(content, source, cls.SCHEMA)
        if content.get("kind") != cls.KIND:
            raise CalibrationError(
                f"{source}: is no {cls.KIND}; {WRITE_AGAIN_ADVICE} {cls.COMMAND}".rstrip()
            )
        with raise_read_errors_as_calibration_error(source):
            told = parse_record_fields(cls, content)
            return cls(**{**told, **cls.parse_extra_fields(content, told, source)})

    @classmethod
    def load(cls, path: Self | Path | str) -> Self:
        """From its file; a result stays as it is.  Raises CalibrationError."""
        if isinstance(path, Path | str):
            return cls.from_dict(read_saved_result_json(path), str(path))
        return path

    def json(self, *, poses: bool = True) -> str:
        """`to_dict` as text."""
        return format_json(self.to_dict(poses=poses))

    def save(self, path: Path | str, *, poses: bool = True) -> None:
        """Write the JSON; never a half-written file."""
        write_file_atomically(path, self.json(poses=poses))

    def summary(self, width: int = 110) -> str:
        """The result as plain text."""
        return "\n\n".join([self.headline(), *(table.text(width) for table in self.tables())])

    def _repr_html_(self) -> str:
        """For a notebook."""
        tables = "\n".join(table.html() for table in self.tables())
        return f"<p>{escape(self.headline())}</p>\n{tables}"


def merge_nested_mappings(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Two objects in one, those that both hold likewise."""
    both = {
        k: merge_nested_mappings(first[k], v)
        for k, v in second.items()
        if isinstance(first.get(k), Mapping)
    }
    return {**first, **second, **both}
