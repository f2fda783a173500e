"""Files of instruments: CSV in, CSV out, joint columns as in a measurement file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.core.files import format_csv, write_file_atomically
from minimax_cal.instruments.instrument import Instrument, InstrumentColumns, check_instrument_data
from minimax_cal.instruments.instrument_registry import INSTRUMENT_CLASSES, load_instrument_class
from minimax_cal.instruments.tracker_points import TrackerPoints, build_tracker_points
from minimax_cal.measuring.campaigns import read_campaigns
from minimax_cal.measuring.measurements import (
    Measurements,
    build_measurements,
    file_column_name_and_scale,
)
from minimax_cal.reading.measurement_table import (
    TARGET_COLUMN_PATTERN,
    MeasurementTable,
    read_measurement_table,
)

InstrumentInput = Instrument | Measurements | str | Path
Numbers = NDArray[Any] | Sequence[Sequence[float]] | Sequence[Sequence[Sequence[float]]]
JointsAndPoints = tuple[Numbers, Numbers]  # (m, n) and (m, 3) or (m, k, 3)
PointData = Measurements | TrackerPoints | JointsAndPoints  # of trackers
InstrumentData = Instrument | Sequence[Instrument | Measurements]  # of others, or of several


def find_instrument_columns(path: Path | str, header: Sequence[str]) -> InstrumentColumns:
    """Those of the instrument that a header announces.  Raises DataError."""
    every = [one.file for one in map(load_instrument_class, INSTRUMENT_CLASSES) if one.file]
    found: list[tuple[str, InstrumentColumns]] = []
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


def read_instruments_or_measurements(
    data: InstrumentInput | Sequence[InstrumentInput | MeasurementTable],
) -> Measurements | list[Instrument]:
    """What data, their files or rows hold: points of trackers, or measurements of instruments.

    Several files of trackers are campaigns of one arm.  Raises DataError.
    """
    given = [data] if isinstance(data, InstrumentInput) else list(data)
    if not given:
        raise DataError("no file of measurements is given")
    every = [read_measurement_table(one) if isinstance(one, str | Path) else one for one in given]
    if not all(map(is_tracker_data, every)):
        return [
            build_tracker_points(build_measurements(one))
            if has_reflector_columns(one)
            else convert_to_instrument(one)
            for one in every
        ]
    sheets = [one.sheet for one in every if isinstance(one, MeasurementTable)]
    if len(given) > max(len(sheets), 1):
        raise DataError("several sets of points are campaigns: give their files")
    if len(every) > 1:
        return read_campaigns(sheets)
    lone = every[0]
    if isinstance(lone, Instrument):
        return lone.at
    return build_measurements(lone) if isinstance(lone, MeasurementTable) else lone


def has_reflector_columns(
    data: MeasurementTable | Instrument | Measurements,
) -> TypeGuard[MeasurementTable]:
    """Whether a file has columns of reflectors."""
    return isinstance(data, MeasurementTable) and any(
        map(TARGET_COLUMN_PATTERN.fullmatch, data.header)
    )


def is_tracker_data(data: MeasurementTable | Instrument | Measurements) -> bool:
    """Whether data are points of a tracker, or of nothing that is known."""
    if isinstance(data, MeasurementTable):
        return has_reflector_columns(data) or not has_instrument_columns(data.header)
    return isinstance(data, Measurements) or data.kind == TrackerPoints.kind


def has_instrument_columns(header: Sequence[str]) -> bool:
    """Whether a header says which instrument it is of."""
    every = [
        one.file.announce for one in map(load_instrument_class, INSTRUMENT_CLASSES) if one.file
    ]
    return any(announce.fullmatch(name) for announce in every for name in header)


def convert_to_instrument(
    data: MeasurementTable | Instrument | Measurements | Path | str,
) -> Instrument:
    """The measurements of an instrument, as they are or of a file.  Raises DataError."""
    if isinstance(data, Instrument):
        return data
    rows = read_measurement_table(data) if isinstance(data, str | Path) else data
    if isinstance(rows, MeasurementTable) and (
        has_instrument_columns(rows.header) or rows.has_standard_column_names
    ):
        return check_instrument_data(find_instrument_columns(rows.path, rows.header).read(rows))
    return build_tracker_points(
        build_measurements(rows) if isinstance(rows, MeasurementTable) else rows
    )


def read_relative(path: Path | str) -> Instrument:
    """Read a CSV file of any instrument, by its columns.  Raises DataError."""
    return convert_to_instrument(path)


def write_relative(path: Path | str, data: Instrument) -> None:
    """Write CSV as `read_relative` reads it: radians (mm for slides) and millimetres."""
    at = data.at
    columns: dict[str, Array] = {
        f"q{i + 1}_{'mm' if slides else 'rad'}": at.q[:, i] * (1e3 if slides else 1.0)
        for i, slides in enumerate(at.sliding)
    }
    columns |= data.file_columns()
    for stem, column in at.columns.items():
        name, factor = file_column_name_and_scale(stem)
        columns[name] = column if column.dtype.kind == "U" else factor * column
    rows = (
        [format_csv_cell(value) for value in row] for row in zip(*columns.values(), strict=True)
    )
    write_file_atomically(path, format_csv([list(columns), *rows]))


def format_csv_cell(value: str | float) -> str:
    """A label as it is, a number to nine decimals; nothing for NaN."""
    if isinstance(value, str):
        return str(value)
    return "" if np.isnan(value) else f"{value:.9f}"
