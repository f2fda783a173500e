"""Measured poses inside a result file: joints, points, errors, and which were held out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, said
from minimax_cal.ground.files import numbers, plain
from minimax_cal.measuring.history import numbered, visits
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.reading.rows import TEXT

TOLD = ("split", "order")  # columns that stand under names of their own


def pose_rows(data: Measurements, held: Array, errors: Mapping[str, Array]) -> dict[str, Any]:
    """For JSON: every pose as measured, with its errors by name; null where not measured.

    held: (m,) True where held out.  errors: (k, m, 3) measured minus predicted [m].
    """
    place = np.empty(data.poses, dtype=int)
    place[visits(data)] = np.arange(1, data.poses + 1)
    columns = {
        name: column if name in TEXT else column.astype(float)
        for name, column in data.columns.items()
        if name not in TOLD
    }
    whole = {
        "source": data.source,
        "line": data.line,
        "split": np.where(held, "holdout", "train"),
        "visit": place,
        "visits_told": numbered(data),
        "q": data.q,
        "q_units": ["m" if sliding else "rad" for sliding in data.sliding],
        "targets": data.target_names,
        "measured_mm": 1e3 * data.y,
        "errors_mm": {name: 1e3 * np.moveaxis(error, 0, 1) for name, error in errors.items()},
        "columns": columns,
        **({"simulated": True} if data.simulated else {}),
    }
    return dict(plain(whole))


def read_poses(content: Mapping[str, Any], source: str) -> tuple[Measurements, Array]:
    """Measurements and (m,) which are held out, from `pose_rows`.  Raises DataError."""
    try:
        columns = {
            name: np.array(column) if name in TEXT else numbers(column)
            for name, column in content["columns"].items()
        }
        if content.get("visits_told", True):
            columns["order"] = np.array(content["visit"], dtype=float)
        data = measurements(numbers(content["q"]), 1e-3 * numbers(content["measured_mm"]))
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
            f"{source}: its list of poses cannot be read ({said(error)}); write the file "
            "again with minimax-cal calibrate"
        ) from error
    known = Measurements(data.q, data.y, names, sliding, line, columns, source=source)
    return replace(known, simulated=content.get("simulated") is True), held
