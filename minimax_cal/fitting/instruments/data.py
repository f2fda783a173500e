"""Measurements that are no coordinates, as every instrument has them: rows of joint values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self, TypeVar

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.measurements import Measurements


@dataclass(frozen=True, eq=False)
class RelativeData:
    """Joint values, and in a class of each instrument's own what was measured there.

    at: the m poses (q, line, columns), with points where these were measured.  kind: name of the
    instrument.  by_row: fields of its own with an entry for each pose.
    """

    at: Measurements
    kind: ClassVar[str]
    by_row: ClassVar[tuple[str, ...]] = ()

    @property
    def poses(self) -> int:
        """Number of rows."""
        return len(self.at.q)

    @property
    def numbers(self) -> Array:
        """(m,) how many numbers each row holds: one."""
        return np.ones(self.poses, dtype=int)

    @property
    def independent(self) -> int:
        """How many of them are independent of each other: those of different poses."""
        _, first = np.unique(groups(self.at), return_index=True)
        return int(self.numbers[first].sum())

    def count(self, held: Array) -> tuple[int, int]:
        """Numbers behind the errors of training and held-out rows.  held: (m,)."""
        return int(self.numbers[~held].sum()), int(self.numbers[held].sum())

    def check(self) -> None:
        """Raise DataError where no fit can make sense of them."""

    def check_training(self) -> None:
        """Raise DataError where they are too few to be fitted."""

    def columns(self) -> Mapping[str, Array]:
        """What was measured, by the names of a file's columns and in their units."""
        return {}

    def take(self, rows: Array) -> Self:
        """The measurements at some rows only.  rows: indices or a mask."""
        own = {name: getattr(self, name)[rows] for name in self.by_row}
        return replace(self, at=self.at.take(rows), **own)

    def in_block_order(self) -> Self:
        """The rows in the order in which the block of the instrument has its poses."""
        return self

    def says(self, row: int) -> str:
        """Where a row stands, for a message."""
        return f"{self.at.source}:{self.at.line[row]}"


D = TypeVar("D", bound=RelativeData)


def bare(q: Array, columns: Mapping[str, Array], **measured: Array) -> Measurements:
    """Poses without any point.  q: (m, n) [rad, m].  measured: by what the caller calls it."""
    q = np.array(q, dtype=float)
    if q.ndim != 2:
        raise DataError(f"q must be (m, n); got {q.shape}")
    extra = {name: np.asarray(column) for name, column in columns.items()}
    for name, column in (*measured.items(), *extra.items()):
        if len(column) != len(q):
            raise DataError(f"{name} has {len(column)} entries, but there are {len(q)} poses")
    sliding = np.zeros(q.shape[1], dtype=bool)
    return Measurements(q, np.zeros((len(q), 0, 3)), (), sliding, np.arange(len(q)) + 1, extra)


def checked(data: D) -> D:
    """The data, if a fit can make sense of them.  Raises DataError."""
    where = data.at.source
    if not data.poses:
        raise DataError(f"{where}: holds no poses")
    if not np.isfinite(data.at.q).all():
        row, joint = np.argwhere(~np.isfinite(data.at.q))[0]
        raise DataError(f"{data.says(row)}: joint {joint + 1} is not a finite number")
    if len(np.unique(groups(data.at))) == 1:
        raise DataError(
            f"{where}: holds one pose only; its joint values must differ from row to row"
        )
    data.check()
    return data


def without_blind(data: D, blind: Array) -> D:
    """The data of a file without the rows at which nothing was measured.  blind: (m,) mask."""
    path = data.at.source
    if blind.all():
        raise DataError(f"{path}: nothing was measured at any pose")
    if not blind.any():
        return data
    notice = f"{path}: {blind.sum()} rows hold nothing measured and are left out"
    data = data.take(~blind)
    return replace(data, at=replace(data.at, notices=(*data.at.notices, notice)))


def different(at: Measurements, rows: Array) -> int:
    """How many different poses some rows (m,) hold."""
    return len(np.unique(groups(at)[rows]))
