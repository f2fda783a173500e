"""The arm in its cell: every point with its error, and the view in three dimensions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from minimax_cal.core.errors import CalibrationError
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.opened_results import open_result
from minimax_cal.measuring.measurements import Measurements, read_measurements
from minimax_cal.reporting.html.html_page import chart_to_json_data
from minimax_cal.reporting.html.report_sources import read_report_sources
from minimax_cal.reporting.html.workspace_view import build_drawn_workspace, build_workspace_view

MAX_CACHED_FITS = 16  # sessions in memory
FIT_VIEW_NAMES = ("nominal", "calibrated")


@dataclass(frozen=True)
class MeasuredPoint:
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


@lru_cache(maxsize=MAX_CACHED_FITS)
def list_points_with_errors(
    fit_path: str,
    fit_modified_ns: int,
    fit_bytes: int,
    measurements_path: str,
    measurements_modified_ns: int,
    measurements_bytes: int,
) -> tuple[MeasuredPoint, ...]:
    """Every point of the measurements, with the errors of a fit that may have left some out.

    The moments and lengths of both files are those for which the answer holds.
    """
    found, whole = Fit.load(fit_path), read_measurements(measurements_path)
    size = {name: 1e3 * np.linalg.norm(e, axis=-1) for name, e in
            (("before", found.error_nominal), ("after", found.error))}  # fmt: skip
    rows = {int(line): row for row, line in enumerate(found.data.line)}
    columns = {name: column for column, name in enumerate(found.data.target_names)}
    suspects = {(int(one.line), one.target) for one in found.suspects}
    try:
        cell, *_ = open_result(fit_path).place_on_data(whole)
        outside = 1e3 * np.linalg.norm(cell.error(whole), axis=-1)
    except CalibrationError:  # the poses of other measurements
        outside = np.full((whole.poses, len(whole.target_names)), np.nan)
    poses_called = [whole.row_name(row) for row in range(whole.poses)]
    names = {name: format_target_name(whole, name) for name in whole.target_names}
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
        out.append(
            MeasuredPoint(line, target, before, after, use, suspect, poses_called[row], name)
        )
    return tuple(out)


def format_target_name(measurements: Measurements, target: str) -> str:
    """A target, with the name that the tracker's file gives it."""
    given = [name for name in measurements.unknown.get(f"{target}_target", ()) if name]
    return f"{target} ({given[0]})" if given else target


@lru_cache(maxsize=MAX_CACHED_FITS)
def build_workspace_view_data(fit_path: str, modified_ns: int, byte_count: int) -> dict[str, Any]:
    """The view of a calibration, as the page draws it.  Raises CalibrationError without poses."""
    sources = read_report_sources([fit_path])
    poses, cell = sources.poses, sources.cell
    if not poses or not cell:
        raise CalibrationError(f"{fit_path}: holds no poses to draw")
    drawn = chart_to_json_data(build_workspace_view(poses, cell, FIT_VIEW_NAMES))
    space = build_drawn_workspace(poses, cell)
    target, pose = np.nonzero(np.isfinite(space.points[..., 0]).T)
    lines, names = poses.data.line[space.pose_indices[pose]], poses.data.target_names
    keys = [f"{line}:{names[k]}" for line, k in zip(lines, target, strict=True)]
    sizes = np.linalg.norm(space.after[pose, target], axis=-1)
    before = np.linalg.norm(space.before[pose, target], axis=-1)
    known = {int(line): poses.data.called(line) for line in set(lines)}
    more = {"keys": keys, "called": known, "size": [round(float(s), 4) for s in sizes],
            "size_before": [round(float(s), 4) for s in before]}  # fmt: skip
    return {**drawn, "arms": {**drawn["arms"], **more}}
