"""Whether an instrument reads as it says: shapes, numbers, and slopes by differences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.instruments.protocol import (
    FlangeKinematics,
    FlangePoses,
    ResidualRows,
    slopes_by_flange_rotation,
)
from minimax_cal.robots.kinematics import rotation_from_vector
from minimax_cal.robots.robot import Robot

DIFFERENCE_STEP = 1e-5  # of differences [m, rad]
MAX_SLOPE_ERROR_RATIO = 1e-3  # of the largest slope of a kind


def check_instrument(
    instrument: Instrument, robot: Robot, options: InstrumentOptions | None = None
) -> None:
    """Raise DataError where an instrument does not read an arm as drawn as its slopes say.

    `relative` asks it of every class that is registered.
    """
    instrument = instrument.ready(robot, options or InstrumentOptions())
    arm, count = (
        FlangeKinematics.from_robot(robot, instrument.at.q).compute_flange_poses(robot.mdh),
        len(instrument.names),
    )
    starts = instrument.starts(arm, np.ones(count, dtype=bool))
    for start in starts:
        check_shape_and_finite(instrument, "a start", np.asarray(start), (count,))
    own = np.asarray(starts[0], dtype=float)
    rows = instrument.read(arm, own)
    r = len(rows.residual)
    shapes = {"residual": (r,), "pose": (r,), "by_own": (r, count)}
    shapes |= dict.fromkeys(("point", "by_point", "by_rotation"), (r, 3))
    for name, shape in shapes.items():
        check_shape_and_finite(
            instrument, f"{name} of read", np.asarray(getattr(rows, name)), shape
        )
    for name, said, found in list_slope_comparisons(instrument, arm, own, rows):
        off, size = np.abs(said - found), np.abs([said, found]).max(initial=MAX_SLOPE_ERROR_RATIO)
        if (off > MAX_SLOPE_ERROR_RATIO * size).any():
            at = int(off.argmax())
            raise DataError(
                f"{instrument.kind}: {name} of row {at} is "
                f"{said[at]:.6g}, but the prediction, measured "
                f"minus residual, changes by {found[at]:.6g}: slopes are those of the prediction"
            )


def check_shape_and_finite(
    instrument: Instrument, name: str, values: Array, shape: tuple[int, ...]
) -> None:
    """Raise DataError for another shape, and for what is no number."""
    if values.shape != shape:
        raise DataError(f"{instrument.kind}: {name} has the shape {values.shape}, not {shape}")
    if not np.isfinite(values).all():
        raise DataError(f"{instrument.kind}: {name} is not finite")


class SlopeComparison(NamedTuple):
    """A parameter's name, slopes (r,) as the instrument has them and by central differences."""

    name: str
    slopes: Array
    differences: Array


def list_slope_comparisons(
    instrument: Instrument, arm: FlangePoses, unknowns: Array, rows: ResidualRows
) -> Iterator[SlopeComparison]:
    """Name, slopes (r,) as the instrument says them and by central differences."""

    def slope(ahead: ResidualRows, behind: ResidualRows) -> Array:
        return (behind.residual - ahead.residual) / (2.0 * DIFFERENCE_STEP)

    for name, step, said in zip(
        instrument.names, DIFFERENCE_STEP * np.eye(len(unknowns)), rows.by_own.T, strict=True
    ):
        ends = (instrument.read(arm, unknowns + step), instrument.read(arm, unknowns - step))
        yield SlopeComparison(f"by_own for {name}", said, slope(*ends))
    by_turn = slopes_by_flange_rotation(arm, rows)
    for i, axis in enumerate("xyz"):
        step = DIFFERENCE_STEP * np.eye(3)[i]
        moved = [
            instrument.read(arm._replace(origin=arm.origin + s * step), unknowns) for s in (1, -1)
        ]
        yield SlopeComparison(f"by_point along {axis}", rows.by_point[:, i], slope(*moved))
        turns = [rotation_from_vector(s * step) @ arm.rotation for s in (1, -1)]
        turned = [instrument.read(arm._replace(rotation=turn), unknowns) for turn in turns]
        yield SlopeComparison(
            f"by_point and by_rotation about {axis}", by_turn[:, i], slope(*turned)
        )
