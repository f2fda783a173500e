"""Names of columns in logs of arms, a format a table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from minimax_cal.reading.words import ANY, JOINTS, NUMBERED, WORDS, folded, split_unit

Q = f"(?P<unit>{'|'.join(ANY)})"
JOINT = r"(?P<joint>\d+)"
OF_MOTION = re.compile(r"(.*?)[ _]*[\[(]?\b(N ?m|N|mA|A|(?:rad|deg|\u00b0)/s)[\])]?")
MOTIONS = {"N m": "Nm", "rad/s": "rad", "deg/s": "deg", "\u00b0/s": "deg"}
INDEX = rf"(?:[.\[]?{JOINT}\]?)?"


@dataclass(frozen=True)
class Format:
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
class Place:
    """What a column holds: its kind (q, qd, tau ...), whose joint ('' for all), in which unit."""

    kind: str
    joint: str
    unit: str


def ros(word: str) -> tuple[str, ...]:
    """How a member of sensor_msgs/JointState is called in tables of several tools."""
    top = r"(?:.*[./])?"
    return (
        rf"{top}{word}(?:\[|[./])?(?P<joint>\d+)\]?",
        rf"{top}{word}(?:\[|[./])(?P<joint>\w+)\]?",
        rf"{top}(?P<joint>\w+)[./]{word}",
    )


def beside_joint(said: str) -> tuple[str, str]:
    """Names of what a joint does, in folded words: before its number, or after it."""
    return (
        rf"(?:{said})[ _.-]?(?:{JOINTS})?[ _.-]?{JOINT}",
        rf"(?:{JOINTS})[ _.-]?{JOINT}[ _.-]?(?:{said})",
    )


OF_DRIVES = {
    "qd": "qd|dq|qdot|velocity|vel|speed|geschwindigkeit|drehzahl|vitesse|velocidad|\u901f\u5ea6",
    "tau": "tau|torque|m|moment|drehmoment|effort|couple|par|[\u626d\u529b\u8f6c]\u77e9",
    "i": "i|current|strom|motorstrom|courant|corriente|\u7535\u6d41",
}
SI = {"q": "rad", "qd": "rad", "qdd": "rad", "q_cmd": "rad", "tau": "Nm", "tau_cmd": "Nm"}
SI |= {"i": "A", "i_cmd": "A", "temperature": "C", "payload": "kg"}
STAMP = r"(?:.*[./])?(?:header[./])?stamp"
FORMATS = (  # tried in this order
    Format(
        "minimax-cal CSV",
        {
            "t": (r"(?:t|time)_(?P<unit>s|ms|us|ns)",),
            "q": (rf"q{JOINT}_{Q}",),
            "qd": (rf"qd{JOINT}_{Q}_s",),
            "qdd": (rf"qdd{JOINT}_{Q}_s2",),
            "q_cmd": (rf"q{JOINT}_cmd_{Q}",),
            "tau": (rf"tau{JOINT}_(?P<unit>Nm|N)",),
            "tau_cmd": (rf"tau{JOINT}_cmd_(?P<unit>Nm|N)",),
            "i": (rf"i{JOINT}_(?P<unit>A|mA)",),
            "i_cmd": (rf"i{JOINT}_cmd_(?P<unit>A|mA)",),
            "temperature": (r"temperature(?P<joint>\d*)_(?P<unit>C)",),
            "payload": (r"payload_(?P<unit>kg)",),
            "run": ("run",),
        },
        strict=True,
    ),
    Format(
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
        units=SI,
    ),
    Format(
        "ROS JointState",
        {
            "sec": (rf"{STAMP}[./]secs?",),
            "nanosec": (rf"{STAMP}[./]n(?:ano)?secs?",),
            "t": ("__time", "%?time", "timestamp", STAMP),
            "name": (r"(?:.*[./])?name(?:\[|[./])?(?P<joint>\d+)\]?",),
            "q": ros("position"),
            "qd": ros("velocity"),
            "tau": ros("effort"),
        },
        first=0,
        units=SI,
    ),
    Format(
        "LeRobot",
        {
            "t": ("timestamp",),
            "q": (rf"observation\.(?:state|position|qpos){INDEX}",),
            "qd": (rf"observation\.(?:velocity|qvel){INDEX}",),
            "q_cmd": (rf"action{INDEX}",),
            "tau": (rf"observation\.(?:effort|torque){INDEX}",),
            "i": (rf"observation\.current{INDEX}",),
            "run": ("episode_index",),
        },
        first=0,
        units={"tau": "Nm", "i": "A"},
    ),
    Format(
        "table in words",
        {
            "t": ("t", *map(re.escape, WORDS["time"])),
            "q": NUMBERED,
            **{kind: beside_joint(said) for kind, said in OF_DRIVES.items()},
            "payload": ("|".join(WORDS["payload"]),),
            "run": ("run|fahrt|lauf",),
        },
        units={"tau": "Nm", "i": "A"},
        strict=True,
        words=True,
    ),
)


def place_of(form: Format, name: str) -> Place | None:
    """What a column of a format holds, or None."""
    found = OF_MOTION.fullmatch(name.strip())
    stem, told = (found[1], found[2]) if found else split_unit(name)
    ways = ((folded(stem), told),) if form.words else ((name, ""), (stem, told))
    for kind, patterns in form.names.items():
        for (text, unit), pattern in product(ways, patterns):
            if match := re.fullmatch(pattern, text, re.ASCII):
                groups = match.groupdict()
                unit = groups.get("unit") or MOTIONS.get(unit, unit) or form.units.get(kind, "")
                return Place(kind, groups.get("joint") or "", unit)
    return None


def places_of(form: Format, header: Sequence[str]) -> dict[int, Place]:
    """What the columns of a file hold in a format, by their number."""
    found = ((i, place_of(form, name)) for i, name in enumerate(header))
    return {i: place for i, place in found if place}


def format_of(header: Sequence[str]) -> tuple[Format, dict[int, Place]] | None:
    """The first format with joint columns in a header, and what its columns hold."""
    for form in FORMATS:
        places = places_of(form, header)
        joints = [place.joint for place in places.values() if place.kind == "q"]
        if joints:
            return replace(form, first=0) if form.words and "0" in joints else form, places
    return None


def is_log(header: Sequence[str]) -> bool:
    """Whether a header is of a log: joints with torques, currents or time, and no points."""
    found = format_of(header)
    if not found:
        return False
    kinds = {place.kind for place in found[1].values()}
    points = any(re.match(r"smr\d+_", name) for name in header)
    return not points and ("t_s" in header or bool(kinds & {"tau", "i"}))
