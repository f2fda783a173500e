"""Points that another visit to their pose contradicts.

A model that misses a point by much may lack an effect.  A second visit that misses it as well lacks
none: the arm stood there at the same joint values.  One of both is wrong, or something moved.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from minimax_cal.fitting.floor import FEWEST
from minimax_cal.fitting.suspects import Scores, spread_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.faults.fault import FAINT
from minimax_cal.measuring.grouping import visits
from minimax_cal.measuring.measurements import Measurements

MIN_GUILTY_RATIO = 3.0  # times the error of the other visit: the one that is wrong
MAX_NAMED_PAIRS = 8  # pairs that are told
USUAL_QUANTILE = 0.95  # share of the other visits that keep to what is told of them
# times that: drift, growth and nests that shift part visits by less (blind_gap)
MIN_GROSS_RATIO = 4.0


def contradictions(data: Measurements, error: Array) -> Iterator[str]:
    """Which visits to one pose contradict each other, to people; nothing where none do.

    A visit does to which no other comes nearer than Student's t, fitted to all visits, allows
    [Benjamini and Hochberg 1995], by far.  The errors of a fit are compared, or the points where
    these are nearer to each other: moves between visits are in the points, noise of joints that
    were read back in the errors.  By far: beside how far visits are from half of the others of
    their pose, for joints that stop on either side part them into two groups.  Fewer than five
    poses that were visited again tell nothing.
    error: (k, m, 3), NaN unknown [m].
    """
    group = visits(data)
    near = [nearest(part, group) for part in (error, np.moveaxis(data.y, 1, 0))]
    known = np.isfinite(near[0][0])
    if len(np.unique(group[known.any(axis=0)])) < FEWEST:
        return
    apart, other, amid = min(near, key=lambda visit: float(np.median(visit[0][known])))
    scores = Scores(np.where(known, apart, 0.0) ** 2, 3 * known)
    far = spread_of(scores, 3.0 * known.sum()).far(scores)
    usual = float(np.quantile(amid[known & ~far], USUAL_QUANTILE)) if (known & ~far).any() else 0.0
    far &= apart > max(MIN_GROSS_RATIO * usual, FAINT)
    if not far.any():
        return
    size = np.linalg.norm(error, axis=-1)
    told: dict[tuple[int, int, int], str] = {}
    for target, row in sorted(np.argwhere(far), key=lambda at: -apart[tuple(at)]):
        pair = sorted((row, other[target, row]), key=lambda i: size[target, i])
        right, wrong = (data.called(data.line[i]) for i in pair)
        name, off = data.target_names[target], 1e3 * apart[target, row]
        guilty = size[target, pair[1]] > MIN_GUILTY_RATIO * size[target, pair[0]]
        text = f"{wrong} {name} is {off:.2g} mm from {right}"
        told.setdefault((*sorted(pair), target), text + (", which fits" if guilty else ""))
    yield (
        f"{data.source}: visits to one pose that contradict each other; of each pair one point is "
        f"wrong, or something moved (95 % of the others come within {1e3 * usual:.2g} mm): "
        f"{name_first(list(told.values()), MAX_NAMED_PAIRS, '; ')}"
    )


def nearest(points: Array, group: Array) -> tuple[Array, Array, Array]:
    """Of every visit its distance to the nearest other to the same pose, the row of that, and its
    median distance to the others.

    (k, m) [m], NaN where there is none.  points: (k, m, 3), NaN unknown.  group: (m,).
    """  # fmt: skip
    apart, amid = np.full((2, *points.shape[:2]), np.inf)
    other = np.zeros(points.shape[:2], dtype=int)
    names, counts = np.unique(group, return_counts=True)
    for name in names[counts > 1]:
        rows = np.flatnonzero(group == name)
        between = np.linalg.norm(points[:, rows, None] - points[:, None, rows], axis=-1)
        between[:, range(len(rows)), range(len(rows))] = np.nan
        seen = np.isfinite(between).any(axis=2, keepdims=True)
        half = np.nanmedian(np.where(seen, between, 0.0), axis=2)
        amid[:, rows] = np.where(seen[..., 0], half, np.inf)
        between = np.where(np.isfinite(between), between, np.inf)
        apart[:, rows], other[:, rows] = between.min(axis=2), rows[between.argmin(axis=2)]
    return np.where(np.isfinite(apart), apart, np.nan), other, amid
