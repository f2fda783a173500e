"""The workspace in three dimensions: arrows of the errors, the arm at a pose, the tracker."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.cell import Cell
from minimax_cal.reporting.html.content import View, plain, some
from minimax_cal.reporting.html.error_charts import Names, of_poses
from minimax_cal.reporting.html.projection import Drawing, drawn
from minimax_cal.reporting.html.sources import Poses
from minimax_cal.robots.kinematics import chain
from minimax_cal.robots.robot import Robot

LONG = 0.12  # length of a large arrow, of the workspace's radius
LARGE = 90.0  # percentile of the errors that is such a one
PAD = 0.12  # room around the workspace, of its radius
STEPS = tuple(m * 10**e for e in range(6) for m in (1, 2, 5))  # magnifications to choose from


@dataclass(frozen=True, eq=False)
class Space:
    """What is drawn, in the robot's base frame [mm].

    chosen: (s,) poses.  points: (s, k, 3) measured, NaN where not.  before, after: (s, k, 3)
    measured minus predicted.  arms: (s, v, 3) the arm from base to flange.  corners: (v,) True
    where a joint is.  tracker: (3,) where it is drawn; away: how far it really is from the base.
    """

    chosen: Array
    points: Array
    before: Array
    after: Array
    arms: Array
    corners: Array
    tracker: Array
    away: float

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


def space_of(poses: Poses, cell: Cell) -> Space:
    """Poses and arm in the base frame of a calibrated cell."""
    chosen = some(of_poses(poses.after))
    turn, origin = cell.base[:3, :3], 1e3 * cell.base[:3, 3]
    points = (1e3 * poses.data.y[chosen] - origin) @ turn
    before, after = (e[chosen] @ turn for e in (poses.before, poses.after))
    arms, corners = skeleton(cell.robot, poses.data.q[chosen])
    tracker = -origin @ turn
    space = Space(chosen, points, before, after, arms, corners, tracker,
                  float(np.linalg.norm(tracker)))  # fmt: skip
    return replace(space, tracker=inside(space))


def inside(space: Space) -> Array:
    """Where to draw the tracker: as it is, or where the line to it leaves the workspace's box."""
    sight = space.tracker - space.centre
    half = (space.high - space.low) / 2.0 + PAD * space.radius
    with np.errstate(divide="ignore"):
        far = float((half / np.abs(sight)).min())
    return np.asarray(space.centre + min(far, 1.0) * sight)


def skeleton(robot: Robot, q: Array) -> tuple[Array, Array]:
    """The arm as a chain of lines: (m, v, 3) [mm], and (v,) True where a joint is.

    Each link goes along its joint axis by d, then along its normal by a.  q: (m, n) [rad, m].
    """
    links = chain(robot.mdh, robot.turned(q), robot.prismatic)
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
    return 1e3 * np.stack(spots, axis=1), np.array(joints)


def magnification(space: Space, errors: Array) -> int:
    """How much to magnify errors so that a large one is well seen: one of `STEPS`."""
    size = np.linalg.norm(errors, axis=-1)
    size = size[np.isfinite(size)]
    large = float(np.percentile(size, LARGE)) if len(size) else 0.0
    best = LONG * space.radius / max(large, 1e-9)
    return int(max([step for step in STEPS if step <= best], default=1))


def arms_of(space: Space, poses: Poses, names: Names) -> dict[str, Any]:
    """What the page's controls need: arrows, and the arm at every pose drawn."""
    before, after = of_poses(poses.before), of_poses(poses.after)
    target, pose = np.nonzero(np.isfinite(space.points[..., 0]).T)
    return {
        "names": list(names),
        "steps": list(STEPS),
        "start": [magnification(space, e) for e in (space.before, space.after)],
        "worst": int(np.argmax(after[space.chosen])),
        "points": plain(space.points[pose, target], 5),
        "before": plain(space.before[pose, target], 4),
        "after": plain(space.after[pose, target], 4),
        "corners": np.flatnonzero(space.corners).tolist(),
        "poses": [
            {
                "line": int(poses.data.line[i]),
                "held": bool(poses.held[i]),
                "error": plain(np.array([before[i], after[i]]), 4),
                "arm": plain(space.arms[row], 5),
                "spots": plain(space.points[row][np.isfinite(space.points[row, :, 0])], 5),
            }
            for row, i in enumerate(space.chosen)
        ],
    }


def cloud(name: str, colour: str, points: Array, **more: Any) -> dict[str, Any]:
    """Points or lines in space, in millimetres."""
    x, y, z = (plain(column, 4) for column in np.reshape(points, (-1, 3)).T)
    return {"type": "scatter3d", "name": name, "x": x, "y": y, "z": z, "hoverinfo": "skip",
            "marker": {"color": colour, "size": 3}, "line": {"color": colour, "width": 4},
            **more}  # fmt: skip


def workspace(poses: Poses, cell: Cell, names: Names) -> View:
    """The view and its still picture."""
    space = space_of(poses, cell)
    nothing = np.zeros((0, 3))
    near = np.linalg.norm(space.tracker) > 0.99 * space.away
    where = f"tracker, {space.away / 1e3:.2f} m away" + (
        "" if near else " (only its direction is drawn)"
    )
    traces = (
        *(cloud(f"error, {name}", look, nothing, mode="lines", line={"width": 3, "color": look})
          for name, look in zip(names, ("before", "after"), strict=True)),
        cloud("arm at the chosen pose", "ink", nothing, mode="lines+markers",
              line={"color": "ink", "width": 8}, marker={"color": "ink", "size": 1}),
        cloud("its joints", "ink", nothing, mode="markers",
              marker={"color": "ink", "size": 6, "symbol": "circle"}, showlegend=False),
        cloud("its targets", "ink", nothing, mode="lines+markers",
              line={"color": "ink", "width": 2},
              marker={"color": "ink", "size": 5, "symbol": "diamond"}),
        cloud(where, "soft", np.stack([space.tracker, space.centre]), mode="lines+markers",
              line={"color": "soft", "width": 2, "dash": "dash"},
              marker={"color": "soft", "size": [7, 0.1], "symbol": "square"}),
    )  # fmt: skip
    layout = {
        "margin": {"l": 0, "r": 0, "t": 30, "b": 0},
        "legend": {"orientation": "h", "x": 0, "yref": "container", "y": 1.0, "yanchor": "top"},
        "scene": scene_axes(space),
    }
    large = np.linalg.norm(np.stack([space.before, space.after]), axis=-1)
    cut = "" if len(space.chosen) == len(poses.held) else (
        f" {len(space.chosen)} of {len(poses.held)} poses are drawn: the worst, and an even choice "
        "of the others."
    )  # fmt: skip
    says = (
        f"The errors as arrows in the workspace, from where the model says to where the target was "
        f"measured, magnified. Largest, training poses too: {np.nanmax(large[0]):.3f} mm "
        f"{names[0]}, {np.nanmax(large[1]):.3f} mm {names[1]}. The arm is drawn by its calibrated "
        f"chain of frames.{cut}"
    )
    return View(
        "workspace", "The errors in the workspace", says, traces, layout, 560,
        still=still(space, poses, names, where), arms=arms_of(space, poses, names),
    )  # fmt: skip


def scene_axes(space: Space) -> dict[str, Any]:
    """Axes in millimetres, the same scale on all, that do not move with the arrows."""
    pad = (PAD + 0.02) * space.radius
    ends = [[a - pad, b + pad]
            for a, b in zip(space.low, space.high, strict=True)]  # fmt: skip
    axes = {
        f"{letter}axis": {"title": {"text": f"{letter} (mm)"}, "range": plain(np.array(ends[i]), 4),
                          "color": "ink", "gridcolor": "line", "showbackground": False, "nticks": 6}
        for i, letter in enumerate("xyz")
    }  # fmt: skip
    return {
        **axes,
        "aspectmode": "data",
        "camera": {
            "eye": {"x": 1.05, "y": -1.2, "z": 0.55},
            "center": {"x": 0, "y": 0, "z": -0.12},
        },
    }


def still(space: Space, poses: Poses, names: Names, where: str) -> str:
    """The view on paper: errors after, magnified, and the arm where the largest is."""
    times = magnification(space, space.after)
    seen = np.isfinite(space.points[..., 0])
    start = space.points[seen]
    worst = int(np.argmax(of_poses(poses.after)[space.chosen]))
    called = poses.data.called(poses.data.line[space.chosen[worst]])
    words = (
        f"errors {names[1]}, magnified {times} times",
        f"arm at the pose of the largest error ({called})",
        where,
    )
    picture = Drawing(
        start=start,
        end=start + times * space.after[seen],
        arm=space.arms[worst],
        joints=space.arms[worst][space.corners],
        spots=space.points[worst][seen[worst]],
        tracker=space.tracker,
        centre=space.centre,
        words=words,
    )
    return drawn(picture)
