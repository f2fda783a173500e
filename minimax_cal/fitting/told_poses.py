"""The poses of a result's file: as they were measured, with the errors of its arms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, said
from minimax_cal.ground.files import numbers
from minimax_cal.ground.records import AGAIN, FAULTS
from minimax_cal.measuring.measurements import FARTHEST, Measurements
from minimax_cal.measuring.pose_rows import read_poses
from minimax_cal.modelling.cell import Cell

NEAR = 1e-6  # a file's own errors come back to this, or it lacks columns of the measurements [m]


def measured_poses(
    content: Mapping[str, Any], source: str, cell: Cell | None, first: str
) -> tuple[Measurements, Array, tuple[Array, Array]]:
    """The poses of a result file, (m,) which are held out, and errors (k, m, 3) of `first` and
    `final` as they stand there [m].  None where the file has none.  Raises CalibrationError.
    """  # fmt: skip
    if content.get("poses") is None or cell is None:
        nowhere = np.zeros((0, 0, 3)) if cell is None else np.zeros((0, len(cell.target_names), 3))
        joints = cell.robot.joints if cell else 0
        nothing, lines = np.zeros((0, joints)), np.zeros(0, dtype=int)
        names = cell.target_names if cell else ()
        data = Measurements(nothing, nowhere, names, np.zeros(joints, dtype=bool), lines, {})
        none = np.moveaxis(nowhere, 1, 0)
        return replace(data, source=source), np.zeros(0, dtype=bool), (none, none)
    given = content["poses"]
    data, held = read_poses(given, source)
    try:
        if data.q.shape[1] != cell.robot.joints or set(data.target_names) - set(cell.target_names):
            raise ValueError("joints or targets are not those of the robot")
        errors = (told_errors(given, first, data), told_errors(given, "final", data))
        frames = cell.sessions.frames  # points were written as the first session saw them
        return replace(data, source=str(given["source"]), frames=frames), held, errors
    except FAULTS as error:
        raise CalibrationError(
            f"{source}: its list of poses cannot be read ({said(error)}); {AGAIN}"
        ) from error


def told_errors(given: Mapping[str, Any], name: str, data: Measurements) -> Array:
    """(k, m, 3) errors of a name as they stand in a file [m].  Raises ValueError."""
    told = 1e-3 * numbers(given["errors_mm"][name])
    if told.shape != data.y.shape:
        raise ValueError(f"errors_mm.{name} differs in length")
    if np.nanmax(np.abs(told), initial=0.0) > FARTHEST:
        raise ValueError(f"errors_mm.{name} holds a distance that no instrument measures")
    return np.moveaxis(np.where(np.isfinite(told), told, np.nan), 1, 0)


def errors_of(cell: Cell | None, data: Measurements, told: Array) -> Array:
    """(k, m, 3) errors of a cell [m]: worked out, or as they stand in a file that lacks columns of
    the measurements which its effects look at.
    """  # fmt: skip
    if cell is None or not data.poses:
        return told
    exact = cell.error(data)
    same = np.nanmax(np.abs(exact - told), initial=0.0) <= NEAR
    return exact if same else told
