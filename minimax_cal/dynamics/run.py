"""A run: joint values and torques of one trajectory, as a controller logged them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array

TORQUE = "N m"  # of a revolute joint; N of one that slides
CURRENT = "A"
NOTHING = ""  # where neither was logged, but commands
ROWS = ("time", "q", "qd", "qdd", "torque", "temperature", "command")  # what has a value a row


@dataclass(frozen=True, eq=False)
class Run:
    """One trajectory of n joints at m times.

    name: of the run, unique among those read together.  source: path of the file.
    time: (m,) increasing, evenly spaced or not [s].
    q: (m, n) joint values in the robot file's order, without jumps by whole turns [rad, m].
    qd, qdd: (m, n) the controller's own derivatives, where it logged them [rad/s, rad/s^2].
    torque: (m, n) measured at the joints or motors [unit]; 0 where it was not.
    unit: TORQUE, CURRENT or NOTHING.
    payload: mass at the flange, where it was reported [kg].
    temperature: (m, n), or (m,) of the whole arm [C].
    command: (m, n) joint values that were commanded, where all were logged [rad, m].
    notices: what the reader should know about the log.
    """

    name: str
    source: str
    time: Array
    q: Array
    qd: Array | None
    qdd: Array | None
    torque: Array
    unit: str
    payload: float | None = None
    temperature: Array | None = None
    notices: tuple[str, ...] = ()
    command: Array | None = None

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    @property
    def duration(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def step(self) -> float:
        """Typical time between rows [s]."""
        return float(np.median(np.diff(self.time)))

    def at(self, rows: Array) -> Run:
        """Some rows, time as it is.  rows: (m,) mask."""
        return replace(self, **rows_of(self, ROWS, rows))


def rows_of(record: Any, names: Sequence[str], rows: Array) -> dict[str, Any]:
    """Some rows of fields of a record, None where it has none."""
    every = {name: getattr(record, name) for name in names}
    return {name: None if value is None else value[rows] for name, value in every.items()}
