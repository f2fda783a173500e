"""The workspace in three dimensions: arrows of the errors, the arm at a pose, the tracker."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.cell import Cell
from minimax_cal.reporting.html.error_charts import BeforeAfterNames, rms_error_of_each_pose
from minimax_cal.reporting.html.report_content import (
    View3dBlock,
    round_for_json,
    select_drawn_indices,
)
from minimax_cal.reporting.html.report_sources import PosesWithErrors
from minimax_cal.reporting.html.workspace_svg import WorkspaceDrawing, draw_workspace_svg
from minimax_cal.robots.kinematics import compute_link_frames
from minimax_cal.robots.robot import Robot

LARGE_ARROW_FRACTION_OF_RADIUS = 0.12  # length of a large arrow, of the workspace's radius
LARGE_ERROR_PERCENTILE = 90.0  # percentile of the errors that is such a one
WORKSPACE_PADDING_FRACTION = 0.12  # room around the workspace, of its radius
MAGNIFICATION_STEPS = tuple(
    m * 10**e for e in range(6) for m in (1, 2, 5)
)  # magnifications to choose from


@dataclass(frozen=True, eq=False)
class DrawnWorkspace:
    """What is drawn, in the robot's base frame [mm].

    pose_indices: (s,) poses.  points: (s, k, 3) measured, NaN where not.  before, after: (s, k, 3)
    measured minus predicted.  arms: (s, v, 3) the arm from base to flange.  corners: (v,) True
    where a joint is.  tracker: (3,) where it is drawn; tracker_distance: how far it really is from
    the base.
    """

    pose_indices: Array
    points: Array
    before: Array
    after: Array
    arms: Array
    corners: Array
    tracker: Array
    tracker_distance: float

    @property
    def centre(self) -> Array:
        """(3,) the middle of the workspace."""
        return np.asarray((self.low + self.high) / 2.0)

    @property
    def low(self) -> Array:
        """(3,) the lowest corner of all that the arm and the targets reach."""
        both = np.concatenate([self.points.reshape(-1, 3), self.arms.reshape(-1, 3)])
        return np.asarray(np.nanmin(both, axis=0))

    @property
    def high(self) -> Array:
        """(3,) its highest corner."""
        both = np.concatenate([self.points.reshape(-1, 3), self.arms.reshape(-1, 3)])
        return np.asarray(np.nanmax(both, axis=0))

    @property
    def radius(self) -> float:
        """Half of the workspace's diagonal."""
        return max(float(np.linalg.norm(self.high - self.low)) / 2.0, 1.0)


def build_drawn_workspace(poses: PosesWithErrors, cell: Cell) -> DrawnWorkspace:
    """Poses and arm in the base frame of a calibrated cell."""
    chosen = select_drawn_indices(rms_error_of_each_pose(poses.after))
    turn, origin = cell.base[:3, :3], 1e3 * cell.base[:3, 3]
    points = (1e3 * poses.data.y[chosen] - origin) @ turn
    before, after = (e[chosen] @ turn for e in (poses.before, poses.after))
    arms, corners = arm_polylines(cell.robot, poses.data.q[chosen])
    tracker = -origin @ turn
    space = DrawnWorkspace(chosen, points, before, after, arms, corners, tracker,
                  float(np.linalg.norm(tracker)))  # fmt: skip
    return replace(space, tracker=clip_tracker_to_workspace(space))


def clip_tracker_to_workspace(workspace: DrawnWorkspace) -> Array:
    """Where to draw the tracker: as it is, or where the line to it leaves the workspace's box."""
    sight = workspace.tracker - workspace.centre
    half = (workspace.high - workspace.low) / 2.0 + WORKSPACE_PADDING_FRACTION * workspace.radius
    with np.errstate(divide="ignore"):
        far = float((half / np.abs(sight)).min())
    return np.asarray(workspace.centre + min(far, 1.0) * sight)


class ArmPolylines(NamedTuple):
    """The arm as lines.  See `arm_polylines`."""

    vertices: Array
    is_joint: Array


def arm_polylines(robot: Robot, q: Array) -> ArmPolylines:
    """The arm as a chain of lines: (m, v, 3) [mm], and (v,) True where a joint is.

    Each link goes along its joint axis by d, then along its normal by a.  q: (m, n) [rad, m].
    """
    links = compute_link_frames(robot.mdh, robot.chain_joint_values(q), robot.prismatic)
    spots, joints = [np.zeros((len(q), 3))], [True]
    for i in range(robot.joints):
        start, end = links.before[i].T, links.after[i].T
        axis = links.z[i].T
        knee = start + axis * ((end - start) * axis).sum(axis=1, keepdims=True)
        for spot, corner in ((knee, False), (end, True)):
            if np.abs(spot - spots[-1]).max(initial=0.0) > 1e-6:
                spots.append(spot)
                joints.append(corner)
            elif corner:
                joints[-1] = True
    return ArmPolylines(1e3 * np.stack(spots, axis=1), np.array(joints))


def choose_magnification(workspace: DrawnWorkspace, errors: Array) -> int:
    """How much to magnify errors so that a large one is well seen: one of `MAGNIFICATION_STEPS`."""
    size = np.linalg.norm(errors, axis=-1)
    size = size[np.isfinite(size)]
    large = float(np.percentile(size, LARGE_ERROR_PERCENTILE)) if len(size) else 0.0
    best = LARGE_ARROW_FRACTION_OF_RADIUS * workspace.radius / max(large, 1e-9)
    return int(max([step for step in MAGNIFICATION_STEPS if step <= best], default=1))


def build_view_control_data(
    workspace: DrawnWorkspace, poses: PosesWithErrors, names: BeforeAfterNames
) -> dict[str, Any]:
    """What the page's controls need: arrows, and the arm at every pose drawn."""
    before, after = rms_error_of_each_pose(poses.before), rms_error_of_each_pose(poses.after)
    target, pose = np.nonzero(np.isfinite(workspace.points[..., 0]).T)
    return {
        "names": list(names),
        "steps": list(MAGNIFICATION_STEPS),
        "start": [choose_magnification(workspace, e) for e in (workspace.before, workspace.after)],
        "worst": int(np.argmax(after[workspace.pose_indices])),
        "points": round_for_json(workspace.points[pose, target], 5),
        "before": round_for_json(workspace.before[pose, target], 4),
        "after": round_for_json(workspace.after[pose, target], 4),
        "corners": np.flatnonzero(workspace.corners).tolist(),
        "poses": [
            {
                "line": int(poses.data.line[i]),
                "held": bool(poses.held[i]),
                "error": round_for_json(np.array([before[i], after[i]]), 4),
                "arm": round_for_json(workspace.arms[row], 5),
                "spots": round_for_json(
                    workspace.points[row][np.isfinite(workspace.points[row, :, 0])], 5
                ),
            }
            for row, i in enumerate(workspace.pose_indices)
        ],
    }


def build_3d_trace(name: str, colour: str, points: Array, **more: Any) -> dict[str, Any]:
    """Points or lines in space, in millimetres."""
    x, y, z = (round_for_json(column, 4) for column in np.reshape(points, (-1, 3)).T)
    return {"type": "scatter3d", "name": name, "x": x, "y": y, "z": z, "hoverinfo": "skip",
            "marker": {"color": colour, "size": 3}, "line": {"color": colour, "width": 4},
            **more}  # fmt: skip


def build_workspace_view(
    poses: PosesWithErrors, cell: Cell, names: BeforeAfterNames
) -> View3dBlock:
    """The view and its still picture."""
    space = build_drawn_workspace(poses, cell)
    nothing = np.zeros((0, 3))
    near = np.linalg.norm(space.tracker) > 0.99 * space.tracker_distance
    where = f"tracker, {space.tracker_distance / 1e3:.2f} m away" + (
        "" if near else " (only its direction is drawn)"
    )
    traces = (
        *(
            build_3d_trace(
                f"error, {name}", look, nothing, mode="lines", line={"width": 3, "color": look}
            )
            for name, look in zip(names, ("before", "after"), strict=True)
        ),
        build_3d_trace(
            "arm at the chosen pose",
            "ink",
            nothing,
            mode="lines+markers",
            line={"color": "ink", "width": 8},
            marker={"color": "ink", "size": 1},
        ),
        build_3d_trace(
            "its joints",
            "ink",
            nothing,
            mode="markers",
            marker={"color": "ink", "size": 6, "symbol": "circle"},
            showlegend=False,
        ),
        build_3d_trace(
            "its targets",
            "ink",
            nothing,
            mode="lines+markers",
            line={"color": "ink", "width": 2},
            marker={"color": "ink", "size": 5, "symbol": "diamond"},
        ),
        build_3d_trace(
            where,
            "soft",
            np.stack([space.tracker, space.centre]),
            mode="lines+markers",
            line={"color": "soft", "width": 2, "dash": "dash"},
            marker={"color": "soft", "size": [7, 0.1], "symbol": "square"},
        ),
    )
    layout = {
        "margin": {"l": 0, "r": 0, "t": 30, "b": 0},
        "legend": {"orientation": "h", "x": 0, "yref": "container", "y": 1.0, "yanchor": "top"},
        "scene": build_3d_axes(space),
    }
    large = np.linalg.norm(np.stack([space.before, space.after]), axis=-1)
    cut = (
        ""
        if len(space.pose_indices) == len(poses.held)
        else (
            f" {len(space.pose_indices)} of {len(poses.held)} poses "
            f"are drawn: the worst, and an even choice "
            "of the others."
        )
    )
    says = (
        f"The errors as arrows in the workspace, from where the model says to where the target was "
        f"measured, magnified. Largest, training poses too: {np.nanmax(large[0]):.3f} mm "
        f"{names[0]}, {np.nanmax(large[1]):.3f} mm {names[1]}. The arm is drawn by its calibrated "
        f"chain of frames.{cut}"
    )
    return View3dBlock(
        "workspace",
        "The errors in the workspace",
        says,
        traces,
        layout,
        560,
        still=draw_still_view(space, poses, names, where),
        arms=build_view_control_data(space, poses, names),
    )


def build_3d_axes(workspace: DrawnWorkspace) -> dict[str, Any]:
    """Axes in millimetres, the same scale on all, that do not move with the arrows."""
    pad = (WORKSPACE_PADDING_FRACTION + 0.02) * workspace.radius
    ends = [[a - pad, b + pad]
            for a, b in zip(workspace.low, workspace.high, strict=True)]  # fmt: skip
    axes = {
        f"{letter}axis": {
            "title": {"text": f"{letter} (mm)"},
            "range": round_for_json(np.array(ends[i]), 4),
            "color": "ink",
            "gridcolor": "line",
            "showbackground": False,
            "nticks": 6,
        }
        for i, letter in enumerate("xyz")
    }
    return {
        **axes,
        "aspectmode": "data",
        "camera": {
            "eye": {"x": 1.05, "y": -1.2, "z": 0.55},
            "center": {"x": 0, "y": 0, "z": -0.12},
        },
    }


def draw_still_view(
    workspace: DrawnWorkspace, poses: PosesWithErrors, names: BeforeAfterNames, tracker_text: str
) -> str:
    """The view on paper: errors after, magnified, and the arm where the largest is."""
    times = choose_magnification(workspace, workspace.after)
    seen = np.isfinite(workspace.points[..., 0])
    start = workspace.points[seen]
    worst = int(np.argmax(rms_error_of_each_pose(poses.after)[workspace.pose_indices]))
    called = poses.data.called(poses.data.line[workspace.pose_indices[worst]])
    words = (
        f"errors {names[1]}, magnified {times} times",
        f"arm at the pose of the largest error ({called})",
        tracker_text,
    )
    picture = WorkspaceDrawing(
        start=start,
        end=start + times * workspace.after[seen],
        arm=workspace.arms[worst],
        joints=workspace.arms[worst][workspace.corners],
        spots=workspace.points[worst][seen[worst]],
        tracker=workspace.tracker,
        centre=workspace.centre,
        words=words,
    )
    return draw_workspace_svg(picture)
