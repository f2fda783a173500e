"""A measurement file that grows by a row a pose; knows nothing of ROS."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

STILL = 1e-4  # rad or m that a joint may move while the arm counts as at rest
REST = 1.0  # s that it must have stood so


@dataclass
class Rest:
    """Whether the arm stands: its joints over the last second.

    names: of the joints, in the order of the file.
    """

    names: Sequence[str]
    seen: deque[tuple[float, list[float]]] = field(default_factory=deque)

    def hear(self, time: float, names: Sequence[str], values: Sequence[float]) -> None:
        """A joint state [s, rad or m]; one that lacks a joint is left out."""
        at = dict(zip(names, values, strict=False))
        if not all(math.isfinite(at.get(name, math.nan)) for name in self.names):
            return
        if self.seen and time <= self.seen[-1][0]:
            self.seen.clear()  # the clock went back, as where a bag begins again
        self.seen.append((time, [at[name] for name in self.names]))
        while len(self.seen) > 2 and self.seen[1][0] <= time - REST:
            self.seen.popleft()

    def joints(self) -> list[float] | None:
        """The mean of the joints while the arm stands, None where it moves or is too new."""
        if not self.seen or self.seen[-1][0] - self.seen[0][0] < REST:
            return None
        columns = list(zip(*(q for _, q in self.seen), strict=True))
        if any(max(column) - min(column) > STILL for column in columns):
            return None
        return [sum(column) / len(column) for column in columns]


def header(slides: Sequence[bool], targets: Sequence[str]) -> str:
    """The first line.  slides: whether each joint is a slide."""
    joints = [f"q{i + 1}_{'m' if slide else 'rad'}" for i, slide in enumerate(slides)]
    points = [f"{name}_{axis}_mm" for name in targets for axis in "xyz"]
    return ",".join(["pose", *joints, *points])


def row(
    pose: int,
    joints: Sequence[float],
    points: Mapping[str, Sequence[float]],
    targets: Sequence[str],
) -> str:
    """A pose.  joints: [rad, m].  points: by target [m]; one that is not seen stays empty."""
    cells = [str(pose), *(f"{q:.9f}" for q in joints)]
    for name in targets:
        cells += [f"{1e3 * v:.6f}" for v in points[name]] if name in points else ["", "", ""]
    return ",".join(cells)
