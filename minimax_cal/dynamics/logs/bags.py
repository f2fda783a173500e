"""Logs of ROS: bags of ROS 1, directories and files of ROS 2, and MCAP; `rosbags` reads them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.core.optional_packages import import_optional
from minimax_cal.dynamics.logs.log_table import LogColumns
from minimax_cal.reading.log_formats import SI_UNIT_BY_KIND

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
BAG_METADATA_FILE = "metadata.yaml"  # in the folder of a ROS 2 bag
JOINT_STATE_TYPE = "sensor_msgs/msg/JointState"
JOINT_STATE_MEMBERS = {"q": "position", "qd": "velocity", "tau": "effort"}


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: by its ending, or a folder with the metadata of one."""
    return path.suffix.lower() in BAG_SUFFIXES or (path / BAG_METADATA_FILE).is_file()


def read_bag(path: Path) -> list[LogColumns]:
    """The joint states of a bag, one log a topic with efforts.  Raises DataError, OptionError."""
    rosbags = import_optional("rosbags.highlevel", "reading a bag", "minimax-cal[logs]")
    typesys = import_optional("rosbags.typesys", "reading a bag", "minimax-cal[logs]")
    if not path.exists():
        raise DataError(f"{path}: cannot be read (No such file or directory)")
    try:
        types = typesys.get_typestore(typesys.Stores.LATEST)
        with rosbags.AnyReader([path], default_typestore=types) as reader:
            found = [c for c in reader.connections if c.msgtype == JOINT_STATE_TYPE]
            messages: dict[str, list[tuple[int, Any]]] = {c.topic: [] for c in found}
            for c, stamp, raw in reader.messages(found) if found else ():
                messages[c.topic].append((stamp, reader.deserialize(raw, JOINT_STATE_TYPE)))
    except Exception as error:  # of a broken file the parser of another package raises anything
        why = str(error).partition("\n")[0] or type(error).__name__
        raise DataError(f"{path}: cannot be read as a bag ({why})") from error
    logs = {
        topic: build_log_of_topic(path, topic, some) for topic, some in messages.items() if some
    }
    with_effort = {topic: log for topic, log in logs.items() if "tau" in log.values_by_kind}
    if not with_effort:
        held = "no JointState" if not logs else f"no effort in {', '.join(logs)}"
        raise DataError(f"{path}: holds {held}; record /joint_states with effort")
    if len(with_effort) > 1:
        names = " and ".join(with_effort)
        raise DataError(f"{path}: holds efforts in {names}; record one of them")
    return list(with_effort.values())


def build_log_of_topic(path: Path, topic: str, messages: Sequence[tuple[int, Any]]) -> LogColumns:
    """The messages of one topic as columns; messages of other joints than the first are left out.

    messages: time of reception [ns], message.
    """
    names = tuple(messages[0][1].name)
    same = [(t, m) for t, m in messages if tuple(m.name) == names and len(m.position) == len(names)]
    if not same:
        raise DataError(f"{path}: {topic} holds no positions; record /joint_states with them")
    stamped = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in same]
    received = [1e-9 * (t - same[0][0]) for t, _ in same]
    time, held = np.array(stamped if any(stamped) else received), dict[str, Array]()
    for kind, member in JOINT_STATE_MEMBERS.items():
        rows = [np.asarray(getattr(m, member), dtype=float) for _, m in same]
        if all(len(row) == len(names) for row in rows):
            held[kind] = np.array(rows)
    other = len(messages) - len(same)
    said = (
        f"{path}: {other} messages of {topic} have other joints than {', '.join(names)}: left out"
    )
    return LogColumns(
        source=str(path),
        format_name="ROS bag",
        line_numbers=np.arange(1, len(same) + 1),
        values_by_kind={"t": time - time[0], **held},
        column_names_by_kind={
            kind: tuple(f"{JOINT_STATE_MEMBERS[kind]} of {n}" for n in names) for kind in held
        },
        units_by_kind={kind: (SI_UNIT_BY_KIND[kind],) * len(names) for kind in held},
        joint_names=names,
        notices=(said,) if other else (),
    )
