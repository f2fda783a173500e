"""A program in, the same with corrected points out.

A controller turns a point into joints by its own arm, the nominal one.  It is therefore told the
pose that the nominal arm has at the corrected joints, which bring the calibrated arm to the point.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from minimax_cal.compensation.joint_compensation import Compensation
from minimax_cal.compensation.programs import krl, rapid
from minimax_cal.compensation.programs.program_text import (
    NamedLine,
    NumberEdit,
    ProgramPoint,
    ProgramText,
    build_correction_mark,
    check_not_corrected_already,
    rotation_from_quaternion,
    transform_from_position_mm,
)
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.files import read_bytes
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.inverse_kinematics import (
    MAX_REACHED_RESIDUAL,
    pose_residual_and_jacobian,
    solve_nearest_joints,
)
from minimax_cal.robots.joint_ranges import clip_range_near_zero
from minimax_cal.robots.robot import INVERSE_LEVER_PER_REACH, Robot

FRAME_KIND_NAMES = {"tool": "tool", "wobj": "work object"}


def list_frame_uses_by_kind(
    language: ModuleType, program_text: ProgramText, points: Sequence[ProgramPoint]
) -> dict[str, list[NamedLine]]:
    """By "tool" and "wobj": each line that moves with one, and its name, '' where untold.

    None where all points are joints, which ask for no tool.
    """
    if all(point.pose is None for point in points):
        return {}
    told = sorted(language.find_used_frames(program_text, points))
    return {
        one: [NamedLine(line, name) for line, option, name in told if option == one]
        for one in FRAME_KIND_NAMES
    }


def check_frames_match_given(
    language: ModuleType,
    program_text: ProgramText,
    points: Sequence[ProgramPoint],
    given_frames: Mapping[str, str],
) -> None:
    """Raise OptionError for a move with another tool or work object than was named.

    given_frames: what is taken as the "tool" and the "wobj"; numbers may be any one of the
    program's.
    """
    known = [name.lower() for name in language.find_declared_frames(program_text)]
    for option, moves in list_frame_uses_by_kind(language, program_text, points).items():
        one, named = given_frames[option], [(line, name) for line, name in moves if name]
        numbers = "," in one and bool(named)
        first, wanted = named[0] if numbers else (0, one or language.DEFAULT_FRAME_NAMES[option])
        for line, name in named:
            if name.lower() == wanted.lower():
                continue
            where = f"{program_text.source}:{line}: moves with {name}"
            if numbers:
                raise OptionError(
                    f"{where}, at line {first} with {wanted}, and {option}={one} cannot be both; "
                    "split the file and correct each part with its own"
                )
            mend = f"{option}='{name}', or its frame as " if name.lower() in known else f"{option}="
            raise OptionError(
                f"{where}, not with {wanted}; give {mend}x,y,z,q1,q2,q3,q4, and correct programs "
                f"of several {FRAME_KIND_NAMES[option]}s one by one"
            )


def warn_of_unnamed_frames(
    language: ModuleType,
    program_text: ProgramText,
    points: Sequence[ProgramPoint],
    given_frames: Mapping[str, str],
) -> Iterator[str]:
    """Notices where a program does not tell its tool or its work object, in a move or at all."""
    doubts: dict[tuple[int, ...], list[tuple[str, str]]] = {}  # by lines, none for the whole file
    for option, moves in list_frame_uses_by_kind(language, program_text, points).items():
        lines = tuple(line for line, name in moves if not name)
        if lines or not (moves or given_frames[option]):
            taken = given_frames[option] or language.DEFAULT_FRAME_NAMES[option]
            doubts.setdefault(lines, []).append((FRAME_KIND_NAMES[option], taken))
    for lines, pairs in doubts.items():
        words, taken = (" and ".join(dict.fromkeys(part)) for part in zip(*pairs, strict=True))
        who = f"moves at line {format_first_items(lines)} do" if lines else "does"
        yield (
            f"{program_text.source}: {who} not tell the {words} "
            f"of the points, which are taken as those "
            f"of {taken}; give tool= or wobj= where they are of others"
        )


def format_first_items(items: Sequence[object]) -> str:
    """The first of many lines or names."""
    once = list(dict.fromkeys(items))
    return ", ".join(map(str, once[:8])) + (" ..." if len(once) > 8 else "")


def parse_given_frame(
    frame_text: str, declared_frames: dict[str, Array], option_name: str
) -> Array:
    """(4, 4) of a name or numbers.  Raises OptionError."""
    if not frame_text:
        return np.eye(4)
    names = {name.lower(): pose for name, pose in declared_frames.items()}
    if frame_text.lower() in names:
        return names[frame_text.lower()]
    try:
        numbers = np.array([float(part) for part in frame_text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 7 or not np.isfinite(numbers).all():
        there = f" ({', '.join(declared_frames)})" if declared_frames else ""
        raise OptionError(
            f"{option_name}={frame_text!r}: give x,y,z,q1,q2,q3,q4 "
            f"in mm, or a name declared there{there}"
        )
    try:
        return transform_from_position_mm(
            numbers[:3], rotation_from_quaternion(numbers[3:], f"{option_name}={frame_text!r}")
        )
    except DataError as error:
        raise OptionError(str(error)) from error


# ---- programs ------------------------------------------------------------------------------------


LANGUAGE_BY_FILE_ENDING: dict[str, ModuleType] = {
    ".mod": rapid, ".modx": rapid, ".prg": rapid, ".sys": rapid, ".sysx": rapid,
    ".src": krl, ".dat": krl,
}  # fmt: skip
MAX_PROGRAM_BYTES = 16 << 20  # bytes of a program
MAX_PROGRAM_POINTS = 20_000  # points
INVERSE_STARTS_PER_POINT, POINTS_PER_INVERSE_CHUNK = (
    48,
    100,
)  # of the search for all ways; points at a time
RAPID_EXTERNAL_AXIS_LETTERS = ".abcdef"  # of RAPID's external axes, from 1
MAX_SAME_CONFIGURATION_DIFFERENCE = 1e-3  # two ways are one [rad]


def is_robot_program_file(path: Path | str) -> bool:
    """Whether a file is one of the languages known, by its ending."""
    return Path(path).suffix.lower() in LANGUAGE_BY_FILE_ENDING


@dataclass(frozen=True, eq=False)
class RobotProgram:
    """A program and its points.

    tool: (4, 4) in the flange.  work_object: (4, 4) of the work object in the robot's base [m].
    data: the joints (m, n) that the controller turns the points into.
    """

    text: ProgramText
    language: ModuleType
    points: tuple[ProgramPoint, ...]
    tool: Array
    work_object: Array
    robot: Robot
    data: Measurements

    def format_corrected(self, compensation: Compensation) -> bytes:
        """The same bytes, with the points' numbers anew and a comment that says so."""
        changes = [
            build_correction_mark(
                self.text, self.language.PROGRAM_HEAD_PATTERN, self.language.COMMENT_SIGN
            )
        ]
        poses = np.linalg.inv(self.work_object) @ self.robot.pose(compensation.q) @ self.tool
        for point, pose, old, q in zip(
            self.points, poses, compensation.commanded, compensation.q, strict=True
        ):
            if point.pose is None:
                new = [f"{angle:.8f}" for angle in np.degrees(q)]
            else:
                new = self.language.format_pose_numbers(pose, point)
                changes += self.language.list_configuration_changes(point, old, q)
            changes += starmap(NumberEdit, zip(point.pose_or_joint_numbers, new, strict=True))
        return self.text.replace_numbers(changes).encode("latin-1")


def read_robot_program(
    path: Path | str, robot: Robot, tool: str = "", wobj: str = ""
) -> RobotProgram:
    """A program and the joints that a nominal robot takes at its points.

    tool, wobj: x,y,z,q1,q2,q3,q4 in mm, or the name of one that the program declares; the flange
    and the robot's base unless given.  Raises CalibrationError with the line.
    """
    language = LANGUAGE_BY_FILE_ENDING[Path(path).suffix.lower()]
    raw = read_bytes(path, error_type=DataError, max_bytes=MAX_PROGRAM_BYTES)
    if b"\0" in raw:
        raise DataError(f"{path}: is no text")
    text = language.parse_program(raw.decode("latin-1"), str(path))
    check_not_corrected_already(text)
    if robot.joints != 6 or robot.prismatic.any():
        raise OptionError(f"{robot.name}: points of programs are for arms with six turning joints")
    points = tuple(
        point
        for point, _ in zip(language.find_points(text), range(MAX_PROGRAM_POINTS + 1), strict=False)
    )
    if not points:
        only = any(language.find_unchanged_point_lines(text))
        more = ", only relative motions, offsets or parts of points" if only else ""
        raise DataError(f"{path}: holds no points with numbers{more}")
    if len(points) > MAX_PROGRAM_POINTS:
        raise DataError(f"{path}: holds over {MAX_PROGRAM_POINTS} points; split it")
    for line, name in language.find_displacements(text):
        raise DataError(
            f"{path}:{line}: {name} displaces the points after it, so their positions are not "
            "known; remove it, or correct a program without displaced points"
        )
    known, given = language.find_declared_frames(text), {"tool": tool, "wobj": wobj}
    check_frames_are_constant(language, text, points, given)
    check_frames_match_given(language, text, points, given)
    grip, table = (parse_given_frame(one, known, option) for option, one in given.items())
    q, doubts = solve_program_joints(points, language, robot, grip, table, str(path))
    notices = (
        *warn_of_unnamed_frames(language, text, points, given),
        *warn_of_unchanged_points(language, text),
        *warn_of_external_axes(language, points, str(path)),
        *warn_of_runtime_changes(language, text),
        *doubts,
    )
    lines = np.array([point.line for point in points])
    nowhere = np.zeros((len(q), 0, 3))
    data = Measurements(
        q, nowhere, (), robot.prismatic, lines, {}, notices=notices, source=str(path)
    )
    return RobotProgram(text, language, points, grip, table, robot, data)


def check_frames_are_constant(
    language: ModuleType,
    program_text: ProgramText,
    points: Sequence[ProgramPoint],
    given_frames: Mapping[str, str],
) -> None:
    """Raise DataError where the run writes a tool or work object that points are told in."""
    told = [(option, name) for _, option, name in language.find_used_frames(program_text, points)]
    used = {
        (option, name.partition("{")[0].lower()) for option, name in (*told, *given_frames.items())
    }
    for line, kind, name, part in language.find_values_changed_at_runtime(program_text):
        if (kind, name.lower()) in used:
            raise DataError(
                f"{program_text.source}:{line}: the program changes "
                f"{part}, so the positions of its points "
                f"are not known; correct a program whose {FRAME_KIND_NAMES[kind]} stays the same"
            )


def warn_of_runtime_changes(language: ModuleType, program_text: ProgramText) -> Iterator[str]:
    """A notice of coordinates that the run writes over those that are corrected."""
    found = [
        (line, part)
        for line, kind, _, part in language.find_values_changed_at_runtime(program_text)
        if kind == "point"
    ]
    if found:
        lines, parts = zip(*found, strict=True)
        yield (
            f"{program_text.source}: at line {format_first_items(lines)} the "
            f"run writes {format_first_items(parts)}: what it writes "
            "is not corrected"
        )


def warn_of_external_axes(
    language: ModuleType, points: Sequence[ProgramPoint], source: str
) -> Iterator[str]:
    """A notice of external axes that are not at zero: they may carry the arm or its work."""
    by_axis: dict[int, list[float]] = {}
    for point in points:
        for axis, value in point.external_axis_values:
            by_axis.setdefault(axis, []).append(value)
    for axis, values in sorted(by_axis.items()):
        low, high = min(values), max(values)
        if low or high:
            name = (
                f"{language.EXTERNAL_AXIS_PREFIX}"
                f"{RAPID_EXTERNAL_AXIS_LETTERS[axis] if language is rapid else axis}"
            )
            where = f"at {low:g}" if low == high else f"from {low:g} to {high:g}"
            yield (
                f"{source}: external axis {name} stands {where}; points are taken as if it carried "
                "neither the arm nor the work object, so correct no program of a track or a "
                "positioner"
            )


def warn_of_unchanged_points(language: ModuleType, program_text: ProgramText) -> tuple[str, ...]:
    """A notice of points that stay as they are though they hold numbers."""
    lines = list(language.find_unchanged_point_lines(program_text))
    if not lines:
        return ()
    many = f"{len(lines)} points are" if len(lines) > 1 else "1 point is"
    return (
        f"{program_text.source}: {many} left as programmed, at line "
        f"{format_first_items(lines)}: relative motions, "
        "offsets, and points without all of X, Y, Z, A, B, C or A1 to A6",
    )


class ProgramJoints(NamedTuple):
    """Joint values (m, n) of the points of a program, and notices."""

    q: Array
    notices: tuple[str, ...]


def solve_program_joints(
    points: tuple[ProgramPoint, ...],
    language: ModuleType,
    robot: Robot,
    tool: Array,
    work_object: Array,
    source: str,
) -> ProgramJoints:
    """(m, n) joints that the controller turns points into, and notices.  Raises DataError."""
    posed_points = [point for point in points if point.pose is not None]
    goals = [work_object @ point.pose @ np.linalg.inv(tool) for point in posed_points]
    ways = iter(solve_joint_configurations(robot, np.array(goals).reshape(-1, 4, 4)))
    out, doubtful = [], []
    before = np.clip(np.zeros(robot.joints), robot.lower, robot.upper)
    for point in points:
        if point.pose is None:
            before = point.joints
        else:
            found = next(ways)
            if not len(found):
                raise DataError(
                    f"{source}:{point.line}: {point.kind} {point.name} is out of reach of "
                    f"{robot.name}: check tool and work object, units and the robot"
                )
            fitting = np.array(
                [q for q in found if language.has_programmed_configuration(point, q)]
            )
            if not len(fitting):
                doubtful.append(point.line)
            several = fitting if len(fitting) else found
            before = several[np.argmin(np.abs(several - before).max(axis=1))]
        out.append(before)
    if not doubtful:
        return ProgramJoints(np.array(out), ())
    said = (
        f"{source}: at line {format_first_items(doubtful)} no way "
        f"of {robot.name} stands as the configuration "
        "says; the one nearest to the point before is taken"
    )
    return ProgramJoints(np.array(out), (said,))


def solve_joint_configurations(robot: Robot, flange_poses: Array) -> Iterator[Array]:
    """For each goal (4, 4) of the flange the different joints (s, n) that reach it."""
    span = clip_range_near_zero(robot.lower, robot.upper)
    begin = np.random.default_rng(0).uniform(*span, (INVERSE_STARTS_PER_POINT, robot.joints))
    lever, turning = INVERSE_LEVER_PER_REACH * robot.reach(), robot.joint_to_chain_matrix
    for first in range(0, len(flange_poses), POINTS_PER_INVERSE_CHUNK):
        chunk = np.repeat(
            flange_poses[first : first + POINTS_PER_INVERSE_CHUNK], INVERSE_STARTS_PER_POINT, axis=0
        )

        def look(rows: Array, q: Array, goal: Array = chunk) -> tuple[Array, Array]:
            here = robot.chain_joint_values(q)
            return pose_residual_and_jacobian(
                robot.mdh, here, robot.prismatic, turning, goal[rows], lever
            )

        start = np.tile(begin, (len(chunk) // INVERSE_STARTS_PER_POINT, 1))
        box = (np.broadcast_to(end, start.shape) for end in (robot.lower, robot.upper))
        q = solve_nearest_joints(look, start, *box)
        left = np.linalg.norm(look(np.arange(len(q)), q)[0], axis=1)
        for ways, off in zip(
            q.reshape(-1, INVERSE_STARTS_PER_POINT, robot.joints),
            left.reshape(-1, INVERSE_STARTS_PER_POINT),
            strict=True,
        ):
            yield add_full_turn_configurations(
                robot, drop_duplicate_configurations(ways[off <= MAX_REACHED_RESIDUAL])
            )


def drop_duplicate_configurations(configurations: Array) -> Array:
    """The different ones."""
    _, first = np.unique(
        np.round(configurations / MAX_SAME_CONFIGURATION_DIFFERENCE).astype(int),
        axis=0,
        return_index=True,
    )
    return np.asarray(configurations[np.sort(first)])


def add_full_turn_configurations(robot: Robot, configurations: Array) -> Array:
    """The same with each of the joints a turn further either way, within its limits."""
    for joint in range(robot.joints):
        steps = 2.0 * np.pi * np.eye(robot.joints)[joint]
        more = np.concatenate([configurations, configurations - steps, configurations + steps])
        inside = (more >= robot.lower - MAX_SAME_CONFIGURATION_DIFFERENCE) & (
            more <= robot.upper + MAX_SAME_CONFIGURATION_DIFFERENCE
        )
        near = np.abs(more[:, joint]) <= 2.0 * np.pi
        configurations = more[inside.all(axis=1) & near]
    return drop_duplicate_configurations(configurations) if len(configurations) else configurations
