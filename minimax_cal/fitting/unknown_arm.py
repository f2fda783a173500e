"""A robot file for an arm of which nothing is drawn: its joints' types, and measurements.

Its axes come from sweeps, rows in which one joint alone moves.  A point on a link that turns by q
about an axis moves on a circle, ``c + u cos q + v sin q`` with v = w x u: linear in c, u, v,
whatever the joint's zero.  On a slide it moves on a line.  Axes are taken at the pose of their
sweep and turned back by the joints before them [Mooring, Roth and Driels 1991, ch. 5; products of
exponentials, Brockett 1984].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import Progress, silent_progress
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.global_start import search_base_rotations
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots.kinematics import rotation_from_vector
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.robots.transforms import (
    build_transform,
    invert_transform,
    link_row_to_axis,
    link_transform,
    rotation_from_z_to_direction,
)
from minimax_cal.solvers.status import Status

JOINT_TYPE_IS_PRISMATIC = {"revolute": False, "r": False, "prismatic": True, "p": True}
MAX_IDENTIFIED_JOINTS = 12
RIGHT_ANGLE = 0.5 * np.pi
TRIALS, ROUNDS = 8, 2  # of arms drawn at random, and of starts of each
GUESSED_LINK_LENGTH = 0.3  # length of a link that is sought; lengths are solved for [m]
MAX_IDENTIFIED_ERROR_OF_REACH = (
    2e-3  # of the points' spread: a fit that misses by less has found the arm
)
MAX_STILL_JOINT_MOTION = {
    False: 2e-3,
    True: 2e-4,
}  # by sliding: how far a joint at rest may be from there [rad, m]
MIN_SWEEP_SPAN = {False: 0.35, True: 0.02}  # of a sweep [rad, m]
MIN_SWEEP_ROWS = 5  # of a sweep: a circle takes three
SWEEPS, SEARCH = "sweeps of single joints", "a search over random poses"


@dataclass(frozen=True, eq=False)
class UnknownArm:
    """robot: as identified, `build_rough_robot`.  fit: of all measurements by it.  way: how it was
    found.
    """

    robot: Robot
    fit: Fit
    way: str

    @property
    def status(self) -> Status:
        """How the numbers ended.

        Where sweeps alone reach the noise, a fit is no better than they are, and as good.
        """
        better = self.fit.status is not Status.NO_BETTER
        return self.fit.status if better else Status.CONVERGED

    def headline(self) -> str:
        """How it was found and how well it fits, in a line."""
        rms, poses = self.fit.accuracy["holdout"].rms_mm, self.fit.accuracy["holdout"].poses
        return (
            f"{self.robot.joints} joints, found by {self.way}: RMS {rms:.3g} mm at {poses} "
            "poses held out"
        )


def parse_joint_types(joints: str | Sequence[str]) -> Array:
    """(n,) True where a joint slides.  joints: revolute or prismatic each.  Raises OptionError."""
    names = [n.strip().lower() for n in (joints.split(",") if isinstance(joints, str) else joints)]
    wrong = [name for name in names if name not in JOINT_TYPE_IS_PRISMATIC]
    if wrong or not 1 <= len(names) <= MAX_IDENTIFIED_JOINTS:
        raise OptionError(
            f"joints={','.join(names)!r}: write revolute or prismatic for each joint from the base "
            "on, as joints='revolute,revolute,prismatic'"
        )
    return np.array([JOINT_TYPE_IS_PRISMATIC[name] for name in names])


def identify_arm(
    data: Measurements,
    joints: str | Sequence[str],
    name: str = "identified arm",
    progress: Progress = silent_progress,
) -> UnknownArm:
    """The geometry of an arm that nothing is drawn of.

    data: measurements; best with sweeps, rows in which one joint alone moves, of every joint.
    joints: revolute or prismatic each.  Raises CalibrationError for wrong input; how the numbers
    ended is in the result's `status`.
    """
    sliding = parse_joint_types(joints)
    if data.q.shape[1] != len(sliding):
        raise OptionError(
            f"joints= names {len(sliding)} joints, but {data.source} has {data.q.shape[1]} joint "
            "columns"
        )
    if (odd := data.sliding != sliding).any():
        number = int(np.argmax(odd)) + 1
        kind = "slides" if sliding[number - 1] else "turns"
        raise DataError(
            f"{data.source}: joint {number} {kind}; name its column q{number}_"
            f"{'mm' if sliding[number - 1] else 'deg'}"
        )
    lacking = [j for j in range(len(sliding)) if not len(select_sweep_rows(data, j, sliding))]
    progress("axes")
    if not lacking:
        robot, way = (
            build_rough_robot(name, convert_axes_to_links(find_joint_axes(data, sliding)), sliding),
            SWEEPS,
        )
    else:
        robot, way = search_square_arms(name, data, sliding, lacking), SEARCH
    fit = calibrate(robot, data, "sum", allow_large_changes=True, progress=progress)
    return UnknownArm(replace(robot, mdh=fit.cell.robot.mdh), fit, way)


def build_rough_robot(name: str, mdh: Array, sliding: Array) -> Robot:
    """An arm whose geometry is a first guess."""
    keys = ("a", "d", "theta", "alpha", "beta")
    rows = [
        dict(zip(keys, map(float, row), strict=True)) | ({"type": "prismatic"} if slides else {})
        for row, slides in zip(mdh, sliding, strict=True)
    ]
    units = {"length": "m", "angle": "rad"}
    return robot_from_dict({"name": name, "units": units, "nominal": "rough", "joints": rows})


def search_square_arms(
    name: str, data: Measurements, sliding: Array, joints_without_sweep: Sequence[int]
) -> Robot:
    """The best of arms with square axes drawn at random.  Raises DataError where none fits.

    Lengths need no guess: they are solved for at every step (`PointLeastSquares.reduced`).
    """
    rng = np.random.default_rng(0)
    n, points = len(sliding), float(data.seen.sum())
    spread = float(np.sqrt(np.nanvar(data.y, axis=0).sum(axis=-1).max()))
    best, least = None, np.inf
    for _ in range(TRIALS):
        mdh = np.zeros((n, 5))
        mdh[:, 0] = GUESSED_LINK_LENGTH
        mdh[:, 2] = RIGHT_ANGLE * rng.integers(-1, 3, n)
        mdh[:, 3] = RIGHT_ANGLE * rng.integers(-1, 2, n)
        mdh[-1] = 0.0
        robot = build_rough_robot(name, mdh, sliding)
        model = build_point_model(robot, data)
        first = search_base_rotations(
            model, mdh, points, MAX_IDENTIFIED_ERROR_OF_REACH * spread, ROUNDS
        )
        miss = float(np.sqrt(first.cost[0] / points))
        if miss < least:
            # The same arm in links of common normals, short ones between parallel axes.
            at, axes = np.eye(4), []
            for row, slides in zip(first.x.mdh[0], sliding, strict=True):
                axes.append(JointAxis(at[:3, 2], at[:3, 3], bool(slides)))
                at = at @ link_transform(row)
            best, least = build_rough_robot(name, convert_axes_to_links(axes), sliding), miss
        if least < MAX_IDENTIFIED_ERROR_OF_REACH * spread:
            break
    if best is None or least >= MAX_IDENTIFIED_ERROR_OF_REACH * spread:
        named = ", ".join(str(j + 1) for j in joints_without_sweep)
        raise DataError(
            f"{data.source}: no arm of these joints fits (the best misses by {1e3 * least:.3g} mm);"
            f" measure sweeps of joint {named}: rows in which it alone moves, five or more over 20 "
            "degrees, all others at rest"
        )
    return best


@dataclass(frozen=True, eq=False)
class JointAxis:
    """A joint's axis: direction (3,), a point (3,) on it [m], at joint values 0."""

    direction: Array
    point: Array
    slides: bool

    def displacement(self, q: float) -> Array:
        """(4, 4) what a joint value does to space [rad, m]."""
        if self.slides:
            return build_transform(np.eye(3), q * self.direction)
        turn = rotation_from_vector(q * self.direction)
        return build_transform(turn, self.point - turn @ self.point)


def select_sweep_rows(data: Measurements, joint: int, sliding: Array) -> Array:
    """The rows in which a joint alone moves, those that span most; empty for none.

    sliding: (n,) True for slides.
    """
    others = np.arange(data.q.shape[1]) != joint
    still = np.where(sliding, MAX_STILL_JOINT_MOTION[True], MAX_STILL_JOINT_MOTION[False])[others]
    best, widest = np.zeros(0, dtype=int), MIN_SWEEP_SPAN[bool(sliding[joint])]
    for row in range(data.poses):
        near = (np.abs(data.q[:, others] - data.q[row, others]) < still).all(axis=1)
        rows = np.flatnonzero(near & data.seen.any(axis=1))
        span = float(np.ptp(data.q[rows, joint])) if len(rows) else 0.0
        if span > widest and len(np.unique(data.q[rows, joint])) >= MIN_SWEEP_ROWS:
            best, widest = rows, span
    return best


def fit_axis_to_sweep(q: Array, y: Array, slides: bool) -> JointAxis:
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
        if not slides and seen.sum() >= MIN_SWEEP_ROWS:
            turns = [np.ones(seen.sum()), np.cos(q[seen]), np.sin(q[seen])]
            centre, u, v = np.linalg.lstsq(np.stack(turns, axis=1), points[seen], rcond=None)[0]
            weight = float(np.linalg.norm(np.cross(u, v)))
            direction += np.cross(u, v)
            foot, total = foot + weight * centre, total + weight
    size = float(np.linalg.norm(direction))
    if size == 0.0:
        raise DataError("a sweep moves no point; measure targets off the axis")
    return JointAxis(
        direction / size, foot / total if total else np.nanmean(y, axis=(0, 1)), slides
    )


def find_joint_axes(data: Measurements, sliding: Array) -> list[JointAxis]:
    """The axes at joint values 0, in the measurement frame.  Raises DataError without a sweep."""
    axes: list[JointAxis] = []
    for joint, slides in enumerate(sliding):
        rows = select_sweep_rows(data, joint, sliding)
        if not len(rows):
            raise DataError(f"{data.source}: joint {joint + 1} never moves alone")
        found = fit_axis_to_sweep(data.q[rows, joint], data.y[rows], bool(slides))
        before = np.eye(4)
        for axis, value in zip(axes, data.q[rows].mean(axis=0), strict=False):
            before = before @ axis.displacement(float(value))
        back = invert_transform(before)
        direction, point = back[:3, :3] @ found.direction, back[:3, :3] @ found.point + back[:3, 3]
        axes.append(JointAxis(direction, point, bool(slides)))
    return axes


def convert_axes_to_links(axes: Sequence[JointAxis]) -> Array:
    """(n, 5) links whose joints lie on axes; the last frame lies on the last one.

    A slide may be anywhere along its line's plane: it goes through the frame before it.
    """
    first = axes[0]
    at = build_transform(rotation_from_z_to_direction(first.direction), first.point)
    rows = []
    for axis in axes[1:]:
        back = invert_transform(at)
        point = np.zeros(3) if axis.slides else back[:3, :3] @ axis.point + back[:3, 3]
        rows.append(link_row_to_axis(point, back[:3, :3] @ axis.direction))
        at = at @ link_transform(rows[-1])
    return np.array([*rows, np.zeros(5)])
