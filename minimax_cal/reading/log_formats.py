"""Names of columns in logs of arms, a format a table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

from minimax_cal.reading.column_words import (
    JOINT_COLUMN_UNITS,
    JOINT_WORDS_REGEX,
    NUMBERED_JOINT_PATTERNS,
    WORDS_BY_MEANING,
    fold_case_and_accents,
    split_name_and_unit,
)

UNIT_GROUP_REGEX = f"(?P<unit>{'|'.join(JOINT_COLUMN_UNITS)})"
JOINT_GROUP_REGEX = r"(?P<joint>\d+)"
MOTION_UNIT_PATTERN = re.compile(r"(.*?)[ _]*[\[(]?\b(N ?m|N|mA|A|(?:rad|deg|\u00b0)/s)[\])]?")
MOTION_UNITS = {"N m": "Nm", "rad/s": "rad", "deg/s": "deg", "\u00b0/s": "deg"}
OPTIONAL_INDEX_REGEX = rf"(?:[.\[]?{JOINT_GROUP_REGEX}\]?)?"


@dataclass(frozen=True)
class LogFormat:
    """What columns are called.

    names: patterns by kind, of which the first that fits counts; `joint` is the joint's number or
    name, `unit` the unit.  first: number of the first joint.  units: by kind, where names have
    none.  strict: whether a column that nothing uses is worth a notice.  words: whether patterns
    are of folded names without units, and joints may be numbered from 0 too.
    """

    title: str
    names: Mapping[str, tuple[str, ...]]
    first: int = 1
    units: Mapping[str, str] = field(default_factory=dict)
    strict: bool = False
    words: bool = False


@dataclass(frozen=True)
class LogColumn:
    """What a column holds: its kind (q, qd, tau ...), whose joint ('' for all), in which unit."""

    kind: str
    joint: str
    unit: str


def ros_joint_state_patterns(member_name: str) -> tuple[str, ...]:
    """How a member of sensor_msgs/JointState is called in tables of several tools."""
    top = r"(?:.*[./])?"
    return (
        rf"{top}{member_name}(?:\[|[./])?(?P<joint>\d+)\]?",
        rf"{top}{member_name}(?:\[|[./])(?P<joint>\w+)\]?",
        rf"{top}(?P<joint>\w+)[./]{member_name}",
    )


class JointQuantityPatterns(NamedTuple):
    """Regular expressions of a joint quantity's word before, and after, the joint's number."""

    before_number: str
    after_number: str


def joint_quantity_patterns(quantity_words: str) -> JointQuantityPatterns:
    """Names of what a joint does, in folded words: before its number, or after it."""
    return JointQuantityPatterns(
        rf"(?:{quantity_words})[ _.-]?(?:{JOINT_WORDS_REGEX})?[ _.-]?{JOINT_GROUP_REGEX}",
        rf"(?:{JOINT_WORDS_REGEX})[ _.-]?{JOINT_GROUP_REGEX}[ _.-]?(?:{quantity_words})",
    )


DRIVE_QUANTITY_WORDS = {
    "qd": "qd|dq|qdot|velocity|vel|speed|geschwindigkeit|drehzahl|vitesse|velocidad|\u901f\u5ea6",
    "tau": "tau|torque|m|moment|drehmoment|effort|couple|par|[\u626d\u529b\u8f6c]\u77e9",
    "i": "i|current|strom|motorstrom|courant|corriente|\u7535\u6d41",
}
SI_UNIT_BY_KIND = {
    "q": "rad",
    "qd": "rad",
    "qdd": "rad",
    "q_cmd": "rad",
    "tau": "Nm",
    "tau_cmd": "Nm",
}
SI_UNIT_BY_KIND |= {"i": "A", "i_cmd": "A", "temperature": "C", "payload": "kg"}
STAMP_REGEX = r"(?:.*[./])?(?:header[./])?stamp"
LOG_FORMATS = (  # tried in this order
    LogFormat(
        "minimax-cal CSV",
        {
            "t": (r"(?:t|time)_(?P<unit>s|ms|us|ns)",),
            "q": (rf"q{JOINT_GROUP_REGEX}_{UNIT_GROUP_REGEX}",),
            "qd": (rf"qd{JOINT_GROUP_REGEX}_{UNIT_GROUP_REGEX}_s",),
            "qdd": (rf"qdd{JOINT_GROUP_REGEX}_{UNIT_GROUP_REGEX}_s2",),
            "q_cmd": (rf"q{JOINT_GROUP_REGEX}_cmd_{UNIT_GROUP_REGEX}",),
            "tau": (rf"tau{JOINT_GROUP_REGEX}_(?P<unit>Nm|N)",),
            "tau_cmd": (rf"tau{JOINT_GROUP_REGEX}_cmd_(?P<unit>Nm|N)",),
            "i": (rf"i{JOINT_GROUP_REGEX}_(?P<unit>A|mA)",),
            "i_cmd": (rf"i{JOINT_GROUP_REGEX}_cmd_(?P<unit>A|mA)",),
            "temperature": (r"temperature(?P<joint>\d*)_(?P<unit>C)",),
            "payload": (r"payload_(?P<unit>kg)",),
            "run": ("run",),
        },
        strict=True,
    ),
    LogFormat(
        "UR RTDE",
        {
            "t": ("timestamp",),
            "q": (r"actual_q_(?P<joint>\d)",),
            "qd": (r"actual_qd_(?P<joint>\d)",),
            "q_cmd": (r"target_q_(?P<joint>\d)",),
            "tau": (r"actual_current_as_torque_(?P<joint>\d)",),
            "tau_cmd": (r"target_moment_(?P<joint>\d)",),
            "i": (r"actual_current_(?P<joint>\d)",),
            "i_cmd": (r"target_current_(?P<joint>\d)",),
            "temperature": (r"joint_temperatures_(?P<joint>\d)",),
            "payload": ("payload",),
        },
        first=0,
        units=SI_UNIT_BY_KIND,
    ),
    LogFormat(
        "ROS JointState",
        {
            "sec": (rf"{STAMP_REGEX}[./]secs?",),
            "nanosec": (rf"{STAMP_REGEX}[./]n(?:ano)?secs?",),
            "t": ("__time", "%?time", "timestamp", STAMP_REGEX),
            "name": (r"(?:.*[./])?name(?:\[|[./])?(?P<joint>\d+)\]?",),
            "q": ros_joint_state_patterns("position"),
            "qd": ros_joint_state_patterns("velocity"),
            "tau": ros_joint_state_patterns("effort"),
        },
        first=0,
        units=SI_UNIT_BY_KIND,
    ),
    LogFormat(
        "LeRobot",
        {
            "t": ("timestamp",),
            "q": (rf"observation\.(?:state|position|qpos){OPTIONAL_INDEX_REGEX}",),
            "qd": (rf"observation\.(?:velocity|qvel){OPTIONAL_INDEX_REGEX}",),
            "q_cmd": (rf"action{OPTIONAL_INDEX_REGEX}",),
            "tau": (rf"observation\.(?:effort|torque){OPTIONAL_INDEX_REGEX}",),
            "i": (rf"observation\.current{OPTIONAL_INDEX_REGEX}",),
            "run": ("episode_index",),
        },
        first=0,
        units={"tau": "Nm", "i": "A"},
    ),
    LogFormat(
        "table in words",
        {
            "t": ("t", *map(re.escape, WORDS_BY_MEANING["time"])),
            "q": NUMBERED_JOINT_PATTERNS,
            **{kind: joint_quantity_patterns(said) for kind, said in DRIVE_QUANTITY_WORDS.items()},
            "payload": ("|".join(WORDS_BY_MEANING["payload"]),),
            "run": ("run|fahrt|lauf",),
        },
        units={"tau": "Nm", "i": "A"},
        strict=True,
        words=True,
    ),
)


def parse_log_column_name(log_format: LogFormat, column_name: str) -> LogColumn | None:
    """What a column of a format holds, or None."""
    found = MOTION_UNIT_PATTERN.fullmatch(column_name.strip())
    stem, told = (found[1], found[2]) if found else split_name_and_unit(column_name)
    ways = (
        ((fold_case_and_accents(stem), told),)
        if log_format.words
        else ((column_name, ""), (stem, told))
    )
    for kind, patterns in log_format.names.items():
        for (text, unit), pattern in product(ways, patterns):
            if match := re.fullmatch(pattern, text, re.ASCII):
                groups = match.groupdict()
                unit = (
                    groups.get("unit")
                    or MOTION_UNITS.get(unit, unit)
                    or log_format.units.get(kind, "")
                )
                return LogColumn(kind, groups.get("joint") or "", unit)
    return None


def parse_log_header(log_format: LogFormat, header: Sequence[str]) -> dict[int, LogColumn]:
    """What the columns of a file hold in a format, by their number."""
    found = ((i, parse_log_column_name(log_format, name)) for i, name in enumerate(header))
    return {i: place for i, place in found if place}


class DetectedLogFormat(NamedTuple):
    """A format of logs, and what the columns of a file hold in it, by their index."""

    log_format: LogFormat
    columns: dict[int, LogColumn]


def detect_log_format(header: Sequence[str]) -> DetectedLogFormat | None:
    """The first format with joint columns in a header, and what its columns hold."""
    for form in LOG_FORMATS:
        places = parse_log_header(form, header)
        joints = [place.joint for place in places.values() if place.kind == "q"]
        if joints:
            return DetectedLogFormat(
                replace(form, first=0) if form.words and "0" in joints else form, places
            )
    return None


def is_log_header(header: Sequence[str]) -> bool:
    """Whether a header is of a log: joints with torques, currents or time, and no points."""
    found = detect_log_format(header)
    if not found:
        return False
    kinds = {place.kind for place in found[1].values()}
    points = any(re.match(r"smr\d+_", name) for name in header)
    return not points and ("t_s" in header or bool(kinds & {"tau", "i"}))
