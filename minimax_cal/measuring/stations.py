"""Where the instrument stood in each session: points of several frames in one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.history import Clock
from minimax_cal.measuring.measurements import Measurements

Frames = Mapping[str, Array]  # (4, 4) of each session in the first one's frame, by label


@dataclass(frozen=True, eq=False)
class Sessions:
    """What a fit must know to place other measurements beside its own.

    frames: where the measurement frame of each session stands in the first one's, by label, the
    first one's first; empty where there was one frame only.  clock: None where rows have no time.
    """

    frames: Frames = field(default_factory=dict)
    clock: Clock | None = None

    @staticmethod
    def of(data: Measurements) -> Sessions:
        """Those of the data of a fit."""
        return Sessions(data.frames, Clock.of(data))


ALONE = Sessions()


def labels(data: Measurements) -> Array:
    """(m,) the session of each row as text, empty where there is none."""
    return data.columns.get("session", np.full(data.poses, "")).astype(str)


def station(data: Measurements, frames: Frames | None = None) -> Array:
    """(m,) number of the frame of each row; the first's where its session is not among them.

    frames: those of the data unless given.
    """
    known = list(data.frames if frames is None else frames)
    place = {label: number for number, label in enumerate(known)}
    names, row = np.unique(labels(data), return_inverse=True)
    numbers = np.array([place.get(str(name), 0) for name in names], dtype=int)
    return np.asarray(numbers[row.reshape(-1)])


def shifts(data: Measurements, frames: Frames) -> Array:
    """(m, 4, 4) what takes each row's points as they are given into the first of other frames."""
    new = np.stack(list(frames.values()))[station(data, frames)]
    if not data.frames:
        return np.asarray(new)
    old = np.stack(list(data.frames.values()))[station(data)]
    return np.asarray(new @ np.linalg.inv(old))


def moved(points: Array, shift: Array) -> Array:
    """Points (m, k, 3) moved by one pose for each row.  shift: (m, 4, 4)."""
    turned = np.einsum("mij,mkj->mki", shift[:, :3, :3], points)
    return np.asarray(turned + shift[:, None, :3, 3])


def seen_from(data: Measurements, frames: Frames) -> Measurements:
    """The data with all points in the first of some frames; as they are where there are none."""
    if not frames or frames is data.frames:
        return data
    return data.everywhere(
        lambda part: replace(part, y=moved(part.y, shifts(part, frames)), frames=frames)
    )


def stood(data: Measurements) -> Array:
    """(m, 3) where the instrument was, in the frame that the points are given in [m]."""
    if not data.frames:
        return np.zeros((data.poses, 3))
    return np.asarray(np.stack(list(data.frames.values()))[station(data), :3, 3])
