"""Which poses belong together, which are held out, and which parts of the poses can be left out.

Two questions are asked of poses that no fit has seen.  Does the model hold between the measured
poses (*within*: some are held out at random)?  Does it hold where none was measured (*beyond*: a
whole part is left out)?  Poses that repeat each other, or stand in one cluster, are on one side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from typing import NamedTuple
from weakref import finalize

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.option_fields import check_seed
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import (
    has_order_numbers,
    session_clock_values,
    session_indices,
)

# Joints (root of the sum of squares) within half a milliradian, or half a millimetre of a slide:
# arms come back so near to where they were, and nobody measures two places so near each other.
MAX_REPEAT_DISTANCE = 5e-4
MIN_CLUSTER_GAP_RATIO = 3.0  # the distance between clusters over those inside them
MIN_CLUSTERS = (
    8  # fewer are regions of the workspace: `list_holdout_regions` leaves each out in its turn
)
GROUPING_COLUMNS = ("pose", "group")  # columns that tell which poses belong together
MAX_POSES_PAIRED_BY_SORTING = 2000  # poses among which pairs are found by sorting, without a tree
MAX_CLUSTERED_POSES = 3000  # poses among which clusters are looked for
MIN_MOVING_JOINT_RANGE = 0.01  # a joint with less range does not move [rad, m]
FULL_TURN = 2.0 * np.pi
JOINT_REGION_COUNT = 5  # clusters of joint values that are left out in their turn
LLOYD_ROUNDS = 10  # rounds that find them
JOINT_END_QUANTILE = 0.25  # of the poses at each end of a joint
LAST_SESSION_PART = 0.2  # share of a session that its last part is
MAX_REGION_SHARE = 0.5  # share of the poses that a part may have
MIN_REGION_POSES = 3  # poses of a part


def cache_by_joint_values(
    find_labels: Callable[[Measurements], Array],
) -> Callable[[Measurements], Array]:
    """The function, whose answers are kept as long as the joint values of the poses.

    One calibration asks a dozen times, and arrays of measurements are never changed in place.  The
    answer must rest on joints and labels alone.
    """
    known: dict[int, tuple[Mapping[str, Array], Array]] = {}

    @wraps(find_labels)
    def asked(data: Measurements) -> Array:
        labels = {name: data.columns[name] for name in GROUPING_COLUMNS if name in data.columns}
        here = known.get(id(data.q))
        if here is None:
            finalize(data.q, known.pop, id(data.q), None)
        if here is None or labels.keys() != here[0].keys() or any(
            here[0][name] is not label for name, label in labels.items()
        ):  # fmt: skip
            here = known[id(data.q)] = labels, find_labels(data)
        return here[1].copy()

    return asked


@cache_by_joint_values
def group_repeated_poses(data: Measurements) -> Array:
    """(m,) a number for each pose: rows at the same joints, or of the same `pose`, share it."""
    near = find_close_pairs(data.q, MAX_REPEAT_DISTANCE)
    group = connected_components(near, data.poses) if len(near) else np.arange(data.poses)
    for label in np.unique(group[near[:, 0]]) if len(near) else ():
        rows = np.flatnonzero(group == label)
        if np.ptp(data.q[rows], axis=0).max() > 2.0 * MAX_REPEAT_DISTANCE:  # a path, not a pose
            group[rows] = group.max() + 1 + find_group_leaders(data.q[rows])
    if "pose" in data.columns:
        labels = data.columns["pose"]
        for label in np.unique(labels[labels != ""]):
            same = np.isin(group, group[labels == label])
            group[same] = group[same].min()
    return number_groups_by_joints(group, data.q)


def group_agreeing_visits(data: Measurements) -> Array:
    """(m,) a number for each pose, load and session: rows that share it are visits that should
    agree; between sessions something may have moved.
    """
    group = group_repeated_poses(data)
    if len(group) and group.max() + 1 == len(group):  # no pose was visited again
        return group
    load = np.nan_to_num(data.columns.get("payload", np.zeros(data.poses)).astype(float))
    both = np.stack([group.astype(float), load, session_indices(data).astype(float)])
    return np.asarray(np.unique(both, axis=1, return_inverse=True)[1]).reshape(-1)


def sum_rows_by_group(rows: Array, group_labels: Array) -> Array:
    """Sums of rows (m, ...) over each group."""
    _, place = np.unique(group_labels, return_inverse=True)
    out = np.zeros((place.max() + 1, *rows.shape[1:]))
    np.add.at(out, place, rows)
    return out


class GroupDeviations(NamedTuple):
    """Deviations (m, c) from the mean of the group, and degrees of freedom (c,)."""

    deviations: Array
    degrees_of_freedom: Array


def deviations_from_group_means(values: Array, group_labels: Array) -> GroupDeviations:
    """Deviations (m, c) from the mean of the group, 0 for NaN, and degrees of freedom of each."""
    known = np.isfinite(values)
    _, place = np.unique(group_labels, return_inverse=True)
    count = np.maximum(sum_rows_by_group(known.astype(float), group_labels), 1.0)[place]
    # means of what is left after one row of each group are exact to rounding, far from the origin
    first = np.unique(place, return_index=True)[1][place]
    moved = np.where(known & known[first], values - values[first], 0.0)
    moved = np.where(known & ~known[first], values, moved)
    alone = np.where(known, moved - (sum_rows_by_group(moved, group_labels)[place] / count), 0.0)
    return GroupDeviations(alone, np.where(known, 1.0 - 1.0 / count, 0.0))


def describe_mislabelled_pose(data: Measurements) -> str:
    """Which `pose` label stands at poses that are not one, to people; '' for none.

    A joint may have come back a whole turn away.
    """
    labels = data.columns.get("pose", np.full(data.poses, "")).astype(str)
    for label in np.unique(labels[labels != ""]):
        rows = np.flatnonzero(labels == label)
        off = data.q[rows] - data.q[rows[0]]
        off = np.abs(off - np.where(data.sliding, 0.0, FULL_TURN * np.round(off / FULL_TURN)))
        if off.max() > MIN_MOVING_JOINT_RANGE:
            row, joint = np.argwhere(off == off.max())[0]
            size = f"{1e3 * off.max():.3g} mm" if data.sliding[joint] else f"{off.max():.3g} rad"
            return (
                f"{data.source}:{data.line[rows[row]]}: pose {str(label)!r} is also that of line "
                f"{data.line[rows[0]]}, where joint {joint + 1} differs by {size}; an equal label "
                "says that the same pose was visited again: name each pose by itself"
            )
    return ""


def find_close_pairs(q: Array, max_distance: float) -> Array:
    """(e, 2) rows of q (m, n) that lie so near each other."""
    if len(q) > MAX_POSES_PAIRED_BY_SORTING:
        return scipy.spatial.KDTree(q).query_pairs(max_distance, output_type="ndarray")
    widest = q[:, np.argmax(np.ptp(q, axis=0))] if len(q) else q[:, 0]
    order = np.argsort(widest, kind="stable")
    found = [np.zeros((0, 2), dtype=int)]
    for apart in range(1, len(q)):
        first, second = order[:-apart], order[apart:]
        near = np.flatnonzero(widest[second] - widest[first] <= max_distance)
        if not len(near):
            break
        pairs = np.stack([first[near], second[near]], axis=1)
        found.append(pairs[np.linalg.norm(q[pairs[:, 0]] - q[pairs[:, 1]], axis=1) <= max_distance])
    return np.concatenate(found)


class SpanningTree(NamedTuple):
    """Edges (m - 1, 2) of the shortest tree that joins all rows, and their lengths (m - 1,)."""

    edges: Array
    lengths: Array


def minimum_spanning_tree(q: Array) -> SpanningTree:
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
    return SpanningTree(pairs, np.sqrt(length))


def number_groups_by_joints(group_labels: Array, q: Array) -> Array:
    """The same groups, numbered by their joint values, so that rows in another order split alike.

    group_labels: (m,).  q: (m, n).
    """
    _, group_labels = np.unique(group_labels, return_inverse=True)
    rounded = np.round(q, 9)
    order, rank = np.lexsort(rounded.T[::-1]), np.zeros(len(q), dtype=int)
    rank[order[1:]] = (np.diff(rounded[order], axis=0) != 0.0).any(axis=1).cumsum()
    least = np.full(int(group_labels.max()) + 1, len(q))
    np.minimum.at(least, group_labels.reshape(-1), rank)
    return np.asarray(np.argsort(np.argsort(least))[group_labels.reshape(-1)])


def connected_components(pairs: Array, count: int) -> Array:
    """(count,) number of the connected set of each member.  pairs: (e, 2)."""
    ones = np.ones(len(pairs), dtype=bool)
    graph = scipy.sparse.coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1])


def find_group_leaders(q: Array) -> Array:
    """(m,) the first earlier row within `MAX_REPEAT_DISTANCE` that leads a group itself, else the
    row.
    """
    lead = np.arange(len(q))
    for row in range(len(q)):
        ahead = np.flatnonzero(lead[:row] == np.arange(row))
        close = np.linalg.norm(q[ahead] - q[row], axis=1) < MAX_REPEAT_DISTANCE
        if close.any():
            lead[row] = ahead[np.argmax(close)]
    return lead


@cache_by_joint_values
def cluster_poses(data: Measurements) -> Array:
    """(m,) a number for each pose; poses of a cluster share it, repeats always do.

    There are clusters where, joining what is nearest first, the joining distance jumps: inside they
    are at least `MIN_CLUSTER_GAP_RATIO` times smaller than between.  A `group_labels` column
    decides instead.
    """
    group = group_repeated_poses(data)
    if "group" in data.columns:
        return merge_repeats_by_label(data, data.columns["group"])
    _, first = np.unique(group, return_index=True)
    if not 2 * MIN_CLUSTERS <= len(first) <= MAX_CLUSTERED_POSES:
        return group
    pairs, length = minimum_spanning_tree(data.q[first])
    height = np.maximum(np.sort(length), MAX_REPEAT_DISTANCE)
    for at in np.argsort(-(height[1:] / height[:-1])):
        if height[at + 1] < MIN_CLUSTER_GAP_RATIO * height[at]:
            break
        label = connected_components(pairs[length <= height[at] * (1.0 + 1e-9)], len(first))
        alone = np.bincount(label)[label] == 1
        if len(np.unique(label)) >= MIN_CLUSTERS and alone.mean() < 0.5:
            return number_groups_by_joints(label[group], data.q)
    return group


def add_group_column(data: Measurements) -> Measurements:
    """The data with a `group_labels` column where poses stand in clusters, so that every part knows
    it.
    """
    label = cluster_poses(data)
    if "group" in data.columns or label.max() == group_repeated_poses(data).max():
        return data
    return replace(data, columns={**data.columns, "group": label.astype(str)})


def merge_repeats_by_label(data: Measurements, labels: Array) -> Array:
    """Repeats, joined where their rows share a label; an empty label joins nothing."""
    group, names = group_repeated_poses(data), np.asarray(labels).astype(str)
    m = len(group)
    told = np.flatnonzero((names != "") & (names != "nan"))
    _, label = np.unique(names[told], return_inverse=True)
    nodes = np.concatenate([np.stack([np.arange(m), m + group], axis=1),
                            np.stack([told, 2 * m + label.reshape(-1)], axis=1)])  # fmt: skip
    return number_groups_by_joints(connected_components(nodes, 3 * m)[:m], data.q)


def group_for_holdout(data: Measurements, group_by: str | None = None) -> Array:
    """(m,) which poses stand on one side of the split.

    group_by: a column whose equal values stay together, `region` for clusters in joint space; else
    `cluster_poses`.  Raises OptionError.
    """
    if group_by is None:
        return cluster_poses(data)
    if group_by == "region":
        return merge_repeats_by_label(data, cluster_joint_regions(data))
    columns = {**data.unknown, **data.columns}
    if group_by not in columns:
        named = ", ".join(["region", *columns])
        raise OptionError(
            f"holdout-by {group_by!r}: {data.source} has no such column; choose {named}"
        )
    return merge_repeats_by_label(data, columns[group_by])


class HoldoutSplit(NamedTuple):
    """Training and held-out poses, and notices."""

    train: Measurements
    holdout: Measurements
    notices: tuple[str, ...]


def split_train_and_holdout(
    data: Measurements, holdout: float, seed: int, group_by: str | None = None
) -> HoldoutSplit:
    """Training and held-out poses, and notices.

    A `split_train_and_holdout` column decides where there is one; else a seeded random share of the
    poses is held out, all rows of a group together (`group_for_holdout`).  Raises OptionError,
    DataError.
    """
    held, notices = select_holdout_rows(data, holdout, seed, group_by)
    return HoldoutSplit(data.take(~held), data.take(held), notices)


def check_holdout_and_seed(holdout: float, seed: int) -> None:
    """Raise OptionError for a share of poses, or a seed, that cannot be."""
    check_seed(seed)
    if not 0.0 <= holdout < 1.0:
        raise OptionError(f"holdout {holdout:g} is not a fraction; give 0 <= holdout < 1, as 0.2")


class HoldoutMask(NamedTuple):
    """Rows (m,) True where no fit may see them, and notices."""

    holdout_rows: Array
    notices: tuple[str, ...]


def select_holdout_rows(
    data: Measurements, holdout: float, seed: int, group_by: str | None = None
) -> HoldoutMask:
    """(m,) True for rows that no fit may see, and notices.  As `split_train_and_holdout`."""
    check_holdout_and_seed(holdout, seed)
    if "split" in data.columns and group_by is None:
        return holdout_rows_from_split_column(data)
    group = group_for_holdout(data, group_by)
    count = int(group.max()) + 1
    chosen = round(holdout * count)
    if chosen == count:
        raise OptionError(
            f"holdout {holdout:g} leaves none of {count} poses for training; give less"
        )
    held = np.isin(group, np.random.default_rng(seed).permutation(count)[:chosen])
    poses = len(np.unique(group_repeated_poses(data)))
    if group_by is None and 1.5 * count < poses:
        return HoldoutMask(
            held,
            (
                f"{poses} poses stand in {count} groups: whole groups are held out, and intervals "
                "count groups, not poses",
            ),
        )
    return HoldoutMask(held, ())


def holdout_rows_from_split_column(data: Measurements) -> HoldoutMask:
    """What the `split_train_and_holdout` column holds out.  Raises DataError."""
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
    shared = group_repeated_poses(data)
    if np.isin(shared[held], shared[~held]).any():
        notices += ("some poses stand both in training and in the held-out rows",)
    return HoldoutMask(held, notices)


# ---- parts that are left out whole -------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class HoldoutRegion:
    """Some of the poses.  name: for people.  rows: (m,) True for them."""

    name: str
    rows: Array


def list_holdout_regions(
    data: Measurements, group_by: str | None = None
) -> tuple[HoldoutRegion, ...]:
    """What can be left out whole: regions, ends of joints, the last poses, sessions, groups.

    Of poses that belong together all or none.  Parts of few poses, or of most of them, are not
    among them.  group_by: as in `group_for_holdout`, its groups are then the parts.
    """
    group = group_repeated_poses(data)
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    out, known = [], set()
    for part in list_region_candidates(data, group_by):
        rows = part.rows[first][inverse.reshape(-1)]
        if (
            MIN_REGION_POSES <= rows.sum() <= MAX_REGION_SHARE * data.poses
            and rows.tobytes() not in known
        ):
            known.add(rows.tobytes())
            out.append(HoldoutRegion(part.name, rows))
    return tuple(out)


def list_region_candidates(data: Measurements, group_by: str | None) -> Iterator[HoldoutRegion]:
    """Parts, whatever their size."""
    if group_by is not None:
        label = group_for_holdout(data, group_by)
        for number in np.unique(label):
            rows = label == number
            yield HoldoutRegion(
                f"the {group_by} of {data.called(data.line[np.argmax(rows)])}", rows
            )
        return
    label = cluster_joint_regions(data)
    for number in np.unique(label):
        yield HoldoutRegion(describe_region(data, label == number), label == number)
    for joint, q in enumerate(data.q.T):
        low, high = np.quantile(q, [JOINT_END_QUANTILE, 1.0 - JOINT_END_QUANTILE])
        if np.ptp(q) > MIN_MOVING_JOINT_RANGE:
            yield HoldoutRegion(f"joint {joint + 1} at its low end", q < low)
            yield HoldoutRegion(f"joint {joint + 1} at its high end", q > high)
    if has_order_numbers(data) or "time" in data.columns:
        when = data.columns.get("clock", session_clock_values(data))
        yield HoldoutRegion("the last fifth", when > np.quantile(when, 1.0 - LAST_SESSION_PART))
    session = session_indices(data)
    for number in np.unique(session) if session.any() else ():
        rows = session == number
        yield HoldoutRegion(f"session {data.columns['session'][np.argmax(rows)]}", rows)


def cluster_joint_regions(data: Measurements) -> Array:
    """(m,) number of the cluster of joint values that a pose is in, out of about
    `JOINT_REGION_COUNT`.
    """
    count = min(JOINT_REGION_COUNT, len(np.unique(group_repeated_poses(data))))
    return k_means_labels(data.q, count, np.random.default_rng(0))


def k_means_labels(q: Array, mean_count: int, rng: np.random.Generator) -> Array:
    """(m,) the nearest of some means of q (m, n) [Lloyd 1982; Arthur and Vassilvitskii 2007].

    Ten rounds from a start that is drawn apart, as `scipy.cluster.vq.kmeans2` takes them, which is
    slow to import.
    """

    def squares() -> Array:
        return np.stack([((q - mean) ** 2).sum(axis=1) for mean in means])

    means = q[[rng.integers(len(q))]]
    while len(means) < mean_count:
        square = squares().min(axis=0)
        chosen = np.searchsorted((square / square.sum()).cumsum(), rng.uniform())
        means = np.concatenate([means, q[[chosen]]])
    for _ in range(LLOYD_ROUNDS):
        label = squares().argmin(axis=0)
        size = np.bincount(label, minlength=mean_count)
        total = np.stack([np.bincount(label, column, mean_count) for column in q.T], axis=1)
        means = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], means)
    return np.asarray(label)


def describe_region(data: Measurements, rows: Array) -> str:
    """A region by the joint in which it differs most from the other poses."""
    middle = np.median(data.q, axis=0)
    off = np.median(data.q[rows], axis=0) - middle
    joint = int(np.argmax(np.abs(off)))
    value = middle[joint] + off[joint]
    shown = f"{1e3 * value:.0f} mm" if data.sliding[joint] else f"{np.degrees(value):.0f} deg"
    return f"region about joint {joint + 1} = {shown}"
