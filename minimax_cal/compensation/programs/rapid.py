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
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.compensation.programs.program_text import (
    FrameUse,
    NamedLine,
    NumberEdit,
    ProgramPoint,
    ProgramText,
    RuntimeChange,
    check_coordinate_range,
    rotation_from_quaternion,
    transform_from_position_mm,
)
from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import replace_matches_with_spaces
from minimax_cal.core.errors import DataError
from minimax_cal.measuring.importers.robot_programs import RAPID_IGNORED_PATTERN

RAPID_MOVE_PATTERN = re.compile(
    r"(?<![\w.\\])(Move(?:L|J|C|AbsJ)\w{0,8}|(?:Arc|Cap|Contact|Cut|Disp|FCPress\d?|Glue|Laser|"
    r"Paint|Seal|Search|SpotM?|Trigg)(?:L|J|C|AbsJ)\d?(?:Start|End|IOs)?)"
    r"(?=[\s\\])(?!\s*(?:\(|:=))",
    re.IGNORECASE,
)
RAPID_CALL_PATTERN = re.compile(
    r"^[^\S\r\n]*(?!(?:ALIAS|BACKWARD|CASE|CONNECT|CONST|DEFAULT|ELSE|ELSEIF|END\w{2,6}|ERROR|EXIT|"
    r"FOR|FUNC|GOTO|IF|LOCAL|MODULE|PERS|PROC|RAISE|RECORD|RETRY|RETURN|TASK|TEST|TRAP|TRYNEXT|"
    r"UNDO|VAR|WHILE)\b)([A-Za-z]\w{0,31})(?=[\s\\])(?!\s*(?:\(|:=))",
    re.IGNORECASE | re.MULTILINE,
)
RAPID_DISPLACEMENT_PATTERN = re.compile(
    r"^[^\S\r\n]*(PDisp(?:On|Set))(?=[\s\\])", re.IGNORECASE | re.MULTILINE
)
RAPID_SIGN_PATTERN = re.compile(r"[\[\](){},\\]")
RAPID_ROBTARGET_NAME_PATTERN = re.compile(
    r"(?:(?:Offs|RelTool)\s*\(\s*(\w+)|(\w+)\s*(?:\{[^}]*\}\s*)?\Z)", re.IGNORECASE
)
RAPID_WORK_OBJECT_PATTERN = re.compile(r"WObj\s*(?::=|\?)", re.IGNORECASE)
RAPID_DATUM_NAME_PATTERN = re.compile(r"[A-Za-z]\w{0,31}(?:\s*\{[^}]{0,40}\}|\.\w{1,32}){0,4}")
RAPID_PLACED_DATA_PATTERN = re.compile(
    r"\b(robtarget|tooldata|wobjdata)\s+(\w{1,32})", re.IGNORECASE
)
RAPID_ROUTINE_PATTERN = re.compile(
    r"\b(?:PROC|FUNC\s+\w{1,32}|TRAP)\s+(\w{1,32})\s*(\()?", re.IGNORECASE
)
MAX_INSTRUCTION_LETTERS = 2000  # letters of an instruction
RAPID_ENDINGS_WITH_TOOL_BEFORE_LAST = (
    "do",
    "ao",
    "go",
    "sync",
)  # ends of names whose tool is not the last argument


@dataclass(frozen=True)
class MoveInstruction:
    """An instruction that goes to a point.

    start: where it begins.  argument_span: where its arguments begin and end.  tool, work_object:
    as it names them, '' where it does not tell.
    """

    name: str
    start: int
    argument_span: tuple[int, int]
    tool: str
    work_object: str

    @property
    def goes_to_joints(self) -> bool:
        """Whether it goes to joints, which no tool changes."""
        return "absj" in self.name.lower()


def find_move_instructions(program: ProgramText) -> Iterator[MoveInstruction]:
    """Every instruction that goes to a point, in the order of the module."""
    declared: dict[str, set[str]] = {"robtarget": set(), "tooldata": {"tool0"}, "wobjdata": set()}
    for data in RAPID_PLACED_DATA_PATTERN.finditer(program.text_without_comments):
        declared[data[1].lower()].add(data[2].lower())
    routines, passed = set(), set()
    for found in RAPID_ROUTINE_PATTERN.finditer(program.text_without_comments):
        routines.add(found[1].lower())
        stop = (
            program.text_without_comments.find(
                ")", found.end(), found.end() + MAX_INSTRUCTION_LETTERS
            )
            if found[2]
            else -1
        )
        given = program.text_without_comments[found.end() : max(stop, found.end())]
        passed |= {data[2].lower() for data in RAPID_PLACED_DATA_PATTERN.finditer(given)}
    named = {
        found.start(1): found
        for found in RAPID_MOVE_PATTERN.finditer(program.text_without_comments)
    }
    heads = {
        found.start(1): found
        for found in RAPID_CALL_PATTERN.finditer(program.text_without_comments)
    } | named
    end = 0
    for start, found in sorted(heads.items()):
        stop = program.text_without_comments.find(
            ";", found.end(), found.end() + MAX_INSTRUCTION_LETTERS
        )
        if start < end or stop < 0 or found[1].lower() in routines:
            continue
        known, body = start in named, program.text_without_comments[found.end() : stop]
        if not (known or has_robtarget_argument(body, declared["robtarget"])):
            continue
        end = stop
        tool, work = parse_tool_and_work_object(
            found[1], body, declared["tooldata"], is_controller_instruction=known
        )
        # what a routine is given, its caller tells
        tool, work = (
            "" if word.partition("{")[0].strip().lower() in passed else word
            for word in (tool, work)
        )
        yield MoveInstruction(found[1], start, (found.end(), stop), tool, work)


def find_displacement_instructions(program: ProgramText) -> Iterator[NamedLine]:
    """Lines and names of instructions that displace every point after them."""
    for found in RAPID_DISPLACEMENT_PATTERN.finditer(program.text_without_comments):
        yield NamedLine(program.line_number(found.start(1)), found[1])


class InstructionArgument(NamedTuple):
    """An argument, and the comma or backslash before it."""

    separator: str
    text: str


def split_arguments(arguments_text: str) -> Iterator[InstructionArgument]:
    """The arguments, each with the comma or the backslash before it."""
    depth, sign, at = 0, ",", 0
    for found in RAPID_SIGN_PATTERN.finditer(arguments_text):
        if found[0] in "[({":
            depth += 1
        elif found[0] in "])}":
            depth -= 1
        elif depth == 0:
            yield InstructionArgument(sign, arguments_text[at : found.start()].strip())
            sign, at = found[0], found.end()
    yield InstructionArgument(sign, arguments_text[at:].strip())


def has_robtarget_argument(arguments_text: str, robtarget_names: set[str]) -> bool:
    """Whether an argument is a robtarget, by its name or in numbers."""
    for sign, text in split_arguments(arguments_text):
        inner = [part.count(",") + 1 for part in RAPID_BRACKETS_PATTERN.findall(text)]
        place = RAPID_ROBTARGET_NAME_PATTERN.match(text)
        name = (place[1] or place[2]).lower() if place else ""
        if sign == "," and (name in robtarget_names or (text[:1] == "[" and inner == [3, 4, 4, 6])):
            return True
    return False


class FrameNames(NamedTuple):
    """Names of a tool and a work object, '' where none is told."""

    tool: str
    work_object: str


def parse_tool_and_work_object(
    instruction_name: str,
    arguments_text: str,
    tool_names: set[str],
    *,
    is_controller_instruction: bool,
) -> FrameNames:
    """Tool and work object of an instruction, '' where it does not tell.

    tool_names: names that the module declares.  is_controller_instruction: whether the instruction
    is the controller's.
    """
    placed: list[str] = []
    for sign, text in split_arguments(arguments_text):
        if sign == "\\" and (work := RAPID_WORK_OBJECT_PATTERN.match(text)):
            tool = parse_datum_name(placed[-1]) if placed else ""
            return FrameNames(tool, parse_datum_name(text[work.end() :]))
        if sign == "," and text:
            placed.append(text)
    own = [text for text in placed if text.partition("{")[0].strip().lower() in tool_names]
    if own:
        return FrameNames(parse_datum_name(own[-1]), "wobj0")
    if not is_controller_instruction:
        return FrameNames("", "")
    ends = instruction_name.lower().startswith("move") and instruction_name.lower().endswith(
        RAPID_ENDINGS_WITH_TOOL_BEFORE_LAST
    )
    at = (4 if instruction_name[4:5].lower() == "c" else 3) if ends else len(placed) - 1
    return FrameNames((parse_datum_name(placed[at]) if 0 <= at < len(placed) else ""), "wobj0")


def parse_datum_name(text: str) -> str:
    """The name of a datum or of one in an array, '' for any other expression."""
    return "".join(text.split()) if RAPID_DATUM_NAME_PATTERN.fullmatch(text.strip()) else ""


# ---- programs ------------------------------------------------------------------------------------


RAPID_TARGET_VALUE_PATTERN = re.compile(
    r"\b(robtarget|jointtarget)\s+(\w{1,32})\s*(?:\{[^}]{0,40}\}\s*)?:=\s*", re.IGNORECASE
)
RAPID_TARGET_NAME_PATTERN = re.compile(r"\b(robtarget|jointtarget)\s+(\w{1,32})", re.IGNORECASE)
RAPID_ARRAY_ASSIGNMENT_PATTERN = re.compile(
    r"(?<![\w.\\])(\w{1,32})\s*(?:\{[^}]{0,40}\}\s*)?:=\s*(?=\[)"
)
PROGRAM_HEAD_PATTERN = re.compile(  # the words that a comment on the whole module stands behind
    r"^(?:\xef\xbb\xbf)?[^\S\n]*MODULE\s+\w+(?:\s*\([^)]{0,200}\))?[^\S\r\n]*",
    re.IGNORECASE | re.MULTILINE,
)
RAPID_BRACKETS_PATTERN = re.compile(r"\[[^\[\]]*\]")
RAPID_LITERAL_PATTERN = re.compile(r"\[(?:\s*\[[^\[\]]*\]\s*,?){2,4}\s*\]")
RAPID_FRAME_VALUE_PATTERN = re.compile(r"\b(tooldata|wobjdata)\s+(\w{1,32})\s*:=\s*", re.IGNORECASE)
QUARTER_TURN_JOINTS = (0, 3, 5)  # joints whose quarter turns cf1, cf4, cf6 tell
RAPID_BRACKET_SIZES = {"robtarget": (3, 4, 4, 6), "jointtarget": (6, 6)}
DEFAULT_FRAME_NAMES = {"tool": "tool0", "wobj": "wobj0"}
COMMENT_SIGN = "!"
MIN_ABSENT_AXIS_VALUE = (
    8.9e9  # 9E9 says that there is no such external axis [ABB RAPID reference, extjoint]
)
EXTERNAL_AXIS_PREFIX = "eax_"
RAPID_DATA_KINDS = {
    "robtarget": "point",
    "jointtarget": "point",
    "tooldata": "tool",
    "wobjdata": "wobj",
}
RAPID_DATA_NAME_PATTERN = re.compile(
    r"\b(robtarget|jointtarget|tooldata|wobjdata)\s+(\w{1,32})", re.IGNORECASE
)
RAPID_ASSIGNMENT_PATTERN = re.compile(  # an assignment to a datum, one of an array, or a part of it
    r"(?<![\w.\\])(\w{1,32})((?:\s*\{[^}]{0,40}\}|\.\w{1,32}){0,4})\s*:=", re.IGNORECASE
)
RAPID_DECLARATION_START_PATTERN = re.compile(
    r"\b(?:robtarget|jointtarget|tooldata|wobjdata)\s+\Z", re.IGNORECASE
)
RAPID_LETTERS_SEARCHED_BEFORE_NAME = (
    40  # letters before a name in which its declaration would stand
)


def parse_program(text: str, source: str) -> ProgramText:
    """A module."""
    return ProgramText(text, replace_matches_with_spaces(text, RAPID_IGNORED_PATTERN), source)


def find_points(program: ProgramText) -> Iterator[ProgramPoint]:
    """Every target with numbers, in the order of the module.  Raises DataError."""
    declared = set()
    for found in RAPID_TARGET_VALUE_PATTERN.finditer(program.text_without_comments):
        kind, name = found[1].lower(), found[2]
        literals = list(find_value_spans(program, found.end()))
        if not literals:
            continue  # made from other values: these are corrected where they stand
        for start, stop in literals:
            declared.add(start)
            yield parse_target(program, kind, name, start, stop)
    kinds = {
        name[2].lower(): name[1].lower()
        for name in RAPID_TARGET_NAME_PATTERN.finditer(program.text_without_comments)
    }
    end = 0
    for found in RAPID_ARRAY_ASSIGNMENT_PATTERN.finditer(program.text_without_comments):
        if found.start() < end or found[1].lower() not in kinds:
            continue
        end = program.text_without_comments.find(";", found.end()) % (
            len(program.text_without_comments) + 1
        )
        for start, stop in find_value_spans(program, found.end()):
            if start not in declared:
                declared.add(start)
                yield parse_target(program, kinds[found[1].lower()], found[1], start, stop)
    for move in find_move_instructions(program):
        for literal in RAPID_LITERAL_PATTERN.finditer(
            program.text_without_comments, *move.argument_span
        ):
            kind = "jointtarget" if move.goes_to_joints else "robtarget"
            if (
                literal.start() not in declared
                and count_values_in_brackets(literal[0]) == RAPID_BRACKET_SIZES[kind]
            ):
                yield parse_target(program, kind, "", literal.start(), literal.end())


def find_unchanged_point_lines(program: ProgramText) -> Iterator[int]:
    """Lines of points that stay as they are though they hold numbers: none."""
    yield from ()


def find_displacements(program: ProgramText) -> Iterator[NamedLine]:
    """Lines and names of what displaces every point after it."""
    return find_displacement_instructions(program)


def find_values_changed_at_runtime(program: ProgramText) -> Iterator[RuntimeChange]:
    """What the run writes: line, "point", "tool" or "wobj", the datum's name, and what of it.

    A point that is written whole is not among them: its numbers stand there, or are made of points.
    """
    kinds = {
        data[2].lower(): RAPID_DATA_KINDS[data[1].lower()]
        for data in RAPID_DATA_NAME_PATTERN.finditer(program.text_without_comments)
    }
    for found in RAPID_ASSIGNMENT_PATTERN.finditer(program.text_without_comments):
        name, part = found[1], "".join(found[2].split())
        kind = kinds.get(name.lower(), "")
        if RAPID_DECLARATION_START_PATTERN.search(
            program.text_without_comments[
                max(0, found.start() - RAPID_LETTERS_SEARCHED_BEFORE_NAME) : found.start()
            ]
        ):
            continue  # its declaration
        if kind in ("tool", "wobj") or (kind == "point" and "." in part):
            yield RuntimeChange(program.line_number(found.start(1)), kind, name, name + part)


class TextSpan(NamedTuple):
    """Where a text stands in another."""

    start: int
    end: int


def find_value_spans(program: ProgramText, start_offset: int) -> Iterator[TextSpan]:
    """Where the value of a declaration stands, or those of an array."""
    end = program.text_without_comments.find(";", start_offset)
    stop = len(program.text_without_comments) if end < 0 else end
    for literal in RAPID_LITERAL_PATTERN.finditer(
        program.text_without_comments, start_offset, stop
    ):
        yield TextSpan(*literal.span())


def count_values_in_brackets(literal: str) -> tuple[int, ...]:
    """How many values stand in each inner bracket."""
    return tuple(part.count(",") + 1 for part in RAPID_BRACKETS_PATTERN.findall(literal))


def parse_target(
    program: ProgramText, target_kind: str, target_name: str, start: int, stop: int
) -> ProgramPoint:
    """One target.  Raises DataError."""
    line = program.line_number(start)
    where = f"{program.source}:{line}: {target_kind} {target_name}".rstrip()
    inner = list(
        RAPID_BRACKETS_PATTERN.finditer(program.text_without_comments, start + 1, stop - 1)
    )
    if tuple(found[0].count(",") + 1 for found in inner) != RAPID_BRACKET_SIZES[target_kind]:
        want = ", ".join(map(str, RAPID_BRACKET_SIZES[target_kind]))
        raise DataError(f"{where}: must hold {want} numbers in its brackets")
    parts = [
        program.parse_numbers(f.start() + 1, f.end() - 1, f"{target_kind} {target_name}".strip())
        for f in inner
    ]
    check_coordinate_range([n for part in parts[:2] for n in part if part is not parts[-1]], where)
    outer = tuple(
        (i + 1, n.value) for i, n in enumerate(parts[-1]) if n.value < MIN_ABSENT_AXIS_VALUE
    )
    if target_kind == "jointtarget":
        joints = np.radians([number.value for number in parts[0]])
        return ProgramPoint(
            target_kind,
            target_name,
            line,
            tuple(parts[0]),
            None,
            joints,
            external_axis_values=outer,
        )
    turn = rotation_from_quaternion(np.array([n.value for n in parts[1]]), where)
    pose = transform_from_position_mm(np.array([n.value for n in parts[0]]), turn)
    place = (*parts[0], *parts[1])
    return ProgramPoint(
        target_kind, target_name, line, place, pose, np.zeros(0), tuple(parts[2][:3]), outer
    )


def format_pose_numbers(pose: Array, point: ProgramPoint) -> list[str]:
    """A pose as the numbers of a robtarget, the quaternion with the sign of the one before."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    q = np.array([w, x, y, z])
    q = q if q @ [n.value for n in point.pose_or_joint_numbers[3:]] >= 0.0 else -q
    return [f"{1e3 * v:.6f}" for v in pose[:3, 3]] + [f"{v:.9f}" for v in q]


def has_programmed_configuration(point: ProgramPoint, q: Array) -> bool:
    """Whether joints (n,) stand the way that a target says."""
    return all(
        quarter_turn(q[joint]) == number.value
        for joint, number in zip(QUARTER_TURN_JOINTS, point.configuration_numbers, strict=True)
    )


def list_configuration_changes(
    point: ProgramPoint, q_before: Array, q_after: Array
) -> list[NumberEdit]:
    """The quarter turns that a correction changed."""
    return [
        NumberEdit(number, str(quarter_turn(q_after[joint])))
        for joint, number in zip(QUARTER_TURN_JOINTS, point.configuration_numbers, strict=True)
        if quarter_turn(q_before[joint]) == number.value
        and quarter_turn(q_after[joint]) != number.value
    ]


def quarter_turn(angle: float) -> int:
    """The quarter turn that an angle [rad] lies in: 0 from 0 to 90 degrees, -1 below."""
    return int(np.floor(angle / (0.5 * np.pi) + 1e-12))


def find_declared_frames(program: ProgramText) -> dict[str, Array]:
    """Tools and work objects that the module declares with numbers: (4, 4) by name [m].

    Without tools that stand still and work objects that the robot holds.
    """
    out = {name: np.eye(4) for name in DEFAULT_FRAME_NAMES.values()}
    for found in RAPID_FRAME_VALUE_PATTERN.finditer(program.text_without_comments):
        kind, name = found[1].lower(), found[2]
        end = max(program.text_without_comments.find(";", found.end()), found.end())
        value = program.text_without_comments[found.end() : end]
        held = value.lstrip("[ \t\r\n").partition(",")[0].strip().upper()
        inner = list(
            RAPID_BRACKETS_PATTERN.finditer(program.text_without_comments, found.end(), end)
        )
        pairs = [p for p in pairwise(inner) if [f[0].count(",") for f in p] == [2, 3]]
        poses = [parse_frame_literal(program, name, *pair) for pair in pairs]
        if kind == "tooldata" and held == "TRUE" and poses:
            out[name] = poses[0]
        elif kind == "wobjdata" and held == "FALSE" and len(poses) > 1:
            out[name] = poses[0] @ poses[1]
    return out


def parse_frame_literal(
    program: ProgramText, name: str, position_match: re.Match[str], quaternion_match: re.Match[str]
) -> Array:
    """(4, 4) of a position and a quaternion in brackets [m]."""
    where = f"{program.source}:{program.line_number(position_match.start())}: {name}"
    xyz, quaternion = (
        np.array([n.value for n in program.parse_numbers(f.start() + 1, f.end() - 1, name)])
        for f in (position_match, quaternion_match)
    )
    return transform_from_position_mm(xyz, rotation_from_quaternion(quaternion, where))


def find_used_frames(program: ProgramText, points: Sequence[ProgramPoint]) -> Iterator[FrameUse]:
    """Line, "tool" or "wobj", and its name of each move, '' where the move does not tell."""
    for move in find_move_instructions(program):
        if not move.goes_to_joints:
            yield FrameUse(program.line_number(move.start), "tool", move.tool)
            yield FrameUse(program.line_number(move.start), "wobj", move.work_object)
