"""Does the drawn arm fit far better with a slip mended?  Rows, columns, units, signs, conventions.

Each is tried by the alignment of the drawn arm alone, which takes milliseconds.  The mends of whole
files that the messages name are made here as well, where the user asks for them.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.measuring.measurements import Measurements, RowOrigin
from minimax_cal.robots import dh_notation
from minimax_cal.robots.dh_notation import DhNotation
from minimax_cal.robots.robot import Robot

MAX_TRIAL_POSES = 30  # poses that are enough to test a slip of units or signs
TRIED_ROW_SHIFTS = (
    1,
    -1,
    2,
    -2,
    3,
    -3,
)  # rows that a file is shifted by: a line more or less, seldom two
MM_PER_INCH = 25.4
ROW_SHIFT_WORDS = {1: "one row", 2: "two rows", 3: "three rows"}
MIN_FLANGE_MOTION = 0.01  # a flange that moved farther leaves no point where it was [m]
RADIANS_PER_DEGREE = np.pi / 180.0
ROBOT_UNIT_ADVICE = "(or the robot file gives {} under the unit {})"
INCHES_ADVICE = (
    "the points look like inches given as {}: minimax-cal import {{}} --units smr=in -o "
)
# by what to multiply, and what to say of what, in columns of which beginning
LENGTH_UNIT_ADVICE = {
    1e-3: "{0} look like millimetres given as metres: name the columns {1}_mm, ...",
    1e3: "{0} look like metres given as millimetres: name the columns {1}_m, ...",
    MM_PER_INCH: "{0} look like inches given as millimetres: multiply them by 25.4",
    1e-3 * MM_PER_INCH: "{0} look like inches given as metres: multiply them by 0.0254",
}
# what to say, and by what to multiply turning joints and points; likely ones first
UNIT_MISTAKES = (
    (
        "the measurement frame looks left-handed; reverse one of its axes",
        1.0,
        np.array([1.0, 1.0, -1.0]),
    ),
    (
        "the joint values look like degrees; name the columns q1_deg, q2_deg, ...",
        RADIANS_PER_DEGREE,
        1.0,
    ),
    (
        "the joint values look like radians; name the columns q1_rad, q2_rad, ...",
        1 / RADIANS_PER_DEGREE,
        1.0,
    ),
    (
        "the points look like millimetres given as metres: name the columns smr1_x_mm, ... "
        + ROBOT_UNIT_ADVICE.format("metres", "mm"),
        1.0,
        1e-3,
    ),
    (
        "the points look like metres given as millimetres: name the columns smr1_x_m, ... "
        + ROBOT_UNIT_ADVICE.format("millimetres", "m"),
        1.0,
        1e3,
    ),
    (INCHES_ADVICE.format("mm") + "mended.csv", 1.0, MM_PER_INCH),
    (INCHES_ADVICE.format("m") + "mended.csv", 1.0, 1e-3 * MM_PER_INCH),
    (
        "the lengths of the robot file look like inches given as mm: multiply them by 25.4",
        1.0,
        1.0 / MM_PER_INCH,
    ),
)
JOINT_ROUNDING_STEPS = {  # of joint values with so few, the step in rad and what to say
    "whole degrees": np.pi / 180.0,
    "tenths of a degree": np.pi / 1800.0,
    "hundredths of a radian": 1e-2,
}
MAX_GRID_DEVIATION = 1e-6  # share of a step by which printed values miss their grid


SHIFT_VALUE_PATTERN = re.compile(r"(-?\d+)(?:@(\d*)\.\.(\d*))?")
MEND_EXAMPLES = "shift=1, shift=-1@40.. (from line 40 on), reverse, joints=1:3:2, scale=0.999"
MAX_MEND_SCALE = 1e3


def with_points_from_rows_ahead(data: Measurements, row_shift: int) -> Measurements:
    """Each row with the points of the row that many further on; rows that get none are gone."""
    if row_shift > 0:
        poses, points = slice(None, -row_shift), slice(row_shift, None)
    else:
        poses, points = slice(-row_shift, None), slice(None, row_shift or None)
    rows = np.arange(data.poses)
    out = data.take(rows[poses])
    own = data.take(rows[points])
    columns = {**out.columns, **{k: c for k, c in own.columns.items() if k == "u95"}}
    return replace(out, y=own.y, columns=columns)


def with_points_reversed(data: Measurements) -> Measurements:
    """The points in the opposite order."""
    columns = {k: c[::-1] if k == "u95" else c for k, c in data.columns.items()}
    return replace(data, y=data.y[::-1], columns=columns)


def with_joint_columns_ordered(data: Measurements, column_order: list[int]) -> Measurements:
    """Joint columns in another order.  column_order: which column each joint's values stand in."""
    return replace(data, q=data.q[:, column_order], sliding=data.sliding[column_order])


def propose_file_corrections(
    robot: Robot, data: Measurements
) -> Iterator[tuple[str, tuple[Robot, Measurements]]]:
    """Slips of the whole file: what to say, and robot and data with it mended."""
    yield from ((text, (robot, mended)) for text, mended in propose_unit_corrections(robot, data))
    for text, how, joints, points in propose_row_corrections(data.poses):
        moved = replace(data.take(points), q=data.q[joints])
        yield f"the points {text}; {format_mend_command(data, how)}", (robot, moved)
    for text, how, mended in propose_column_corrections(robot, data):
        yield f"{text}; {format_mend_command(data, how)}", (robot, mended)
    other = convert_to_other_dh_convention(robot)
    if other is not None:
        name = "modified (Craig's)" if other.notation.modified else "standard"
        text = (
            f"the rows of {robot.name} look like {name} DH; set "
            f'"convention": "{name.split()[0]}" in the robot file'
        )
        yield text, (other, data)
    for text, mended in propose_joint_corrections(robot, data):
        yield text, (robot, mended)


def format_import_command(origin: RowOrigin, option_text: str) -> str:
    """The command that reads some files with an option, and writes what is mended."""
    words = [*origin.points, *(["--joints", origin.joints] if origin.joints else [])]
    return f"minimax-cal import {shlex.join(words)} {option_text} -o mended.csv"


def format_mend_command(data: Measurements, mend_text: str) -> str:
    """The command that mends a file."""
    origin = data.origins[0] if len(data.origins) == 1 else RowOrigin((data.source,))
    return format_import_command(origin, f"--mend {mend_text}")


def format_leave_out_command(data: Measurements, rows: Array) -> str:
    """The command that sets rows aside: all of the file that holds the first."""
    lines = data.line[rows]
    origin = data.origin_of_line(lines[0])
    mine = [str(line - origin.begin) for line in lines if data.origin_of_line(line) == origin]
    return format_import_command(origin, f"--leave-out {','.join(mine)}")


def propose_unit_corrections(
    robot: Robot, data: Measurements
) -> Iterator[tuple[str, Measurements]]:
    """Angles and lengths in another unit than they say."""
    for text, turned, scaled in UNIT_MISTAKES:
        q = np.where(robot.prismatic, data.q, data.q * turned)
        yield text.format(data.source), replace(data, q=q, y=data.y * scaled)


def describe_row_shift(row_shift: int) -> str:
    """Where points stand that are so many rows further on than their joints."""
    return (
        f"stand {ROW_SHIFT_WORDS[abs(row_shift)]} "
        f"{'below' if row_shift > 0 else 'above'} its joints"
    )


def propose_row_corrections(count: int) -> Iterator[tuple[str, str, Array, Array]]:
    """What was measured in other rows than its joints: what to say, how it is mended.

    And the rows of the joints, and of what was measured, that belong together.
    """
    rows = np.arange(count)
    for by in TRIED_ROW_SHIFTS:
        if count > 10 + abs(by):
            own = rows[max(-by, 0) : count - max(by, 0)]
            text = f"look shifted: those of each pose {describe_row_shift(by)}"
            yield text, f"shift={by}", own, own + by
    yield "look like those of the poses in reverse order", "reverse", rows, rows[::-1]


def propose_column_corrections(
    robot: Robot, data: Measurements
) -> Iterator[tuple[str, str, Measurements]]:
    """Joint columns under each other's names: what to say, how it is mended, the data mended."""
    joints = list(range(robot.joints))
    orders = []
    for i, j in combinations(joints, 2):
        order = joints.copy()
        order[i], order[j] = j, i
        orders.append((f"columns of joints {i + 1} and {j + 1} look swapped", order))
    if len(joints) > 3:
        orders.append(
            ("joint columns look like those of the joints in reverse order", joints[::-1])
        )
    for text, order in orders:
        if np.array_equal(data.sliding[order], data.sliding):
            names = ":".join(str(i + 1) for i in order)
            yield f"the {text}", f"joints={names}", with_joint_columns_ordered(data, order)


def convert_to_other_dh_convention(robot: Robot) -> Robot | None:
    """The robot with the rows of its file read as of the other convention; None if impossible."""
    rows, end = robot.notation.rows_in_file_convention(robot.mdh, robot.prismatic)
    offset = robot.notation.offset
    sign = robot.sign.copy()
    if robot.notation.modified:
        sign[0] *= -1.0 if robot.notation.half_turn else 1.0
        mdh, sign = dh_notation.apply_offsets_and_half_turn(
            rows, sign, robot.prismatic, offset, False
        )
        return replace(robot, mdh=mdh, sign=sign, notation=DhNotation(offset=offset))
    first = rows[0, dh_notation.CRAIG_SHIFTED_COLUMNS]
    if (
        np.abs(first[[0, 2]]).max() > dh_notation.MAX_ROW_ROUNDING
        or abs(np.sin(first[1])) > dh_notation.MAX_ROW_ROUNDING
    ):
        return None
    mdh, sign, said = dh_notation.convert_modified_rows(
        rows, sign, robot.prismatic, offset, end, robot.name
    )
    return replace(robot, mdh=mdh, sign=sign, notation=said)


def propose_joint_corrections(
    robot: Robot, data: Measurements
) -> Iterator[tuple[str, Measurements]]:
    """Joints 2 and 3 that a controller counts together, and joints that turn the other way."""
    n = robot.joints
    for i, j in ((2, 1), (1, 2)):
        for sign in (1.0, -1.0):
            if n > 2 and not robot.prismatic[[i, j]].any():
                q = data.q.copy()
                q[:, i] += sign * q[:, j]
                yield (
                    f"joints {i + 1} and {j + 1} look coupled (a linked arm); set "
                    f'"coupling": {{"J{i + 1}": {{"J{j + 1}": {sign:g}}}}} in the robot file',
                    replace(data, q=q),
                )
    for count in range(1, min(n, 6) + 1):
        for flipped in combinations(range(n), count):
            names = ", ".join(f"{i + 1}" for i in flipped)
            yield (
                f"the sign of joint {names} looks reversed; set its sign in the robot file",
                replace(data, q=np.where(np.isin(np.arange(n), flipped), -data.q, data.q)),
            )


def find_stale_rows(robot: Robot, data: Measurements) -> Array:
    """(b,) rows whose points are those of the row before, to the last digit, though the arm moved.

    A reading that is taken again before the next point was measured.
    """
    flange = robot.pose(data.q)[:, :3, 3]
    went = np.linalg.norm(np.diff(flange, axis=0), axis=1) > MIN_FLANGE_MOTION
    both = data.seen[1:] & data.seen[:-1]
    same = (np.diff(data.y, axis=0) == 0.0).all(axis=2) & both
    return 1 + np.flatnonzero(went & same.any(axis=1) & (same | ~both).all(axis=1))


def describe_coarse_rounding(robot: Robot, data: Measurements) -> str:
    """How few digits the joint values of all turning joints have, or ''."""
    q = data.q[:, ~robot.prismatic]
    moving = q[:, np.ptp(q, axis=0) > 0.0] if len(q) else q
    if moving.size < 20:
        return ""
    for name, step in JOINT_ROUNDING_STEPS.items():
        away = np.abs(moving / step - np.round(moving / step))
        if (away < max(MAX_GRID_DEVIATION, 1e-9 / step)).all():
            return name
    return ""


def apply_mends(data: Measurements, mend_texts: Iterable[str]) -> Measurements:
    """The data with mends made, one after the other.

    mend_texts: shift=N (each row takes the points of the row N further on; @A..B in lines A to B
    alone), reverse (points in the opposite order), joints=1:3:2 (which column each joint's values
    stand in), scale=S (of the points).  Raises OptionError.
    """
    for text in mend_texts:
        name, _, value = text.strip().partition("=")
        if name not in MEND_FUNCTIONS:
            raise OptionError(f"mend={text!r}: write {MEND_EXAMPLES}")
        if data.aside is not None:
            raise OptionError(f"mend={text!r}: mend the file before points are set aside in it")
        data = MEND_FUNCTIONS[name](data, value)
    return data


def apply_shift_mend(data: Measurements, shift_text: str) -> Measurements:
    """Points moved by rows, in some lines or in all."""
    found = SHIFT_VALUE_PATTERN.fullmatch(shift_text)
    if not found or not 0 < abs(int(found[1])) < data.poses:
        raise OptionError(f"mend='shift={shift_text}': write shift=1, shift=-2 or shift=1@40..")
    first, last = int(found[2] or 0), int(found[3] or data.line.max())
    inside = (data.line >= first) & (data.line <= last)
    if not inside.any():
        raise OptionError(
            f"mend='shift={shift_text}': no row stands there; lines are {data.line.min()} to "
            f"{data.line.max()}"
        )
    moved = with_points_from_rows_ahead(data.take(inside), int(found[1]))
    return data.take(data.line < first).append_measurements(moved, data.take(data.line > last))


def apply_joint_order_mend(data: Measurements, order_text: str) -> Measurements:
    """Joint columns in another order."""
    n = data.q.shape[1]
    order = [int(part) - 1 for part in order_text.split(":") if part.isdigit()]
    if sorted(order) != list(range(n)):
        raise OptionError(
            f"mend='joints={order_text}': name each of the {n} columns once, as "
            f"joints={':'.join(str(i + 1) for i in range(n))}"
        )
    return with_joint_columns_ordered(data, order)


def apply_scale_mend(data: Measurements, scale_text: str) -> Measurements:
    """Points times a factor."""
    try:
        factor = float(scale_text)
    except ValueError:
        factor = 0.0
    if not 1.0 / MAX_MEND_SCALE < factor < MAX_MEND_SCALE:
        raise OptionError(f"mend='scale={scale_text}': write a factor, as scale=0.999")
    return data.with_y(factor * data.y)


MEND_FUNCTIONS: dict[str, Callable[[Measurements, str], Measurements]] = {
    "shift": apply_shift_mend,
    "reverse": lambda data, _: with_points_reversed(data),
    "joints": apply_joint_order_mend,
    "scale": apply_scale_mend,
}
