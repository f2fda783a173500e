"""Robot-world and hand-eye calibration at once, A X = Z B, and the arm with it if asked.

A is the arm's forward kinematics, X the tool in the flange, B a measured pose of the tool and Z
the instrument in the base.  A closed form by quaternions is refined by Gauss-Newton [Dornaika and
Horaud 1998, "Simultaneous robot-world and hand-eye calibration", IEEE Trans. Robotics and
Automation].  With the link parameters freed too, the same refinement is the pose calibration of an
MDH model that paper M compares with ([28] there).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.pose_fitting import (
    GaussNewtonSolution,
    PointFit,
    adjoint_matrix,
    fit_poses_to_points,
    minimise_by_gauss_newton,
    pose_residual_jacobian,
    pose_residuals,
    rotation_lever_arm,
    transform_points,
    triangle_from_distances,
    twist_exponential,
)
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import LinkFrames
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform, invert_transform


def quaternion_product_matrix(p: Array, side: float) -> Array:
    """Matrix of p q (side 1) or q p (side -1) for quaternions p, scalar first: (..., 4, 4)."""
    out = p[..., :1, None] * np.eye(4)
    out[..., 0, 1:], out[..., 1:, 0] = -p[..., 1:], p[..., 1:]
    out[..., 1:, 1:] += side * kinematics.skew_matrix(p[..., 1:])
    return np.asarray(out)


def solve_hand_eye_in_closed_form(A: Array, B: Array, rounds: int = 20) -> tuple[Array, Array]:
    """X and Z with A_j X = Z B_j: rotations by quaternions, then translations.

    A, B: (m, 4, 4).  Returns two (4, 4).  q_A q_X = q_Z q_B up to sign, so that the unit
    quaternions which minimise sum |Q(q_A) q_X - W(q_B) q_Z|^2 are the leading singular vectors of
    sum Q(q_A)' W(q_B).  Signs: the turn from pose i to pose j has the same angle in A and in B, so
    (q_A,i . q_A,j) (q_B,i . q_B,j) is positive where the signs of i and j agree; its leading
    eigenvector sorts them and weighs doubtful ones little.  Later rounds take the signs that the
    answer implies.  Rotations alone must tell the frames apart: not so for an arm that turns its
    flange about one axis (SCARA), where the refinement in `fit_base_and_tool` has to bring the
    rest.
    """
    a, b = (Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True) for T in (A, B))
    outer = np.einsum("mi,mj->mij", a, b).reshape(-1, 16)  # its Gram matrix holds those products
    weight = np.linalg.svd(outer, full_matrices=False)[0][:, 0]
    products = np.swapaxes(quaternion_product_matrix(a, 1.0), -1, -2) @ quaternion_product_matrix(
        b, -1.0
    )
    x = z = np.zeros(4)
    for _ in range(rounds):
        u, _, vt = np.linalg.svd(np.einsum("m,mij->ij", weight, products))
        x, z = u[:, 0], vt[0]
        signs = np.sign(np.einsum("i,mij,j->m", x, products, z))
        if np.array_equal(signs, weight):
            break
        weight = signs
    turn_x, turn_z = (Rotation.from_quat(q, scalar_first=True).as_matrix() for q in (x, z))
    # R_A t_X - t_Z = R_Z t_B - t_A
    rows = np.concatenate([A[:, :3, :3], np.broadcast_to(-np.eye(3), (len(A), 3, 3))], axis=-1)
    right = B[:, :3, 3] @ turn_z.T - A[:, :3, 3]
    shift = np.linalg.lstsq(rows.reshape(-1, 6), right.reshape(-1), rcond=1e-12)[0]
    return build_transform(turn_x, shift[:3]), build_transform(turn_z, shift[3:])


@dataclass(frozen=True, eq=False)
class PlacedArm:
    """An arm in its place: measured pose = base FK(mdh, q) tool.

    mdh: (n, 5) [m, rad].  base: (4, 4) = Z^-1, in the instrument's frame.  tool: (4, 4) = X.
    """

    mdh: Array
    base: Array
    tool: Array

    def tool_poses(self, q: Array, prismatic: Array) -> Array:
        """Tool in the instrument's frame: (m, 4, 4).  q: (m, n) with signs applied."""
        return np.asarray(
            self.base @ kinematics.forward_kinematics(self.mdh, q, prismatic) @ self.tool
        )

    def move_parameters(self, dx: Array, with_links: bool) -> PlacedArm:
        """Moved by dx: all a, d, theta, alpha, beta if links, base (its axes), tool (its axes)."""
        geometry, base, tool = np.split(dx, [len(dx) - 12, len(dx) - 6])
        mdh = self.mdh + geometry.reshape(5, -1).T if with_links else self.mdh
        return PlacedArm(
            mdh, self.base @ twist_exponential(base), self.tool @ twist_exponential(tool)
        )


def tool_twists(arm: PlacedArm, chain: LinkFrames, with_links: bool) -> Array:
    """How the tool moves with each parameter of `PlacedArm.move_parameters`, in base axes: (m, 6,
    p).
    """
    n, _, m = chain.x.shape
    axis, moment = kinematics.screw_axes_and_moments(chain)
    still = np.zeros_like(chain.x)
    lengths = [np.concatenate([chain.x, still], 1), np.concatenate([chain.z, still], 1)]
    geometry = np.concatenate([*lengths, np.concatenate([moment, axis], axis=1)])
    flange = build_transform(np.moveaxis(chain.axes, -1, 0).swapaxes(-1, -2), chain.origin.T)
    parts = [
        np.moveaxis(geometry, -1, 0).swapaxes(-1, -2)[..., : 5 * n if with_links else 0],
        np.broadcast_to(np.eye(6), (m, 6, 6)),
        adjoint_matrix(flange @ arm.tool),
    ]
    return np.concatenate(parts, axis=-1)


def linearise_pose_residuals(
    arm: PlacedArm,
    q: Array,
    prismatic: Array,
    measured_poses: Array,
    lever_arm: float,
    with_links: bool,
) -> tuple[Array, Array]:
    """Residuals (6m,) [m] and their derivative (6m, p), poses compared in the base frame."""
    found = kinematics.compute_link_frames(arm.mdh, q, prismatic)
    seen = invert_transform(arm.base) @ measured_poses
    computed = kinematics.forward_kinematics(arm.mdh, q, prismatic) @ arm.tool
    residual = pose_residuals(seen, computed, lever_arm)
    slope = pose_residual_jacobian(seen, computed, tool_twists(arm, found, with_links), lever_arm)
    return residual.reshape(-1), slope.reshape(residual.size, -1)


def fit_base_and_tool(
    mdh: Array,
    q: Array,
    prismatic: Array,
    measured_poses: Array,
    lever_arm: float,
    *,
    with_links: bool = False,
) -> GaussNewtonSolution[PlacedArm]:
    """Base and tool, and with links the geometry, that fit measured poses best.

    q: (m, n) with signs applied.  measured_poses: (m, 4, 4).  lever_arm: of an angle's lever [m].
    Starts from the closed form with the given geometry.  The link parameters are redundant with
    base, tool and each other (beta where axes are not parallel): see `minimise_by_gauss_newton` for
    the step taken.
    """
    X, Z = solve_hand_eye_in_closed_form(
        kinematics.forward_kinematics(mdh, q, prismatic), measured_poses
    )
    problem = partial(
        linearise_pose_residuals,
        q=q,
        prismatic=prismatic,
        measured_poses=measured_poses,
        lever_arm=lever_arm,
        with_links=with_links,
    )
    return minimise_by_gauss_newton(
        problem,
        lambda arm, dx: arm.move_parameters(dx, with_links),
        PlacedArm(mdh, invert_transform(Z), X),
    )


@dataclass(frozen=True, eq=False)
class HandEyeStart:
    """What pose methods start from: triangle (3, 3), measured poses (m, 4, 4), base and tool.

    length: lever that makes an angle comparable to a position [m].
    """

    shape: Array
    length: float
    measured: Array
    found: GaussNewtonSolution[PlacedArm]


def fit_hand_eye_start(robot: Robot, train: Measurements) -> HandEyeStart:
    """Hand-eye calibration with the nominal geometry."""
    shape = triangle_from_distances(train.y)
    measured, length = fit_poses_to_points(shape, train.y), rotation_lever_arm(shape)
    found = fit_base_and_tool(robot.mdh, train.q * robot.sign, robot.prismatic, measured, length)
    return HandEyeStart(shape, length, measured, found)


def build_point_fit(
    robot: Robot, triangle_points: Array, solution: GaussNewtonSolution[PlacedArm]
) -> PointFit:
    """An MDH arm fitted to poses; the SMRs sit in the tool as measured on average."""
    arm, sign, prismatic = solution.x, robot.sign, robot.prismatic
    return PointFit(
        lambda q: transform_points(arm.tool_poses(q * sign, prismatic), triangle_points),
        str(solution.status),
    )


def fit_nominal_arm(robot: Robot, train: Measurements) -> PointFit:
    """Nominal geometry, base and tool by hand-eye calibration."""
    start = fit_hand_eye_start(robot, train)
    return build_point_fit(robot, start.shape, start.found)


def fit_mdh_to_poses(robot: Robot, train: Measurements) -> PointFit:
    """MDH, all parameters, fitted to measured poses."""
    start, q = fit_hand_eye_start(robot, train), train.q * robot.sign
    found = fit_base_and_tool(
        robot.mdh, q, robot.prismatic, start.measured, start.length, with_links=True
    )
    return build_point_fit(robot, start.shape, found)
