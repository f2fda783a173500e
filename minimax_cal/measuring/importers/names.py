"""Points and poses joined by their names: equal but for spelling, or with the target's name beside.

``P17_2`` is target 2 at pose ``P17``; ``SMR1-P017`` target smr1 there; ``Pkt 17`` the pose ``P17``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from minimax_cal.reading.words import folded

PART = re.compile(r"\d+|[^\W\d_]+")
MOST_BESIDE = 3  # parts of a name that may be the target's
COMMON = 0.5  # of the count of the commonest word
ENOUGH = 0.5  # of the points that a pattern must find poses for
Parts = tuple[str | int, ...]


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
    """How names of points tell their poses; None where no pattern finds half of them.

    poses: names without repeats.
    """
    found = [match for match in patterns(points, poses) if share_of(match) >= ENOUGH]
    return max(found, key=share_of, default=None)


def share_of(match: Match) -> float:
    """Share of the points that have a pose."""
    return sum(row >= 0 for row in match.pose) / max(len(match.pose), 1)


def patterns(points: Sequence[str], poses: Sequence[str]) -> Iterator[Match]:
    """Every pattern tried, the plainest first."""
    rows = {parts_of(name): i for i, name in enumerate(poses)}
    names = [parts_of(name) for name in points]
    if len(rows) == len(poses):
        yield matched(points, poses, [(rows.get(parts, -1), "") for parts in names], "name")
        for way, beside in (("pose, target", last_of), ("target, pose", first_of)):
            yield matched(points, poses, [beside(parts, rows) for parts in names], f"name: {way}")
    numbers = {n: i for i, name in enumerate(poses) if (n := number_of(parts_of(name))) >= 0}
    if len(numbers) == len(poses):
        yield matched(points, poses, by_number(names, numbers), "number in the name")


def last_of(parts: Parts, rows: Mapping[Parts, int]) -> tuple[int, str]:
    """The pose's row and the target, where the target's name comes last."""
    for size in range(1, min(MOST_BESIDE, len(parts) - 1) + 1):
        if (row := rows.get(parts[:-size], -1)) >= 0:
            return row, "".join(map(str, parts[-size:]))
    return -1, ""


def first_of(parts: Parts, rows: Mapping[Parts, int]) -> tuple[int, str]:
    """The pose's row and the target, where the target's name comes first."""
    for size in range(1, min(MOST_BESIDE, len(parts) - 1) + 1):
        if (row := rows.get(parts[size:], -1)) >= 0:
            return row, "".join(map(str, parts[:size]))
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
