"""YAML in, without what can blow up."""

from __future__ import annotations

from typing import Any

import yaml


class WrittenOut(yaml.SafeLoader):
    """YAML without aliases, which a few lines can make larger than any memory."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """A node.  Raises YAMLError for an alias."""
        if self.check_event(yaml.AliasEvent):
            line = self.line + 1
            raise yaml.YAMLError(f"line {line}: an alias (*name); write the value out")
        return super().compose_node(parent, index)


def parsed(text: str) -> Any:
    """A YAML document.  Raises ValueError."""
    try:
        return yaml.load(text, WrittenOut)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
