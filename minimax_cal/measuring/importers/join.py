"""Rows of points and rows of joints become poses."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.reading import Reading

RIGID, LOOSE = 0.02, 0.1  # spread of the distances between targets, relative: one body, or not


@dataclass(frozen=True, eq=False)
class Places:
    """Where the rows of a file of points go.

    pose: (m,) row of the joints.  slot: (m,) which target, where rows take turns.
    names: of the targets, '' where the file does not tell.  how: for people.
    """

    pose: Array
    slot: Array
    names: tuple[str, ...]
    how: str


def place(points: Reading, joints: Reading, layout: str) -> Places:
    """Match rows of points to rows of joints.  Raises DataError naming file and line."""
    if points is joints:
        return with_targets(points, np.arange(len(points.line)), "same row")
    key, other = points.find("pose"), joints.find("pose")
    if key and other and set(key.cells) & set(other.cells):
        return by_key(points, joints)
    return by_count(points, joints, layout)


def settled(points: Reading, joints: Reading, layout: str) -> Reading:
    """A file of points, those that are marked deleted set aside.

    A point that was measured anew has a row of its own: then the rest is as many as the joints, and
    the deleted one is left out.  Where it was not, its row keeps the place of its pose.  Raises
    DataError where neither holds.
    """
    if not points.deleted:
        return points
    beside, rest = points.kept_beside(), points.measured_again()
    if points is joints:
        return beside
    keyed = points.find("pose") and joints.find("pose")
    first, second = (beside, rest) if keyed else (rest, beside)
    try:
        place(first, joints, layout)
    except DataError as error:
        try:
            place(second, joints, layout)
        except DataError:
            raise DataError(f"{error} (left out as marked deleted: {points.where})") from None
        return second
    return first


def labels_of(points: Reading) -> tuple[tuple[str, ...], Array]:
    """Names of the targets in order of appearance, and (m,) the index of each row's."""
    column = points.find("target")
    if column is None or len(points.smrs) > 1:
        return ("",), np.zeros(len(points.line), dtype=int)
    names = tuple(dict.fromkeys(column.cells))
    return names, np.array([names.index(cell) for cell in column.cells])


def with_targets(points: Reading, pose: Array, how: str) -> Places:
    """Rows whose pose is known; a target's name says which target."""
    names, slot = labels_of(points)
    seen: dict[tuple[int, int], int] = {}
    for line, at in zip(points.line, zip(pose, slot, strict=True), strict=True):
        if at in seen:
            raise DataError(
                f"{points.sheet.path}:{line}: a second point of the pose and target of line "
                f"{seen[at]}; delete one, or name the targets in a column target"
            )
        seen[at] = int(line)
    return Places(pose, slot, names, how)


def by_key(points: Reading, joints: Reading) -> Places:
    """Match by a column both files have."""
    key, other = points.find("pose"), joints.find("pose")
    if key is None or other is None:
        raise DataError(f"{points.sheet.path}: has no key column")
    row: dict[str, int] = {}
    for i, name in enumerate(other.cells):
        if name in row:
            raise DataError(
                f"{joints.sheet.path}:{joints.line[i]}: {name!r} stands twice in the key column "
                f"{other.name}; rename or delete one"
            )
        row[name] = i
    for i, name in enumerate(key.cells):
        if name not in row:
            raise DataError(
                f"{points.sheet.path}:{points.line[i]}: {name!r} is in no row of "
                f"{joints.sheet.path}; mend column {key.name}, or delete the row"
            )
    return with_targets(points, np.array([row[name] for name in key.cells]), f"key {key.name}")


def by_count(points: Reading, joints: Reading, layout: str) -> Places:
    """Match by order: one point a row of joints, or as many for each."""
    names, slot = labels_of(points)
    m, poses = len(points.line), len(joints.line)
    if len(names) > 1:
        count = np.bincount(slot, minlength=len(names))
        if np.all(count == poses):
            turn = np.zeros(m, dtype=int)
            for target in range(len(names)):
                turn[slot == target] = np.arange(poses)
            return with_targets(points, turn, "order, targets by name")
        if m != poses:
            odd = int(np.argmax(count != poses))
            last = points.line[np.flatnonzero(slot == odd)[-1]]
            raise DataError(
                f"{points.sheet.path}:{last}: target {names[odd]!r} has {count[odd]} points, but "
                f"{joints.sheet.path} has {poses} rows; complete them, or give both files a "
                "column pose"
            )
    if m == poses:
        return with_targets(points, np.arange(m), "order")
    if m > poses and m % poses == 0 and len(points.smrs) == 1:
        return by_turns(points, joints, layout)
    if m > poses:
        raise DataError(
            f"{points.sheet.path}:{points.line[poses]}: point {poses + 1} has no joints: there "
            f"are {m} points, but {poses} rows in {joints.sheet.path}; delete what does not "
            "belong, or give both files a column pose"
        )
    raise DataError(
        f"{joints.sheet.path}:{joints.line[m]}: joint row {m + 1} has no point: there are {poses} "
        f"rows, but {m} points in {points.sheet.path}; delete what does not belong, or give both "
        "files a column pose"
    )


def by_turns(points: Reading, joints: Reading, layout: str) -> Places:
    """As many points for each row of joints: which of them belong together, a rigid body tells."""
    poses = len(joints.line)
    k = len(points.line) // poses
    index = np.arange(len(points.line))
    ways = {"pose": (index // k, index % k), "target": (index % poses, index // poses)}
    if not layout:
        number = points.smrs[0]
        xyz = np.stack(
            [points.numbers(points.column(f"smr{number}_{axis}")) for axis in "xyz"], axis=1
        )
        loose = {
            "pose": looseness(xyz.reshape(poses, k, 3)),
            "target": looseness(xyz.reshape(k, poses, 3).swapaxes(0, 1)),
        }
        rigid = [way for way, spread in loose.items() if spread < RIGID]
        if len(rigid) != 1 or max(loose.values()) < LOOSE:
            raise DataError(
                f"{points.sheet.path}: {k} points for each row of {joints.sheet.path}; add "
                "layout='pose' if the points of a pose follow each other, or layout='target' if "
                "those of a target do"
            )
        layout = rigid[0]
    pose, slot = ways[layout]
    names, _ = labels_of(points)
    return Places(pose, slot, names * k, f"{k} points a row, by {layout}")


def looseness(bodies: Array) -> float:
    """How much the distances between targets vary, relative to them.  bodies: (m, k, 3)."""
    m, k, _ = bodies.shape
    if m < 3:
        return float("nan")
    first, second = np.triu_indices(k, 1)
    apart = np.linalg.norm(bodies[:, first] - bodies[:, second], axis=-1)
    mean = np.nanmean(apart, axis=0)
    return float((np.nanstd(apart, axis=0) / np.maximum(mean, 1e-12)).max())


def in_file_order(readings: list[Reading]) -> list[Reading]:
    """Files of targets sorted by the number in their names, where each has its own."""
    numbers = [re.findall(r"\d+", reading.sheet.path.stem)[-1:] for reading in readings]
    found = [int(number[0]) for number in numbers if number]
    if len(found) < len(readings) or len(set(found)) < len(found):
        return readings
    return [readings[i] for i in np.argsort(found)]
