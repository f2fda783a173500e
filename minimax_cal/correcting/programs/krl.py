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

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.correcting.programs.points import Number, Point, Text, checked, posed
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import blanked
from minimax_cal.measuring.importers.programs import KRL_ASIDE

MOTION = re.compile(
    r"(?<![\w$#])(?:S?(?:PTP|LIN|CIRC)|SPL)(_REL)?(?=[ \t{])([^\r\n]*)", re.IGNORECASE
)
FRAMES = (  # a tool or a base, and its number or what it is set to
    re.compile(r"\b(TOOL|BASE)_NO\s*=?\s*(-?\d+)", re.IGNORECASE),
    re.compile(r"\bBAS\s*\(\s*#(TOOL|BASE)\s*,([^)\r\n]{0,200})\)", re.IGNORECASE),
    re.compile(r"\$(?:ACT_)?(TOOL|BASE)\s*=(?!=)([^\r\n]*)", re.IGNORECASE),
    re.compile(r"(?<=\$)(TOOL|BASE)(\.[XYZABC])\s*=(?!=)", re.IGNORECASE),
)
FDAT = re.compile(r"\bF(\w{1,31})\s*=\s*\{[^{}]*\Z", re.IGNORECASE)
NOWHERE = re.compile(
    r"\$(?:NULLFRAME|WORLD)|\w{4}_DATA\[0\]|\{(?:FRAME:)?(?:[XYZABC][-+]?[0.]+,?)+\}"
)
BRACES = re.compile(r"\{[^{}]*\}")
WORD = re.compile(r"\s*\$?([A-Za-z]\w{0,31})")
ORIGINS = {"tool": "$NULLFRAME", "wobj": "$NULLFRAME"}  # the flange, and the robot's base
LOOK = 200  # letters before a value that say what it is


@dataclass(frozen=True)
class Going:
    """What motions go to.

    lines: the motion of a line, by where the line begins.  to: names that motions go to.
    relative: names that motions go on by.  named: all of these, and parts of sums of frames.
    """

    lines: dict[int, re.Match[str]]
    to: frozenset[str]
    relative: frozenset[str]
    named: frozenset[str]


def motions(program: Text) -> Going:
    """What the motions of a file go to, by name."""
    lines: dict[int, re.Match[str]] = {}
    to: set[str] = set()
    relative: set[str] = set()
    summed: set[str] = set()
    for motion in MOTION.finditer(program.bare):
        lines.setdefault(program.bare.rfind("\n", 0, motion.start()) + 1, motion)
        for target in BRACES.sub("{}", motion[2]).split(","):
            first, *offsets = (WORD.match(part) for part in target.split(":"))
            group = relative if motion[1] else summed if any(offsets) else to
            group |= {word[1].upper() for word in (first, *offsets) if word}
    return Going(lines, *map(frozenset, (to, relative, to | relative | summed)))


def used(program: Text, points: Sequence[Point]) -> Iterator[tuple[int, str, str]]:
    """Line, "tool" or "wobj", and its name wherever the file says one.

    FDAT of points in joints (FP1 of XP1) tell nothing of other points.
    """
    joints = {point.name.upper() for point in points if point.pose is None and point.name}
    for pattern in FRAMES:
        for found in pattern.finditer(program.bare):
            before = FDAT.search(program.bare[max(0, found.start() - LOOK) : found.start()])
            if before and f"X{before[1].upper()}" in joints:
                continue
            kind = "tool" if found[1].upper() == "TOOL" else "wobj"
            yield program.line(found.start()), kind, frame_name(found[1].upper(), found[2])


def frame_name(what: str, value: str) -> str:
    """What a TOOL or BASE is set to, one name for one thing: TOOL_DATA[2], $NULLFRAME."""
    value = "".join(value.split()).upper()
    if value.startswith("."):
        return f"${what}{value}"
    value = f"{what}_DATA[{value}]" if re.fullmatch(r"-?\d+", value) else value
    return "$NULLFRAME" if NOWHERE.fullmatch(value) else value


# ---- programs ------------------------------------------------------------------------------------


__all__ = ["ORIGINS", "used"]  # of the language, beside what stands here
AGGREGATE = re.compile(r"\{\s*(?:(E6POS|POS|FRAME|E6AXIS|AXIS)\s*:)?([^{}]*)\}", re.IGNORECASE)
ENTRY = re.compile(r"\s*([A-Za-z]\w{0,3})\s+([^,\s]+)\s*")
BEFORE = re.compile(
    r"(?:\b(E6POS|POS|FRAME|E6AXIS|AXIS)\s+)?\$?(\w{1,32})\s*(?:\[[^\]]{0,20}\]\s*)?=\s*\Z",
    re.IGNORECASE,
)
DECLARED = re.compile(r"\bDECL\s+(?:GLOBAL\s+)?(E6POS|POS|E6AXIS|AXIS)\s+([^=\r\n]*)", re.I)
HEAD = re.compile(  # the line that a comment on the whole file stands behind
    r"^(?:\xef\xbb\xbf)?[^\S\n]*(?:GLOBAL\s+)?DEF(?:DAT|FCT)?\s[^\r\n]*",
    re.IGNORECASE | re.MULTILINE,
)
PLACE = ("X", "Y", "Z", "A", "B", "C")
AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
ENTRIES = {*PLACE, *AXES, "S", "T", *(f"E{i}" for i in range(1, 7))}
COLON = re.compile(r"[ \t]*:")
COMMENT = ";"
OUTER = "E"
WRITTEN = re.compile(
    r"^[^\S\r\n]*(\w{1,32})((?:\[[^\]]{0,20}\])?\.(?:[XYZABCST]|[AE][1-6]))\s*=(?!=)", re.I | re.M
)
MIN_COSINE_B = 1e-7  # cosine of B below which A and C turn about one axis


def read(text: str, source: str) -> Text:
    """A program or its data list."""
    return Text(text, blanked(text, KRL_ASIDE), source)


def points(program: Text) -> Iterator[Point]:
    """Every point with numbers, in the order of the file.  Raises DataError.

    A FRAME may be a base or a tool: it is a point where a motion of the same file goes to it.
    """
    for kind, name, found in values(program):
        if kind:
            yield point(program, kind, name, found)


def left(program: Text) -> Iterator[int]:
    """Lines of what stays as it is: relative motions, offsets, points that are not whole."""
    for kind, _, found in values(program):
        if not kind:
            yield program.line(found.start())


def displacements(program: Text) -> Iterator[tuple[int, str]]:
    """Lines and names of what displaces every point after it: a base does, which is heeded."""
    yield from ()


def changes(program: Text) -> Iterator[tuple[int, str, str, str]]:
    """What the run writes: line, "point", the point's name, and what of it.

    Changes of $TOOL and $BASE are heeded as those that a program moves with.
    """
    names = {name.upper() for kind, name, _ in values(program) if kind} | set(declared(program))
    for found in WRITTEN.finditer(program.bare):
        if found[1].upper() in names:
            yield program.line(found.start(1)), "point", found[1], found[1] + found[2]


def values(program: Text) -> Iterator[tuple[str, str, re.Match[str]]]:
    """Type, name and braces of what a motion may go to; no type where it stays as it is."""
    going, kinds = motions(program), declared(program)
    for found in AGGREGATE.finditer(program.bare):
        line_start = program.bare.rfind("\n", 0, found.start()) + 1
        before = BEFORE.search(program.bare[max(line_start, found.start() - LOOK) : found.start()])
        own = before[2] if before else ""
        name = own.upper()
        keys = {entry[1].upper() for entry in ENTRY.finditer(found[2])}
        whole = set(PLACE) <= keys or set(AXES) <= keys
        kind = (found[1] or (before[1] if before else "") or kinds.get(name, "")).upper()
        if not kind:
            kind = "E6AXIS" if set(AXES) <= keys else "E6POS" if "S" in keys else "FRAME"
        coordinates = keys & {*PLACE, *AXES} and (whole or keys <= ENTRIES)
        if not coordinates or (kind == "FRAME" and name.startswith(("BASE", "TOOL"))):
            continue
        motion = going.lines.get(line_start)
        inside = bool(motion and motion.start() < found.start() and not name)
        relative = name in going.relative or bool(inside and motion and motion[1])
        meant = kind != "FRAME" or inside or name in going.to
        if whole and meant and not relative and not beside_colon(program.bare, found):
            yield kind, own, found
        elif meant or name in going.named:
            yield "", own, found


def beside_colon(bare: str, found: re.Match[str]) -> bool:
    """Whether a value is a part of a sum of frames, such as the offset of XP : {...}."""
    before = bare[max(0, found.start() - LOOK) : found.start()].rstrip(" \t")
    return before.endswith(":") or bool(COLON.match(bare, found.end()))


def declared(program: Text) -> dict[str, str]:
    """Types of points that are declared without a value, by name."""
    return {
        name[1].upper(): found[1].upper()
        for found in DECLARED.finditer(program.bare)
        for part in found[2].split(",")
        if (name := WORD.match(part))
    }


def point(program: Text, kind: str, name: str, found: re.Match[str]) -> Point:
    """One point.  Raises DataError."""
    line = program.line(found.start())
    where = f"{program.source}:{line}: {kind} {name}".rstrip()
    values: dict[str, Number] = {}
    for entry in ENTRY.finditer(program.bare, found.start(2), found.end(2)):
        (number,) = program.numbers(*entry.span(2), f"{kind} {name} {entry[1]}")
        if entry[1].upper() in values:
            raise DataError(f"{where}: {entry[1]} stands twice")
        values[entry[1].upper()] = number
    outer = tuple((i, values[f"E{i}"].value) for i in range(1, 7) if f"E{i}" in values)
    if kind in ("E6AXIS", "AXIS"):
        missing = [axis for axis in AXES if axis not in values]
        if missing:
            raise DataError(f"{where}: {missing[0]} is missing")
        place = tuple(values[axis] for axis in AXES)
        checked(place, where)
        joints = np.radians([n.value for n in place])
        return Point(kind, name, line, place, None, joints, outer=outer)
    place = tuple(values[key] for key in PLACE)
    checked(place, where)
    at = np.array([number.value for number in place])
    turn = Rotation.from_euler("ZYX", at[3:], degrees=True).as_matrix()
    way = (values["T"],) if "T" in values else ()
    return Point(kind, name, line, place, posed(at[:3], turn), np.zeros(0), way, outer)


def numbers_of(pose: Array, point: Point) -> list[str]:
    """A pose as X, Y, Z, A, B, C, each angle within half a turn of the one that was there."""
    old = np.array([number.value for number in point.place[3:]])
    turn = angles(pose[:3, :3], np.radians(old[0]))
    other = np.array([turn[0] + 180.0, 180.0 - turn[1], turn[2] + 180.0])  # the same rotation
    both = [one + 360.0 * np.round((old - one) / 360.0) for one in (turn, other)]
    best = min(both, key=lambda one: float(np.abs(one - old).max()))
    return [f"{1e3 * v:.6f}" for v in pose[:3, 3]] + [f"{v:.8f}" for v in best]


def angles(turn: Array, a: float) -> Array:
    """A, B, C of a rotation (3, 3) [deg]; A as given [rad] where B leaves only A and C together."""
    level = float(np.hypot(turn[0, 0], turn[1, 0]))
    a = float(np.arctan2(turn[1, 0], turn[0, 0])) if level > MIN_COSINE_B else a
    b = np.arctan2(-turn[2, 0], level)
    rest = Rotation.from_euler("Z", -a).as_matrix() @ turn
    return np.degrees([a, b, np.arctan2(-rest[1, 2], rest[1, 1])])


def stands(point: Point, q: Array) -> bool:
    """Whether joints (n,) have the signs that T says."""
    return all(int(number.value) & 63 == turn_bits(q) for number in point.way)


def ways(point: Point, before: Array, after: Array) -> list[tuple[Number, str]]:
    """T, where a correction changed the sign of a joint."""
    now = turn_bits(after)
    return [
        (number, str((int(number.value) & ~63) | now))
        for number in point.way
        if int(number.value) & 63 == turn_bits(before) and turn_bits(before) != now
    ]


def turn_bits(q: Array) -> int:
    """The signs of six joints as bits."""
    return sum(1 << i for i, angle in enumerate(q[:6]) if angle < 0.0)


def frames(program: Text) -> dict[str, Array]:
    """KRL keeps bases and tools in the controller."""
    return {}
