"""YAML in, without what can blow up or means something else than it seems."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml

NOT_DECIMAL_PATTERN = re.compile(r"[-+]?0\d+|.*:.*")  # octal 0445, and 1:30, which is 90


class StrictYamlLoader(yaml.SafeLoader):
    """YAML without aliases, which a few lines can make larger than any memory.

    Every key stands once, and a number is what it reads as: no octal, no minutes and seconds.
    """

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """A node.  Raises YAMLError for an alias."""
        if self.check_event(yaml.AliasEvent):
            line = self.line + 1
            raise yaml.YAMLError(f"line {line}: an alias (*name); write the value out")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """A mapping.  Raises YAMLError for a key that stands twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.YAMLError(f"line {line}: a key that is no word; write one")
            if key.value in seen:
                raise yaml.YAMLError(f"line {line}: {key.value!r} stands twice; keep one")
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """An integer.  Raises YAMLError for one in another notation."""
        return int(super().construct_yaml_int(self.check_decimal_number(node)))

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """A number.  Raises YAMLError for one in another notation."""
        return float(super().construct_yaml_float(self.check_decimal_number(node)))

    def check_decimal_number(self, node: yaml.ScalarNode) -> yaml.ScalarNode:
        """The node of a number.  Raises YAMLError where YAML reads it as people do not."""
        if NOT_DECIMAL_PATTERN.fullmatch(node.value):
            line = node.start_mark.line + 1
            raise yaml.YAMLError(f"line {line}: {node.value} is no decimal number; write it plain")
        return node


for _kind in ("int", "float"):
    StrictYamlLoader.add_constructor(
        f"tag:yaml.org,2002:{_kind}", getattr(StrictYamlLoader, f"construct_yaml_{_kind}")
    )


def parse_strict_yaml(text: str) -> Any:
    """A YAML document.  Raises ValueError."""
    try:
        return yaml.load(text, StrictYamlLoader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
