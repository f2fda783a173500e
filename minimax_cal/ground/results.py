"""What every result can do: JSON and its file, plain text, a notebook."""

from __future__ import annotations

from abc import abstractmethod
from html import escape
from pathlib import Path
from typing import Any

from minimax_cal.ground.files import json_text, write_whole
from minimax_cal.ground.tables import Table


class Result:
    """A record that people and programs read: it has `headline`, `tables` and `to_dict`."""

    @abstractmethod
    def headline(self) -> str:
        """The result in a sentence or two."""

    @abstractmethod
    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The JSON of the contract, and more."""

    def json(self) -> str:
        """`to_dict` as text."""
        return json_text(self.to_dict())

    def save(self, path: Path | str) -> None:
        """Write the JSON; never a half-written file."""
        write_whole(path, self.json())

    def summary(self, width: int = 110) -> str:
        """The result as plain text."""
        return "\n\n".join([self.headline(), *(table.text(width) for table in self.tables())])

    def _repr_html_(self) -> str:
        """For a notebook."""
        tables = "\n".join(table.html() for table in self.tables())
        return f"<p>{escape(self.headline())}</p>\n{tables}"
