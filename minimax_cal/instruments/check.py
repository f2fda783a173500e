"""Whether an instrument reads as it says: shapes, numbers, and slopes by differences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.options import InstrumentOptions
from minimax_cal.instruments.protocol import Arm, FlangePoses, ResidualRows, by_turns
from minimax_cal.robots.kinematics import rotation
from minimax_cal.robots.robot import Robot

STEP = 1e-5  # of differences [m, rad]
ALIKE = 1e-3  # of the largest slope of a kind


def check_instrument(
    one: Instrument, robot: Robot, options: InstrumentOptions | None = None
) -> None:
    """Raise DataError where an instrument does not read an arm as drawn as its slopes say.

    `relative` asks it of every class that is registered.
    """
    one = one.ready(robot, options or InstrumentOptions())
    arm, count = Arm.of(robot, one.at.q).at(robot.mdh), len(one.names)
    starts = one.starts(arm, np.ones(count, dtype=bool))
    for start in starts:
        alike(one, "a start", np.asarray(start), (count,))
    own = np.asarray(starts[0], dtype=float)
    rows = one.read(arm, own)
    r = len(rows.residual)
    shapes = {"residual": (r,), "pose": (r,), "by_own": (r, count)}
    shapes |= dict.fromkeys(("point", "by_point", "by_rotation"), (r, 3))
    for name, shape in shapes.items():
        alike(one, f"{name} of read", np.asarray(getattr(rows, name)), shape)
    for name, said, found in compared(one, arm, own, rows):
        off, size = np.abs(said - found), np.abs([said, found]).max(initial=ALIKE)
        if (off > ALIKE * size).any():
            at = int(off.argmax())
            raise DataError(
                f"{one.kind}: {name} of row {at} is {said[at]:.6g}, but the prediction, measured "
                f"minus residual, changes by {found[at]:.6g}: slopes are those of the prediction"
            )


def alike(one: Instrument, name: str, values: Array, shape: tuple[int, ...]) -> None:
    """Raise DataError for another shape, and for what is no number."""
    if values.shape != shape:
        raise DataError(f"{one.kind}: {name} has the shape {values.shape}, not {shape}")
    if not np.isfinite(values).all():
        raise DataError(f"{one.kind}: {name} is not finite")


def compared(
    one: Instrument, arm: FlangePoses, own: Array, rows: ResidualRows
) -> Iterator[tuple[str, Array, Array]]:
    """Name, slopes (r,) as the instrument says them and by central differences."""

    def slope(ahead: ResidualRows, behind: ResidualRows) -> Array:
        return (behind.residual - ahead.residual) / (2.0 * STEP)

    for name, step, said in zip(one.names, STEP * np.eye(len(own)), rows.by_own.T, strict=True):
        ends = (one.read(arm, own + step), one.read(arm, own - step))
        yield f"by_own for {name}", said, slope(*ends)
    by_turn = by_turns(arm, rows)
    for i, axis in enumerate("xyz"):
        step = STEP * np.eye(3)[i]
        moved = [one.read(arm._replace(origin=arm.origin + s * step), own) for s in (1, -1)]
        yield f"by_point along {axis}", rows.by_point[:, i], slope(*moved)
        turns = [rotation(s * step) @ arm.rotation for s in (1, -1)]
        turned = [one.read(arm._replace(rotation=turn), own) for turn in turns]
        yield f"by_point and by_rotation about {axis}", by_turn[:, i], slope(*turned)
