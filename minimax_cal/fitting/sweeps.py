"""The axes of an arm that nothing is drawn of, from sweeps: rows in which one joint alone moves.

A point on a link that turns by q about an axis moves on a circle, ``c + u cos q + v sin q`` with
v = w x u: linear in c, u, v, whatever the joint's zero.  On a slide it moves on a line.  Axes are
taken at the pose of their sweep and turned back by the joints before them [Mooring, Roth and
Driels 1991, ch. 5; products of exponentials, Brockett 1984].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.kinematics import rotation
from minimax_cal.robots.transforms import along, inverse, link, link_to, transform

STILL = {False: 2e-3, True: 2e-4}  # by sliding: how far a joint at rest may be from there [rad, m]
LEAST_SPAN = {False: 0.35, True: 0.02}  # of a sweep [rad, m]
LEAST_ROWS = 5  # of a sweep: a circle takes three


@dataclass(frozen=True, eq=False)
class Axis:
    """A joint's axis: direction (3,), a point (3,) on it [m], at joint values 0."""

    direction: Array
    point: Array
    slides: bool

    def moved(self, q: float) -> Array:
        """(4, 4) what a joint value does to space [rad, m]."""
        if self.slides:
            return transform(np.eye(3), q * self.direction)
        turn = rotation(q * self.direction)
        return transform(turn, self.point - turn @ self.point)


def sweep_of(data: Measurements, joint: int, sliding: Array) -> Array:
    """The rows in which a joint alone moves, those that span most; empty for none.

    sliding: (n,) True for slides.
    """
    others = np.arange(data.q.shape[1]) != joint
    still = np.where(sliding, STILL[True], STILL[False])[others]
    best, widest = np.zeros(0, dtype=int), LEAST_SPAN[bool(sliding[joint])]
    for row in range(data.poses):
        near = (np.abs(data.q[:, others] - data.q[row, others]) < still).all(axis=1)
        rows = np.flatnonzero(near & data.seen.any(axis=1))
        span = float(np.ptp(data.q[rows, joint])) if len(rows) else 0.0
        if span > widest and len(np.unique(data.q[rows, joint])) >= LEAST_ROWS:
            best, widest = rows, span
    return best


def lacking_sweeps(data: Measurements, sliding: Array) -> list[int]:
    """The joints that never move alone."""
    return [j for j in range(len(sliding)) if not len(sweep_of(data, j, sliding))]


def axis_of_sweep(q: Array, y: Array, slides: bool) -> Axis:
    """The axis that a joint's values (m,) and points (m, k, 3) show, where they were measured.

    Targets count by how far they are from a turning axis, or equally.
    """
    direction, total, foot = np.zeros(3), 0.0, np.zeros(3)
    for points in np.moveaxis(y, 1, 0):
        seen = np.isfinite(points[:, 0])
        if slides and seen.sum() >= 2:
            base = np.stack([np.ones(seen.sum()), q[seen]], axis=1)
            _, slope = np.linalg.lstsq(base, points[seen], rcond=None)[0]
            direction += slope
        if not slides and seen.sum() >= LEAST_ROWS:
            turns = [np.ones(seen.sum()), np.cos(q[seen]), np.sin(q[seen])]
            centre, u, v = np.linalg.lstsq(np.stack(turns, axis=1), points[seen], rcond=None)[0]
            weight = float(np.linalg.norm(np.cross(u, v)))
            direction += np.cross(u, v)
            foot, total = foot + weight * centre, total + weight
    size = float(np.linalg.norm(direction))
    if size == 0.0:
        raise DataError("a sweep moves no point; measure targets off the axis")
    return Axis(direction / size, foot / total if total else np.nanmean(y, axis=(0, 1)), slides)


def axes_of(data: Measurements, sliding: Array) -> list[Axis]:
    """The axes at joint values 0, in the measurement frame.  Raises DataError without a sweep."""
    axes: list[Axis] = []
    for joint, slides in enumerate(sliding):
        rows = sweep_of(data, joint, sliding)
        if not len(rows):
            raise DataError(f"{data.source}: joint {joint + 1} never moves alone")
        found = axis_of_sweep(data.q[rows, joint], data.y[rows], bool(slides))
        before = np.eye(4)
        for axis, value in zip(axes, data.q[rows].mean(axis=0), strict=False):
            before = before @ axis.moved(float(value))
        back = inverse(before)
        direction, point = back[:3, :3] @ found.direction, back[:3, :3] @ found.point + back[:3, 3]
        axes.append(Axis(direction, point, bool(slides)))
    return axes


def links_of_axes(axes: Sequence[Axis]) -> Array:
    """(n, 5) links whose joints lie on axes; the last frame lies on the last one.

    A slide may be anywhere along its line's plane: it goes through the frame before it.
    """
    first = axes[0]
    at = transform(along(first.direction), first.point)
    rows = []
    for axis in axes[1:]:
        back = inverse(at)
        point = np.zeros(3) if axis.slides else back[:3, :3] @ axis.point + back[:3, 3]
        rows.append(link_to(point, back[:3, :3] @ axis.direction))
        at = at @ link(rows[-1])
    return np.array([*rows, np.zeros(5)])
