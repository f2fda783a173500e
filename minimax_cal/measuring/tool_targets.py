"""Several tools or adapters in one file: each has reflectors of its own places, as smr1@gripper."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from minimax_cal.core.errors import DataError
from minimax_cal.measuring.measurements import Measurements

TOOL_SEPARATOR = "@"  # between a reflector and its tool
MAX_TOOLS = 50
NOT_TARGET_NAME_PATTERN = re.compile(r"[^\w.-]+")  # what no name of a target holds


def split_targets_by_tool(data: Measurements) -> Measurements:
    """The data with the reflectors of each tool as targets of their own.

    As they are where a file has no column `tool`, or one tool alone.  Raises DataError.
    """
    if "tool" not in data.columns or any(TOOL_SEPARATOR in name for name in data.target_names):
        return data
    labels = np.array(
        [NOT_TARGET_NAME_PATTERN.sub("-", str(cell).strip()) for cell in data.columns["tool"]]
    )
    tools = list(dict.fromkeys(labels))
    if len(tools) < 2:
        return data
    if len(tools) > MAX_TOOLS:
        raise DataError(f"{data.source}: column tool: {len(tools)} tools; is it another number?")
    if not all(tools):
        line = data.line[int(np.argmax(labels == ""))]
        raise DataError(f"{data.source}:{line}: column tool is empty; name the tool of each pose")
    parts, names = [], []
    for tool in tools:
        mine = np.where((labels == tool)[:, None, None], data.y, np.nan)
        for target, name in enumerate(data.target_names):
            if np.isfinite(mine[:, target]).any():
                parts.append(mine[:, target])
                names.append(f"{name}{TOOL_SEPARATOR}{tool}")
    return replace(data, y=np.stack(parts, axis=1), target_names=tuple(names))


def join_targets_of_tools(data: Measurements) -> Measurements:
    """The inverse of `split_targets_by_tool`, as a file has it."""
    stems = [name.partition(TOOL_SEPARATOR)[0] for name in data.target_names]
    names = tuple(dict.fromkeys(stems))
    if len(names) == len(stems):
        return replace(data, target_names=names)
    y = np.full((data.poses, len(names), 3), np.nan)
    for target, stem in enumerate(stems):
        seen = data.seen[:, target]
        y[seen, names.index(stem)] = data.y[seen, target]
    return replace(data, y=y, target_names=names)
