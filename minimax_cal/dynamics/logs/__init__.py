"""Logs of arms in motion, as controllers and recorders write them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.dynamics.logs.bags import is_bag, read_bag
from minimax_cal.dynamics.logs.faults import check_repeats, checked, join_short_runs
from minimax_cal.dynamics.logs.table import (
    TORQUE,
    Draft,
    Log,
    Run,
    drafts_of,
    log_sheet,
    read_table,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.files import csv_text
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.importers import units_of
from minimax_cal.reading.formats import is_log
from minimax_cal.reading.words import along_arm

__all__ = ["LogFiles", "Run", "are_logs", "import_logs", "read_runs", "runs_text"]

LOOKED_AT = 50  # lines that show whether a file is a log


@dataclass(frozen=True, eq=False)
class LogFiles:
    """runs: of all files.  titles: the format of each run's file.  sliding: (n,) by their columns.

    columns: of each run, the joints' columns and those of torque or current.
    """

    runs: tuple[Run, ...]
    titles: tuple[str, ...]
    columns: tuple[tuple[str, ...], ...]
    sliding: Array

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
            for run, title, columns in zip(self.runs, self.titles, self.columns, strict=True)
        ]  # fmt: skip
        first = self.runs[0]
        return {"joints": first.joints, "unit": first.unit, "runs": rows, "notices": self.notices}

    def table(self) -> Table:
        """A row a run."""
        rows = ((run.name, title, len(run.time), run.duration, 1.0 / run.step, columns[0], run.unit)
                for run, title, columns in zip(self.runs, self.titles, self.columns,
                                               strict=True))  # fmt: skip
        total, count = sum(run.duration for run in self.runs), len(self.runs)
        joints = self.runs[0].joints
        title = f"{count} run{'s' * (count > 1)}, {total:.1f} s, {joints} joints"
        columns = "run | format | rows | s | rows a second | first joint | torque in"
        return Table.made(title, rows, columns)

    def csv(self) -> str:
        """As CSV of this project."""
        return runs_text(self.runs, self.sliding)


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
    return import_logs(paths, joints, units).runs


def import_logs(
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
    given = units_of(units)
    drafts: list[Draft] = []
    for path in files:
        name = path.stem if [p.stem for p in files].count(path.stem) == 1 else str(path)
        for log in read_bag(path) if is_bag(path) else [read_table(path, given)]:
            drafts += map(checked, join_short_runs(drafts_of(in_order(log, joints), name)))
    first = drafts[0]
    for draft in drafts:
        source, other = draft.log.source, first.log.source
        if draft.q.shape[1] != first.q.shape[1] or (draft.log.sliding != first.log.sliding).any():
            raise DataError(f"{source}: has other joints than {other}; give logs of one arm")
        if draft.kind != first.kind:
            what = "torques" if draft.kind == "tau" else "currents"
            raise DataError(f"{source}: holds {what}, unlike {other}; log the same of all runs")
    check_repeats([draft for draft in drafts if draft.measured])
    return LogFiles(
        runs=tuple(draft.run() for draft in drafts),
        titles=tuple(draft.log.title for draft in drafts),
        columns=tuple((*d.log.headers["q"], *d.log.headers[d.kind]) for d in drafts),
        sliding=first.log.sliding,
    )


def in_order(log: Log, joints: Sequence[str]) -> Log:
    """The log with its joints in the robot's order, where names tell.  Raises DataError."""
    n = log.values["q"].shape[1]
    found = order_by_names(log.joints, joints)
    if found is not None:
        others = [name for i, name in enumerate(log.joints) if i not in found]
        said = [f"{log.source}: joints {', '.join(others)} are not the robot's: left out"]
        log = replace(log, notices=(*log.notices, *(said if others else ())))
        return log.taking(found)
    if joints and n != len(joints):
        names = f" ({', '.join(log.joints)})" if log.joints else ""
        raise DataError(f"{log.source}: has {n} joints{names}, but the robot has {len(joints)}")
    if not log.joints:
        return log
    named = [name if name.endswith("_joint") else f"{name}_joint" for name in log.joints]
    along = along_arm(named)
    order = [named.index(name) for name in along]
    names = ", ".join(log.joints[i] for i in order)
    how = "along the arm" if order != list(range(n)) else "as in the file; check their order"
    said = [f"{log.source}: joints 1 to {n} are {names}, {how}"]
    return replace(log, notices=(*log.notices, *said)).taking(order)


def order_by_names(names: Sequence[str], joints: Sequence[str]) -> list[int] | None:
    """Which of a log's joints are the robot's, in its order; None where names do not tell."""
    if not names or not joints:
        return None
    found = []
    for joint in joints:
        same = [i for i, name in enumerate(names) if name == joint]
        same = same or [
            i for i, name in enumerate(names) if name.endswith(joint) or joint.endswith(name)
        ]
        if len(same) != 1:
            return None
        found.append(same[0])
    return found if len(set(found)) == len(joints) else None


def are_logs(paths: Sequence[Path | str]) -> bool:
    """Whether all files are logs of a motion, as the header of each, or its lack, says."""
    for path in map(Path, paths):
        try:
            if not (is_bag(path) or is_log(log_sheet(path, LOOKED_AT).header)):
                return False
        except DataError:
            return False
    return True


def runs_text(runs: Sequence[Run], sliding: Array) -> str:
    """CSV of runs of one arm that `read_runs` reads.  sliding: (n,) joints in mm.

    Raises DataError for runs in different units.
    """
    units = {run.unit for run in runs}
    if len(units) > 1 or len({run.joints for run in runs}) > 1:
        source = runs[0].source
        raise DataError(f"{source}: the runs differ in joints or units; write one at a time")
    length = ["mm" if slides else "rad" for slides in sliding]
    drive = ["A" if TORQUE not in units else "N" if slides else "Nm" for slides in sliding]
    letter = "tau" if TORQUE in units else "i"
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
            scale = np.where(sliding, 1e3, 1.0) if kind in ("q", "qd", "qdd") else 1.0
            blocks.append(np.broadcast_to(value, (len(run.time), len(names[kind]))) * scale)
        for time, row in zip(run.time, np.hstack(blocks), strict=True):
            cells = ["" if np.isnan(value) else f"{value:.9g}" for value in row]
            lines.append([*(run.name for _ in label), f"{time:.6f}", *cells])
    return csv_text(lines)
