"""Sessions that differ: other units, or a base that stands elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.faults.data_fault import (
    FAULT_FALSE_ALARM_RATE,
    MIN_DISTANCE_COUNT,
    MIN_INSTRUMENT_NOISE,
    NO_FAULT_ROWS,
    NO_POINT_ERRORS,
    DataFault,
    FaultAmount,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.measuring.visit_history import rows_in_visit_order, session_indices

POSES_PER_SOLVE = 65536  # poses whose displacements are solved for at a time
MAX_JUMP_REVISIONS = 10  # of asking each jump again
MIN_JUMP_EXPLAINED_SHARE = (
    0.1  # of the squares that all poses as one body leave: a jump explains so much, or is none
)


def find_mixed_unit_sessions(data: Measurements) -> tuple[DataFault, ...]:
    """Sessions whose numbers are a unit apart from those of the first."""
    session = session_indices(data)
    return tuple(
        DataFault(
            "mixed_units",
            "all",
            f"{what} from {data.called(data.line[np.argmax(session == other)])} on ({word}) are "
            f"about {ratio:.3g} times those of the first session: another unit?",
            np.flatnonzero(session == other),
            parameters=(FaultAmount("ratio", ratio),),
        )
        for other in range(1, int(session.max()) + 1)
        for what, word, ratio in find_session_unit_ratios(data, session == 0, session == other)
    )


class SessionUnitRatio(NamedTuple):
    """What two sessions give in different units, which units, and the ratio of their numbers."""

    quantity: str
    unit_pair: str
    ratio: float


def find_session_unit_ratios(
    data: Measurements, first_rows: Array, other_rows: Array
) -> Iterator[SessionUnitRatio]:
    """What two sessions give in different units, and how far apart."""
    size = [
        float(np.nanmedian(np.linalg.norm(data.y[s], axis=-1))) for s in (first_rows, other_rows)
    ]
    ratio = size[1] / max(size[0], MIN_INSTRUMENT_NOISE)
    for factor, word in ((1e3, "metres and millimetres"), (25.4, "inches and millimetres")):
        for f in (factor, 1.0 / factor):
            if abs(np.log(ratio / f)) < 0.5:
                yield SessionUnitRatio("points", word, ratio)
    turning = ~data.sliding
    if turning.any():
        wide = [
            float(np.median(np.ptp(data.q[s][:, turning], axis=0)))
            for s in (first_rows, other_rows)
        ]
        if max(wide) > 4.0 * np.pi and min(wide) > 0.0:
            ratio = wide[1] / wide[0]
            if min(ratio, 1.0 / ratio) < 0.1:
                yield SessionUnitRatio("joint values", "radians and degrees", ratio)


def find_session_jumps(
    data: Measurements,
    point_errors: Array = NO_POINT_ERRORS,
    fit_jump_sizes: Callable[[Array], Array] | None = None,
) -> tuple[DataFault, ...]:
    """A notice if the residual of a fit moves as a whole from some pose on; see
    `locate_frame_jumps`.

    fit_jump_sizes: sizes of the effects that start at some rows, fitted beside the arm [m], NaN
    where that cannot be done; without it those of the residual, of which arm and base took a part.
    """
    rows, sizes = (
        locate_frame_jumps(data, point_errors)
        if len(point_errors)
        else (NO_FAULT_ROWS, np.zeros(0))
    )
    if not len(rows):
        return ()
    sizes = fit_jump_sizes(rows) if fit_jump_sizes else sizes
    told = ", ".join(
        f"{data.called(line)} on" + (f" by {1e3 * size:.3g} mm" if np.isfinite(size) else "")
        for line, size in zip(data.line[rows], sizes, strict=True)
    )
    return (
        DataFault(
            "session_jump",
            "frame",
            f"{data.source}: all targets stand elsewhere from {told}: was the instrument or the "
            "base moved, or another workspace measured? name the sessions in a column `session`, "
            "or free the jump with effects='session_jump'",
            rows,
            parameters=tuple(FaultAmount("size", float(size), "m") for size in sizes),
        ),
    )


class FrameJumps(NamedTuple):
    """Rows (j,) from which on all targets have moved as one body, and how far (j,) [m]."""

    rows: Array
    sizes: Array


def locate_frame_jumps(data: Measurements, point_errors: Array) -> FrameJumps:
    """Rows (j,) from which on, as visited, all targets have moved as one body, and how far [m].

    The mean errors of the poses' targets are explained by one small displacement (6) for all, or by
    another one from some pose on: the best such pose is tried against chance (F-test times the
    poses tried), and so are both sides (`find_jump_poses`).  point_errors: (m, k, 3) of a fit, in
    the axes of the data [m].
    """
    known = np.isfinite(point_errors[..., 0]) & data.seen
    order = rows_in_visit_order(data)
    order = order[np.asarray(known.any(axis=1))[order]]
    count = known.sum(axis=1)[order, None]
    mean = np.where(known[..., None], point_errors, 0.0).sum(axis=1)[order] / count
    place = np.where(known[..., None], data.y, 0.0).sum(axis=1)[order] / count
    begins = find_pose_starts(data, order)
    often = np.diff([*begins, len(order)])[:, None]  # visits in a row, which are one pose
    poses = RigidMotionSums.from_mean_points(
        *(np.add.reduceat(part, begins) / often for part in (place, mean))
    )
    starts = find_jump_poses(poses, len(begins))
    if not starts:
        return FrameJumps(NO_FAULT_ROWS, np.zeros(0))
    steps = [poses.fit_displacement(a, b) for a, b in pairwise([0, *starts, len(begins)])]
    sizes = [poses.rms_motion(later - earlier) for earlier, later in pairwise(steps)]
    return FrameJumps(order[begins[np.array(starts, dtype=int)]], np.array(sizes))


def find_pose_starts(data: Measurements, visit_rows: Array) -> Array:
    """(p,) at which visits another pose begins.  visit_rows: (v,) rows as visited."""
    both = np.stack([group_repeated_poses(data), session_indices(data)])[:, visit_rows]
    return np.flatnonzero(np.append(True, (both[:, 1:] != both[:, :-1]).any(axis=0)))


@dataclass(frozen=True, eq=False)
class RigidMotionSums:
    """Small displacements of poses as one body, summed up pose by pose.

    design: (m, 3, 6) motion of each pose's mean point along and about the axes, turns in levers.
    value: (m, 3) its error [m].  gram: (m + 1, 6, 6), pull: (m + 1, 6), square: (m + 1,) sums over
    the poses before.
    """

    design: Array
    value: Array
    gram: Array
    pull: Array
    square: Array

    @staticmethod
    def from_mean_points(mean_points: Array, mean_errors: Array) -> RigidMotionSums:
        """Of poses in their order.  mean_points: (m, 3) mean point, mean_errors: (m, 3) mean error
        [m].
        """
        mean_points = mean_points - mean_points.mean(axis=0)
        lever = max(float(np.sqrt((mean_points**2).mean())), MIN_INSTRUMENT_NOISE)
        design = np.zeros((len(mean_points), 3, 6))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            design[:, i, i], design[:, k, 3 + j] = 1.0, -mean_points[:, i] / lever
            design[:, j, 3 + k] = mean_points[:, i] / lever
        parts = (
            np.swapaxes(design, 1, 2) @ design,
            np.einsum("mij,mi->mj", design, mean_errors),
            (mean_errors**2).sum(axis=1),
        )
        return RigidMotionSums(design, mean_errors, *map(sums_before_each_row, parts))

    def residual_squares(self, first_poses: Array, end_poses: Array) -> Array:
        """(a,) squares that one displacement for the poses first to last - 1 leaves [m^2]."""
        out = self.square[end_poses] - self.square[first_poses]
        for lo in range(0, len(out), POSES_PER_SOLVE):
            a, b = first_poses[lo : lo + POSES_PER_SOLVE], end_poses[lo : lo + POSES_PER_SOLVE]
            gram, pull = self.gram[b] - self.gram[a], self.pull[b] - self.pull[a]
            gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(6)
            step = np.linalg.solve(gram, pull[..., None])[..., 0]
            out[lo : lo + POSES_PER_SOLVE] -= np.einsum("ai,ai->a", pull, step)
        return out

    def fit_displacement(self, first_pose: int, end_pose: int) -> Array:
        """(6,) the displacement of some poses."""
        gram, pull = (
            self.gram[end_pose] - self.gram[first_pose],
            self.pull[end_pose] - self.pull[first_pose],
        )
        return np.asarray(np.linalg.lstsq(gram, pull, rcond=1e-9)[0])

    def rms_motion(self, displacement: Array) -> float:
        """RMS motion of all poses by a displacement [m]."""
        return float(np.sqrt(((self.design @ displacement) ** 2).sum(axis=1).mean()))


def sums_before_each_row(rows: Array) -> Array:
    """(m + 1, ...) sums of the rows (m, ...) before each."""
    out = np.zeros((len(rows) + 1, *rows.shape[1:]))
    np.cumsum(rows, axis=0, out=out[1:])
    return out


def find_jump_poses(motion_sums: RigidMotionSums, pose_count: int) -> list[int]:
    """Where the poses jump: parts are split while one clearly does; then each jump is asked again.

    Between its neighbours a jump may turn out to stand elsewhere, or nowhere.
    """
    found, waiting = [0, pose_count], [(0, pose_count)]
    while waiting:
        first, last = waiting.pop()
        at = find_jump_between(motion_sums, first, last)
        if at:
            found.append(at)
            waiting += [(first, at), (at, last)]
    found.sort()
    for _ in range(MAX_JUMP_REVISIONS):
        before = list(found)
        for old in before[1:-1]:
            i = found.index(old)
            at = find_jump_between(motion_sums, found[i - 1], found[i + 1])
            found[i : i + 1] = [at] if at else []
        if found == before:
            break
    return found[1:-1]


def find_jump_between(motion_sums: RigidMotionSums, first_pose: int, end_pose: int) -> int:
    """The best place for a jump among the poses first to last - 1; 0 where none is clear."""
    at = np.arange(first_pose + MIN_DISTANCE_COUNT, end_pose - MIN_DISTANCE_COUNT + 1)
    dof = 3 * (end_pose - first_pose) - 12
    if not len(at) or dof < 1:
        return 0
    begin, end = np.full_like(at, first_pose), np.full_like(at, end_pose)
    starts = np.concatenate([begin, at, [first_pose, 0]])  # and all these poses, and all there are
    left = motion_sums.residual_squares(
        starts, np.concatenate([at, end, [end_pose, len(motion_sums.value)]])
    )
    before, after, (whole, every) = np.split(left, [len(at), 2 * len(at)])
    apart = before + after
    best = int(np.argmin(apart))
    two = float(apart[best])
    ratio = (whole - two) / 6.0 / max(two / dof, 1e-30)
    chance = fdtrc(6, dof, ratio) * len(at)
    clear = whole - two > MIN_JUMP_EXPLAINED_SHARE * every
    return int(at[best]) if clear and chance < 0.1 * FAULT_FALSE_ALARM_RATE else 0
