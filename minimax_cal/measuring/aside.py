"""A measured point that takes no part in a fit, with the reason and by whom it was set aside."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

USER, FILE, TOOL = "user", "file", "tool"
WHO = {USER: "the user", FILE: "the measurement file", TOOL: "the program"}  # in sentences


@dataclass(frozen=True)
class SetAside:
    """A measured point that takes no part in a fit.

    row: line of the measurement file.  pose: its number among the poses of that file, from 1.  why:
    the reason; by: USER, FILE or TOOL.
    """

    row: int
    pose: int
    target: str
    why: str
    by: str


def counted(points: Sequence[SetAside]) -> str:
    """How many points, and by whom they were set aside, as 8 points set aside by the user."""
    count = Counter(point.by for point in points)
    several = len(count) > 1
    named = ", ".join(
        f"{count[by]} by {who}" if several else f"by {who}" for by, who in WHO.items() if count[by]
    )
    total = f"{len(points)} point{'s' * (len(points) != 1)} set aside"
    return f"{total} ({named})" if several else f"{total} {named}"
