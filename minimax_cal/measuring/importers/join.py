"""Rows of points and rows of joints become poses, by names where both have some, else by order.

Names are equal but for spelling, or have the target's beside: ``P17_2`` is target 2 at pose
``P17``; ``SMR1-P017`` target smr1 there; ``Pkt 17`` the pose ``P17``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.importers.tables import Column, Reading
from minimax_cal.reading.words import folded

PART = re.compile(r"\d+|[^\W\d_]+")
MOST_BESIDE = 3  # parts of a name that may be the target's
COMMON = 0.5  # of the count of the commonest word
ENOUGH = 0.5  # of the points that a pattern must find poses for
Parts = tuple[str | int, ...]
LABELS = ("", "group", "tool")  # meanings of columns that may name targets
LEAST_PARTS = 2  # of a name that holds a pose and a target: at least
SAME = "same row"
MOST_NAMED = 12  # points or poses that a notice names
RIGID, LOOSE = 0.02, 0.1  # spread of the distances between targets, relative: one body, or not


@dataclass(frozen=True)
class Match:
    """pose: for each point the row of its pose, -1 for none.  label: its target, '' not given.

    how: the pattern, for people.
    """

    pose: tuple[int, ...]
    label: tuple[str, ...]
    how: str


def parts_of(name: str) -> Parts:
    """Words and numbers of a name: P017-a is p, 17, a."""
    return tuple(int(p) if p.isdecimal() else p for p in PART.findall(folded(name)))


def match_names(points: Sequence[str], poses: Sequence[str]) -> Match | None:
    """How names of points tell their poses; None where no pattern finds half of either.

    poses: names without repeats.
    """
    found = [
        match
        for match in patterns(points, poses)
        if max(share_of(match), len({*match.pose} - {-1}) / max(len(poses), 1)) >= ENOUGH
    ]
    return max(found, key=share_of, default=None)


def share_of(match: Match) -> float:
    """Share of the points that have a pose."""
    return sum(row >= 0 for row in match.pose) / max(len(match.pose), 1)


def patterns(points: Sequence[str], poses: Sequence[str]) -> Iterator[Match]:
    """Every pattern tried, the plainest first; numbers alone only where no name has a pose."""
    rows = {parts_of(name): i for i, name in enumerate(poses)}
    names = [parts_of(name) for name in points]
    if len(rows) == len(poses):
        every = [matched(points, poses, [(rows.get(parts, -1), "") for parts in names], "name")]
        for way, last in (("pose, target", True), ("target, pose", False)):
            found = [beside(parts, rows, last) for parts in names]
            every.append(matched(points, poses, found, f"name: {way}"))
        yield from every
        if any(map(share_of, every)):
            return
    numbers = {n: i for i, name in enumerate(poses) if (n := number_of(parts_of(name))) >= 0}
    if len(numbers) == len(poses):
        yield matched(points, poses, by_number(names, numbers), "number in the name")


def beside(parts: Parts, rows: Mapping[Parts, int], last: bool) -> tuple[int, str]:
    """The pose's row and the target, where the target's name comes last, or first."""
    for size in range(1, min(MOST_BESIDE, len(parts) - 1) + 1):
        cut = len(parts) - size if last else size
        ends = parts[:cut], parts[cut:]
        if (row := rows.get(ends[not last], -1)) >= 0:
            return row, "".join(map(str, ends[last]))
    return -1, ""


def by_number(names: Sequence[Parts], numbers: Mapping[int, int]) -> list[tuple[int, str]]:
    """The pose's row where the number alone tells, and the word beside it where several are common.

    Rare words name other things: R1 to R3 among P1 to P48 are references.
    """
    words = [" ".join(part for part in parts if isinstance(part, str)) for parts in names]
    count = Counter(words)
    common = {word for word in count if count[word] >= COMMON * max(count.values())}
    return [
        (numbers.get(number_of(parts), -1), word if len(common) > 1 else "")
        if word in common
        else (-1, "")
        for parts, word in zip(names, words, strict=True)
    ]


def number_of(parts: Parts) -> int:
    """The one number of a name, -1 where there is none, or several."""
    found = [part for part in parts if isinstance(part, int)]
    return found[0] if len(found) == 1 else -1


def matched(
    points: Sequence[str], poses: Sequence[str], found: Sequence[tuple[int, str]], how: str
) -> Match:
    """A match, with its first example."""
    row, label = next(((r, text) for r, text in found if r >= 0), (-1, ""))
    if row >= 0:
        first = points[[r for r, _ in found].index(row)]
        said = f"{first} is pose {poses[row]}" + (f", target {label}" if label else "")
        how = f"{how} ({said})" if first != poses[row] else how
    return Match(tuple(r for r, _ in found), tuple(text for _, text in found), how)


def natural(label: str) -> tuple[Parts, ...]:
    """A key that sorts labels as people do: 2 before 10, numbers before words."""
    return tuple((p, "") if isinstance(p, int) else (10**9, p) for p in parts_of(label))


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


def place(points: Reading, joints: Reading, layout: str) -> tuple[Reading, Places]:
    """Rows of points that have a pose, and where they go.  Raises DataError naming file and line.

    By names where both files have some, else by order.  What is missing is listed.
    """
    points, spot = placed(points, joints, layout)
    return points.saying(*gaps(points, joints, spot)), spot


def placed(points: Reading, joints: Reading, layout: str) -> tuple[Reading, Places]:
    """Rows of points and where they go."""
    if points is joints:
        return points, with_targets(points, np.arange(len(points.line)), SAME)
    key, other = points.find("pose"), joints.find("pose")
    if not (key and other):
        return points, by_count(points, joints, layout)
    check_unique(joints, other)
    match = match_names(key.cells, other.cells)
    if match is None:
        said = (
            f"names of the points ({key.cells[0]} ...) and of the joints in {joints.sheet.path} "
            f"({other.cells[0]} ...) have nothing in common: they are matched by order"
        )
        return points.saying(said), by_count(points, joints, layout)
    return by_name(points, joints, match)


def with_keys(points: Reading, joints: Reading) -> Reading:
    """The points with the column that names their poses, whatever it is called.

    Trackers call it target.  Where points share a name, the column that tells them apart names the
    targets.
    """
    other = joints.find("pose")
    if points is joints or other is None:
        return points
    for key in (points.find("pose"), points.find("target")):
        if key and (match := match_names(key.cells, other.cells)):
            beside = points.find("pose")
            given = {beside.name: ""} if beside and beside is not key else {}
            points = points.meaning({**given, key.name: "pose"})
            return points if points.find("target") else with_target(points, match)
    return points


def with_target(points: Reading, match: Match) -> Reading:
    """Points that share a name with the column that tells them apart as that of their targets."""
    gone = set(points.deleted)
    rows = [i for i, pose in enumerate(match.pose) if pose >= 0 and i not in gone]
    names = [(match.pose[i], match.label[i]) for i in rows]
    most = max(Counter(names).values(), default=1)
    for column in points.columns if most > 1 else ():
        cells = [column.cells[i] for i in rows]
        apart = len(set(zip(names, cells, strict=True))) == len(rows)
        if column.meaning in LABELS and apart and len(set(cells)) == most:
            return points.meaning({column.name: "target"})
    return points


def check_unique(joints: Reading, key: Column) -> None:
    """Raise DataError where two poses have one name."""
    first: dict[str, int] = {}
    for line, name in zip(joints.line, key.cells, strict=True):
        if name in first:
            raise DataError(
                f"{joints.sheet.path}:{line}: {name!r} stands twice in the key column {key.name} "
                f"(line {first[name]}); rename or delete one"
            )
        first[name] = int(line)


def by_name(points: Reading, joints: Reading, match: Match) -> tuple[Reading, Places]:
    """Points where their names say; those without a pose left out."""
    rows = np.array(match.pose)
    kept = np.flatnonzero(rows >= 0)
    if len(lost := np.flatnonzero(rows < 0)):
        key = points.column("pose")
        named = [f"{key.cells[i]} (line {points.line[i]})" for i in lost]
        points = points.saying(
            f"{len(lost)} points have no pose of their name in {joints.sheet.path} and are left "
            f"out: {name_first(named, MOST_NAMED)}"
        )
    points, labels = points.take(kept), [match.label[i] for i in kept]
    own, slot = labels_of(points)
    if own == ("",) and len(set(labels)) > 1:
        own = tuple(sorted(set(labels), key=natural))
        slot = np.array([own.index(label) for label in labels])
    first = without_repeats(points, rows[kept], slot)
    if len(first) < len(kept):
        again = sorted({*range(len(kept))} - {*first})
        points = points.saying(f"points that are there twice, left out once: {points.lines(again)}")
        points, kept, slot = points.take(first), kept[first], slot[first]
    check_once(points, rows[kept], slot)
    return points, Places(rows[kept], slot, own, match.how)


def without_repeats(points: Reading, pose: Array, slot: Array) -> list[int]:
    """The rows of points without those that repeat an earlier one, digit by digit."""
    coordinates = [column.cells for column in points.columns if column.family == "smr"]
    rows = zip(pose.tolist(), slot.tolist(), *coordinates, strict=True)
    first = {row: i for i, row in reversed(list(enumerate(rows)))}
    return sorted(first.values())


def gaps(points: Reading, joints: Reading, spot: Places) -> list[str]:
    """Poses that lack a point, by their names or lines; none where most do."""
    slots, several = len(spot.names), len(points.smrs) > 1
    seen = np.zeros((len(joints.line), len(points.smrs) * slots), dtype=bool)
    for i, number in enumerate(points.smrs):
        given = np.array([bool(cell) for cell in points.column(f"smr{number}_x").cells])
        seen[spot.pose[given], i * slots + spot.slot[given]] = True
    labels = [
        f"smr{number} {name}".strip() if several else name
        for number in points.smrs
        for name in spot.names
    ]
    key = joints.find("pose")
    names = key.cells if key else [f"line {line}" for line in joints.line]
    poses = np.flatnonzero(~seen.all(axis=1))
    if not len(poses) or 2 * len(poses) > len(seen):
        return []
    out = []
    for pose in poses:
        lacking = [label for label, there in zip(labels, seen[pose], strict=True) if not there]
        whole = len(labels) == 1 or not seen[pose].any()
        out.append(names[pose] + ("" if whole else f" (target {', '.join(lacking)})"))
    return [f"no point, left empty: {name_first(out, MOST_NAMED)}"]


def settled(points: Reading, joints: Reading, layout: str) -> Reading:
    """A file of points, those that are marked deleted set aside.

    A point that was measured anew has a row of its own: then the rest is as many as the joints, and
    the deleted one is left out.  Where it was not, its row keeps the place of its pose.  Raises
    DataError where neither holds.
    """
    if not points.deleted:
        return points
    beside, rest = points.with_deleted(), points.without_deleted()
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
            where = points.lines(points.deleted)
            raise DataError(f"{error} (left out as marked deleted: {where})") from None
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
    check_once(points, pose, slot)
    return Places(pose, slot, names, how)


def check_once(points: Reading, pose: Array, slot: Array) -> None:
    """Raise DataError where a target has two points at a pose."""
    seen: dict[tuple[int, int], int] = {}
    for line, at in zip(points.line, zip(pose, slot, strict=True), strict=True):
        if at in seen:
            raise DataError(
                f"{points.sheet.path}:{line}: a second point of the pose and target of line "
                f"{seen[at]}; delete one, or name the targets in a column target"
            )
        seen[at] = int(line)


def poses_of(reading: Reading) -> Reading | None:
    """Of a table with a row for each point, the rows of its poses; None for one of poses.

    Names tell: P1_1 and P1_2 are two targets at P1, if the joints of both are the same.
    """
    key = reading.find("pose")
    if key is None or reading.find("target") or len(reading.smrs) != 1 or not reading.joints:
        return None
    names = [parts_of(cell) for cell in key.cells]
    joints = list(zip(*(c.cells for c in reading.joints), strict=True))
    first: dict[tuple[str | int, ...], int] = {}
    for i, parts in enumerate(names):
        row = first.setdefault(parts[:-1], i)
        if len(parts) < LEAST_PARTS or joints[row] != joints[i]:
            return None
    if not 2 * len(first) <= len(names) + len(first) // 2 or len(first) < 2:
        return None
    poses = reading.take(np.array(sorted(first.values())))
    stems = tuple("-".join(map(str, parts_of(c)[:-1])) for c in poses.column("pose").cells)
    columns = tuple(replace(c, cells=stems) if c.meaning == "pose" else c for c in poses.columns)
    return replace(poses, columns=columns)


def by_count(points: Reading, joints: Reading, layout: str) -> Places:
    """Match by order: one point a row of joints, or as many for each."""
    for sheet in (points.sheet, joints.sheet):
        if sheet.torn:
            raise DataError(
                f"{sheet.path}:{sheet.torn[0]}: the line is torn, and rows are matched by their "
                "order; complete it, or give both files a column pose"
            )
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
    return Places(pose, slot, names * k, f"order, {k} points a row, by {layout}")


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
