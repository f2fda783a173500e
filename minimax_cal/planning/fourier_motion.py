"""Excitations: finite Fourier series of the joints that begin and end at rest, within limits.

A joint follows q(t) = c + sum over k of a_k cos(k w t) + b_k sin(k w t), w = 2 pi / T [Swevers et
al. 1997], with sum k b_k = 0 and sum k^2 a_k = 0: no speed and no acceleration at either end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.dynamics.regressor import JointMotion
from minimax_cal.planning.pose_visibility import (
    ARM_CONDITIONS,
    ArmAtPoses,
    ArmWorkspace,
    TrackerVisibility,
)
from minimax_cal.robots.kinematics import compute_link_frames

JOINT_LIMIT_CHECK_HZ = 25.0  # rows at which joints, speeds and accelerations are looked at
SEARCH_COLLISION_CHECK_HZ, FINAL_COLLISION_CHECK_HZ = (
    10.0,
    50.0,
)  # and the arm's points: in the search, and once it has ended
REACHED_FRACTION_OF_LIMITS = (
    0.98  # of limits that a series reaches: between those rows it goes a little farther
)
AMPLITUDE_SHRINK_FACTOR = (
    0.7  # factor by which a motion about a pose is made smaller until it is free
)
MIN_AMPLITUDE_FRACTION = 0.1  # of its largest size, below which another pose is tried
MAX_MOTION_CENTRES_DRAWN, MAX_MOTIONS_TRIED = (
    1000,
    60,
)  # poses drawn, and motions tried about free ones, before giving up
MAX_FIXED_POINT_TRAVEL = 1e-3  # a point that moves by less is none of the arm's moving ones [m]


@dataclass(frozen=True, eq=False)
class FourierMotion:
    """centre: (n,).  cos_coefficients, sin_coefficients: (K, n) of cos and sin [rad, m].  period:
    [s].
    """

    centre: Array
    cos_coefficients: Array
    sin_coefficients: Array
    period: float

    def evaluate(self, times: Array) -> JointMotion:
        """The motion at times (m,) [s]."""
        w = 2.0 * np.pi / self.period * np.arange(1, len(self.cos_coefficients) + 1)
        cos, sin = np.cos(times[:, None] * w), np.sin(times[:, None] * w)
        return JointMotion(
            self.centre + cos @ self.cos_coefficients + sin @ self.sin_coefficients,
            (cos * w) @ self.sin_coefficients - (sin * w) @ self.cos_coefficients,
            -(cos * w**2) @ self.cos_coefficients - (sin * w**2) @ self.sin_coefficients,
        )

    def sample_times(self, rate_hz: float) -> Array:
        """Times of a whole period at a rate [Hz]: (m,) [s]."""
        return np.arange(round(self.period * rate_hz) + 1) / rate_hz

    def scale_amplitudes(self, factor: Array | float) -> FourierMotion:
        """The same about its centre, each joint's motion by a factor."""
        return replace(
            self,
            cos_coefficients=factor * self.cos_coefficients,
            sin_coefficients=factor * self.sin_coefficients,
        )


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """What a motion may do.  workspace: limits of the joints, floor and box.  box: (2, 3), or
    empty.

    speed, acceleration: (n,) at most [rad/s, rad/s^2; m].
    """

    workspace: ArmWorkspace
    box: Array
    speed: Array
    acceleration: Array


class FourierCoefficients(NamedTuple):
    """(K, n) coefficients of cos and sin."""

    cos: Array
    sin: Array


def project_to_rest_at_ends(
    cos_coefficients: Array, sin_coefficients: Array
) -> FourierCoefficients:
    """The nearest coefficients (K, n) without speed and acceleration at the ends."""
    k = np.arange(1.0, len(cos_coefficients) + 1.0)[:, None]
    return FourierCoefficients(
        cos_coefficients - k**2 * (k**2 * cos_coefficients).sum(0) / (k**4).sum(),
        sin_coefficients - k * (k * sin_coefficients).sum(0) / (k**2).sum(),
    )


def scale_motion_to_limits(motion: FourierMotion, limits: MotionLimits) -> FourierMotion:
    """The series, each joint's motion as large as its limits allow about its centre."""
    moved = motion.evaluate(motion.sample_times(JOINT_LIMIT_CHECK_HZ))
    off = moved.q - motion.centre
    room = limits.workspace
    with np.errstate(divide="ignore", invalid="ignore"):  # a joint without a drive stays
        up = (room.upper - motion.centre) / np.maximum(off.max(axis=0), 0.0)
        down = (motion.centre - room.lower) / np.maximum(-off.min(axis=0), 0.0)
        quick = limits.speed / np.abs(moved.qd).max(axis=0)
        hard = limits.acceleration / np.abs(moved.qdd).max(axis=0)
    factor = REACHED_FRACTION_OF_LIMITS * np.min([up, down, quick, hard], axis=0)
    return motion.scale_amplitudes(np.where(np.isfinite(factor), factor, 0.0))


def are_poses_allowed(q: Array, limits: MotionLimits) -> Array:
    """(m,) True where the arm's points are in the box, above the floor and clear of each other.

    q: (m, n) [rad, m].
    """
    room = limits.workspace
    view = ArmAtPoses(room, TrackerVisibility(np.zeros(3), room.robot.up), q)
    out = np.asarray(ARM_CONDITIONS["floor"](view) & ARM_CONDITIONS["self-collision"](view))
    return out & are_moving_links_in_box(room, q, limits.box) if len(limits.box) else out


def are_moving_links_in_box(workspace: ArmWorkspace, q: Array, box: Array) -> Array:
    """(m,) True where all moving origins of the arm's links are in a box.  box: (2, 3) [m]."""
    robot = workspace.robot
    points = compute_link_frames(
        robot.mdh, np.ascontiguousarray(robot.chain_joint_values(q)), robot.prismatic
    ).after
    low, high = box[:, None, :, None]
    within = np.all((points >= low) & (points <= high), axis=1)
    return np.asarray(within[find_moving_links(workspace)].all(axis=0))


def find_moving_links(workspace: ArmWorkspace) -> Array:
    """(n,) True for the links whose origin moves as the joints do."""
    robot = workspace.robot
    q = np.random.default_rng(0).uniform(workspace.lower, workspace.upper, (20, robot.joints))
    points = compute_link_frames(robot.mdh, robot.chain_joint_values(q), robot.prismatic).after
    return np.asarray(np.ptp(points, axis=-1).max(axis=-1) > MAX_FIXED_POINT_TRAVEL)


def is_motion_allowed(
    motion: FourierMotion, limits: MotionLimits, check_rate_hz: float = SEARCH_COLLISION_CHECK_HZ
) -> bool:
    """Whether the arm's points are free all along a motion.  check_rate_hz: of the rows looked at
    [Hz].
    """
    return bool(
        are_poses_allowed(motion.evaluate(motion.sample_times(check_rate_hz)).q, limits).all()
    )


def draw_allowed_motion(
    limits: MotionLimits, harmonic_count: int, period: float, rng: np.random.Generator
) -> FourierMotion:
    """A random series that the arm can take.  Raises OptionError where none is found."""
    room, n = limits.workspace, len(limits.speed)
    centres = rng.uniform(room.lower, room.upper, (MAX_MOTION_CENTRES_DRAWN, n))
    k = np.arange(1.0, harmonic_count + 1.0)[:, None]  # as much speed in each harmonic
    for centre in centres[are_poses_allowed(centres, limits)][:MAX_MOTIONS_TRIED]:
        a, b = project_to_rest_at_ends(*(rng.normal(size=(2, harmonic_count, n)) / k))
        found = shrink_until_allowed(
            scale_motion_to_limits(FourierMotion(centre, a, b, period), limits), limits
        )
        if found is not None:
            return found
    raise OptionError(
        f"{room.robot.name}: no motion found that stays within the limits and the box; make "
        "volume= larger, or give floor= or joints="
    )


def shrink_until_allowed(
    motion: FourierMotion, limits: MotionLimits, check_rate_hz: float = SEARCH_COLLISION_CHECK_HZ
) -> FourierMotion | None:
    """The series, as small as it must be to be free; None where little is left of it."""
    share = 1.0
    while share > MIN_AMPLITUDE_FRACTION:
        if is_motion_allowed(motion.scale_amplitudes(share), limits, check_rate_hz):
            return motion.scale_amplitudes(share)
        share *= AMPLITUDE_SHRINK_FACTOR
    return None


def improve_motion_by_random_steps(
    motion: FourierMotion,
    limits: MotionLimits,
    objective: Callable[[FourierMotion], float],
    step_count: int,
    rng: np.random.Generator,
) -> FourierMotion:
    """A series of more worth, by random steps that become smaller [1+1 evolution]."""
    room, best, value, step = limits.workspace, motion, objective(motion), 0.3
    for _ in range(step_count):
        spread = step * max(
            float(np.abs(best.cos_coefficients).max()), float(np.abs(best.sin_coefficients).max())
        )
        k = np.arange(1.0, len(best.cos_coefficients) + 1.0)[:, None]
        a, b = (
            c + spread / k * rng.normal(size=c.shape)
            for c in (best.cos_coefficients, best.sin_coefficients)
        )
        away = 0.1 * step * (room.upper - room.lower)
        centre = best.centre + away * rng.normal(size=len(away))
        centre = np.clip(centre, room.lower, room.upper)
        tried = shrink_until_allowed(
            scale_motion_to_limits(
                FourierMotion(centre, *project_to_rest_at_ends(a, b), best.period), limits
            ),
            limits,
        )
        size = -np.inf if tried is None else objective(tried)
        if tried is not None and size > value:
            best, value, step = tried, size, min(1.3 * step, 1.0)
        else:
            step = max(0.95 * step, 0.02)
    return best
