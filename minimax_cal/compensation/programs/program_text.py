"""Points in a program: where their numbers stand in its text, and what they mean."""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.reading.text_sheet import CELL_NUMBER_PATTERN
from minimax_cal.robots.transforms import build_transform

MAX_NUMBER_LETTERS = 40  # letters of a number
MAX_COORDINATE_MM_OR_DEG = 1e5  # of a coordinate [mm]
CORRECTION_MARK = (
    "Corrected by minimax-cal compensate; correct the program as it was before, not this one"
)
CORRECTION_MARK_PATTERN = re.compile(rf"^[^\S\n]*[!;] {CORRECTION_MARK[:35]}", re.MULTILINE)


@dataclass(frozen=True)
class NumberInText:
    """A number and where it stands in the text."""

    value: float
    start: int
    stop: int


class NumberEdit(NamedTuple):
    """A number of a program, and the text that is written in its place."""

    number: NumberInText
    new_text: str


class NamedLine(NamedTuple):
    """A line of a program, and a name that stands there."""

    line: int
    name: str


class FrameUse(NamedTuple):
    """A line that uses a frame: "tool" or "wobj", and its name, '' where the line has none."""

    line: int
    frame_kind: str
    name: str


class RuntimeChange(NamedTuple):
    """A line that writes to a "point", "tool" or "wobj" at run time, and the part it writes."""

    line: int
    kind: str
    name: str
    written_part: str


@dataclass(frozen=True, eq=False)
class ProgramPoint:
    """A place that a program moves to.

    kind: as the language calls it.  line: where it stands, from 1.  pose_or_joint_numbers: numbers
    of the position and the orientation, or of the joints.  pose: (4, 4) of the tool in the work
    object [m], None for joints.  joints: (n,) [rad], empty for a pose.  configuration_numbers:
    numbers that say which way the arm stands: RAPID's cf1, cf4, cf6, or KRL's T; empty where it
    does not say.  external_axis_values: values of the external axes that are there [mm or deg], by
    their numbers.
    """

    kind: str
    name: str
    line: int
    pose_or_joint_numbers: tuple[NumberInText, ...]
    pose: Array | None
    joints: Array
    configuration_numbers: tuple[NumberInText, ...] = ()
    external_axis_values: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True)
class ProgramText:
    """A program: its text with comments and strings blanked, of the same length.

    source: what messages call it.
    """

    text: str
    text_without_comments: str
    source: str

    def line_number(self, text_offset: int) -> int:
        """The line of a letter, from 1."""
        return bisect_right(self.line_starts, text_offset)

    @cached_property
    def line_starts(self) -> list[int]:
        """Where each line begins."""
        return [0, *(found.end() for found in re.finditer("\n", self.text))]

    def parse_numbers(self, start: int, stop: int, description: str) -> list[NumberInText]:
        """Numbers between commas.  Raises DataError for anything else."""
        out, at = [], start
        for part in self.text_without_comments[start:stop].split(","):
            inner = part.strip()
            begin = at + len(part) - len(part.lstrip())
            if len(inner) > MAX_NUMBER_LETTERS or not CELL_NUMBER_PATTERN.fullmatch(inner):
                raise DataError(
                    f"{self.source}:{self.line_number(start)}: {description}: "
                    f"{inner[:MAX_NUMBER_LETTERS]!r} is no number; "
                    "write points as numbers, not as expressions"
                )
            out.append(NumberInText(float(inner), begin, begin + len(inner)))
            at += len(part) + 1
        return out

    def replace_numbers(self, replacements: Sequence[NumberEdit]) -> str:
        """The text with numbers written anew; all else as it is."""
        parts, at = [], 0
        for number, new in sorted(replacements, key=lambda change: change[0].start):
            parts += [self.text[at : number.start], new]
            at = number.stop
        return "".join([*parts, self.text[at:]])


def build_correction_mark(
    program: ProgramText, head_pattern: re.Pattern[str], comment_sign: str
) -> NumberEdit:
    """A comment that tells a corrected program, on a line of its own behind its head."""
    found = head_pattern.search(program.text_without_comments)
    at = found.end() if found else 0
    end = "\r\n" if "\r\n" in program.text else "\n"
    alone = program.text[at : at + 1] in ("", "\r", "\n")
    parts = (end if at else "", f"{comment_sign} {CORRECTION_MARK}", "" if at and alone else end)
    return NumberEdit(NumberInText(0.0, at, at), "".join(parts))


def check_not_corrected_already(program: ProgramText) -> None:
    """Raise DataError for a program that was corrected already."""
    if found := CORRECTION_MARK_PATTERN.search(program.text):
        raise DataError(
            f"{program.source}:{program.line_number(found.start())}"
            f": these points are corrected already, "
            "and would be twice; give the program as it was before"
        )


def check_coordinate_range(numbers: Sequence[NumberInText], location: str) -> None:
    """Raise DataError for coordinates that no arm reaches."""
    for number in numbers:
        if not (math.isfinite(number.value) and abs(number.value) <= MAX_COORDINATE_MM_OR_DEG):
            raise DataError(f"{location}: {number.value:g} is no coordinate in mm or degrees")


def rotation_from_quaternion(quaternion: Array, location: str) -> Array:
    """Rotation (3, 3) of w, x, y, z.  Raises DataError unless it has unit length."""
    size = float(np.linalg.norm(quaternion))
    if abs(size - 1.0) > 1e-3:
        raise DataError(f"{location}: the quaternion has length {size:.4g}; it must be 1")
    return np.asarray(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix())  # it wants w last


def transform_from_position_mm(position_mm: Array, rotation: Array) -> Array:
    """(4, 4) of a place (3,) [mm] and a rotation."""
    return build_transform(rotation, 1e-3 * position_mm)
