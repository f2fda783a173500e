"""What motions of KRL go to, and the tools and bases that they go with.

A tool and a base hold from where they are set: by $TOOL and $BASE, by BAS(), or by the number in
the FDAT of a point [KUKA, expert programming].
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from minimax_cal.correcting.programs.points import Point, Text

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
