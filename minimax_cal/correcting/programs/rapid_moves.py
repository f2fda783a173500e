"""RAPID's instructions that go to a point: their arguments, their tool and work object.

Those of the controller and its options are known by name; any other, such as a routine of the
user, by a robtarget among its arguments.  Arguments with a place stand between commas, optional
ones behind a backslash [ABB RAPID reference].
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from minimax_cal.correcting.programs.points import Text

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
BRACKETS = re.compile(r"\[[^\[\]]*\]")
WORK = re.compile(r"WObj\s*(?::=|\?)", re.IGNORECASE)
NAME = re.compile(r"[A-Za-z]\w{0,31}(?:\s*\{[^}]{0,40}\}|\.\w{1,32}){0,4}")
DATA = re.compile(r"\b(robtarget|tooldata|wobjdata)\s+(\w{1,32})", re.IGNORECASE)
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
    for data in DATA.finditer(program.bare):
        declared[data[1].lower()].add(data[2].lower())
    routines, passed = set(), set()
    for found in ROUTINE.finditer(program.bare):
        routines.add(found[1].lower())
        stop = program.bare.find(")", found.end(), found.end() + LONGEST) if found[2] else -1
        given = program.bare[found.end() : max(stop, found.end())]
        passed |= {data[2].lower() for data in DATA.finditer(given)}
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
