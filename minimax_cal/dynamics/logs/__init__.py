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
        keys = ("name", "source", "format", "rows", "duration_s", "step_s", "payload_kg", "columns")
        rows = ((run.name, run.source, title, len(run.time), run.duration, run.step, run.payload,
                 columns) for run, title, columns in zip(self.runs, self.titles, self.columns,
                                                         strict=True))  # fmt: skip
        told, first = [dict(zip(keys, row, strict=True)) for row in rows], self.runs[0]
        return {"joints": first.joints, "unit": first.unit, "runs": told, "notices": self.notices}

    def table(self) -> Table:
        """A row a run."""
        told, first = self.to_dict()["runs"], self.runs[0]
        rows = (
            (run["name"], run["format"], run["rows"], run["duration_s"], 1.0 / run["step_s"],
             run["columns"][0], first.unit)
            for run in told
        )  # fmt: skip
        total, count = sum(run.duration for run in self.runs), len(told)
        title = f"{count} run{'s' * (count > 1)}, {total:.1f} s, {first.joints} joints"
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
    same_arm(drafts)
    check_repeats([draft for draft in drafts if draft.measured])
    return LogFiles(
        runs=tuple(draft.run() for draft in drafts),
        titles=tuple(draft.log.title for draft in drafts),
        columns=tuple((*d.log.headers["q"], *d.log.headers[d.kind]) for d in drafts),
        sliding=drafts[0].log.sliding,
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


def same_arm(drafts: Sequence[Draft]) -> None:
    """Raise DataError where files have other joints than the first."""
    first = drafts[0]
    for draft in drafts:
        if draft.q.shape[1] != first.q.shape[1] or (draft.log.sliding != first.log.sliding).any():
            raise DataError(
                f"{draft.log.source}: has other joints than {first.log.source}; give logs of one "
                "arm"
            )
        if draft.kind != first.kind:
            raise DataError(
                f"{draft.log.source}: holds {'torques' if draft.kind == 'tau' else 'currents'}, "
                f"unlike {first.log.source}; log the same of all runs"
            )


def are_logs(paths: Sequence[Path | str]) -> bool:
    """Whether all files are logs of a motion, as their columns say."""
    return all(is_bag(Path(path)) or looks_like_log(Path(path)) for path in paths)


def looks_like_log(path: Path) -> bool:
    """Whether the header of a text file, or its lack, is that of a log."""
    try:
        return is_log(log_sheet(path, LOOKED_AT).header)
    except DataError:
        return False


def runs_text(runs: Sequence[Run], sliding: Array) -> str:
    """CSV of runs of one arm that `read_runs` reads.  sliding: (n,) joints in mm.

    Raises DataError for runs in different units.
    """
    units = {run.unit for run in runs}
    if len(units) > 1 or len({run.joints for run in runs}) > 1:
        raise DataError(
            f"{runs[0].source}: the runs differ in joints or units; write one at a time"
        )
    n, many = runs[0].joints, len(runs) > 1
    length = ["mm" if slides else "rad" for slides in sliding]
    scale = np.where(sliding, 1e3, 1.0)
    drive = ["A" if TORQUE not in units else "N" if slides else "Nm" for slides in sliding]
    letter = "tau" if TORQUE in units else "i"
    blocks: list[tuple[list[str], list[Array | None]]] = []
    for kind, suffix in (("q", ""), ("qd", "_s"), ("qdd", "_s2")):
        given = [getattr(run, kind) for run in runs]
        if any(value is not None for value in given):
            names = [f"{kind}{j + 1}_{u}{suffix}" for j, u in enumerate(length)]
            blocks.append((names, [None if v is None else v * scale for v in given]))
    blocks.append(([f"{letter}{j + 1}_{u}" for j, u in enumerate(drive)], [r.torque for r in runs]))
    blocks += [block for block in (warmth(runs, n), payload(runs)) if block]
    lines = [["run"] * many + ["t_s"] + [name for names, _ in blocks for name in names]]
    for at, run in enumerate(runs):
        empty = np.full((len(run.time), n), np.nan)
        parts = [empty[:, : len(names)] if (own := values[at]) is None else own
                 for names, values in blocks]  # fmt: skip
        for time, row in zip(run.time, np.hstack(parts), strict=True):
            cells = ["" if np.isnan(value) else f"{value:.9g}" for value in row]
            lines.append([run.name] * many + [f"{time:.6f}"] + cells)
    return csv_text(lines)


def warmth(runs: Sequence[Run], n: int) -> tuple[list[str], list[Array | None]] | None:
    """Columns of temperature, where runs have them alike."""
    given = [run.temperature for run in runs if run.temperature is not None]
    if not given:
        return None
    one = all(value.ndim == 1 for value in given)
    names = ["temperature_C"] if one else [f"temperature{j + 1}_C" for j in range(n)]
    wide = [None if r.temperature is None else np.atleast_2d(r.temperature.T).T for r in runs]
    return names, [v if v is None or v.shape[1] == len(names) else np.repeat(v, n, 1) for v in wide]


def payload(runs: Sequence[Run]) -> tuple[list[str], list[Array | None]] | None:
    """The column of payload, where a run has one."""
    if all(run.payload is None for run in runs):
        return None
    values = [None if r.payload is None else np.full((len(r.time), 1), r.payload) for r in runs]
    return ["payload_kg"], list(values)
