"""A short way through joint space past all poses, and going back to some of them.

How long a move takes is told by the joint that has to go farthest; speeds are not known, and a
slide's metre counts as a turn of two radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import format_csv
from minimax_cal.core.record_fields import StoredSeparately, derived_field
from minimax_cal.core.tables import TableCell as TableCell
from minimax_cal.modelling.cell import Cell

PRISMATIC_METRES_PER_RADIAN = 0.5  # metres of a slide that count as a radian
OTHER_SIDE_APPROACH_STEP = np.radians(
    5.0
)  # a pose is approached from its other side by a move of so much [rad]


def pairwise_move_lengths(q: Array, is_prismatic: Array) -> Array:
    """(m, m) lengths of the moves between poses (m, n) [rad]."""
    scaled = q / np.where(is_prismatic, PRISMATIC_METRES_PER_RADIAN, 1.0)
    return np.asarray(np.abs(scaled[:, None] - scaled[None]).max(axis=-1))


def path_length(q: Array, is_prismatic: Array) -> float:
    """Length of the way through poses (m, n) as they come [rad]."""
    scaled = q / np.where(is_prismatic, PRISMATIC_METRES_PER_RADIAN, 1.0)
    return float(np.abs(np.diff(scaled, axis=0)).max(axis=1).sum()) if len(q) > 1 else 0.0


def order_poses_for_short_path(q: Array, is_prismatic: Array, start_q: Array) -> Array:
    """(m,) an order of poses (m, n) with a short way from `start_q` (n,): nearest first, then
    2-opt.

    2-opt turns a stretch of the way round wherever that makes it shorter [Croes 1958].
    """
    away = pairwise_move_lengths(np.concatenate([start_q[None], q]), is_prismatic)
    m = len(q)
    order, left = [0], np.ones(m + 1, dtype=bool)
    left[0] = False
    for _ in range(m):
        here = np.where(left, away[order[-1]], np.inf)
        order.append(int(np.argmin(here)))
        left[order[-1]] = False
    way = np.array(order)
    while True:
        one, other, gain = find_best_path_reversal(away, way)
        if gain <= 1e-12:
            return way[1:] - 1
        way[one : other + 1] = way[one : other + 1][::-1].copy()


class PathReversal(NamedTuple):
    """Ends of the stretch of a path that is reversed, and by how much the path gets shorter."""

    first: int
    last: int
    shortening: float


def find_best_path_reversal(distances: Array, path_order: Array) -> PathReversal:
    """Which stretch of an open way to turn round, and by how much it gets shorter."""
    m = len(path_order)
    if m < 3:
        return PathReversal(0, 0, 0.0)
    before, first = (
        path_order[:-1],
        path_order[1:],
    )  # stretch i..j begins at way[i], i >= 1, and ends at way[j]
    now = distances[before, first]
    last, after = path_order[1:], np.append(path_order[2:], -1)
    follows = after >= 0
    out = np.where(follows, distances[last, after], 0.0)
    joined = distances[np.ix_(before, last)] + np.where(
        follows[None], distances[np.ix_(first, np.maximum(after, 0))], 0.0
    )
    gain = np.triu(now[:, None] + out[None] - joined, 1)
    one, other = np.unravel_index(int(np.argmax(gain)), gain.shape)
    return PathReversal(int(one) + 1, int(other) + 1, float(gain[one, other]))


@dataclass(frozen=True, eq=False)
class VisitSequence:
    """Where the arm goes, stop by stop.

    pose: (v,) which pose, counted from 0.  q: (v, n) joints [rad, m].
    via: (v,) True at a stop on the way, where nothing is measured.
    approach: (v, n) sign of each joint's last move, 0 before the first.
    """

    pose: StoredSeparately[Array]
    q: Array
    via: Array
    approach: Array

    @derived_field(key="pose")
    def pose_numbers(self) -> Array:
        """(v,) the poses, counted from 1."""
        return self.pose + 1


def build_visit_sequence(
    q: Array,
    is_prismatic: Array,
    lower: Array,
    upper: Array,
    revisit_count: int = 0,
    *,
    from_other_side: bool = False,
) -> VisitSequence:
    """Poses (m, n) as they come, then `revisit_count` of them, spread evenly, once more in a short
    order.

    from_other_side: come to them from the other side than the first time, by a short move of all
    joints from a stop on the way.  A joint at its limit, where there is no room for that, keeps its
    side.
    """
    stops = [(one, there, False) for one, there in enumerate(q)]
    side = last_move_signs(q)
    picked = np.linspace(0, len(q), revisit_count, endpoint=False).astype(
        int
    )  # the last few just were
    if len(picked):
        picked = picked[order_poses_for_short_path(q[picked], is_prismatic, q[-1])]
    step = OTHER_SIDE_APPROACH_STEP * np.where(is_prismatic, PRISMATIC_METRES_PER_RADIAN, 1.0)
    for one in picked:
        if from_other_side:
            came = np.where(side[one] == 0.0, -1.0, side[one])
            there = q[one] + came * step
            room = (there >= lower) & (there <= upper)
            stops.append((one, np.where(room, there, q[one] - came * step), True))
        stops.append((one, q[one], False))
    pose, path, via = (np.array(column) for column in zip(*stops, strict=True))
    return VisitSequence(pose, path, via, last_move_signs(path))


def last_move_signs(q: Array) -> Array:
    """(v, n) sign of each joint's last move along a way (v, n), 0 before its first."""
    out = np.zeros(q.shape, dtype=int)
    for row in range(1, len(q)):
        move = q[row] - q[row - 1]
        out[row] = np.where(np.abs(move) > 1e-9, np.sign(move), out[row - 1])
    return out


# ---- stops ---------------------------------------------------------------------------------------


RADIANS_TO_ANGLE_UNIT = {"deg": 180.0 / np.pi, "rad": 1.0}  # units of turning joints in a file


class CsvRows(NamedTuple):
    """Header and rows of a CSV file."""

    header: list[str]
    rows: list[list[TableCell]]


def build_stop_rows(
    visits: VisitSequence, cell: Cell, expected_positions: Array, angle_unit: str
) -> CsvRows:
    """Header and rows: visit number, pose, joints, sides, and where the targets should be seen.

    expected_positions: (N, k, 3) [m].  angle_unit: of turning joints; slides are in millimetres.
    Raises OptionError.
    """
    if angle_unit not in RADIANS_TO_ANGLE_UNIT:
        raise OptionError(f"no unit {angle_unit!r}; choose {' or '.join(RADIANS_TO_ANGLE_UNIT)}")
    slides, n = cell.robot.prismatic, cell.robot.joints
    scale = np.where(slides, 1e3, RADIANS_TO_ANGLE_UNIT[angle_unit])
    stopping = bool(visits.via.any())
    header = ["order", "pose"]
    header += [f"q{j + 1}_{'mm' if slides[j] else angle_unit}" for j in range(n)]
    header += [f"approach{j + 1}" for j in range(n)]
    header += ["via"] if stopping else []
    header += [f"expected_{target}_{axis}_mm" for target in cell.target_names for axis in "xyz"]
    width = len(str(len(expected_positions)))
    rows: list[list[TableCell]] = []
    for stop, pose in enumerate(visits.pose):
        row: list[TableCell] = [stop + 1, f"p{pose + 1:0{width}d}"]
        row += [float(value) for value in visits.q[stop] * scale]
        row += [int(sign) for sign in visits.approach[stop]]
        row += [int(visits.via[stop])] if stopping else []
        there = expected_positions[pose].reshape(-1) * (np.nan if visits.via[stop] else 1e3)
        row += [float(value) for value in there]
        rows.append(row)
    return CsvRows(header, rows)


def format_rounded_csv(header: Sequence[str], rows: Sequence[Sequence[TableCell]]) -> str:
    """The file: angles to a microdegree or less, lengths to 1 um, empty where not seen."""
    digits = [{"rad": 9, "deg": 6}.get(name.rpartition("_")[2], 3) for name in header]
    cells = ([format_csv_cell(*each) for each in zip(row, digits, strict=True)] for row in rows)
    return format_csv([header, *cells])


def format_csv_cell(cell: TableCell, digits: int) -> str:
    """A cell of the file: empty where there is no number."""
    if not isinstance(cell, float):
        return str(cell)
    return f"{cell:.{digits}f}" if np.isfinite(cell) else ""
