"""A program in, the same with corrected points out.

A controller turns a point into joints by its own arm, the nominal one.  It is therefore told the
pose that the nominal arm has at the corrected joints, which bring the calibrated arm to the point.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from minimax_cal.correcting.compensate import Compensation
from minimax_cal.correcting.programs import krl, rapid
from minimax_cal.correcting.programs.points import (
    Point,
    Text,
    check_unmarked,
    marked,
    of_quaternion,
    posed,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.files import read_raw
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.inverse import NEAR, missing, nearest
from minimax_cal.robots.ranges import near_zero
from minimax_cal.robots.robot import LEVER, Robot

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


# ---- programs ------------------------------------------------------------------------------------


LANGUAGES: dict[str, ModuleType] = {
    ".mod": rapid, ".modx": rapid, ".prg": rapid, ".sys": rapid, ".sysx": rapid,
    ".src": krl, ".dat": krl,
}  # fmt: skip
LARGEST = 16 << 20  # bytes of a program
MAX_POINTS = 20_000  # points
STARTS, CHUNK = 48, 100  # of the search for all ways; points at a time
AXES = ".abcdef"  # of RAPID's external axes, from 1
WAY_TOLERANCE = 1e-3  # two ways are one [rad]


def is_program(path: Path | str) -> bool:
    """Whether a file is one of the languages known, by its ending."""
    return Path(path).suffix.lower() in LANGUAGES


@dataclass(frozen=True, eq=False)
class Program:
    """A program and its points.

    tool: (4, 4) in the flange.  work: (4, 4) of the work object in the robot's base [m].
    data: the joints (m, n) that the controller turns the points into.
    """

    text: Text
    language: ModuleType
    points: tuple[Point, ...]
    tool: Array
    work: Array
    robot: Robot
    data: Measurements

    def corrected(self, found: Compensation) -> bytes:
        """The same bytes, with the points' numbers anew and a comment that says so."""
        changes = [marked(self.text, self.language.HEAD, self.language.COMMENT)]
        poses = np.linalg.inv(self.work) @ self.robot.pose(found.q) @ self.tool
        for point, pose, old, q in zip(self.points, poses, found.commanded, found.q, strict=True):
            if point.pose is None:
                new = [f"{angle:.8f}" for angle in np.degrees(q)]
            else:
                new = self.language.numbers_of(pose, point)
                changes += self.language.ways(point, old, q)
            changes += zip(point.place, new, strict=True)
        return self.text.replaced(changes).encode("latin-1")


def read_program(path: Path | str, robot: Robot, tool: str = "", wobj: str = "") -> Program:
    """A program and the joints that a nominal robot takes at its points.

    tool, wobj: x,y,z,q1,q2,q3,q4 in mm, or the name of one that the program declares; the flange
    and the robot's base unless given.  Raises CalibrationError with the line.
    """
    language = LANGUAGES[Path(path).suffix.lower()]
    raw = read_raw(path, kind=DataError, most=LARGEST)
    if b"\0" in raw:
        raise DataError(f"{path}: is no text")
    text = language.read(raw.decode("latin-1"), str(path))
    check_unmarked(text)
    if robot.joints != 6 or robot.prismatic.any():
        raise OptionError(f"{robot.name}: points of programs are for arms with six turning joints")
    points = tuple(
        point for point, _ in zip(language.points(text), range(MAX_POINTS + 1), strict=False)
    )
    if not points:
        only = any(language.left(text))
        more = ", only relative motions, offsets or parts of points" if only else ""
        raise DataError(f"{path}: holds no points with numbers{more}")
    if len(points) > MAX_POINTS:
        raise DataError(f"{path}: holds over {MAX_POINTS} points; split it")
    for line, name in language.displacements(text):
        raise DataError(
            f"{path}:{line}: {name} displaces the points after it, so their positions are not "
            "known; remove it, or correct a program without displaced points"
        )
    known, given = language.frames(text), {"tool": tool, "wobj": wobj}
    check_frames_stay(language, text, points, given)
    check_used(language, text, points, given)
    grip, table = (frame_of(one, known, option) for option, one in given.items())
    q, doubts = joints_of(points, language, robot, grip, table, str(path))
    notices = (
        *untold(language, text, points, given),
        *left_out(language, text),
        *moved_outside(language, points, str(path)),
        *written_by_run(language, text),
        *doubts,
    )
    lines = np.array([point.line for point in points])
    nowhere = np.zeros((len(q), 0, 3))
    data = Measurements(
        q, nowhere, (), robot.prismatic, lines, {}, notices=notices, source=str(path)
    )
    return Program(text, language, points, grip, table, robot, data)


def check_frames_stay(
    language: ModuleType, text: Text, points: Sequence[Point], given: Mapping[str, str]
) -> None:
    """Raise DataError where the run writes a tool or work object that points are told in."""
    told = [(option, name) for _, option, name in language.used(text, points)]
    used = {(option, name.partition("{")[0].lower()) for option, name in (*told, *given.items())}
    for line, kind, name, part in language.changes(text):
        if (kind, name.lower()) in used:
            raise DataError(
                f"{text.source}:{line}: the program changes {part}, so the positions of its points "
                f"are not known; correct a program whose {WORDS[kind]} stays the same"
            )


def written_by_run(language: ModuleType, text: Text) -> Iterator[str]:
    """A notice of coordinates that the run writes over those that are corrected."""
    found = [(line, part) for line, kind, _, part in language.changes(text) if kind == "point"]
    if found:
        lines, parts = zip(*found, strict=True)
        yield (
            f"{text.source}: at line {shown(lines)} the run writes {shown(parts)}: what it writes "
            "is not corrected"
        )


def moved_outside(language: ModuleType, points: Sequence[Point], source: str) -> Iterator[str]:
    """A notice of external axes that are not at zero: they may carry the arm or its work."""
    by_axis: dict[int, list[float]] = {}
    for point in points:
        for axis, value in point.outer:
            by_axis.setdefault(axis, []).append(value)
    for axis, values in sorted(by_axis.items()):
        low, high = min(values), max(values)
        if low or high:
            name = f"{language.OUTER}{AXES[axis] if language is rapid else axis}"
            where = f"at {low:g}" if low == high else f"from {low:g} to {high:g}"
            yield (
                f"{source}: external axis {name} stands {where}; points are taken as if it carried "
                "neither the arm nor the work object, so correct no program of a track or a "
                "positioner"
            )


def left_out(language: ModuleType, text: Text) -> tuple[str, ...]:
    """A notice of points that stay as they are though they hold numbers."""
    lines = list(language.left(text))
    if not lines:
        return ()
    many = f"{len(lines)} points are" if len(lines) > 1 else "1 point is"
    return (
        f"{text.source}: {many} left as programmed, at line {shown(lines)}: relative motions, "
        "offsets, and points without all of X, Y, Z, A, B, C or A1 to A6",
    )


def joints_of(
    points: tuple[Point, ...],
    language: ModuleType,
    robot: Robot,
    tool: Array,
    work: Array,
    source: str,
) -> tuple[Array, tuple[str, ...]]:
    """(m, n) joints that the controller turns points into, and notices.  Raises DataError."""
    posed_points = [point for point in points if point.pose is not None]
    goals = [work @ point.pose @ np.linalg.inv(tool) for point in posed_points]
    ways = iter(all_ways(robot, np.array(goals).reshape(-1, 4, 4)))
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
            fitting = np.array([q for q in found if language.stands(point, q)])
            if not len(fitting):
                doubtful.append(point.line)
            several = fitting if len(fitting) else found
            before = several[np.argmin(np.abs(several - before).max(axis=1))]
        out.append(before)
    if not doubtful:
        return np.array(out), ()
    said = (
        f"{source}: at line {shown(doubtful)} no way of {robot.name} stands as the configuration "
        "says; the one nearest to the point before is taken"
    )
    return np.array(out), (said,)


def all_ways(robot: Robot, goals: Array) -> Iterator[Array]:
    """For each goal (4, 4) of the flange the different joints (s, n) that reach it."""
    span = near_zero(robot.lower, robot.upper)
    begin = np.random.default_rng(0).uniform(*span, (STARTS, robot.joints))
    lever, turning = LEVER * robot.reach(), robot.turning
    for first in range(0, len(goals), CHUNK):
        chunk = np.repeat(goals[first : first + CHUNK], STARTS, axis=0)

        def look(rows: Array, q: Array, goal: Array = chunk) -> tuple[Array, Array]:
            here = robot.turned(q)
            return missing(robot.mdh, here, robot.prismatic, turning, goal[rows], lever)

        start = np.tile(begin, (len(chunk) // STARTS, 1))
        box = (np.broadcast_to(end, start.shape) for end in (robot.lower, robot.upper))
        q = nearest(look, start, *box)
        left = np.linalg.norm(look(np.arange(len(q)), q)[0], axis=1)
        for ways, off in zip(
            q.reshape(-1, STARTS, robot.joints), left.reshape(-1, STARTS), strict=True
        ):
            yield turned(robot, distinct(ways[off <= NEAR]))


def distinct(ways: Array) -> Array:
    """The different ones."""
    _, first = np.unique(np.round(ways / WAY_TOLERANCE).astype(int), axis=0, return_index=True)
    return np.asarray(ways[np.sort(first)])


def turned(robot: Robot, ways: Array) -> Array:
    """The same with each of the joints a turn further either way, within its limits."""
    for joint in range(robot.joints):
        steps = 2.0 * np.pi * np.eye(robot.joints)[joint]
        more = np.concatenate([ways, ways - steps, ways + steps])
        inside = (more >= robot.lower - WAY_TOLERANCE) & (more <= robot.upper + WAY_TOLERANCE)
        near = np.abs(more[:, joint]) <= 2.0 * np.pi
        ways = more[inside.all(axis=1) & near]
    return distinct(ways) if len(ways) else ways
