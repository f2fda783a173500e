"""KRL of KUKA (.src, .dat): E6POS, POS, FRAME and E6AXIS, declared, assigned or in a motion.

{X .., Y .., Z .., A .., B .., C .., S .., T ..} in mm and degrees, with the orientation
Rz(A) Ry(B) Rx(C).  Bit i of T is set where joint i + 1 is negative [KUKA, expert programming].

A tool and a base hold from where they are set: by $TOOL and $BASE, by BAS(), or by the number in
the FDAT of a point [KUKA, expert programming].
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.compensation.programs.program_text import (
    FrameUse,
    NamedLine,
    NumberEdit,
    NumberInText,
    ProgramPoint,
    ProgramText,
    RuntimeChange,
    check_coordinate_range,
    transform_from_position_mm,
)
from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import replace_matches_with_spaces
from minimax_cal.core.errors import DataError
from minimax_cal.measuring.importers.robot_programs import KRL_IGNORED_PATTERN

KRL_MOTION_PATTERN = re.compile(
    r"(?<![\w$#])(?:S?(?:PTP|LIN|CIRC)|SPL)(_REL)?(?=[ \t{])([^\r\n]*)", re.IGNORECASE
)
KRL_FRAME_PATTERNS = (  # a tool or a base, and its number or what it is set to
    re.compile(r"\b(TOOL|BASE)_NO\s*=?\s*(-?\d+)", re.IGNORECASE),
    re.compile(r"\bBAS\s*\(\s*#(TOOL|BASE)\s*,([^)\r\n]{0,200})\)", re.IGNORECASE),
    re.compile(r"\$(?:ACT_)?(TOOL|BASE)\s*=(?!=)([^\r\n]*)", re.IGNORECASE),
    re.compile(r"(?<=\$)(TOOL|BASE)(\.[XYZABC])\s*=(?!=)", re.IGNORECASE),
)
KRL_FDAT_PATTERN = re.compile(r"\bF(\w{1,31})\s*=\s*\{[^{}]*\Z", re.IGNORECASE)
KRL_NULL_FRAME_PATTERN = re.compile(
    r"\$(?:NULLFRAME|WORLD)|\w{4}_DATA\[0\]|\{(?:FRAME:)?(?:[XYZABC][-+]?[0.]+,?)+\}"
)
KRL_BRACES_PATTERN = re.compile(r"\{[^{}]*\}")
KRL_WORD_PATTERN = re.compile(r"\s*\$?([A-Za-z]\w{0,31})")
DEFAULT_FRAME_NAMES = {
    "tool": "$NULLFRAME",
    "wobj": "$NULLFRAME",
}  # the flange, and the robot's base
KRL_LETTERS_SEARCHED_BEFORE_VALUE = 200  # letters before a value that say what it is


@dataclass(frozen=True)
class MotionTargets:
    """What motions go to.

    motion_by_line_start: the motion of a line, by where the line begins.  absolute_names: names
    that motions go to. relative_names: names that motions go on by.  all_names: all of these, and
    parts of sums of frames.
    """

    motion_by_line_start: dict[int, re.Match[str]]
    absolute_names: frozenset[str]
    relative_names: frozenset[str]
    all_names: frozenset[str]


def find_motion_targets(program: ProgramText) -> MotionTargets:
    """What the motions of a file go to, by name."""
    lines: dict[int, re.Match[str]] = {}
    to: set[str] = set()
    relative: set[str] = set()
    summed: set[str] = set()
    for motion in KRL_MOTION_PATTERN.finditer(program.text_without_comments):
        lines.setdefault(program.text_without_comments.rfind("\n", 0, motion.start()) + 1, motion)
        for target in KRL_BRACES_PATTERN.sub("{}", motion[2]).split(","):
            first, *offsets = (KRL_WORD_PATTERN.match(part) for part in target.split(":"))
            group = relative if motion[1] else summed if any(offsets) else to
            group |= {word[1].upper() for word in (first, *offsets) if word}
    return MotionTargets(lines, *map(frozenset, (to, relative, to | relative | summed)))


def find_used_frames(program: ProgramText, points: Sequence[ProgramPoint]) -> Iterator[FrameUse]:
    """Line, "tool" or "wobj", and its name wherever the file says one.

    FDAT of points in joints (FP1 of XP1) tell nothing of other points.
    """
    joints = {point.name.upper() for point in points if point.pose is None and point.name}
    for pattern in KRL_FRAME_PATTERNS:
        for found in pattern.finditer(program.text_without_comments):
            before = KRL_FDAT_PATTERN.search(
                program.text_without_comments[
                    max(0, found.start() - KRL_LETTERS_SEARCHED_BEFORE_VALUE) : found.start()
                ]
            )
            if before and f"X{before[1].upper()}" in joints:
                continue
            kind = "tool" if found[1].upper() == "TOOL" else "wobj"
            yield FrameUse(
                program.line_number(found.start()),
                kind,
                normalise_frame_name(found[1].upper(), found[2]),
            )


def normalise_frame_name(frame_kind: str, frame_text: str) -> str:
    """What a TOOL or BASE is set to, one name for one thing: TOOL_DATA[2], $NULLFRAME."""
    frame_text = "".join(frame_text.split()).upper()
    if frame_text.startswith("."):
        return f"${frame_kind}{frame_text}"
    frame_text = (
        f"{frame_kind}_DATA[{frame_text}]" if re.fullmatch(r"-?\d+", frame_text) else frame_text
    )
    return "$NULLFRAME" if KRL_NULL_FRAME_PATTERN.fullmatch(frame_text) else frame_text


# ---- programs ------------------------------------------------------------------------------------


__all__ = ["DEFAULT_FRAME_NAMES", "find_used_frames"]  # of the language, beside what stands here
KRL_AGGREGATE_PATTERN = re.compile(
    r"\{\s*(?:(E6POS|POS|FRAME|E6AXIS|AXIS)\s*:)?([^{}]*)\}", re.IGNORECASE
)
KRL_ENTRY_PATTERN = re.compile(r"\s*([A-Za-z]\w{0,3})\s+([^,\s]+)\s*")
KRL_ASSIGNMENT_PATTERN = re.compile(
    r"(?:\b(E6POS|POS|FRAME|E6AXIS|AXIS)\s+)?\$?(\w{1,32})\s*(?:\[[^\]]{0,20}\]\s*)?=\s*\Z",
    re.IGNORECASE,
)
KRL_DECLARATION_PATTERN = re.compile(
    r"\bDECL\s+(?:GLOBAL\s+)?(E6POS|POS|E6AXIS|AXIS)\s+([^=\r\n]*)", re.I
)
PROGRAM_HEAD_PATTERN = re.compile(  # the line that a comment on the whole file stands behind
    r"^(?:\xef\xbb\xbf)?[^\S\n]*(?:GLOBAL\s+)?DEF(?:DAT|FCT)?\s[^\r\n]*",
    re.IGNORECASE | re.MULTILINE,
)
KRL_POSE_KEYS = ("X", "Y", "Z", "A", "B", "C")
KRL_AXIS_KEYS = ("A1", "A2", "A3", "A4", "A5", "A6")
KRL_ENTRY_KEYS = {*KRL_POSE_KEYS, *KRL_AXIS_KEYS, "S", "T", *(f"E{i}" for i in range(1, 7))}
KRL_COLON_PATTERN = re.compile(r"[ \t]*:")
COMMENT_SIGN = ";"
EXTERNAL_AXIS_PREFIX = "E"
KRL_COMPONENT_ASSIGNMENT_PATTERN = re.compile(
    r"^[^\S\r\n]*(\w{1,32})((?:\[[^\]]{0,20}\])?\.(?:[XYZABCST]|[AE][1-6]))\s*=(?!=)", re.I | re.M
)
MIN_COSINE_B = 1e-7  # cosine of B below which A and C turn about one axis


def parse_program(text: str, source: str) -> ProgramText:
    """A program or its data list."""
    return ProgramText(text, replace_matches_with_spaces(text, KRL_IGNORED_PATTERN), source)


def find_points(program: ProgramText) -> Iterator[ProgramPoint]:
    """Every point with numbers, in the order of the file.  Raises DataError.

    A FRAME may be a base or a tool: it is a point where a motion of the same file goes to it.
    """
    for kind, name, found in find_point_values(program):
        if kind:
            yield parse_point(program, kind, name, found)


def find_unchanged_point_lines(program: ProgramText) -> Iterator[int]:
    """Lines of what stays as it is: relative motions, offsets, points that are not whole."""
    for kind, _, found in find_point_values(program):
        if not kind:
            yield program.line_number(found.start())


def find_displacements(program: ProgramText) -> Iterator[NamedLine]:
    """Lines and names of what displaces every point after it: a base does, which is heeded."""
    yield from ()


def find_values_changed_at_runtime(program: ProgramText) -> Iterator[RuntimeChange]:
    """What the run writes: line, "point", the point's name, and what of it.

    Changes of $TOOL and $BASE are heeded as those that a program moves with.
    """
    names = {name.upper() for kind, name, _ in find_point_values(program) if kind} | set(
        find_types_of_unset_points(program)
    )
    for found in KRL_COMPONENT_ASSIGNMENT_PATTERN.finditer(program.text_without_comments):
        if found[1].upper() in names:
            yield RuntimeChange(
                program.line_number(found.start(1)), "point", found[1], found[1] + found[2]
            )


class PointValue(NamedTuple):
    """A value of a point; no type where the point stays as it is."""

    type_name: str
    point_name: str
    match: re.Match[str]


def find_point_values(program: ProgramText) -> Iterator[PointValue]:
    """Type, name and braces of what a motion may go to; no type where it stays as it is."""
    going, kinds = find_motion_targets(program), find_types_of_unset_points(program)
    for found in KRL_AGGREGATE_PATTERN.finditer(program.text_without_comments):
        line_start = program.text_without_comments.rfind("\n", 0, found.start()) + 1
        before = KRL_ASSIGNMENT_PATTERN.search(
            program.text_without_comments[
                max(line_start, found.start() - KRL_LETTERS_SEARCHED_BEFORE_VALUE) : found.start()
            ]
        )
        own = before[2] if before else ""
        name = own.upper()
        keys = {entry[1].upper() for entry in KRL_ENTRY_PATTERN.finditer(found[2])}
        whole = set(KRL_POSE_KEYS) <= keys or set(KRL_AXIS_KEYS) <= keys
        kind = (found[1] or (before[1] if before else "") or kinds.get(name, "")).upper()
        if not kind:
            kind = "E6AXIS" if set(KRL_AXIS_KEYS) <= keys else "E6POS" if "S" in keys else "FRAME"
        coordinates = keys & {*KRL_POSE_KEYS, *KRL_AXIS_KEYS} and (whole or keys <= KRL_ENTRY_KEYS)
        if not coordinates or (kind == "FRAME" and name.startswith(("BASE", "TOOL"))):
            continue
        motion = going.motion_by_line_start.get(line_start)
        inside = bool(motion and motion.start() < found.start() and not name)
        relative = name in going.relative_names or bool(inside and motion and motion[1])
        meant = kind != "FRAME" or inside or name in going.absolute_names
        if (
            whole
            and meant
            and not relative
            and not is_term_of_frame_sum(program.text_without_comments, found)
        ):
            yield PointValue(kind, own, found)
        elif meant or name in going.all_names:
            yield PointValue("", own, found)


def is_term_of_frame_sum(bare_text: str, value_match: re.Match[str]) -> bool:
    """Whether a value is a part of a sum of frames, such as the offset of XP : {...}."""
    before = bare_text[
        max(0, value_match.start() - KRL_LETTERS_SEARCHED_BEFORE_VALUE) : value_match.start()
    ].rstrip(" \t")
    return before.endswith(":") or bool(KRL_COLON_PATTERN.match(bare_text, value_match.end()))


def find_types_of_unset_points(program: ProgramText) -> dict[str, str]:
    """Types of points that are declared without a value, by name."""
    return {
        name[1].upper(): found[1].upper()
        for found in KRL_DECLARATION_PATTERN.finditer(program.text_without_comments)
        for part in found[2].split(",")
        if (name := KRL_WORD_PATTERN.match(part))
    }


def parse_point(
    program: ProgramText, point_kind: str, point_name: str, value_match: re.Match[str]
) -> ProgramPoint:
    """One point.  Raises DataError."""
    line = program.line_number(value_match.start())
    where = f"{program.source}:{line}: {point_kind} {point_name}".rstrip()
    values: dict[str, NumberInText] = {}
    for entry in KRL_ENTRY_PATTERN.finditer(
        program.text_without_comments, value_match.start(2), value_match.end(2)
    ):
        (number,) = program.parse_numbers(*entry.span(2), f"{point_kind} {point_name} {entry[1]}")
        if entry[1].upper() in values:
            raise DataError(f"{where}: {entry[1]} stands twice")
        values[entry[1].upper()] = number
    outer = tuple((i, values[f"E{i}"].value) for i in range(1, 7) if f"E{i}" in values)
    if point_kind in ("E6AXIS", "AXIS"):
        missing = [axis for axis in KRL_AXIS_KEYS if axis not in values]
        if missing:
            raise DataError(f"{where}: {missing[0]} is missing")
        place = tuple(values[axis] for axis in KRL_AXIS_KEYS)
        check_coordinate_range(place, where)
        joints = np.radians([n.value for n in place])
        return ProgramPoint(
            point_kind, point_name, line, place, None, joints, external_axis_values=outer
        )
    place = tuple(values[key] for key in KRL_POSE_KEYS)
    check_coordinate_range(place, where)
    at = np.array([number.value for number in place])
    turn = Rotation.from_euler("ZYX", at[3:], degrees=True).as_matrix()
    way = (values["T"],) if "T" in values else ()
    return ProgramPoint(
        point_kind,
        point_name,
        line,
        place,
        transform_from_position_mm(at[:3], turn),
        np.zeros(0),
        way,
        outer,
    )


def format_pose_numbers(pose: Array, point: ProgramPoint) -> list[str]:
    """A pose as X, Y, Z, A, B, C, each angle within half a turn of the one that was there."""
    old = np.array([number.value for number in point.pose_or_joint_numbers[3:]])
    turn = zyx_euler_angles(pose[:3, :3], np.radians(old[0]))
    other = np.array([turn[0] + 180.0, 180.0 - turn[1], turn[2] + 180.0])  # the same rotation
    both = [one + 360.0 * np.round((old - one) / 360.0) for one in (turn, other)]
    best = min(both, key=lambda one: float(np.abs(one - old).max()))
    return [f"{1e3 * v:.6f}" for v in pose[:3, 3]] + [f"{v:.8f}" for v in best]


def zyx_euler_angles(rotation: Array, default_a: float) -> Array:
    """A, B, C of a rotation (3, 3) [deg]; A as given [rad] where B leaves only A and C together."""
    level = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    default_a = (
        float(np.arctan2(rotation[1, 0], rotation[0, 0])) if level > MIN_COSINE_B else default_a
    )
    b = np.arctan2(-rotation[2, 0], level)
    rest = Rotation.from_euler("Z", -default_a).as_matrix() @ rotation
    return np.degrees([default_a, b, np.arctan2(-rest[1, 2], rest[1, 1])])


def has_programmed_configuration(point: ProgramPoint, q: Array) -> bool:
    """Whether joints (n,) have the signs that T says."""
    return all(
        int(number.value) & 63 == negative_joint_bits(q) for number in point.configuration_numbers
    )


def list_configuration_changes(
    point: ProgramPoint, q_before: Array, q_after: Array
) -> list[NumberEdit]:
    """T, where a correction changed the sign of a joint."""
    now = negative_joint_bits(q_after)
    return [
        NumberEdit(number, str((int(number.value) & ~63) | now))
        for number in point.configuration_numbers
        if int(number.value) & 63 == negative_joint_bits(q_before)
        and negative_joint_bits(q_before) != now
    ]


def negative_joint_bits(q: Array) -> int:
    """The signs of six joints as bits."""
    return sum(1 << i for i, angle in enumerate(q[:6]) if angle < 0.0)


def find_declared_frames(program: ProgramText) -> dict[str, Array]:
    """KRL keeps bases and tools in the controller."""
    return {}
