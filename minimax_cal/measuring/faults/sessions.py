"""Sessions that differ: other units, or a base that stands elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import fdtrc

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.fault import (
    FAINT,
    FALSE_ALARM,
    FEWEST,
    NO_ERROR,
    NONE,
    Amount,
    Fault,
)
from minimax_cal.measuring.grouping import groups
from minimax_cal.measuring.history import sessions, visits
from minimax_cal.measuring.measurements import Measurements

CHUNK = 65536  # poses whose displacements are solved for at a time
ROUNDS = 10  # of asking each jump again
CLEAR = 0.1  # of the squares that all poses as one body leave: a jump explains so much, or is none


def mixed_units(data: Measurements) -> tuple[Fault, ...]:
    """Sessions whose numbers are a unit apart from those of the first."""
    session = sessions(data)
    return tuple(
        Fault(
            "mixed_units",
            "all",
            f"{what} from {data.called(data.line[np.argmax(session == other)])} on ({word}) are "
            f"about {ratio:.3g} times those of the first session: another unit?",
            np.flatnonzero(session == other),
            parameters=(Amount("ratio", ratio),),
        )
        for other in range(1, int(session.max()) + 1)
        for what, word, ratio in strange_ratios(data, session == 0, session == other)
    )


def strange_ratios(
    data: Measurements, first: Array, other: Array
) -> Iterator[tuple[str, str, float]]:
    """What two sessions give in different units, and how far apart."""
    size = [float(np.nanmedian(np.linalg.norm(data.y[s], axis=-1))) for s in (first, other)]
    ratio = size[1] / max(size[0], FAINT)
    for factor, word in ((1e3, "metres and millimetres"), (25.4, "inches and millimetres")):
        for f in (factor, 1.0 / factor):
            if abs(np.log(ratio / f)) < 0.5:
                yield "points", word, ratio
    turning = ~data.sliding
    if turning.any():
        wide = [float(np.median(np.ptp(data.q[s][:, turning], axis=0))) for s in (first, other)]
        if max(wide) > 4.0 * np.pi and min(wide) > 0.0:
            ratio = wide[1] / wide[0]
            if min(ratio, 1.0 / ratio) < 0.1:
                yield "joint values", "radians and degrees", ratio


def session_jumps(
    data: Measurements, error: Array = NO_ERROR, fit_sizes: Callable[[Array], Array] | None = None
) -> tuple[Fault, ...]:
    """A notice if the residual of a fit moves as a whole from some pose on; see `jumps`.

    fit_sizes: sizes of the effects that start at some rows, fitted beside the arm [m], NaN where
    that cannot be done; without it those of the residual, of which arm and base took a part.
    """
    rows, sizes = jumps(data, error) if len(error) else (NONE, np.zeros(0))
    if not len(rows):
        return ()
    sizes = fit_sizes(rows) if fit_sizes else sizes
    told = ", ".join(
        f"{data.called(line)} on" + (f" by {1e3 * size:.3g} mm" if np.isfinite(size) else "")
        for line, size in zip(data.line[rows], sizes, strict=True)
    )
    return (
        Fault(
            "session_jump",
            "frame",
            f"{data.source}: all targets stand elsewhere from {told}: was the instrument or the "
            "base moved, or another workspace measured? name the sessions in a column `session`, "
            "or free the jump with effects='session_jump'",
            rows,
            parameters=tuple(Amount("size", float(size), "m") for size in sizes),
        ),
    )


def jumps(data: Measurements, error: Array) -> tuple[Array, Array]:
    """Rows (j,) from which on, as visited, all targets have moved as one body, and how far [m].

    The mean errors of the poses' targets are explained by one small displacement (6) for all, or
    by another one from some pose on: the best such pose is tried against chance (F-test times the
    poses tried), and so are both sides (`jumps_in`).  error: (m, k, 3) of a fit, in the axes of
    the data [m].
    """
    known = np.isfinite(error[..., 0]) & data.seen
    order = visits(data)
    order = order[np.asarray(known.any(axis=1))[order]]
    count = known.sum(axis=1)[order, None]
    mean = np.where(known[..., None], error, 0.0).sum(axis=1)[order] / count
    place = np.where(known[..., None], data.y, 0.0).sum(axis=1)[order] / count
    begins = new_poses(data, order)
    often = np.diff([*begins, len(order)])[:, None]  # visits in a row, which are one pose
    poses = Rigid.of(*(np.add.reduceat(part, begins) / often for part in (place, mean)))
    starts = jumps_in(poses, len(begins))
    if not starts:
        return NONE, np.zeros(0)
    steps = [poses.fitted(a, b) for a, b in pairwise([0, *starts, len(begins)])]
    sizes = [poses.size(later - earlier) for earlier, later in pairwise(steps)]
    return order[begins[np.array(starts, dtype=int)]], np.array(sizes)


def new_poses(data: Measurements, order: Array) -> Array:
    """(p,) at which visits another pose begins.  order: (v,) rows as visited."""
    both = np.stack([groups(data), sessions(data)])[:, order]
    return np.flatnonzero(np.append(True, (both[:, 1:] != both[:, :-1]).any(axis=0)))


@dataclass(frozen=True, eq=False)
class Rigid:
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
    def of(place: Array, value: Array) -> Rigid:
        """Of poses in their order.  place: (m, 3) mean point, value: (m, 3) mean error [m]."""
        place = place - place.mean(axis=0)
        lever = max(float(np.sqrt((place**2).mean())), FAINT)
        design = np.zeros((len(place), 3, 6))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            design[:, i, i], design[:, k, 3 + j] = 1.0, -place[:, i] / lever
            design[:, j, 3 + k] = place[:, i] / lever
        parts = (
            np.swapaxes(design, 1, 2) @ design,
            np.einsum("mij,mi->mj", design, value),
            (value**2).sum(axis=1),
        )
        return Rigid(design, value, *map(summed_up, parts))

    def left(self, first: Array, last: Array) -> Array:
        """(a,) squares that one displacement for the poses first to last - 1 leaves [m^2]."""
        out = self.square[last] - self.square[first]
        for lo in range(0, len(out), CHUNK):
            a, b = first[lo : lo + CHUNK], last[lo : lo + CHUNK]
            gram, pull = self.gram[b] - self.gram[a], self.pull[b] - self.pull[a]
            gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(6)
            step = np.linalg.solve(gram, pull[..., None])[..., 0]
            out[lo : lo + CHUNK] -= np.einsum("ai,ai->a", pull, step)
        return out

    def fitted(self, first: int, last: int) -> Array:
        """(6,) the displacement of some poses."""
        gram, pull = self.gram[last] - self.gram[first], self.pull[last] - self.pull[first]
        return np.asarray(np.linalg.lstsq(gram, pull, rcond=1e-9)[0])

    def size(self, step: Array) -> float:
        """RMS motion of all poses by a displacement [m]."""
        return float(np.sqrt(((self.design @ step) ** 2).sum(axis=1).mean()))


def summed_up(part: Array) -> Array:
    """(m + 1, ...) sums of the rows (m, ...) before each."""
    out = np.zeros((len(part) + 1, *part.shape[1:]))
    np.cumsum(part, axis=0, out=out[1:])
    return out


def jumps_in(poses: Rigid, count: int) -> list[int]:
    """Where the poses jump: parts are split while one clearly does; then each jump is asked again.

    Between its neighbours a jump may turn out to stand elsewhere, or nowhere.
    """
    found, waiting = [0, count], [(0, count)]
    while waiting:
        first, last = waiting.pop()
        at = jump_between(poses, first, last)
        if at:
            found.append(at)
            waiting += [(first, at), (at, last)]
    found.sort()
    for _ in range(ROUNDS):
        before = list(found)
        for old in before[1:-1]:
            i = found.index(old)
            at = jump_between(poses, found[i - 1], found[i + 1])
            found[i : i + 1] = [at] if at else []
        if found == before:
            break
    return found[1:-1]


def jump_between(poses: Rigid, first: int, last: int) -> int:
    """The best place for a jump among the poses first to last - 1; 0 where none is clear."""
    at = np.arange(first + FEWEST, last - FEWEST + 1)
    dof = 3 * (last - first) - 12
    if not len(at) or dof < 1:
        return 0
    begin, end = np.full_like(at, first), np.full_like(at, last)
    starts = np.concatenate([begin, at, [first, 0]])  # and all these poses, and all there are
    left = poses.left(starts, np.concatenate([at, end, [last, len(poses.value)]]))
    before, after, (whole, every) = np.split(left, [len(at), 2 * len(at)])
    apart = before + after
    best = int(np.argmin(apart))
    two = float(apart[best])
    ratio = (whole - two) / 6.0 / max(two / dof, 1e-30)
    chance = fdtrc(6, dof, ratio) * len(at)
    clear = whole - two > CLEAR * every
    return int(at[best]) if clear and chance < 0.1 * FALSE_ALARM else 0
