"""The file of stops: targets for a controller, and a form for the measurements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import csv_text
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.modelling.cell import Cell
from minimax_cal.planning.route import Visits

ANGLES = {"deg": 180.0 / np.pi, "rad": 1.0}  # units of turning joints in a file


def stops(
    visits: Visits, cell: Cell, expected: Array, unit: str
) -> tuple[list[str], list[list[TableCell]]]:
    """Header and rows: visit number, pose, joints, sides, and where the targets should be seen.

    expected: (N, k, 3) [m].  unit: of turning joints; slides are in millimetres.
    Raises OptionError.
    """
    if unit not in ANGLES:
        raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
    slides, n = cell.robot.prismatic, cell.robot.joints
    scale = np.where(slides, 1e3, ANGLES[unit])
    stopping = bool(visits.via.any())
    header = ["order", "pose"]
    header += [f"q{j + 1}_{'mm' if slides[j] else unit}" for j in range(n)]
    header += [f"approach{j + 1}" for j in range(n)]
    header += ["via"] if stopping else []
    header += [f"expected_{target}_{axis}_mm" for target in cell.target_names for axis in "xyz"]
    width = len(str(len(expected)))
    rows: list[list[TableCell]] = []
    for stop, pose in enumerate(visits.pose):
        row: list[TableCell] = [stop + 1, f"p{pose + 1:0{width}d}"]
        row += [float(value) for value in visits.q[stop] * scale]
        row += [int(sign) for sign in visits.approach[stop]]
        row += [int(visits.via[stop])] if stopping else []
        there = expected[pose].reshape(-1) * (np.nan if visits.via[stop] else 1e3)
        row += [float(value) for value in there]
        rows.append(row)
    return header, rows


def rounded_csv(header: Sequence[str], rows: Sequence[Sequence[TableCell]]) -> str:
    """The file: angles to a microdegree or less, lengths to 1 um, empty where not seen."""
    digits = [{"rad": 9, "deg": 6}.get(name.rpartition("_")[2], 3) for name in header]
    cells = ([written(*each) for each in zip(row, digits, strict=True)] for row in rows)
    return csv_text([header, *cells])


def written(cell: TableCell, digits: int) -> str:
    """A cell of the file: empty where there is no number."""
    if not isinstance(cell, float):
        return str(cell)
    return f"{cell:.{digits}f}" if np.isfinite(cell) else ""
