"""Measured poses inside a result file: joints, points, errors, and which were held out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, DataError, describe_file_content_error
from minimax_cal.core.files import array_from_json, convert_to_plain_json
from minimax_cal.core.record_parsing import FILE_CONTENT_ERRORS, WRITE_AGAIN_ADVICE
from minimax_cal.measuring.measurements import MAX_POINT_DISTANCE, Measurements, measurements
from minimax_cal.measuring.visit_history import has_order_numbers, rows_in_visit_order
from minimax_cal.modelling.cell import Cell
from minimax_cal.reading.measurement_table import MEASUREMENT_TEXT_KINDS

SKIPPED_POSE_COLUMNS = ("split", "order")  # columns that stand under names of their own


def build_pose_records(
    data: Measurements, is_held: Array, errors_by_name: Mapping[str, Array]
) -> dict[str, Any]:
    """For JSON: every pose as measured, with its errors by name; null where not measured.

    is_held: (m,) True where held out.  errors_by_name: (m, k, 3) measured minus predicted [m].
    """
    place = np.empty(data.poses, dtype=int)
    place[rows_in_visit_order(data)] = np.arange(1, data.poses + 1)
    columns = {
        name: column if name in MEASUREMENT_TEXT_KINDS else column.astype(float)
        for name, column in data.columns.items()
        if name not in SKIPPED_POSE_COLUMNS
    }
    whole = {
        "source": data.source,
        "line": data.line,
        "split": np.where(is_held, "holdout", "train"),
        "visit": place,
        "visits_told": has_order_numbers(data),
        "q": data.q,
        "q_units": ["m" if sliding else "rad" for sliding in data.sliding],
        "targets": data.target_names,
        "measured_mm": 1e3 * data.y,
        "errors_mm": {name: 1e3 * error for name, error in errors_by_name.items()},
        "columns": columns,
        **({"simulated": True} if data.simulated else {}),
    }
    return dict(convert_to_plain_json(whole))


def parse_pose_records(content: Mapping[str, Any], source: str) -> tuple[Measurements, Array]:
    """Measurements and (m,) which are held out, from `build_pose_records`.  Raises DataError."""
    try:
        columns = {
            name: np.array(column) if name in MEASUREMENT_TEXT_KINDS else array_from_json(column)
            for name, column in content["columns"].items()
        }
        if content.get("visits_told", True):
            columns["order"] = np.array(content["visit"], dtype=float)
        data = measurements(
            array_from_json(content["q"]), 1e-3 * array_from_json(content["measured_mm"])
        )
        held = np.array(content["split"]) == "holdout"
        line = np.array(content["line"], dtype=int)
        names = tuple(map(str, content["targets"]))
        sliding = np.array(content["q_units"]) == "m"
        short = [len(part) for part in (*columns.values(), held, line)]
        if set(short) != {data.poses} or (len(names), len(sliding)) != (
            data.y.shape[1], data.q.shape[1]
        ):  # fmt: skip
            raise ValueError("its parts differ in length")
    except (KeyError, TypeError, ValueError, AttributeError, DataError) as error:
        raise DataError(
            f"{source}: its list of poses cannot be read ({describe_file_content_error(error)}); "
            "write the file again with minimax-cal calibrate"
        ) from error
    known = Measurements(data.q, data.y, names, sliding, line, columns, source=source)
    return replace(known, simulated=content.get("simulated") is True), held


MAX_REPRODUCED_ERROR_DIFFERENCE = (
    1e-6  # a file's own errors come back to this, or it lacks columns of the measurements [m]
)


def parse_measured_poses(
    content: Mapping[str, Any], source: str, cell: Cell | None, nominal_name: str
) -> tuple[Measurements, Array, tuple[Array, Array]]:
    """The poses of a result file, (m,) which are held out, and errors (m, k, 3) of `nominal_name`
    and `final` as they stand there [m].  None where the file has none.  Raises CalibrationError.
    """  # fmt: skip
    if content.get("poses") is None or cell is None:
        nowhere = np.zeros((0, 0, 3)) if cell is None else np.zeros((0, len(cell.target_names), 3))
        joints = cell.robot.joints if cell else 0
        nothing, lines = np.zeros((0, joints)), np.zeros(0, dtype=int)
        names = cell.target_names if cell else ()
        data = Measurements(nothing, nowhere, names, np.zeros(joints, dtype=bool), lines, {})
        return replace(data, source=source), np.zeros(0, dtype=bool), (nowhere, nowhere)
    given = content["poses"]
    data, held = parse_pose_records(given, source)
    try:
        if data.q.shape[1] != cell.robot.joints or set(data.target_names) - set(cell.target_names):
            raise ValueError("joints or targets are not those of the robot")
        errors = (
            parse_saved_errors(given, nominal_name, data),
            parse_saved_errors(given, "final", data),
        )
        frames = cell.sessions.frames  # points were written as the first session saw them
        return replace(data, source=str(given["source"]), frames=frames), held, errors
    except FILE_CONTENT_ERRORS as error:
        raise CalibrationError(
            f"{source}: its list of poses cannot be read "
            f"({describe_file_content_error(error)}); {WRITE_AGAIN_ADVICE}"
        ) from error


def parse_saved_errors(records: Mapping[str, Any], name: str, data: Measurements) -> Array:
    """(m, k, 3) errors of a name as they stand in a file [m].  Raises ValueError."""
    told = 1e-3 * array_from_json(records["errors_mm"][name])
    if told.shape != data.y.shape:
        raise ValueError(f"errors_mm.{name} differs in length")
    if np.nanmax(np.abs(told), initial=0.0) > MAX_POINT_DISTANCE:
        raise ValueError(f"errors_mm.{name} holds a distance that no instrument measures")
    return np.where(np.isfinite(told), told, np.nan)


def compute_or_restore_errors(cell: Cell, data: Measurements, saved_errors: Array) -> Array:
    """(m, k, 3) errors of a cell [m]: worked out, or as they stand in a file that lacks columns of
    the measurements which its effects look at.
    """  # fmt: skip
    if not data.poses:
        return saved_errors
    exact = cell.error(data)
    return exact if are_errors_reproduced(exact, saved_errors) else saved_errors


def are_errors_reproduced(computed_errors: Array, saved_errors: Array) -> bool:
    """Whether errors (m, k, 3), worked out from a file's columns, are those that it tells [m]."""
    return bool(
        np.nanmax(np.abs(computed_errors - saved_errors), initial=0.0)
        <= MAX_REPRODUCED_ERROR_DIFFERENCE
    )
