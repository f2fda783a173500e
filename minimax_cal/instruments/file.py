"""Files of instruments: CSV in, CSV out, joint columns as in a measurement file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import csv_text, write_whole
from minimax_cal.instruments.instrument import Columns, Instrument, checked
from minimax_cal.instruments.table import INSTRUMENTS, instrument
from minimax_cal.instruments.tracker import Points, points
from minimax_cal.measuring.campaigns import read_campaigns
from minimax_cal.measuring.measurements import Measurements, file_column, measurements_in
from minimax_cal.reading.rows import TARGET, Rows, read_rows

Given = Instrument | Measurements | str | Path
Numbers = NDArray[Any] | Sequence[Sequence[float]] | Sequence[Sequence[Sequence[float]]]
JointsAndPoints = tuple[Numbers, Numbers]  # (m, n) and (m, 3) or (m, k, 3)
PointData = Measurements | Points | JointsAndPoints  # of trackers
InstrumentData = Instrument | Sequence[Instrument | Measurements]  # of others, or of several


def columns_of(path: Path | str, header: Sequence[str]) -> Columns:
    """Those of the instrument that a header announces.  Raises DataError."""
    every = [one.file for one in map(instrument, INSTRUMENTS) if one.file]
    found: list[tuple[str, Columns]] = []
    for columns in every:
        names = [name for name in header if columns.announce.fullmatch(name)]
        wrong = [name for name in names if not columns.own.fullmatch(name)]
        if wrong:
            raise DataError(
                f"{path}:1: column {wrong[0]} is not understood; write {columns.written}"
            )
        found += [(names[0], columns)] if names else []
    if not found:
        named = ", or ".join(each.written for each in every)
        raise DataError(f"{path}:1: no measured columns; name them {named}")
    first = [each for each in found if not each[1].yields] or found
    if len(first) > 1:
        raise DataError(
            f"{path}:1: columns {first[0][0]} and {first[1][0]} are of different kinds; put them "
            "into two files"
        )
    return first[0][1]


def taken(data: Given | Sequence[Given | Rows]) -> Measurements | list[Instrument]:
    """What data, their files or rows hold: points of trackers, or measurements of instruments.

    Several files of trackers are campaigns of one arm.  Raises DataError.
    """
    given = [data] if isinstance(data, Given) else list(data)
    if not given:
        raise DataError("no file of measurements is given")
    every = [read_rows(one) if isinstance(one, str | Path) else one for one in given]
    if not all(map(of_tracker, every)):
        return [
            points(measurements_in(one)) if has_points(one) else as_instrument(one) for one in every
        ]
    sheets = [one.sheet for one in every if isinstance(one, Rows)]
    if len(given) > max(len(sheets), 1):
        raise DataError("several sets of points are campaigns: give their files")
    if len(every) > 1:
        return read_campaigns(sheets)
    lone = every[0]
    if isinstance(lone, Instrument):
        return lone.at
    return measurements_in(lone) if isinstance(lone, Rows) else lone


def has_points(data: Rows | Instrument | Measurements) -> TypeGuard[Rows]:
    """Whether a file has columns of reflectors."""
    return isinstance(data, Rows) and any(map(TARGET.fullmatch, data.header))


def of_tracker(data: Rows | Instrument | Measurements) -> bool:
    """Whether data are points of a tracker, or of nothing that is known."""
    if isinstance(data, Rows):
        return has_points(data) or not is_announced(data.header)
    return isinstance(data, Measurements) or data.kind == Points.kind


def is_announced(header: Sequence[str]) -> bool:
    """Whether a header says which instrument it is of."""
    every = [one.file.announce for one in map(instrument, INSTRUMENTS) if one.file]
    return any(announce.fullmatch(name) for announce in every for name in header)


def as_instrument(data: Rows | Instrument | Measurements | Path | str) -> Instrument:
    """The measurements of an instrument, as they are or of a file.  Raises DataError."""
    if isinstance(data, Instrument):
        return data
    rows = read_rows(data) if isinstance(data, str | Path) else data
    if isinstance(rows, Rows) and (is_announced(rows.header) or rows.own):
        return checked(columns_of(rows.path, rows.header).read(rows))
    return points(measurements_in(rows) if isinstance(rows, Rows) else rows)


def read_relative(path: Path | str) -> Instrument:
    """Read a CSV file of any instrument, by its columns.  Raises DataError."""
    return as_instrument(path)


def write_relative(path: Path | str, data: Instrument) -> None:
    """Write CSV as `read_relative` reads it: radians (mm for slides) and millimetres."""
    at = data.at
    columns: dict[str, Array] = {
        f"q{i + 1}_{'mm' if slides else 'rad'}": at.q[:, i] * (1e3 if slides else 1.0)
        for i, slides in enumerate(at.sliding)
    }
    columns |= data.columns()
    for stem, column in at.columns.items():
        name, factor = file_column(stem)
        columns[name] = column if column.dtype.kind == "U" else factor * column
    rows = ([cell(value) for value in row] for row in zip(*columns.values(), strict=True))
    write_whole(path, csv_text([list(columns), *rows]))


def cell(value: str | float) -> str:
    """A label as it is, a number to nine decimals; nothing for NaN."""
    if isinstance(value, str):
        return str(value)
    return "" if np.isnan(value) else f"{value:.9f}"
