"""Product of exponentials: an arm as screws instead of links, and its calibration.

    T(q) = exp(xi_1 q_1) ... exp(xi_n q_n) M

with xi_i the twist of joint i and M the tool, both in the base frame at q = 0 [Brockett 1984;
Okamura and Park 1996].  Unlike Denavit-Hartenberg parameters twists do not jump when axes become
parallel.
A twist is (v, w) with w the unit axis of a turning joint, or v the unit direction of a slide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.hand_eye import start_of
from experiments.poses import (
    Fit,
    Found,
    adjoint,
    exp,
    gauss_newton,
    point_slope,
    points,
    pose_residual,
    pose_slope,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import inverse, transform


@dataclass(frozen=True, eq=False)
class Screws:
    """An arm: twists (n, 6) of its joints [m, rad] and its tool (4, 4) at q = 0."""

    twists: Array
    tool: Array

    def poses(self, q: Array) -> Array:
        """Tool in the base: (m, 4, 4).  q: (m, n) with signs applied [rad, m]."""
        return np.asarray(self.partial_products(q)[-1] @ self.tool)

    def partial_products(self, q: Array) -> Array:
        """exp(xi_1 q_1) ... exp(xi_i q_i) for i = 0 ... n: (n + 1, m, 4, 4)."""
        factors = exp(self.twists * q[..., None])
        out = np.empty((q.shape[1] + 1, len(q), 4, 4), dtype=factors.dtype)
        out[0] = np.eye(4)
        for i in range(q.shape[1]):
            out[i + 1] = out[i] @ factors[:, i]
        return out

    def step(self, dx: Array) -> Screws:
        """Moved by dx (6n + 6,): every joint's axis, then the tool, by a motion exp(dx_i) each.

        xi <- Ad(exp(dx_i)) xi moves an axis as a body: it stays a pure turn, or a pure slide.
        """
        moves = exp(dx.reshape(-1, 6))
        turned = (adjoint(moves[:-1]) @ self.twists[..., None])[..., 0]
        return Screws(turned, moves[-1] @ self.tool)

    def tool_twists(self, q: Array) -> Array:
        """How the tool moves with each entry of `step`: spatial twists (m, 6, 6n + 6).

        With P_i the partial products, exp(xi_i q_i) becomes E exp(xi_i q_i) E^-1, so a motion
        E = exp(dx_i) of joint i's axis moves the tool by (Ad P_i-1 - Ad P_i) dx_i, and one of M by
        Ad P_n dx.
        """
        carried = adjoint(self.partial_products(q))
        parts = np.concatenate([carried[:-1] - carried[1:], carried[-1:]])
        return np.moveaxis(parts, 0, 2).reshape(len(q), 6, -1)


def screws_of(robot: Robot, tool: Array) -> Screws:
    """The same arm as twists.  tool: (4, 4) pose of the tool in the flange."""
    zero = np.zeros((1, robot.joints))
    links = kinematics.chain(robot.mdh, zero, robot.prismatic)
    axis, through = links.z[..., 0], links.before[..., 0]
    turn = np.concatenate([np.cross(through, axis), axis], axis=1)
    slide = np.concatenate([axis, np.zeros_like(axis)], axis=1)
    flange = kinematics.forward(robot.mdh, zero, robot.prismatic)[0]
    return Screws(np.where(robot.prismatic[:, None], slide, turn), flange @ tool)


def fit_poses(start: Screws, q: Array, measured: Array, length: float) -> Found[Screws]:
    """Fit to measured tool poses (m, 4, 4) in the base [m], an angle weighing `length` [m].

    Of the 6n + 6 parameters 4 a turning joint, 2 a slide and 6 are independent: turning about and
    sliding along an axis leave it in place.  `gauss_newton` takes the least step.
    """

    def linearise(arm: Screws) -> tuple[Array, Array]:
        computed = arm.poses(q)
        residual = pose_residual(measured, computed, length)
        slope = pose_slope(measured, computed, arm.tool_twists(q), length)
        return residual.reshape(-1), slope.reshape(residual.size, -1)

    return gauss_newton(linearise, Screws.step, start)


def fit_positions(start: Screws, q: Array, measured: Array) -> Found[Screws]:
    """Fit the tool's origin to measured positions (m, 3) in the base [m].

    As `fit_poses`, and three of the tool's six parameters (its orientation) do not show.
    """

    def linearise(arm: Screws) -> tuple[Array, Array]:
        computed = arm.poses(q)[:, :3, 3]
        slope = point_slope(computed, arm.tool_twists(q))
        return (computed - measured).reshape(-1), slope.reshape(measured.size, -1)

    return gauss_newton(linearise, Screws.step, start)


def poe_fit(robot: Robot, base: Array, spots: Array, found: Found[Screws]) -> Fit:
    """A POE arm whose base frame stands at `base`, with the SMRs at `spots` (3, 3) in its tool."""
    return Fit(lambda q: points(base @ found.x.poses(q * robot.sign), spots), str(found.status))


def poe_pose(robot: Robot, train: Measurements) -> Fit:
    """POE fitted to measured poses, in the base frame that hand-eye calibration finds."""
    start = start_of(robot, train)
    arm = start.found.x
    measured = inverse(arm.base) @ start.measured
    first = screws_of(robot, arm.tool)
    found = fit_poses(first, train.q * robot.sign, measured, start.length)
    return poe_fit(robot, arm.base, start.shape, found)


def poe_position(robot: Robot, train: Measurements, smr: int) -> Fit:
    """POE fitted to one SMR; all three then take their mean place in the moving tool."""
    start, q = start_of(robot, train), train.q * robot.sign
    arm = start.found.x
    first = screws_of(robot, arm.tool @ transform(np.eye(3), start.shape[smr]))
    to_base = inverse(arm.base)
    y = train.y @ to_base[:3, :3].T + to_base[:3, 3]
    found = fit_positions(first, q, y[:, smr])
    back = inverse(found.x.poses(q))
    seen = np.einsum("mij,mkj->mki", back[:, :3, :3], y) + back[:, None, :3, 3]
    return poe_fit(robot, arm.base, seen.mean(axis=0), found)
