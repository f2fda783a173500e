"""The tool and the work object of a program's points: as named, and as the program tells them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType

import numpy as np

from minimax_cal.correcting.programs.points import Point, Text, of_quaternion, posed
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError

WORDS = {"tool": "tool", "wobj": "work object"}


def uses(
    language: ModuleType, text: Text, points: Sequence[Point]
) -> dict[str, list[tuple[int, str]]]:
    """By "tool" and "wobj": each line that moves with one, and its name, '' where untold.

    None where all points are joints, which ask for no tool.
    """
    if all(point.pose is None for point in points):
        return {}
    told = sorted(language.used(text, points))
    return {one: [(line, name) for line, option, name in told if option == one] for one in WORDS}


def check_used(
    language: ModuleType, text: Text, points: Sequence[Point], given: Mapping[str, str]
) -> None:
    """Raise OptionError for a move with another tool or work object than was named.

    given: what is taken as the "tool" and the "wobj"; numbers may be any one of the program's.
    """
    known = [name.lower() for name in language.frames(text)]
    for option, moves in uses(language, text, points).items():
        one, named = given[option], [(line, name) for line, name in moves if name]
        numbers = "," in one and bool(named)
        first, wanted = named[0] if numbers else (0, one or language.ORIGINS[option])
        for line, name in named:
            if name.lower() == wanted.lower():
                continue
            where = f"{text.source}:{line}: moves with {name}"
            if numbers:
                raise OptionError(
                    f"{where}, at line {first} with {wanted}, and {option}={one} cannot be both; "
                    "split the file and correct each part with its own"
                )
            mend = f"{option}='{name}', or its frame as " if name.lower() in known else f"{option}="
            raise OptionError(
                f"{where}, not with {wanted}; give {mend}x,y,z,q1,q2,q3,q4, and correct programs "
                f"of several {WORDS[option]}s one by one"
            )


def untold(
    language: ModuleType, text: Text, points: Sequence[Point], given: Mapping[str, str]
) -> Iterator[str]:
    """Notices where a program does not tell its tool or its work object, in a move or at all."""
    doubts: dict[tuple[int, ...], list[tuple[str, str]]] = {}  # by lines, none for the whole file
    for option, moves in uses(language, text, points).items():
        lines = tuple(line for line, name in moves if not name)
        if lines or not (moves or given[option]):
            taken = given[option] or language.ORIGINS[option]
            doubts.setdefault(lines, []).append((WORDS[option], taken))
    for lines, pairs in doubts.items():
        words, taken = (" and ".join(dict.fromkeys(part)) for part in zip(*pairs, strict=True))
        who = f"moves at line {shown(lines)} do" if lines else "does"
        yield (
            f"{text.source}: {who} not tell the {words} of the points, which are taken as those "
            f"of {taken}; give tool= or wobj= where they are of others"
        )


def shown(lines: Sequence[object]) -> str:
    """The first of many lines or names."""
    once = list(dict.fromkeys(lines))
    return ", ".join(map(str, once[:8])) + (" ..." if len(once) > 8 else "")


def frame_of(given: str, known: dict[str, Array], option: str) -> Array:
    """(4, 4) of a name or numbers.  Raises OptionError."""
    if not given:
        return np.eye(4)
    names = {name.lower(): pose for name, pose in known.items()}
    if given.lower() in names:
        return names[given.lower()]
    try:
        numbers = np.array([float(part) for part in given.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 7 or not np.isfinite(numbers).all():
        there = f" ({', '.join(known)})" if known else ""
        raise OptionError(
            f"{option}={given!r}: give x,y,z,q1,q2,q3,q4 in mm, or a name declared there{there}"
        )
    try:
        return posed(numbers[:3], of_quaternion(numbers[3:], f"{option}={given!r}"))
    except DataError as error:
        raise OptionError(str(error)) from error
