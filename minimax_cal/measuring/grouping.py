"""Which poses belong together, which are held out, and which parts of the poses can be left out.

Two questions are asked of poses that no fit has seen.  Does the model hold between the measured
poses (*within*: some are held out at random)?  Does it hold where none was measured (*beyond*: a
whole part is left out)?  Poses that repeat each other, or stand in one cluster, are on one side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from weakref import finalize

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.options import check_seed
from minimax_cal.measuring.history import clock, numbered, sessions
from minimax_cal.measuring.measurements import Measurements

# Joints (root of the sum of squares) within half a milliradian, or half a millimetre of a slide:
# arms come back so near to where they were, and nobody measures two places so near each other.
REPEAT = 5e-4
APART = 3.0  # the distance between clusters over those inside them
FEWEST_CLUSTERS = 8  # fewer are regions of the workspace: `parts` leaves each out in its turn
LABELS = ("pose", "group")  # columns that tell which poses belong together
SORTED = 2000  # poses among which pairs are found by sorting, without a tree
MOST = 3000  # poses among which clusters are looked for
MOVES = 0.01  # a joint with less range does not move [rad, m]
TURN = 2.0 * np.pi
REGIONS = 5  # clusters of joint values that are left out in their turn
LLOYD = 10  # rounds that find them
QUARTER = 0.25  # of the poses at each end of a joint
LATE = 0.2  # share of a session that its last part is
MOST_OF = 0.5  # share of the poses that a part may have
FEWEST = 3  # poses of a part


def remembered(find: Callable[[Measurements], Array]) -> Callable[[Measurements], Array]:
    """The function, whose answers are kept as long as the joint values of the poses.

    One calibration asks a dozen times, and arrays of measurements are never changed in place.  The
    answer must rest on joints and labels alone.
    """
    known: dict[int, tuple[Mapping[str, Array], Array]] = {}

    @wraps(find)
    def asked(data: Measurements) -> Array:
        labels = {name: data.columns[name] for name in LABELS if name in data.columns}
        here = known.get(id(data.q))
        if here is None:
            finalize(data.q, known.pop, id(data.q), None)
        if here is None or labels.keys() != here[0].keys() or any(
            here[0][name] is not label for name, label in labels.items()
        ):  # fmt: skip
            here = known[id(data.q)] = labels, find(data)
        return here[1].copy()

    return asked


@remembered
def groups(data: Measurements) -> Array:
    """(m,) a number for each pose: rows at the same joints, or of the same `pose`, share it."""
    near = close_pairs(data.q, REPEAT)
    group = joined(near, data.poses) if len(near) else np.arange(data.poses)
    for label in np.unique(group[near[:, 0]]) if len(near) else ():
        rows = np.flatnonzero(group == label)
        if np.ptp(data.q[rows], axis=0).max() > 2.0 * REPEAT:  # a path, not a pose
            group[rows] = group.max() + 1 + leaders(data.q[rows])
    if "pose" in data.columns:
        labels = data.columns["pose"]
        for label in np.unique(labels[labels != ""]):
            same = np.isin(group, group[labels == label])
            group[same] = group[same].min()
    return numbered_by_joints(group, data.q)


def visits(data: Measurements) -> Array:
    """(m,) a number for each pose, load and session: rows that share it are visits that should
    agree; between sessions something may have moved.
    """
    group = groups(data)
    if len(group) and group.max() + 1 == len(group):  # no pose was visited again
        return group
    load = np.nan_to_num(data.columns.get("payload", np.zeros(data.poses)).astype(float))
    both = np.stack([group.astype(float), load, sessions(data).astype(float)])
    return np.asarray(np.unique(both, axis=1, return_inverse=True)[1]).reshape(-1)


def summed(rows: Array, group: Array) -> Array:
    """Sums of rows (m, ...) over each group."""
    _, place = np.unique(group, return_inverse=True)
    out = np.zeros((place.max() + 1, *rows.shape[1:]))
    np.add.at(out, place, rows)
    return out


def from_means(values: Array, group: Array) -> tuple[Array, Array]:
    """Deviations (m, c) from the mean of the group, 0 for NaN, and degrees of freedom of each."""
    known = np.isfinite(values)
    _, place = np.unique(group, return_inverse=True)
    count = np.maximum(summed(known.astype(float), group), 1.0)[place]
    # means of what is left after one row of each group are exact to rounding, far from the origin
    first = np.unique(place, return_index=True)[1][place]
    moved = np.where(known & known[first], values - values[first], 0.0)
    moved = np.where(known & ~known[first], values, moved)
    alone = np.where(known, moved - (summed(moved, group)[place] / count), 0.0)
    return alone, np.where(known, 1.0 - 1.0 / count, 0.0)


def mislabelled(data: Measurements) -> str:
    """Which `pose` label stands at poses that are not one, to people; '' for none.

    A joint may have come back a whole turn away.
    """
    labels = data.columns.get("pose", np.full(data.poses, "")).astype(str)
    for label in np.unique(labels[labels != ""]):
        rows = np.flatnonzero(labels == label)
        off = data.q[rows] - data.q[rows[0]]
        off = np.abs(off - np.where(data.sliding, 0.0, TURN * np.round(off / TURN)))
        if off.max() > MOVES:
            row, joint = np.argwhere(off == off.max())[0]
            size = f"{1e3 * off.max():.3g} mm" if data.sliding[joint] else f"{off.max():.3g} rad"
            return (
                f"{data.source}:{data.line[rows[row]]}: pose {str(label)!r} is also that of line "
                f"{data.line[rows[0]]}, where joint {joint + 1} differs by {size}; an equal label "
                "says that the same pose was visited again: name each pose by itself"
            )
    return ""


def close_pairs(q: Array, within: float) -> Array:
    """(e, 2) rows of q (m, n) that lie so near each other."""
    if len(q) > SORTED:
        return scipy.spatial.KDTree(q).query_pairs(within, output_type="ndarray")
    widest = q[:, np.argmax(np.ptp(q, axis=0))] if len(q) else q[:, 0]
    order = np.argsort(widest, kind="stable")
    found = [np.zeros((0, 2), dtype=int)]
    for apart in range(1, len(q)):
        first, second = order[:-apart], order[apart:]
        near = np.flatnonzero(widest[second] - widest[first] <= within)
        if not len(near):
            break
        pairs = np.stack([first[near], second[near]], axis=1)
        found.append(pairs[np.linalg.norm(q[pairs[:, 0]] - q[pairs[:, 1]], axis=1) <= within])
    return np.concatenate(found)


def shortest_tree(q: Array) -> tuple[Array, Array]:
    """Edges (m - 1, 2) of the shortest tree that joins all rows of q (m, n), and their lengths.

    These are the heights at which single linkage joins [Prim 1957].
    """
    apart = sum((joint[:, None] - joint) ** 2 for joint in q.T)
    distance, nearest, at = np.full(len(q), np.inf), np.zeros(len(q), dtype=int), 0
    pairs, length = np.empty((len(q) - 1, 2), dtype=int), np.empty(len(q) - 1)
    for step in range(len(length)):
        apart[:, at] = np.inf  # nothing leads there any more
        nearest = np.where(apart[at] < distance, at, nearest)
        distance = np.minimum(distance, apart[at])
        distance[at] = np.inf
        at = int(distance.argmin())
        pairs[step], length[step] = (nearest[at], at), distance[at]
    return pairs, np.sqrt(length)


def numbered_by_joints(group: Array, q: Array) -> Array:
    """The same groups, numbered by their joint values, so that rows in another order split alike.

    group: (m,).  q: (m, n).
    """
    _, group = np.unique(group, return_inverse=True)
    rounded = np.round(q, 9)
    order, rank = np.lexsort(rounded.T[::-1]), np.zeros(len(q), dtype=int)
    rank[order[1:]] = (np.diff(rounded[order], axis=0) != 0.0).any(axis=1).cumsum()
    least = np.full(int(group.max()) + 1, len(q))
    np.minimum.at(least, group.reshape(-1), rank)
    return np.asarray(np.argsort(np.argsort(least))[group.reshape(-1)])


def joined(pairs: Array, count: int) -> Array:
    """(count,) number of the connected set of each member.  pairs: (e, 2)."""
    ones = np.ones(len(pairs), dtype=bool)
    graph = scipy.sparse.coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1])


def leaders(q: Array) -> Array:
    """(m,) the first earlier row within `REPEAT` that leads a group itself, else the row."""
    lead = np.arange(len(q))
    for row in range(len(q)):
        ahead = np.flatnonzero(lead[:row] == np.arange(row))
        close = np.linalg.norm(q[ahead] - q[row], axis=1) < REPEAT
        if close.any():
            lead[row] = ahead[np.argmax(close)]
    return lead


@remembered
def clusters(data: Measurements) -> Array:
    """(m,) a number for each pose; poses of a cluster share it, repeats always do.

    There are clusters where, joining what is nearest first, the joining distance jumps: inside
    they are at least `APART` times smaller than between.  A `group` column decides instead.
    """
    group = groups(data)
    if "group" in data.columns:
        return merged(data, data.columns["group"])
    _, first = np.unique(group, return_index=True)
    if not 2 * FEWEST_CLUSTERS <= len(first) <= MOST:
        return group
    pairs, length = shortest_tree(data.q[first])
    height = np.maximum(np.sort(length), REPEAT)
    for at in np.argsort(-(height[1:] / height[:-1])):
        if height[at + 1] < APART * height[at]:
            break
        label = joined(pairs[length <= height[at] * (1.0 + 1e-9)], len(first))
        alone = np.bincount(label)[label] == 1
        if len(np.unique(label)) >= FEWEST_CLUSTERS and alone.mean() < 0.5:
            return numbered_by_joints(label[group], data.q)
    return group


def with_groups(data: Measurements) -> Measurements:
    """The data with a `group` column where poses stand in clusters, so that every part knows it."""
    label = clusters(data)
    if "group" in data.columns or label.max() == groups(data).max():
        return data
    return replace(data, columns={**data.columns, "group": label.astype(str)})


def merged(data: Measurements, labels: Array) -> Array:
    """Repeats, joined where their rows share a label; an empty label joins nothing."""
    group, names = groups(data), np.asarray(labels).astype(str)
    m = len(group)
    told = np.flatnonzero((names != "") & (names != "nan"))
    _, label = np.unique(names[told], return_inverse=True)
    nodes = np.concatenate([np.stack([np.arange(m), m + group], axis=1),
                            np.stack([told, 2 * m + label.reshape(-1)], axis=1)])  # fmt: skip
    return numbered_by_joints(joined(nodes, 3 * m)[:m], data.q)


def grouped(data: Measurements, by: str | None = None) -> Array:
    """(m,) which poses stand on one side of the split.

    by: a column whose equal values stay together, `region` for clusters in joint space; else
    `clusters`.  Raises OptionError.
    """
    if by is None:
        return clusters(data)
    if by == "region":
        return merged(data, regions(data))
    columns = {**data.unknown, **data.columns}
    if by not in columns:
        named = ", ".join(["region", *columns])
        raise OptionError(f"holdout-by {by!r}: {data.source} has no such column; choose {named}")
    return merged(data, columns[by])


def split(
    data: Measurements, holdout: float, seed: int, by: str | None = None
) -> tuple[Measurements, Measurements, tuple[str, ...]]:
    """Training and held-out poses, and notices.

    A `split` column decides where there is one; else a seeded random share of the poses is held
    out, all rows of a group together (`grouped`).  Raises OptionError, DataError.
    """
    held, notices = held_out(data, holdout, seed, by)
    return data.take(~held), data.take(held), notices


def check_chance(holdout: float, seed: int) -> None:
    """Raise OptionError for a share of poses, or a seed, that cannot be."""
    check_seed(seed)
    if not 0.0 <= holdout < 1.0:
        raise OptionError(f"holdout {holdout:g} is not a fraction; give 0 <= holdout < 1, as 0.2")


def held_out(
    data: Measurements, holdout: float, seed: int, by: str | None = None
) -> tuple[Array, tuple[str, ...]]:
    """(m,) True for rows that no fit may see, and notices.  As `split`."""
    check_chance(holdout, seed)
    if "split" in data.columns and by is None:
        return told_to_hold(data)
    group = grouped(data, by)
    count = int(group.max()) + 1
    chosen = round(holdout * count)
    if chosen == count:
        raise OptionError(
            f"holdout {holdout:g} leaves none of {count} poses for training; give less"
        )
    held = np.isin(group, np.random.default_rng(seed).permutation(count)[:chosen])
    poses = len(np.unique(groups(data)))
    if by is None and 1.5 * count < poses:
        return held, (
            f"{poses} poses stand in {count} groups: whole groups are held out, and intervals "
            "count groups, not poses",
        )
    return held, ()


def told_to_hold(data: Measurements) -> tuple[Array, tuple[str, ...]]:
    """What the `split` column holds out.  Raises DataError."""
    labels = np.char.lower(data.columns["split"].astype(str))
    odd = ~np.isin(labels, ("train", "holdout"))
    if odd.any():
        row = int(np.argmax(odd))
        label = str(data.columns["split"][row])
        raise DataError(
            f"{data.source}:{data.line[row]}: column split: {label!r} is neither train nor holdout"
        )
    held = np.asarray(labels == "holdout")
    if held.all():
        raise DataError(f"{data.source}: column split leaves no row for training")
    notices: tuple[str, ...] = ("the split column decides what is held out",)
    shared = groups(data)
    if np.isin(shared[held], shared[~held]).any():
        notices += ("some poses stand both in training and in the held-out rows",)
    return held, notices


# ---- parts that are left out whole -------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Region:
    """Some of the poses.  name: for people.  rows: (m,) True for them."""

    name: str
    rows: Array


def parts(data: Measurements, by: str | None = None) -> tuple[Region, ...]:
    """What can be left out whole: regions, ends of joints, the last poses, sessions, groups.

    Of poses that belong together all or none.  Parts of few poses, or of most of them, are not
    among them.  by: as in `grouped`, its groups are then the parts.
    """
    group = groups(data)
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    out, known = [], set()
    for part in candidates(data, by):
        rows = part.rows[first][inverse.reshape(-1)]
        if FEWEST <= rows.sum() <= MOST_OF * data.poses and rows.tobytes() not in known:
            known.add(rows.tobytes())
            out.append(Region(part.name, rows))
    return tuple(out)


def candidates(data: Measurements, by: str | None) -> Iterator[Region]:
    """Parts, whatever their size."""
    if by is not None:
        label = grouped(data, by)
        for number in np.unique(label):
            rows = label == number
            yield Region(f"the {by} of {data.called(data.line[np.argmax(rows)])}", rows)
        return
    label = regions(data)
    for number in np.unique(label):
        yield Region(region_name(data, label == number), label == number)
    for joint, q in enumerate(data.q.T):
        low, high = np.quantile(q, [QUARTER, 1.0 - QUARTER])
        if np.ptp(q) > MOVES:
            yield Region(f"joint {joint + 1} at its low end", q < low)
            yield Region(f"joint {joint + 1} at its high end", q > high)
    if numbered(data) or "time" in data.columns:
        when = data.columns.get("clock", clock(data))
        yield Region("the last fifth", when > np.quantile(when, 1.0 - LATE))
    session = sessions(data)
    for number in np.unique(session) if session.any() else ():
        rows = session == number
        yield Region(f"session {data.columns['session'][np.argmax(rows)]}", rows)


def regions(data: Measurements) -> Array:
    """(m,) number of the cluster of joint values that a pose is in, out of about `REGIONS`."""
    count = min(REGIONS, len(np.unique(groups(data))))
    return nearest_means(data.q, count, np.random.default_rng(0))


def nearest_means(q: Array, count: int, rng: np.random.Generator) -> Array:
    """(m,) the nearest of some means of q (m, n) [Lloyd 1982; Arthur and Vassilvitskii 2007].

    Ten rounds from a start that is drawn apart, as `scipy.cluster.vq.kmeans2` takes them, which is
    slow to import.
    """

    def squares() -> Array:
        return np.stack([((q - mean) ** 2).sum(axis=1) for mean in means])

    means = q[[rng.integers(len(q))]]
    while len(means) < count:
        square = squares().min(axis=0)
        chosen = np.searchsorted((square / square.sum()).cumsum(), rng.uniform())
        means = np.concatenate([means, q[[chosen]]])
    for _ in range(LLOYD):
        label = squares().argmin(axis=0)
        size = np.bincount(label, minlength=count)
        total = np.stack([np.bincount(label, column, count) for column in q.T], axis=1)
        means = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], means)
    return np.asarray(label)


def region_name(data: Measurements, rows: Array) -> str:
    """A region by the joint in which it differs most from the other poses."""
    middle = np.median(data.q, axis=0)
    off = np.median(data.q[rows], axis=0) - middle
    joint = int(np.argmax(np.abs(off)))
    value = middle[joint] + off[joint]
    shown = f"{1e3 * value:.0f} mm" if data.sliding[joint] else f"{np.degrees(value):.0f} deg"
    return f"region about joint {joint + 1} = {shown}"
