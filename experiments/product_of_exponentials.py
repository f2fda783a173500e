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

from experiments.hand_eye import fit_hand_eye_start
from experiments.pose_fitting import (
    GaussNewtonSolution,
    PointFit,
    adjoint_matrix,
    minimise_by_gauss_newton,
    point_jacobian,
    pose_residual_jacobian,
    pose_residuals,
    transform_points,
    twist_exponential,
)
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform, invert_transform


@dataclass(frozen=True, eq=False)
class ScrewArm:
    """An arm: twists (n, 6) of its joints [m, rad] and its tool (4, 4) at q = 0."""

    twists: Array
    tool: Array

    def tool_poses(self, q: Array) -> Array:
        """Tool in the base: (m, 4, 4).  q: (m, n) with signs applied [rad, m]."""
        return np.asarray(self.partial_products(q)[-1] @ self.tool)

    def partial_products(self, q: Array) -> Array:
        """exp(xi_1 q_1) ... exp(xi_i q_i) for i = 0 ... n: (n + 1, m, 4, 4)."""
        factors = twist_exponential(self.twists * q[..., None])
        out = np.empty((q.shape[1] + 1, len(q), 4, 4), dtype=factors.dtype)
        out[0] = np.eye(4)
        for i in range(q.shape[1]):
            out[i + 1] = out[i] @ factors[:, i]
        return out

    def move_axes_and_tool(self, dx: Array) -> ScrewArm:
        """Moved by dx (6n + 6,): every joint's axis, then the tool, by a motion exp(dx_i) each.

        xi <- Ad(exp(dx_i)) xi moves an axis as a body: it stays a pure turn, or a pure slide.
        """
        moves = twist_exponential(dx.reshape(-1, 6))
        turned = (adjoint_matrix(moves[:-1]) @ self.twists[..., None])[..., 0]
        return ScrewArm(turned, moves[-1] @ self.tool)

    def tool_twists(self, q: Array) -> Array:
        """How the tool moves with each entry of `move_axes_and_tool`: spatial twists (m, 6, 6n +
        6).

        With P_i the partial products, exp(xi_i q_i) becomes E exp(xi_i q_i) E^-1, so a motion
        E = exp(dx_i) of joint i's axis moves the tool by (Ad P_i-1 - Ad P_i) dx_i, and one of M by
        Ad P_n dx.
        """
        carried = adjoint_matrix(self.partial_products(q))
        parts = np.concatenate([carried[:-1] - carried[1:], carried[-1:]])
        return np.moveaxis(parts, 0, 2).reshape(len(q), 6, -1)


def build_screw_arm(robot: Robot, tool_pose: Array) -> ScrewArm:
    """The same arm as twists.  tool_pose: (4, 4) pose of the tool in the flange."""
    zero = np.zeros((1, robot.joints))
    links = kinematics.compute_link_frames(robot.mdh, zero, robot.prismatic)
    axis, through = links.z[..., 0], links.before[..., 0]
    turn = np.concatenate([np.cross(through, axis), axis], axis=1)
    slide = np.concatenate([axis, np.zeros_like(axis)], axis=1)
    flange = kinematics.forward_kinematics(robot.mdh, zero, robot.prismatic)[0]
    return ScrewArm(np.where(robot.prismatic[:, None], slide, turn), flange @ tool_pose)


def fit_screws_to_poses(
    start: ScrewArm, q: Array, measured_poses: Array, lever_arm: float
) -> GaussNewtonSolution[ScrewArm]:
    """Fit to measured tool poses (m, 4, 4) in the base [m], an angle weighing `lever_arm` [m].

    Of the 6n + 6 parameters 4 a turning joint, 2 a slide and 6 are independent: turning about and
    sliding along an axis leave it in place.  `minimise_by_gauss_newton` takes the least step.
    """

    def linearise(arm: ScrewArm) -> tuple[Array, Array]:
        computed = arm.tool_poses(q)
        residual = pose_residuals(measured_poses, computed, lever_arm)
        slope = pose_residual_jacobian(measured_poses, computed, arm.tool_twists(q), lever_arm)
        return residual.reshape(-1), slope.reshape(residual.size, -1)

    return minimise_by_gauss_newton(linearise, ScrewArm.move_axes_and_tool, start)


def fit_screws_to_positions(
    start: ScrewArm, q: Array, measured_positions: Array
) -> GaussNewtonSolution[ScrewArm]:
    """Fit the tool's origin to measured positions (m, 3) in the base [m].

    As `fit_screws_to_poses`, and three of the tool's six parameters (its orientation) do not show.
    """

    def linearise(arm: ScrewArm) -> tuple[Array, Array]:
        computed = arm.tool_poses(q)[:, :3, 3]
        slope = point_jacobian(computed, arm.tool_twists(q))
        return (computed - measured_positions).reshape(-1), slope.reshape(
            measured_positions.size, -1
        )

    return minimise_by_gauss_newton(linearise, ScrewArm.move_axes_and_tool, start)


def build_point_fit(
    robot: Robot, base_pose: Array, target_positions: Array, solution: GaussNewtonSolution[ScrewArm]
) -> PointFit:
    """A POE arm whose base frame stands at `base_pose`, with the SMRs at `target_positions` (3, 3)
    in its tool.
    """
    return PointFit(
        lambda q: transform_points(
            base_pose @ solution.x.tool_poses(q * robot.sign), target_positions
        ),
        str(solution.status),
    )


def fit_screws_to_measured_poses(robot: Robot, train: Measurements) -> PointFit:
    """POE fitted to measured poses, in the base frame that hand-eye calibration finds."""
    start = fit_hand_eye_start(robot, train)
    arm = start.found.x
    measured = invert_transform(arm.base) @ start.measured
    first = build_screw_arm(robot, arm.tool)
    found = fit_screws_to_poses(first, train.q * robot.sign, measured, start.length)
    return build_point_fit(robot, arm.base, start.shape, found)


def fit_screws_to_one_target(robot: Robot, train: Measurements, target_index: int) -> PointFit:
    """POE fitted to one SMR; all three then take their mean place in the moving tool."""
    start, q = fit_hand_eye_start(robot, train), train.q * robot.sign
    arm = start.found.x
    first = build_screw_arm(robot, arm.tool @ build_transform(np.eye(3), start.shape[target_index]))
    to_base = invert_transform(arm.base)
    y = train.y @ to_base[:3, :3].T + to_base[:3, 3]
    found = fit_screws_to_positions(first, q, y[:, target_index])
    back = invert_transform(found.x.tool_poses(q))
    seen = np.einsum("mij,mkj->mki", back[:, :3, :3], y) + back[:, None, :3, 3]
    return build_point_fit(robot, arm.base, seen.mean(axis=0), found)
