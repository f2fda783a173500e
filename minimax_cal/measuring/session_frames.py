"""Where the instrument stood in each session: points of several frames in one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import SessionClock

Frames = Mapping[str, Array]  # (4, 4) of each session in the first one's frame, by label


@dataclass(frozen=True, eq=False)
class SessionFrames:
    """What a fit must know to place other measurements beside its own.

    frames: where the measurement frame of each session stands in the first one's, by label, the
    first one's first; empty where there was one frame only.  clock: None where rows have no time.
    """

    frames: Frames = field(default_factory=dict)
    clock: SessionClock | None = None

    @staticmethod
    def from_measurements(data: Measurements) -> SessionFrames:
        """Those of the data of a fit."""
        return SessionFrames(data.frames, SessionClock.from_measurements(data))


NO_SESSION_FRAMES = SessionFrames()


def session_labels(data: Measurements) -> Array:
    """(m,) the session of each row as text, empty where there is none."""
    return data.columns.get("session", np.full(data.poses, "")).astype(str)


def frame_index_of_rows(data: Measurements, frames: Frames | None = None) -> Array:
    """(m,) number of the frame of each row; the first's where its session is not among them.

    frames: those of the data unless given.
    """
    known = list(data.frames if frames is None else frames)
    place = {label: number for number, label in enumerate(known)}
    names, row = np.unique(session_labels(data), return_inverse=True)
    numbers = np.array([place.get(str(name), 0) for name in names], dtype=int)
    return np.asarray(numbers[row.reshape(-1)])


def transforms_to_first_frame(data: Measurements, frames: Frames) -> Array:
    """(m, 4, 4) what takes each row's points as they are given into the first of other frames."""
    new = np.stack(list(frames.values()))[frame_index_of_rows(data, frames)]
    if not data.frames:
        return np.asarray(new)
    old = np.stack(list(data.frames.values()))[frame_index_of_rows(data)]
    return np.asarray(new @ np.linalg.inv(old))


def transform_points(points: Array, transforms: Array) -> Array:
    """Points (m, k, 3) moved by one pose for each row.  transforms: (m, 4, 4)."""
    turned = np.einsum("mij,mkj->mki", transforms[:, :3, :3], points)
    return np.asarray(turned + transforms[:, None, :3, 3])


def convert_to_first_frame(data: Measurements, frames: Frames) -> Measurements:
    """The data with all points in the first of some frames; as they are where there are none."""
    if not frames or frames is data.frames:
        return data
    return data.change_with_set_aside(
        lambda part: replace(
            part, y=transform_points(part.y, transforms_to_first_frame(part, frames)), frames=frames
        )
    )


def instrument_positions(data: Measurements) -> Array:
    """(m, 3) where the instrument was, in the frame that the points are given in [m]."""
    if not data.frames:
        return np.zeros((data.poses, 3))
    return np.asarray(np.stack(list(data.frames.values()))[frame_index_of_rows(data), :3, 3])
