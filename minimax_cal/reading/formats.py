"""Names of columns in logs of arms, a format a table."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

ANY = ("rad", "deg", "mm", "m")
SIZES = ("mm", "m")


@dataclass(frozen=True)
class Kind:
    """What this project calls columns of one kind, without the unit, and the units they may have.

    The first is the one that is written.  text: whether cells are labels, never computed with.
    """

    stem: str
    units: tuple[str, ...] = ()
    text: bool = False

    @property
    def pattern(self) -> str:
        """Of the whole name, its last group the unit."""
        return f"{self.stem}_({'|'.join(self.units)})" if self.units else self.stem


OWN = {  # columns of measurements, by kind
    "q": Kind(r"q(\d+)", ANY),
    "smr": Kind(r"smr(\d+)_([xyz])", SIZES),
    "order": Kind("order"),
    "time": Kind("time", ("s",)),
    "temperature": Kind("temperature", ("C",)),
    "payload": Kind("payload", ("kg",)),
    "payload centre": Kind("payload_[xyz]", SIZES),
    "tool": Kind("tool", text=True),
    "tau": Kind(r"tau\d+", ("Nm",)),
    "approach": Kind(r"approach\d+"),
    "session": Kind("session", text=True),
    "group": Kind("group", text=True),
    "u95": Kind("u95", SIZES),
    "pose": Kind("pose", text=True),
    "split": Kind("split", text=True),
    "set_aside": Kind("set_aside", text=True),
    "qread": Kind(r"qread\d+", ANY),
    "base": Kind(r"base\d+_[xyz]", SIZES),
}
OPTIONAL = tuple(kind for kind in OWN if kind not in ("q", "smr"))
Q = f"(?P<unit>{'|'.join(ANY)})"
JOINT = r"(?P<joint>\d+)"
INDEX = rf"(?:[.\[]?{JOINT}\]?)?"


@dataclass(frozen=True)
class Format:
    """What columns are called.

    names: patterns by kind, of which the first that fits counts; `joint` is the joint's number or
    name, `unit` the unit.  first: number of the first joint.  units: by kind, where names have
    none.  strict: whether a column that nothing uses is worth a notice.
    """

    title: str
    names: Mapping[str, tuple[str, ...]]
    first: int = 1
    units: Mapping[str, str] = field(default_factory=dict)
    strict: bool = False


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
            "tau": (rf"observation\.(?:effort|torque){INDEX}",),
            "i": (rf"observation\.current{INDEX}",),
            "run": ("episode_index",),
        },
        first=0,
        units={"tau": "Nm", "i": "A"},
    ),
)


def own_kind(name: str) -> tuple[str, str, str]:
    """The kind of one of this project's columns, its name without the unit, and the unit; or ''."""
    for kind, own in OWN.items():
        if found := re.fullmatch(own.pattern, name):
            unit = found[found.re.groups] if own.units else ""
            return kind, name.removesuffix(f"_{unit}"), unit
    return "", name, ""


def kind_of(stem: str) -> str:
    """The kind of one of this project's columns, by its name without the unit; or ''."""
    return next((kind for kind, own in OWN.items() if re.fullmatch(own.stem, stem)), "")


def near(name: str, known: Iterable[str]) -> str:
    """A hint when a column's name is close to one that would be used; a 1 stands for any number."""
    numbers = {str(i) for i in range(1, 10)}
    every = [k.replace("1", i, 1) for k in known for i in (numbers if "1" in k else "1")]
    match = difflib.get_close_matches(name, sorted(every), 1, cutoff=0.75)
    return f" (did you mean {match[0]}?)" if match else ""


def place_of(form: Format, name: str) -> Place | None:
    """What a column of a format holds, or None."""
    for kind, patterns in form.names.items():
        for pattern in patterns:
            if found := re.fullmatch(pattern, name, re.ASCII):
                groups = found.groupdict()
                unit = groups.get("unit") or form.units.get(kind, "")
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
        if any(place.kind == "q" for place in places.values()):
            return form, places
    return None


def is_log(header: Sequence[str]) -> bool:
    """Whether a header is of a log: joints in time, with torques or currents, and no points."""
    found = format_of(header)
    if not found:
        return False
    kinds = {place.kind for place in found[1].values()}
    points = any(re.match(r"smr\d+_", name) for name in header)
    return not points and ("t_s" in header or bool(kinds & {"tau", "i"} and kinds & {"t", "sec"}))
