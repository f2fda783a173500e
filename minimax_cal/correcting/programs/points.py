"""Points in a program: where their numbers stand in its text, and what they mean."""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.reading.sheet import POINT
from minimax_cal.robots.transforms import transform

LONGEST = 40  # letters of a number
FARTHEST = 1e5  # of a coordinate [mm]
MARK = "Corrected by minimax-cal compensate; correct the program as it was before, not this one"
MARKED = re.compile(rf"^[^\S\n]*[!;] {MARK[:35]}", re.MULTILINE)


@dataclass(frozen=True)
class Number:
    """A number and where it stands in the text."""

    value: float
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Point:
    """A place that a program moves to.

    kind: as the language calls it.  line: where it stands, from 1.  place: numbers of the position
    and the orientation, or of the joints.  pose: (4, 4) of the tool in the work object [m], None
    for joints.  joints: (n,) [rad], empty for a pose.  way: numbers that say which way the arm
    stands: RAPID's cf1, cf4, cf6, or KRL's T; empty where it does not say.  outer: values of the
    external axes that are there [mm or deg], by their numbers.
    """

    kind: str
    name: str
    line: int
    place: tuple[Number, ...]
    pose: Array | None
    joints: Array
    way: tuple[Number, ...] = ()
    outer: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True)
class Text:
    """A program: its text with comments and strings blanked, of the same length.

    source: what messages call it.
    """

    text: str
    bare: str
    source: str

    def line(self, at: int) -> int:
        """The line of a letter, from 1."""
        return bisect_right(self.starts, at)

    @cached_property
    def starts(self) -> list[int]:
        """Where each line begins."""
        return [0, *(found.end() for found in re.finditer("\n", self.text))]

    def numbers(self, start: int, stop: int, what: str) -> list[Number]:
        """Numbers between commas.  Raises DataError for anything else."""
        out, at = [], start
        for part in self.bare[start:stop].split(","):
            inner = part.strip()
            begin = at + len(part) - len(part.lstrip())
            if len(inner) > LONGEST or not POINT.fullmatch(inner):
                raise DataError(
                    f"{self.source}:{self.line(start)}: {what}: {inner[:LONGEST]!r} is no number; "
                    "write points as numbers, not as expressions"
                )
            out.append(Number(float(inner), begin, begin + len(inner)))
            at += len(part) + 1
        return out

    def replaced(self, changes: Sequence[tuple[Number, str]]) -> str:
        """The text with numbers written anew; all else as it is."""
        parts, at = [], 0
        for number, new in sorted(changes, key=lambda change: change[0].start):
            parts += [self.text[at : number.start], new]
            at = number.stop
        return "".join([*parts, self.text[at:]])


def marked(program: Text, head: re.Pattern[str], comment: str) -> tuple[Number, str]:
    """A comment that tells a corrected program, on a line of its own behind its head."""
    found = head.search(program.bare)
    at = found.end() if found else 0
    end = "\r\n" if "\r\n" in program.text else "\n"
    alone = program.text[at : at + 1] in ("", "\r", "\n")
    parts = (end if at else "", f"{comment} {MARK}", "" if at and alone else end)
    return Number(0.0, at, at), "".join(parts)


def check_unmarked(program: Text) -> None:
    """Raise DataError for a program that was corrected already."""
    if found := MARKED.search(program.text):
        raise DataError(
            f"{program.source}:{program.line(found.start())}: these points are corrected already, "
            "and would be twice; give the program as it was before"
        )


def checked(numbers: Sequence[Number], where: str) -> None:
    """Raise DataError for coordinates that no arm reaches."""
    for number in numbers:
        if not (math.isfinite(number.value) and abs(number.value) <= FARTHEST):
            raise DataError(f"{where}: {number.value:g} is no coordinate in mm or degrees")


def of_quaternion(q: Array, where: str) -> Array:
    """Rotation (3, 3) of w, x, y, z.  Raises DataError unless it has unit length."""
    size = float(np.linalg.norm(q))
    if abs(size - 1.0) > 1e-3:
        raise DataError(f"{where}: the quaternion has length {size:.4g}; it must be 1")
    return np.asarray(Rotation.from_quat(np.roll(q, -1)).as_matrix())  # it wants w last


def posed(place: Array, turn: Array) -> Array:
    """(4, 4) of a place (3,) [mm] and a rotation."""
    return transform(turn, 1e-3 * place)
