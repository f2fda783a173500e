"""The arm in its cell: every point with its error, and the view in three dimensions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.opened import open_result
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.reporting.html.page import figure_data
from minimax_cal.reporting.html.scene import space_of, workspace
from minimax_cal.reporting.html.sources import read_sources

KEPT = 16  # sessions in memory
NAMES = ("nominal", "calibrated")


@dataclass(frozen=True)
class Point:
    """A target at a pose.  before, after: how far the arm misses it [mm], NaN where not known.

    use: training, held out, or left out of the fit.  suspect: whether it stands out from the fit.
    pose, name: of pose and target as the file names them.
    """

    line: int
    target: str
    before: float
    after: float
    use: str
    suspect: bool
    pose: str
    name: str

    @property
    def key(self) -> str:
        """As `--leave-out` names it."""
        return f"{self.line}:{self.target}"


@lru_cache(maxsize=KEPT)
def points_of(
    fit: str, fit_moment: int, fit_size: int, poses: str, poses_moment: int, poses_size: int
) -> tuple[Point, ...]:
    """Every point of the measurements, with the errors of a fit that may have left some out.

    The moments and lengths of both files are those for which the answer holds.
    """
    found, whole = Fit.load(fit), read_measurements(poses)
    size = {name: 1e3 * np.linalg.norm(e, axis=-1) for name, e in
            (("before", found.error_nominal), ("after", found.error))}  # fmt: skip
    rows = {int(line): row for row, line in enumerate(found.data.line)}
    columns = {name: column for column, name in enumerate(found.data.target_names)}
    suspects = {(int(one.line), one.target) for one in found.suspects}
    try:
        cell, *_ = open_result(fit).placed_by(whole)
        outside = 1e3 * np.linalg.norm(cell.error(whole), axis=-1)
    except CalibrationError:  # the poses of other measurements
        outside = np.full((whole.poses, len(whole.target_names)), np.nan)
    poses_called = [whole.row_called(row) for row in range(whole.poses)]
    names = {name: target_called(whole, name) for name in whole.target_names}
    out = []
    for row, column in np.argwhere(whole.seen):
        line, target = int(whole.line[row]), whole.target_names[column]
        at = (rows.get(line, -1), columns.get(target, -1))
        used = min(at) >= 0 and np.isfinite(size["after"][at])
        before, after = (float(size[n][at]) for n in size) if used else (
            np.nan, float(outside[row, column]))  # fmt: skip
        use = ("held out" if found.held[at[0]] else "training") if used else "left out"
        suspect = (line, target) in suspects
        name = names[target]
        out.append(Point(line, target, before, after, use, suspect, poses_called[row], name))
    return tuple(out)


def target_called(data: Measurements, target: str) -> str:
    """A target, with the name that the tracker's file gives it."""
    given = [name for name in data.unknown.get(f"{target}_target", ()) if name]
    return f"{target} ({given[0]})" if given else target


@lru_cache(maxsize=KEPT)
def view_of(fit: str, moment: int, size: int) -> dict[str, Any]:
    """The view of a calibration, as the page draws it.  Raises CalibrationError without poses."""
    sources = read_sources([fit])
    poses, cell = sources.poses, sources.cell
    if not poses or not cell:
        raise CalibrationError(f"{fit}: holds no poses to draw")
    drawn = figure_data(workspace(poses, cell, NAMES))
    space = space_of(poses, cell)
    target, pose = np.nonzero(np.isfinite(space.points[..., 0]).T)
    lines, names = poses.data.line[space.chosen[pose]], poses.data.target_names
    keys = [f"{line}:{names[k]}" for line, k in zip(lines, target, strict=True)]
    sizes = np.linalg.norm(space.after[pose, target], axis=-1)
    before = np.linalg.norm(space.before[pose, target], axis=-1)
    known = {int(line): poses.data.called(line) for line in set(lines)}
    more = {"keys": keys, "called": known, "size": [round(float(s), 4) for s in sizes],
            "size_before": [round(float(s), 4) for s in before]}  # fmt: skip
    return {**drawn, "arms": {**drawn["arms"], **more}}
