"""Visits of a ball to sockets: their file, which are held out, and what an error is about."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from minimax_cal.fitting.instruments.data import (
    RelativeData,
    bare,
    checked,
    different,
    without_blind,
)
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.grouping import groups, held_out
from minimax_cal.measuring.joint_rows import joint_rows
from minimax_cal.reading.rows import Rows

SOCKET = re.compile("socket")
WHOLE = 5  # sockets from which on whole ones are held out


@dataclass(frozen=True, eq=False)
class Visits(RelativeData):
    """Visits to sockets.

    socket: (m,) label of the socket that held the ball.
    """

    socket: Array

    kind = "closures"
    by_row = ("socket",)

    @property
    def sockets(self) -> tuple[str, ...]:
        """The sockets' labels, in alphabetical order."""
        return tuple(str(label) for label in np.unique(self.socket))

    @property
    def independent(self) -> int:
        """Three for each different pose in a socket but the first."""
        return sum(3 * (different(self.at, self.socket == label) - 1) for label in self.sockets)

    def count(self, held: Array) -> tuple[int, int]:
        """Three less for each barycentre."""
        return free_numbers(self.socket, held)

    def check(self) -> None:
        """Raise DataError for a socket that was not visited again with other joint values."""
        group = groups(self.at)
        for label in self.sockets:
            rows = np.flatnonzero(self.socket == label)
            if len(np.unique(group[rows])) < 2:
                often = "once" if len(rows) == 1 else "with the same joint values only"
                raise DataError(
                    f"{self.says(rows[0])}: column socket: {label!r} is visited {often}; visit it "
                    "again with other joint values, or leave the cell empty"
                )

    def in_block_order(self) -> Self:
        """Visits of one socket together."""
        return self.take(np.argsort(self.socket, kind="stable"))

    def columns(self) -> Mapping[str, Array]:
        """The labels."""
        return {"socket": self.socket}


def closures(q: Array, socket: Array, **columns: Array) -> Visits:
    """Sockets visited again, from arrays.  q: (m, n) [rad, m].  socket: (m,) labels."""
    labels = np.asarray(socket).astype(str)
    return checked(Visits(bare(q, columns, socket=labels), labels))


def read(file: Rows) -> Visits:
    """The sockets' labels.  Raises DataError."""
    file, at = joint_rows(file, SOCKET)
    labels = np.array(file.text("socket"))
    return without_blind(Visits(at, labels), np.asarray(labels == ""))


def held_back(data: Visits, options: RelativeOptions) -> tuple[Array, tuple[str, ...]]:
    """(m,) True where a visit is held out; sockets of known distances stay."""
    needed = tuple(label for known in options.known_distances for label in known[:2])
    return split_sockets(data, options.holdout, options.seed, needed)


def split_sockets(
    data: Visits, holdout: float, seed: int, needed: tuple[str, ...]
) -> tuple[Array, tuple[str, ...]]:
    """(m,) True where a visit is held out, and a notice that says what was chosen.

    Whole sockets where there are enough: nothing of them shaped the fit.  Else visits, of which
    each socket keeps two.  needed: sockets that must stay, those of known distances.
    """
    held, notices = held_out(data.at, holdout, seed)  # raises for a wrong option
    if "split" in data.at.columns:
        gone = [label for label in needed if held[data.socket == label].all()]
        if gone:
            raise DataError(
                f"{data.at.source}: column split holds out all of socket {gone[0]!r}, whose "
                "distance is given with known_distances=; leave some of its visits in training"
            )
        return held, notices
    if holdout == 0.0:
        return held, notices
    rng = np.random.default_rng(seed)
    labels = np.array(data.sockets)
    loose = labels[~np.isin(labels, needed)]
    whole = round(holdout * len(labels))
    if len(labels) >= WHOLE and 0 < whole <= len(loose):
        chosen = rng.permutation(loose)[:whole]
        notice = (
            f"{whole} of {len(labels)} sockets are held out whole, their own barycentres fitted: "
            "an error is about that barycentre, three degrees of freedom less for each socket"
        )
        return np.isin(data.socket, chosen), (notice,)
    held = spare_visits(data, holdout, rng)
    count = f"{len(labels)} socket{'s' if len(labels) > 1 else ''}"
    notice = (
        f"with {count}, visits are held out, not sockets: an error is about the barycentre of the "
        "training visits"
    )
    return held, (notice,)


def spare_visits(data: Visits, holdout: float, rng: np.random.Generator) -> Array:
    """(m,) True for a share of the visits; each socket keeps two different poses."""
    pose = groups(data.at)
    held = np.zeros(data.poses, dtype=bool)
    wanted = round(holdout * data.poses)
    for chosen in rng.permutation(np.unique(pose)):
        if held.sum() >= wanted:
            break
        rows = pose == chosen
        rest = ~held & ~rows
        left = [
            len(np.unique(pose[rest & (data.socket == label)]))
            for label in np.unique(data.socket[rows])
        ]
        if min(left) >= 2:
            held |= rows
    return held


def misclosures(place: Array, socket: Array, held: Array) -> Array:
    """Errors of visits as if about known sockets: (m, 3) [m], NaN where nothing closes.

    place: (m, 3) of the ball by some model [m].  socket: (m,) labels.  held: (m,) True where held
    out.  A visit is about the barycentre of its socket's training visits, n in number, of which it
    is one: sqrt(n/(n-1)) makes up for it.  In a socket held out whole it is the same, about its own
    barycentre.  A held-out visit about n training visits holds their error too: sqrt(n/(n+1)).
    """
    error = np.full(place.shape, np.nan)
    for label in np.unique(socket):
        here = socket == label
        about = here & ~held if (here & ~held).any() else here
        n, apart = int(about.sum()), here & ~about
        centre = place[about].mean(axis=0)
        error[apart] = (place[apart] - centre) * np.sqrt(n / (n + 1.0))
        if n > 1:
            error[about] = (place[about] - centre) * np.sqrt(n / (n - 1.0))
    return error


def free_numbers(socket: Array, held: Array) -> tuple[int, int]:
    """Independent coordinates of training and held-out visits: three less for each barycentre."""
    trained, left = np.unique(socket[~held]), np.unique(socket[held])
    alone = len(left) - int(np.isin(left, trained).sum())
    return 3 * (int((~held).sum()) - len(trained)), 3 * (int(held.sum()) - alone)
