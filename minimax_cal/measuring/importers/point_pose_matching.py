"""Rows of points and rows of joints become poses, by names where both have some, else by order.

Names are equal but for spelling, or have the target's beside: ``P17_2`` is target 2 at pose
``P17``; ``SMR1-P017`` target smr1 there; ``Pkt 17`` the pose ``P17``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import DataError
from minimax_cal.measuring.importers.column_tables import ImportedColumn, ImportedTable
from minimax_cal.reading.column_words import fold_case_and_accents

NAME_PART_PATTERN = re.compile(r"\d+|[^\W\d_]+")
MAX_TARGET_NAME_PARTS = 3  # parts of a name that may be the target's
MIN_COMMON_WORD_SHARE = 0.5  # of the count of the commonest word
MIN_MATCHED_SHARE = 0.5  # of the points that a pattern must find poses for
NameParts = tuple[str | int, ...]
TARGET_LABEL_MEANINGS = ("", "group", "tool")  # meanings of columns that may name targets
MIN_NAME_PARTS = 2  # of a name that holds a pose and a target: at least
SAME_ROW = "same row"
MAX_LISTED_NAMES = 12  # points or poses that a notice names
MAX_RIGID_DISTANCE_SPREAD, MIN_LOOSE_DISTANCE_SPREAD = (
    0.02,
    0.1,
)  # spread of the distances between targets, relative: one body, or not


@dataclass(frozen=True)
class NameMatch:
    """pose: for each point the row of its pose, -1 for none.  label: its target, '' not given.

    how: the pattern, for people.
    """

    pose: tuple[int, ...]
    label: tuple[str, ...]
    how: str


def split_name_into_parts(name: str) -> NameParts:
    """Words and numbers of a name: P017-a is p, 17, a."""
    return tuple(
        int(p) if p.isdecimal() else p
        for p in NAME_PART_PATTERN.findall(fold_case_and_accents(name))
    )


def match_point_names_to_poses(
    point_names: Sequence[str], pose_names: Sequence[str]
) -> NameMatch | None:
    """How names of points tell their poses; None where no pattern finds half of either.

    pose_names: names without repeats.
    """
    found = [
        match
        for match in try_name_patterns(point_names, pose_names)
        if max(matched_point_share(match), len({*match.pose} - {-1}) / max(len(pose_names), 1))
        >= MIN_MATCHED_SHARE
    ]
    return max(found, key=matched_point_share, default=None)


def matched_point_share(match: NameMatch) -> float:
    """Share of the points that have a pose."""
    return sum(row >= 0 for row in match.pose) / max(len(match.pose), 1)


def try_name_patterns(point_names: Sequence[str], pose_names: Sequence[str]) -> Iterator[NameMatch]:
    """Every pattern tried, the plainest first; numbers alone only where no name has a pose."""
    rows = {split_name_into_parts(name): i for i, name in enumerate(pose_names)}
    names = [split_name_into_parts(name) for name in point_names]
    if len(rows) == len(pose_names):
        every = [
            build_name_match(
                point_names, pose_names, [(rows.get(parts, -1), "") for parts in names], "name"
            )
        ]
        for way, last in (("pose, target", True), ("target, pose", False)):
            found = [find_pose_row_and_target_label(parts, rows, last) for parts in names]
            every.append(build_name_match(point_names, pose_names, found, f"name: {way}"))
        yield from every
        if any(map(matched_point_share, every)):
            return
    numbers = {
        n: i
        for i, name in enumerate(pose_names)
        if (n := only_number_in_name(split_name_into_parts(name))) >= 0
    }
    if len(numbers) == len(pose_names):
        yield build_name_match(
            point_names, pose_names, match_names_by_number(names, numbers), "number in the name"
        )


class PoseRowAndTarget(NamedTuple):
    """Row of a pose, -1 where none is found, and the label of a target."""

    pose_row: int
    target_label: str


def find_pose_row_and_target_label(
    name_parts: NameParts, row_by_pose_name: Mapping[NameParts, int], is_target_last: bool
) -> PoseRowAndTarget:
    """The pose's row and the target, where the target's name comes last, or first."""
    for size in range(1, min(MAX_TARGET_NAME_PARTS, len(name_parts) - 1) + 1):
        cut = len(name_parts) - size if is_target_last else size
        ends = name_parts[:cut], name_parts[cut:]
        if (row := row_by_pose_name.get(ends[not is_target_last], -1)) >= 0:
            return PoseRowAndTarget(row, "".join(map(str, ends[is_target_last])))
    return PoseRowAndTarget(-1, "")


def match_names_by_number(
    point_name_parts: Sequence[NameParts], row_by_number: Mapping[int, int]
) -> list[tuple[int, str]]:
    """The pose's row where the number alone tells, and the word beside it where several are common.

    Rare words name other things: R1 to R3 among P1 to P48 are references.
    """
    words = [
        " ".join(part for part in parts if isinstance(part, str)) for parts in point_name_parts
    ]
    count = Counter(words)
    common = {word for word in count if count[word] >= MIN_COMMON_WORD_SHARE * max(count.values())}
    return [
        (row_by_number.get(only_number_in_name(parts), -1), word if len(common) > 1 else "")
        if word in common
        else (-1, "")
        for parts, word in zip(point_name_parts, words, strict=True)
    ]


def only_number_in_name(name_parts: NameParts) -> int:
    """The one number of a name, -1 where there is none, or several."""
    found = [part for part in name_parts if isinstance(part, int)]
    return found[0] if len(found) == 1 else -1


def build_name_match(
    point_names: Sequence[str],
    pose_names: Sequence[str],
    rows_and_labels: Sequence[tuple[int, str]],
    pattern_text: str,
) -> NameMatch:
    """A match, with its first example."""
    row, label = next(((r, text) for r, text in rows_and_labels if r >= 0), (-1, ""))
    if row >= 0:
        first = point_names[[r for r, _ in rows_and_labels].index(row)]
        said = f"{first} is pose {pose_names[row]}" + (f", target {label}" if label else "")
        pattern_text = f"{pattern_text} ({said})" if first != pose_names[row] else pattern_text
    return NameMatch(
        tuple(r for r, _ in rows_and_labels),
        tuple(text for _, text in rows_and_labels),
        pattern_text,
    )


def natural_sort_key(label: str) -> tuple[NameParts, ...]:
    """A key that sorts labels as people do: 2 before 10, numbers before words."""
    return tuple(
        (p, "") if isinstance(p, int) else (10**9, p) for p in split_name_into_parts(label)
    )


@dataclass(frozen=True, eq=False)
class PointPlacement:
    """Where the rows of a file of points go.

    pose: (m,) row of the joints.  slot: (m,) which target, where rows take turns.
    names: of the targets, '' where the file does not tell.  how: for people.
    """

    pose: Array
    slot: Array
    names: tuple[str, ...]
    how: str


class PlacedPoints(NamedTuple):
    """Rows of points that have a pose, and where they go."""

    table: ImportedTable
    placement: PointPlacement


def place_points_and_list_gaps(
    point_table: ImportedTable, joint_table: ImportedTable, layout: str
) -> PlacedPoints:
    """Rows of points that have a pose, and where they go.  Raises DataError naming file and line.

    By names where both files have some, else by order.  What is missing is listed.
    """
    point_table, spot = place_points(point_table, joint_table, layout)
    return PlacedPoints(
        point_table.with_notices(*list_missing_points(point_table, joint_table, spot)), spot
    )


def place_points(
    point_table: ImportedTable, joint_table: ImportedTable, layout: str
) -> PlacedPoints:
    """Rows of points and where they go."""
    if point_table is joint_table:
        return PlacedPoints(
            point_table,
            place_points_by_target_name(point_table, np.arange(len(point_table.line)), SAME_ROW),
        )
    key, other = point_table.find_column("pose"), joint_table.find_column("pose")
    if not (key and other):
        return PlacedPoints(point_table, place_points_by_order(point_table, joint_table, layout))
    check_unique_pose_names(joint_table, other)
    match = match_point_names_to_poses(key.cells, other.cells)
    if match is None:
        said = (
            f"names of the points ({key.cells[0]} ...) and of "
            f"the joints in {joint_table.sheet.path} "
            f"({other.cells[0]} ...) have nothing in common: they are matched by order"
        )
        return PlacedPoints(
            point_table.with_notices(said), place_points_by_order(point_table, joint_table, layout)
        )
    return place_points_by_name(point_table, joint_table, match)


def mark_pose_name_column(point_table: ImportedTable, joint_table: ImportedTable) -> ImportedTable:
    """The points with the column that names their poses, whatever it is called.

    Trackers call it target.  Where points share a name, the column that tells them apart names the
    targets.
    """
    other = joint_table.find_column("pose")
    if point_table is joint_table or other is None:
        return point_table
    for key in (point_table.find_column("pose"), point_table.find_column("target")):
        if key and (match := match_point_names_to_poses(key.cells, other.cells)):
            beside = point_table.find_column("pose")
            given = {beside.name: ""} if beside and beside is not key else {}
            point_table = point_table.with_meanings({**given, key.name: "pose"})
            return (
                point_table
                if point_table.find_column("target")
                else mark_target_column(point_table, match)
            )
    return point_table


def mark_target_column(point_table: ImportedTable, match: NameMatch) -> ImportedTable:
    """Points that share a name with the column that tells them apart as that of their targets."""
    gone = set(point_table.deleted)
    rows = [i for i, pose in enumerate(match.pose) if pose >= 0 and i not in gone]
    names = [(match.pose[i], match.label[i]) for i in rows]
    most = max(Counter(names).values(), default=1)
    for column in point_table.columns if most > 1 else ():
        cells = [column.cells[i] for i in rows]
        apart = len(set(zip(names, cells, strict=True))) == len(rows)
        if column.meaning in TARGET_LABEL_MEANINGS and apart and len(set(cells)) == most:
            return point_table.with_meanings({column.name: "target"})
    return point_table


def check_unique_pose_names(joint_table: ImportedTable, name_column: ImportedColumn) -> None:
    """Raise DataError where two poses have one name."""
    first: dict[str, int] = {}
    for line, name in zip(joint_table.line, name_column.cells, strict=True):
        if name in first:
            raise DataError(
                f"{joint_table.sheet.path}:{line}: {name!r} stands "
                f"twice in the key column {name_column.name} "
                f"(line {first[name]}); rename or delete one"
            )
        first[name] = int(line)


def place_points_by_name(
    point_table: ImportedTable, joint_table: ImportedTable, match: NameMatch
) -> PlacedPoints:
    """Points where their names say; those without a pose left out."""
    rows = np.array(match.pose)
    kept = np.flatnonzero(rows >= 0)
    if len(lost := np.flatnonzero(rows < 0)):
        key = point_table.column_with_meaning("pose")
        named = [f"{key.cells[i]} (line {point_table.line[i]})" for i in lost]
        point_table = point_table.with_notices(
            f"{len(lost)} points have no pose of their name in "
            f"{joint_table.sheet.path} and are left "
            f"out: {format_first_names(named, MAX_LISTED_NAMES)}"
        )
    point_table, labels = point_table.take_rows(kept), [match.label[i] for i in kept]
    own, slot = target_names_and_slots(point_table)
    if own == ("",) and len(set(labels)) > 1:
        own = tuple(sorted(set(labels), key=natural_sort_key))
        slot = np.array([own.index(label) for label in labels])
    first = rows_without_repeats(point_table, rows[kept], slot)
    if len(first) < len(kept):
        again = sorted({*range(len(kept))} - {*first})
        point_table = point_table.with_notices(
            f"points that are there twice, left out once: {point_table.format_lines(again)}"
        )
        point_table, kept, slot = point_table.take_rows(first), kept[first], slot[first]
    check_one_point_per_target(point_table, rows[kept], slot)
    return PlacedPoints(point_table, PointPlacement(rows[kept], slot, own, match.how))


def rows_without_repeats(
    point_table: ImportedTable, pose_rows: Array, target_slots: Array
) -> list[int]:
    """The rows of points without those that repeat an earlier one, digit by digit."""
    coordinates = [column.cells for column in point_table.columns if column.family == "smr"]
    rows = zip(pose_rows.tolist(), target_slots.tolist(), *coordinates, strict=True)
    first = {row: i for i, row in reversed(list(enumerate(rows)))}
    return sorted(first.values())


def list_missing_points(
    point_table: ImportedTable, joint_table: ImportedTable, placement: PointPlacement
) -> list[str]:
    """Poses that lack a point, by their names or lines; none where most do."""
    slots, several = len(placement.names), len(point_table.target_numbers) > 1
    seen = np.zeros((len(joint_table.line), len(point_table.target_numbers) * slots), dtype=bool)
    for i, number in enumerate(point_table.target_numbers):
        given = np.array(
            [bool(cell) for cell in point_table.column_with_meaning(f"smr{number}_x").cells]
        )
        seen[placement.pose[given], i * slots + placement.slot[given]] = True
    labels = [
        f"smr{number} {name}".strip() if several else name
        for number in point_table.target_numbers
        for name in placement.names
    ]
    key = joint_table.find_column("pose")
    names = key.cells if key else [f"line {line}" for line in joint_table.line]
    poses = np.flatnonzero(~seen.all(axis=1))
    if not len(poses) or 2 * len(poses) > len(seen):
        return []
    out = []
    for pose in poses:
        lacking = [label for label, there in zip(labels, seen[pose], strict=True) if not there]
        whole = len(labels) == 1 or not seen[pose].any()
        out.append(names[pose] + ("" if whole else f" (target {', '.join(lacking)})"))
    return [f"no point, left empty: {format_first_names(out, MAX_LISTED_NAMES)}"]


def resolve_deleted_points(
    point_table: ImportedTable, joint_table: ImportedTable, layout: str
) -> ImportedTable:
    """A file of points, those that are marked deleted set aside.

    A point that was measured anew has a row of its own: then the rest is as many as the joints, and
    the deleted one is left out.  Where it was not, its row keeps the place of its pose.  Raises
    DataError where neither holds.
    """
    if not point_table.deleted:
        return point_table
    beside, rest = point_table.with_deleted(), point_table.without_deleted()
    if point_table is joint_table:
        return beside
    keyed = point_table.find_column("pose") and joint_table.find_column("pose")
    first, second = (beside, rest) if keyed else (rest, beside)
    try:
        place_points_and_list_gaps(first, joint_table, layout)
    except DataError as error:
        try:
            place_points_and_list_gaps(second, joint_table, layout)
        except DataError:
            where = point_table.format_lines(point_table.deleted)
            raise DataError(f"{error} (left out as marked deleted: {where})") from None
        return second
    return first


class TargetSlots(NamedTuple):
    """Names of targets in order of appearance, and (m,) the index of each row's target."""

    names: tuple[str, ...]
    slot_of_row: Array


def target_names_and_slots(point_table: ImportedTable) -> TargetSlots:
    """Names of the targets in order of appearance, and (m,) the index of each row's."""
    column = point_table.find_column("target")
    if column is None or len(point_table.target_numbers) > 1:
        return TargetSlots(("",), np.zeros(len(point_table.line), dtype=int))
    names = tuple(dict.fromkeys(column.cells))
    return TargetSlots(names, np.array([names.index(cell) for cell in column.cells]))


def place_points_by_target_name(
    point_table: ImportedTable, pose_rows: Array, pattern_text: str
) -> PointPlacement:
    """Rows whose pose is known; a target's name says which target."""
    names, slot = target_names_and_slots(point_table)
    check_one_point_per_target(point_table, pose_rows, slot)
    return PointPlacement(pose_rows, slot, names, pattern_text)


def check_one_point_per_target(
    point_table: ImportedTable, pose_rows: Array, target_slots: Array
) -> None:
    """Raise DataError where a target has two points at a pose."""
    seen: dict[tuple[int, int], int] = {}
    for line, at in zip(point_table.line, zip(pose_rows, target_slots, strict=True), strict=True):
        if at in seen:
            raise DataError(
                f"{point_table.sheet.path}:{line}: a second point of the pose and target of line "
                f"{seen[at]}; delete one, or name the targets in a column target"
            )
        seen[at] = int(line)


def extract_pose_table(table: ImportedTable) -> ImportedTable | None:
    """Of a table with a row for each point, the rows of its poses; None for one of poses.

    Names tell: P1_1 and P1_2 are two targets at P1, if the joints of both are the same.
    """
    key = table.find_column("pose")
    if (
        key is None
        or table.find_column("target")
        or len(table.target_numbers) != 1
        or not table.joint_columns
    ):
        return None
    names = [split_name_into_parts(cell) for cell in key.cells]
    joints = list(zip(*(c.cells for c in table.joint_columns), strict=True))
    first: dict[tuple[str | int, ...], int] = {}
    for i, parts in enumerate(names):
        row = first.setdefault(parts[:-1], i)
        if len(parts) < MIN_NAME_PARTS or joints[row] != joints[i]:
            return None
    if not 2 * len(first) <= len(names) + len(first) // 2 or len(first) < 2:
        return None
    poses = table.take_rows(np.array(sorted(first.values())))
    stems = tuple(
        "-".join(map(str, split_name_into_parts(c)[:-1]))
        for c in poses.column_with_meaning("pose").cells
    )
    columns = tuple(replace(c, cells=stems) if c.meaning == "pose" else c for c in poses.columns)
    return replace(poses, columns=columns)


def place_points_by_order(
    point_table: ImportedTable, joint_table: ImportedTable, layout: str
) -> PointPlacement:
    """Match by order: one point a row of joints, or as many for each."""
    for sheet in (point_table.sheet, joint_table.sheet):
        if sheet.torn:
            raise DataError(
                f"{sheet.path}:{sheet.torn[0]}: the line is torn, and rows are matched by their "
                "order; complete it, or give both files a column pose"
            )
    names, slot = target_names_and_slots(point_table)
    m, poses = len(point_table.line), len(joint_table.line)
    if len(names) > 1:
        count = np.bincount(slot, minlength=len(names))
        if np.all(count == poses):
            turn = np.zeros(m, dtype=int)
            for target in range(len(names)):
                turn[slot == target] = np.arange(poses)
            return place_points_by_target_name(point_table, turn, "order, targets by name")
        if m != poses:
            odd = int(np.argmax(count != poses))
            last = point_table.line[np.flatnonzero(slot == odd)[-1]]
            raise DataError(
                f"{point_table.sheet.path}:{last}: target "
                f"{names[odd]!r} has {count[odd]} points, but "
                f"{joint_table.sheet.path} has {poses} rows; complete them, or give both files a "
                "column pose"
            )
    if m == poses:
        return place_points_by_target_name(point_table, np.arange(m), "order")
    if m > poses and m % poses == 0 and len(point_table.target_numbers) == 1:
        return place_points_by_repeating_order(point_table, joint_table, layout)
    if m > poses:
        raise DataError(
            f"{point_table.sheet.path}:{point_table.line[poses]}"
            f": point {poses + 1} has no joints: there "
            f"are {m} points, but {poses} rows in {joint_table.sheet.path}; delete what does not "
            "belong, or give both files a column pose"
        )
    raise DataError(
        f"{joint_table.sheet.path}:{joint_table.line[m]}: joint "
        f"row {m + 1} has no point: there are {poses} "
        f"rows, but {m} points in {point_table.sheet.path}; "
        f"delete what does not belong, or give both "
        "files a column pose"
    )


def place_points_by_repeating_order(
    point_table: ImportedTable, joint_table: ImportedTable, layout: str
) -> PointPlacement:
    """As many points for each row of joints: which of them belong together, a rigid body
    tells.
    """
    poses = len(joint_table.line)
    k = len(point_table.line) // poses
    index = np.arange(len(point_table.line))
    ways = {"pose": (index // k, index % k), "target": (index % poses, index // poses)}
    if not layout:
        number = point_table.target_numbers[0]
        xyz = np.stack(
            [
                point_table.column_numbers(point_table.column_with_meaning(f"smr{number}_{axis}"))
                for axis in "xyz"
            ],
            axis=1,
        )
        loose = {
            "pose": max_distance_variation(xyz.reshape(poses, k, 3)),
            "target": max_distance_variation(xyz.reshape(k, poses, 3).swapaxes(0, 1)),
        }
        rigid = [way for way, spread in loose.items() if spread < MAX_RIGID_DISTANCE_SPREAD]
        if len(rigid) != 1 or max(loose.values()) < MIN_LOOSE_DISTANCE_SPREAD:
            raise DataError(
                f"{point_table.sheet.path}: {k} points for each "
                f"row of {joint_table.sheet.path}; add "
                "layout='pose' if the points of a pose follow each other, or layout='target' if "
                "those of a target do"
            )
        layout = rigid[0]
    pose, slot = ways[layout]
    names, _ = target_names_and_slots(point_table)
    return PointPlacement(pose, slot, names * k, f"order, {k} points a row, by {layout}")


def max_distance_variation(point_sets: Array) -> float:
    """How much the distances between targets vary, relative to them.  point_sets: (m, k, 3)."""
    m, k, _ = point_sets.shape
    if m < 3:
        return float("nan")
    first, second = np.triu_indices(k, 1)
    apart = np.linalg.norm(point_sets[:, first] - point_sets[:, second], axis=-1)
    mean = np.nanmean(apart, axis=0)
    return float((np.nanstd(apart, axis=0) / np.maximum(mean, 1e-12)).max())


def sort_tables_by_file_number(tables: list[ImportedTable]) -> list[ImportedTable]:
    """Files of targets sorted by the number in their names, where each has its own."""
    numbers = [re.findall(r"\d+", reading.sheet.path.stem)[-1:] for reading in tables]
    found = [int(number[0]) for number in numbers if number]
    if len(found) < len(tables) or len(set(found)) < len(found):
        return tables
    return [tables[i] for i in np.argsort(found)]
