"""RAPID modules of ABB: robtargets and jointtargets, declared, assigned or in a move.

robtarget: [[x,y,z],[q1,q2,q3,q4],[cf1,cf4,cf6,cfx],[external axes]]; jointtarget: [[six joints in
degrees],[external axes]].  cf is the quarter turn that a joint stands in [ABB RAPID reference].

Those of the controller and its options are known by name; any other, such as a routine of the
user, by a robtarget among its arguments.  Arguments with a place stand between commas, optional
ones behind a backslash [ABB RAPID reference].
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.correcting.programs.points import (
    Number,
    Point,
    Text,
    checked,
    of_quaternion,
    posed,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.words import blanked
from minimax_cal.measuring.importers.programs import RAPID_ASIDE

NAMED = re.compile(
    r"(?<![\w.\\])(Move(?:L|J|C|AbsJ)\w{0,8}|(?:Arc|Cap|Contact|Cut|Disp|FCPress\d?|Glue|Laser|"
    r"Paint|Seal|Search|SpotM?|Trigg)(?:L|J|C|AbsJ)\d?(?:Start|End|IOs)?)"
    r"(?=[\s\\])(?!\s*(?:\(|:=))",
    re.IGNORECASE,
)
CALL = re.compile(
    r"^[^\S\r\n]*(?!(?:ALIAS|BACKWARD|CASE|CONNECT|CONST|DEFAULT|ELSE|ELSEIF|END\w{2,6}|ERROR|EXIT|"
    r"FOR|FUNC|GOTO|IF|LOCAL|MODULE|PERS|PROC|RAISE|RECORD|RETRY|RETURN|TASK|TEST|TRAP|TRYNEXT|"
    r"UNDO|VAR|WHILE)\b)([A-Za-z]\w{0,31})(?=[\s\\])(?!\s*(?:\(|:=))",
    re.IGNORECASE | re.MULTILINE,
)
DISPLACED = re.compile(r"^[^\S\r\n]*(PDisp(?:On|Set))(?=[\s\\])", re.IGNORECASE | re.MULTILINE)
SIGN = re.compile(r"[\[\](){},\\]")
PLACE = re.compile(r"(?:(?:Offs|RelTool)\s*\(\s*(\w+)|(\w+)\s*(?:\{[^}]*\}\s*)?\Z)", re.IGNORECASE)
WORK = re.compile(r"WObj\s*(?::=|\?)", re.IGNORECASE)
NAME = re.compile(r"[A-Za-z]\w{0,31}(?:\s*\{[^}]{0,40}\}|\.\w{1,32}){0,4}")
PLACED = re.compile(r"\b(robtarget|tooldata|wobjdata)\s+(\w{1,32})", re.IGNORECASE)
ROUTINE = re.compile(r"\b(?:PROC|FUNC\s+\w{1,32}|TRAP)\s+(\w{1,32})\s*(\()?", re.IGNORECASE)
LONGEST = 2000  # letters of an instruction
AHEAD = ("do", "ao", "go", "sync")  # ends of names whose tool is not the last argument


@dataclass(frozen=True)
class Move:
    """An instruction that goes to a point.

    start: where it begins.  body: where its arguments begin and end.  tool, work: as it names
    them, '' where it does not tell.
    """

    name: str
    start: int
    body: tuple[int, int]
    tool: str
    work: str

    @property
    def to_joints(self) -> bool:
        """Whether it goes to joints, which no tool changes."""
        return "absj" in self.name.lower()


def moves(program: Text) -> Iterator[Move]:
    """Every instruction that goes to a point, in the order of the module."""
    declared: dict[str, set[str]] = {"robtarget": set(), "tooldata": {"tool0"}, "wobjdata": set()}
    for data in PLACED.finditer(program.bare):
        declared[data[1].lower()].add(data[2].lower())
    routines, passed = set(), set()
    for found in ROUTINE.finditer(program.bare):
        routines.add(found[1].lower())
        stop = program.bare.find(")", found.end(), found.end() + LONGEST) if found[2] else -1
        given = program.bare[found.end() : max(stop, found.end())]
        passed |= {data[2].lower() for data in PLACED.finditer(given)}
    named = {found.start(1): found for found in NAMED.finditer(program.bare)}
    heads = {found.start(1): found for found in CALL.finditer(program.bare)} | named
    end = 0
    for start, found in sorted(heads.items()):
        stop = program.bare.find(";", found.end(), found.end() + LONGEST)
        if start < end or stop < 0 or found[1].lower() in routines:
            continue
        known, body = start in named, program.bare[found.end() : stop]
        if not (known or goes(body, declared["robtarget"])):
            continue
        end = stop
        tool, work = told(found[1], body, declared["tooldata"], known=known)
        # what a routine is given, its caller tells
        tool, work = (
            "" if word.partition("{")[0].strip().lower() in passed else word
            for word in (tool, work)
        )
        yield Move(found[1], start, (found.end(), stop), tool, work)


def displaced(program: Text) -> Iterator[tuple[int, str]]:
    """Lines and names of instructions that displace every point after them."""
    for found in DISPLACED.finditer(program.bare):
        yield program.line(found.start(1)), found[1]


def parts(body: str) -> Iterator[tuple[str, str]]:
    """The arguments, each with the comma or the backslash before it."""
    depth, sign, at = 0, ",", 0
    for found in SIGN.finditer(body):
        if found[0] in "[({":
            depth += 1
        elif found[0] in "])}":
            depth -= 1
        elif depth == 0:
            yield sign, body[at : found.start()].strip()
            sign, at = found[0], found.end()
    yield sign, body[at:].strip()


def goes(body: str, robtargets: set[str]) -> bool:
    """Whether an argument is a robtarget, by its name or in numbers."""
    for sign, text in parts(body):
        inner = [part.count(",") + 1 for part in BRACKETS.findall(text)]
        place = PLACE.match(text)
        name = (place[1] or place[2]).lower() if place else ""
        if sign == "," and (name in robtargets or (text[:1] == "[" and inner == [3, 4, 4, 6])):
            return True
    return False


def told(name: str, body: str, tools: set[str], *, known: bool) -> tuple[str, str]:
    """Tool and work object of an instruction, '' where it does not tell.

    tools: names that the module declares.  known: whether the instruction is the controller's.
    """
    placed: list[str] = []
    for sign, text in parts(body):
        if sign == "\\" and (work := WORK.match(text)):
            return (named(placed[-1]) if placed else ""), named(text[work.end() :])
        if sign == "," and text:
            placed.append(text)
    own = [text for text in placed if text.partition("{")[0].strip().lower() in tools]
    if own:
        return named(own[-1]), "wobj0"
    if not known:
        return "", ""
    ends = name.lower().startswith("move") and name.lower().endswith(AHEAD)
    at = (4 if name[4:5].lower() == "c" else 3) if ends else len(placed) - 1
    return (named(placed[at]) if 0 <= at < len(placed) else ""), "wobj0"


def named(text: str) -> str:
    """The name of a datum or of one in an array, '' for any other expression."""
    return "".join(text.split()) if NAME.fullmatch(text.strip()) else ""


# ---- programs ------------------------------------------------------------------------------------


DECLARED = re.compile(
    r"\b(robtarget|jointtarget)\s+(\w{1,32})\s*(?:\{[^}]{0,40}\}\s*)?:=\s*", re.IGNORECASE
)
NAMES = re.compile(r"\b(robtarget|jointtarget)\s+(\w{1,32})", re.IGNORECASE)
ASSIGNED = re.compile(r"(?<![\w.\\])(\w{1,32})\s*(?:\{[^}]{0,40}\}\s*)?:=\s*(?=\[)")
HEAD = re.compile(  # the words that a comment on the whole module stands behind
    r"^(?:\xef\xbb\xbf)?[^\S\n]*MODULE\s+\w+(?:\s*\([^)]{0,200}\))?[^\S\r\n]*",
    re.IGNORECASE | re.MULTILINE,
)
BRACKETS = re.compile(r"\[[^\[\]]*\]")
LITERAL = re.compile(r"\[(?:\s*\[[^\[\]]*\]\s*,?){2,4}\s*\]")
FRAME = re.compile(r"\b(tooldata|wobjdata)\s+(\w{1,32})\s*:=\s*", re.IGNORECASE)
QUARTERED = (0, 3, 5)  # joints whose quarter turns cf1, cf4, cf6 tell
SIZES = {"robtarget": (3, 4, 4, 6), "jointtarget": (6, 6)}
ORIGINS = {"tool": "tool0", "wobj": "wobj0"}
COMMENT = "!"
NO_AXIS = 8.9e9  # 9E9 says that there is no such external axis [ABB RAPID reference, extjoint]
OUTER = "eax_"
KINDS = {"robtarget": "point", "jointtarget": "point", "tooldata": "tool", "wobjdata": "wobj"}
DATA = re.compile(r"\b(robtarget|jointtarget|tooldata|wobjdata)\s+(\w{1,32})", re.IGNORECASE)
WRITTEN = re.compile(  # an assignment to a datum, one of an array, or a part of it
    r"(?<![\w.\\])(\w{1,32})((?:\s*\{[^}]{0,40}\}|\.\w{1,32}){0,4})\s*:=", re.IGNORECASE
)
OPENING = re.compile(r"\b(?:robtarget|jointtarget|tooldata|wobjdata)\s+\Z", re.IGNORECASE)
LOOK = 40  # letters before a name in which its declaration would stand


def read(text: str, source: str) -> Text:
    """A module."""
    return Text(text, blanked(text, RAPID_ASIDE), source)


def points(program: Text) -> Iterator[Point]:
    """Every target with numbers, in the order of the module.  Raises DataError."""
    declared = set()
    for found in DECLARED.finditer(program.bare):
        kind, name = found[1].lower(), found[2]
        literals = list(rows(program, found.end()))
        if not literals:
            continue  # made from other values: these are corrected where they stand
        for start, stop in literals:
            declared.add(start)
            yield point(program, kind, name, start, stop)
    kinds = {name[2].lower(): name[1].lower() for name in NAMES.finditer(program.bare)}
    end = 0
    for found in ASSIGNED.finditer(program.bare):
        if found.start() < end or found[1].lower() not in kinds:
            continue
        end = program.bare.find(";", found.end()) % (len(program.bare) + 1)
        for start, stop in rows(program, found.end()):
            if start not in declared:
                declared.add(start)
                yield point(program, kinds[found[1].lower()], found[1], start, stop)
    for move in moves(program):
        for literal in LITERAL.finditer(program.bare, *move.body):
            kind = "jointtarget" if move.to_joints else "robtarget"
            if literal.start() not in declared and sizes(literal[0]) == SIZES[kind]:
                yield point(program, kind, "", literal.start(), literal.end())


def left(program: Text) -> Iterator[int]:
    """Lines of points that stay as they are though they hold numbers: none."""
    yield from ()


def displacements(program: Text) -> Iterator[tuple[int, str]]:
    """Lines and names of what displaces every point after it."""
    return displaced(program)


def changes(program: Text) -> Iterator[tuple[int, str, str, str]]:
    """What the run writes: line, "point", "tool" or "wobj", the datum's name, and what of it.

    A point that is written whole is not among them: its numbers stand there, or are made of points.
    """
    kinds = {data[2].lower(): KINDS[data[1].lower()] for data in DATA.finditer(program.bare)}
    for found in WRITTEN.finditer(program.bare):
        name, part = found[1], "".join(found[2].split())
        kind = kinds.get(name.lower(), "")
        if OPENING.search(program.bare[max(0, found.start() - LOOK) : found.start()]):
            continue  # its declaration
        if kind in ("tool", "wobj") or (kind == "point" and "." in part):
            yield program.line(found.start(1)), kind, name, name + part


def rows(program: Text, at: int) -> Iterator[tuple[int, int]]:
    """Where the value of a declaration stands, or those of an array."""
    end = program.bare.find(";", at)
    stop = len(program.bare) if end < 0 else end
    for literal in LITERAL.finditer(program.bare, at, stop):
        yield literal.span()


def sizes(literal: str) -> tuple[int, ...]:
    """How many values stand in each inner bracket."""
    return tuple(part.count(",") + 1 for part in BRACKETS.findall(literal))


def point(program: Text, kind: str, name: str, start: int, stop: int) -> Point:
    """One target.  Raises DataError."""
    line = program.line(start)
    where = f"{program.source}:{line}: {kind} {name}".rstrip()
    inner = list(BRACKETS.finditer(program.bare, start + 1, stop - 1))
    if tuple(found[0].count(",") + 1 for found in inner) != SIZES[kind]:
        want = ", ".join(map(str, SIZES[kind]))
        raise DataError(f"{where}: must hold {want} numbers in its brackets")
    parts = [program.numbers(f.start() + 1, f.end() - 1, f"{kind} {name}".strip()) for f in inner]
    checked([n for part in parts[:2] for n in part if part is not parts[-1]], where)
    outer = tuple((i + 1, n.value) for i, n in enumerate(parts[-1]) if n.value < NO_AXIS)
    if kind == "jointtarget":
        joints = np.radians([number.value for number in parts[0]])
        return Point(kind, name, line, tuple(parts[0]), None, joints, outer=outer)
    turn = of_quaternion(np.array([n.value for n in parts[1]]), where)
    pose = posed(np.array([n.value for n in parts[0]]), turn)
    place = (*parts[0], *parts[1])
    return Point(kind, name, line, place, pose, np.zeros(0), tuple(parts[2][:3]), outer)


def numbers_of(pose: Array, point: Point) -> list[str]:
    """A pose as the numbers of a robtarget, the quaternion with the sign of the one before."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    q = np.array([w, x, y, z])
    q = q if q @ [n.value for n in point.place[3:]] >= 0.0 else -q
    return [f"{1e3 * v:.6f}" for v in pose[:3, 3]] + [f"{v:.9f}" for v in q]


def stands(point: Point, q: Array) -> bool:
    """Whether joints (n,) stand the way that a target says."""
    return all(
        quarter(q[joint]) == number.value
        for joint, number in zip(QUARTERED, point.way, strict=True)
    )


def ways(point: Point, before: Array, after: Array) -> list[tuple[Number, str]]:
    """The quarter turns that a correction changed."""
    return [
        (number, str(quarter(after[joint])))
        for joint, number in zip(QUARTERED, point.way, strict=True)
        if quarter(before[joint]) == number.value and quarter(after[joint]) != number.value
    ]


def quarter(angle: float) -> int:
    """The quarter turn that an angle [rad] lies in: 0 from 0 to 90 degrees, -1 below."""
    return int(np.floor(angle / (0.5 * np.pi) + 1e-12))


def frames(program: Text) -> dict[str, Array]:
    """Tools and work objects that the module declares with numbers: (4, 4) by name [m].

    Without tools that stand still and work objects that the robot holds.
    """
    out = {name: np.eye(4) for name in ORIGINS.values()}
    for found in FRAME.finditer(program.bare):
        kind, name = found[1].lower(), found[2]
        end = max(program.bare.find(";", found.end()), found.end())
        value = program.bare[found.end() : end]
        held = value.lstrip("[ \t\r\n").partition(",")[0].strip().upper()
        inner = list(BRACKETS.finditer(program.bare, found.end(), end))
        pairs = [p for p in pairwise(inner) if [f[0].count(",") for f in p] == [2, 3]]
        poses = [frame(program, name, *pair) for pair in pairs]
        if kind == "tooldata" and held == "TRUE" and poses:
            out[name] = poses[0]
        elif kind == "wobjdata" and held == "FALSE" and len(poses) > 1:
            out[name] = poses[0] @ poses[1]
    return out


def frame(program: Text, name: str, place: re.Match[str], turn: re.Match[str]) -> Array:
    """(4, 4) of a position and a quaternion in brackets [m]."""
    where = f"{program.source}:{program.line(place.start())}: {name}"
    xyz, quaternion = (
        np.array([n.value for n in program.numbers(f.start() + 1, f.end() - 1, name)])
        for f in (place, turn)
    )
    return posed(xyz, of_quaternion(quaternion, where))


def used(program: Text, points: Sequence[Point]) -> Iterator[tuple[int, str, str]]:
    """Line, "tool" or "wobj", and its name of each move, '' where the move does not tell."""
    for move in moves(program):
        if not move.to_joints:
            yield program.line(move.start), "tool", move.tool
            yield program.line(move.start), "wobj", move.work
