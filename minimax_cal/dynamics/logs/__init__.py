"""Logs of arms in motion, as controllers and recorders write them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.files import format_csv
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.logs.bags import is_bag, read_bag
from minimax_cal.dynamics.logs.faults import (
    check_no_repeated_runs,
    correct_and_check_run,
    join_short_runs,
)
from minimax_cal.dynamics.logs.log_table import (
    TORQUE_UNIT,
    DraftRun,
    LogColumns,
    Run,
    read_log_sheet,
    read_log_table,
    split_log_into_runs,
)
from minimax_cal.measuring.importers import parse_unit_options
from minimax_cal.reading.column_words import sort_joint_names_along_arm
from minimax_cal.reading.log_formats import is_log_header

__all__ = [
    "LogFiles",
    "Run",
    "are_logs",
    "format_runs_csv_in_rad_and_mm",
    "read_log_files",
    "read_runs",
]

LOG_DETECTION_LINE_COUNT = 50  # lines that show whether a file is a log


@dataclass(frozen=True, eq=False)
class LogFiles:
    """runs: of all files.  format_names: the format of each run's file.  is_prismatic: (n,) by
    their columns.

    columns: of each run, the joints' columns and those of torque or current.
    """

    runs: tuple[Run, ...]
    format_names: tuple[str, ...]
    columns: tuple[tuple[str, ...], ...]
    is_prismatic: Array

    @property
    def notices(self) -> tuple[str, ...]:
        """What is to be said of the files."""
        return tuple(dict.fromkeys(text for run in self.runs for text in run.notices))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        rows = [
            {"name": run.name, "source": run.source, "format": title, "rows": len(run.time),
             "duration_s": run.duration, "step_s": run.step, "payload_kg": run.payload,
             "columns": columns}
            for run, title, columns in zip(self.runs, self.format_names, self.columns, strict=True)
        ]  # fmt: skip
        first = self.runs[0]
        return {"joints": first.joints, "unit": first.unit, "runs": rows, "notices": self.notices}

    def table(self) -> Table:
        """A row a run."""
        rows = ((run.name, title, len(run.time), run.duration, 1.0 / run.step, columns[0], run.unit)
                for run, title, columns in zip(self.runs, self.format_names, self.columns,
                                               strict=True))  # fmt: skip
        total, count = sum(run.duration for run in self.runs), len(self.runs)
        joints = self.runs[0].joints
        title = f"{count} run{'s' * (count > 1)}, {total:.1f} s, {joints} joints"
        columns = "run | format | rows | s | rows a second | first joint | torque in"
        return Table.from_rows(title, rows, columns)

    def format_csv(self) -> str:
        """As CSV of this project."""
        return format_runs_csv_in_rad_and_mm(self.runs, self.is_prismatic)


def read_runs(
    paths: Sequence[Path | str] | Path | str,
    joints: Sequence[str] = (),
    units: str | Sequence[str] | Mapping[str, str] = (),
) -> tuple[Run, ...]:
    """Runs of an arm from logs: CSV of this project, UR RTDE, ROS or LeRobot, or ROS bags.

    Parameters
    ----------
    paths
        Files; each is a trajectory, or holds several that a column `run` tells apart.
    joints
        Names of the robot's joints; their number is checked, and logs with names are put in
        their order.
    units
        What a file does not tell, as ``q=deg``.

    Returns
    -------
    tuple of Run
        In radians, metres, seconds, and N m (N) or A.

    Raises
    ------
    DataError
        For a file that cannot be read, or whose rows cannot be (units, order, commands, gaps).

    Examples
    --------
    >>> runs = mc.read_runs(["run1.csv", "run2.csv"])
    """
    return read_log_files(paths, joints, units).runs


def read_log_files(
    paths: Sequence[Path | str] | Path | str,
    joints: Sequence[str] = (),
    units: str | Sequence[str] | Mapping[str, str] = (),
) -> LogFiles:
    """The runs of logs, and how the files were understood; as `read_runs`."""
    several = [paths] if isinstance(paths, Path | str) else list(paths)
    files = [Path(path) for path in several]
    if not files:
        raise OptionError("name a log to read")
    if twice := [path for i, path in enumerate(files) if path in files[:i]]:
        raise DataError(f"{twice[0]}: is given twice; give each log once")
    given = parse_unit_options(units)
    drafts: list[DraftRun] = []
    for path in files:
        name = path.stem if [p.stem for p in files].count(path.stem) == 1 else str(path)
        for log in read_bag(path) if is_bag(path) else [read_log_table(path, given)]:
            drafts += map(
                correct_and_check_run,
                join_short_runs(split_log_into_runs(order_joints_as_robot(log, joints), name)),
            )
    first = drafts[0]
    for draft in drafts:
        source, other = draft.log.source, first.log.source
        if (
            draft.q.shape[1] != first.q.shape[1]
            or (draft.log.is_prismatic != first.log.is_prismatic).any()
        ):
            raise DataError(f"{source}: has other joints than {other}; give logs of one arm")
        if draft.torque_kind != first.torque_kind:
            what = "torques" if draft.torque_kind == "tau" else "currents"
            raise DataError(f"{source}: holds {what}, unlike {other}; log the same of all runs")
    check_no_repeated_runs([draft for draft in drafts if draft.has_torques])
    return LogFiles(
        runs=tuple(draft.build_run_of_one_payload() for draft in drafts),
        format_names=tuple(draft.log.format_name for draft in drafts),
        columns=tuple(
            (*d.log.column_names_by_kind["q"], *d.log.column_names_by_kind[d.torque_kind])
            for d in drafts
        ),
        is_prismatic=first.log.is_prismatic,
    )


def order_joints_as_robot(log: LogColumns, robot_joint_names: Sequence[str]) -> LogColumns:
    """The log with its joints in the robot's order, where names tell.  Raises DataError."""
    n = log.values_by_kind["q"].shape[1]
    found = match_joint_names(log.joint_names, robot_joint_names)
    if found is not None:
        others = [name for i, name in enumerate(log.joint_names) if i not in found]
        said = [f"{log.source}: joints {', '.join(others)} are not the robot's: left out"]
        log = replace(log, notices=(*log.notices, *(said if others else ())))
        return log.select_joints(found)
    if robot_joint_names and n != len(robot_joint_names):
        names = f" ({', '.join(log.joint_names)})" if log.joint_names else ""
        raise DataError(
            f"{log.source}: has {n} joints{names}, but the robot has {len(robot_joint_names)}"
        )
    if not log.joint_names:
        return log
    named = [name if name.endswith("_joint") else f"{name}_joint" for name in log.joint_names]
    along = sort_joint_names_along_arm(named)
    order = [named.index(name) for name in along]
    names = ", ".join(log.joint_names[i] for i in order)
    how = "along the arm" if order != list(range(n)) else "as in the file; check their order"
    said = [f"{log.source}: joints 1 to {n} are {names}, {how}"]
    return replace(log, notices=(*log.notices, *said)).select_joints(order)


def match_joint_names(
    log_joint_names: Sequence[str], robot_joint_names: Sequence[str]
) -> list[int] | None:
    """Which of a log's joints are the robot's, in its order; None where names do not tell."""
    if not log_joint_names or not robot_joint_names:
        return None
    found = []
    for joint in robot_joint_names:
        same = [i for i, name in enumerate(log_joint_names) if name == joint]
        same = same or [
            i
            for i, name in enumerate(log_joint_names)
            if name.endswith(joint) or joint.endswith(name)
        ]
        if len(same) != 1:
            return None
        found.append(same[0])
    return found if len(set(found)) == len(robot_joint_names) else None


def are_logs(paths: Sequence[Path | str]) -> bool:
    """Whether all files are logs of a motion, as the header of each, or its lack, says."""
    for path in map(Path, paths):
        try:
            if not (
                is_bag(path) or is_log_header(read_log_sheet(path, LOG_DETECTION_LINE_COUNT).header)
            ):
                return False
        except DataError:
            return False
    return True


def format_runs_csv_in_rad_and_mm(runs: Sequence[Run], is_prismatic: Array) -> str:
    """CSV of runs of one arm that `read_runs` reads.  is_prismatic: (n,) joints in mm.

    Raises DataError for runs in different units.
    """
    units = {run.unit for run in runs}
    if len(units) > 1 or len({run.joints for run in runs}) > 1:
        source = runs[0].source
        raise DataError(f"{source}: the runs differ in joints or units; write one at a time")
    length = ["mm" if slides else "rad" for slides in is_prismatic]
    drive = [
        "A" if TORQUE_UNIT not in units else "N" if slides else "Nm" for slides in is_prismatic
    ]
    letter = "tau" if TORQUE_UNIT in units else "i"
    names = {
        **{kind: [f"{kind}{j}_{unit}{suffix}" for j, unit in enumerate(length, 1)]
           for kind, suffix in (("q", ""), ("qd", "_s"), ("qdd", "_s2"))},
        "torque": [f"{letter}{j}_{unit}" for j, unit in enumerate(drive, 1)],
        "temperature": ["temperature_C"], "payload": ["payload_kg"],
    }  # fmt: skip
    if any(run.temperature is not None and run.temperature.ndim > 1 for run in runs):
        names["temperature"] = [f"temperature{j + 1}_C" for j in range(len(length))]
    kinds = [kind for kind in names if any(getattr(run, kind) is not None for run in runs)]
    label = ["run"] * (len(runs) > 1)
    lines = [[*label, "t_s", *(name for kind in kinds for name in names[kind])]]
    for run in runs:
        blocks = []
        for kind in kinds:
            value = getattr(run, kind)
            value = np.nan if value is None else value[:, None] if np.ndim(value) == 1 else value
            scale = np.where(is_prismatic, 1e3, 1.0) if kind in ("q", "qd", "qdd") else 1.0
            blocks.append(np.broadcast_to(value, (len(run.time), len(names[kind]))) * scale)
        for time, row in zip(run.time, np.hstack(blocks), strict=True):
            cells = ["" if np.isnan(value) else f"{value:.9g}" for value in row]
            lines.append([*(run.name for _ in label), f"{time:.6f}", *cells])
    return format_csv(lines)
