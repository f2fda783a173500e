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

from experiments.poses import (
    Fit,
    Found,
    adjoint,
    exp,
    gauss_newton,
    lever,
    points,
    pose_residual,
    pose_slope,
    poses_of,
    triangle,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import Chain
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import inverse, transform


def product(p: Array, side: float) -> Array:
    """Matrix of p q (side 1) or q p (side -1) for quaternions p, scalar first: (..., 4, 4)."""
    out = p[..., :1, None] * np.eye(4)
    out[..., 0, 1:], out[..., 1:, 0] = -p[..., 1:], p[..., 1:]
    out[..., 1:, 1:] += side * kinematics.hat(p[..., 1:])
    return np.asarray(out)


def closed_form(A: Array, B: Array, rounds: int = 20) -> tuple[Array, Array]:
    """X and Z with A_j X = Z B_j: rotations by quaternions, then translations.

    A, B: (m, 4, 4).  Returns two (4, 4).  q_A q_X = q_Z q_B up to sign, so that the unit
    quaternions which minimise sum |Q(q_A) q_X - W(q_B) q_Z|^2 are the leading singular vectors of
    sum Q(q_A)' W(q_B).  Signs: the turn from pose i to pose j has the same angle in A and in B, so
    (q_A,i . q_A,j) (q_B,i . q_B,j) is positive where the signs of i and j agree; its leading
    eigenvector sorts them and weighs doubtful ones little.  Later rounds take the signs that the
    answer implies.  Rotations alone must tell the frames apart: not so for an arm that turns its
    flange about one axis (SCARA), where the refinement in `place` has to bring the rest.
    """
    a, b = (Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True) for T in (A, B))
    outer = np.einsum("mi,mj->mij", a, b).reshape(-1, 16)  # its Gram matrix holds those products
    weight = np.linalg.svd(outer, full_matrices=False)[0][:, 0]
    products = np.swapaxes(product(a, 1.0), -1, -2) @ product(b, -1.0)
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
    return transform(turn_x, shift[:3]), transform(turn_z, shift[3:])


@dataclass(frozen=True, eq=False)
class Placed:
    """An arm in its place: measured pose = base FK(mdh, q) tool.

    mdh: (n, 5) [m, rad].  base: (4, 4) = Z^-1, in the instrument's frame.  tool: (4, 4) = X.
    """

    mdh: Array
    base: Array
    tool: Array

    def poses(self, q: Array, prismatic: Array) -> Array:
        """Tool in the instrument's frame: (m, 4, 4).  q: (m, n) with signs applied."""
        return np.asarray(self.base @ kinematics.forward(self.mdh, q, prismatic) @ self.tool)

    def step(self, dx: Array, links: bool) -> Placed:
        """Moved by dx: all a, d, theta, alpha, beta if links, base (its axes), tool (its axes)."""
        geometry, base, tool = np.split(dx, [len(dx) - 12, len(dx) - 6])
        mdh = self.mdh + geometry.reshape(5, -1).T if links else self.mdh
        return Placed(mdh, self.base @ exp(base), self.tool @ exp(tool))


def twists(arm: Placed, links: Chain, with_links: bool) -> Array:
    """How the tool moves with each parameter of `Placed.step`, in base axes: (m, 6, p)."""
    n, _, m = links.x.shape
    axis, moment = kinematics.screws(links)
    still = np.zeros_like(links.x)
    lengths = [np.concatenate([links.x, still], 1), np.concatenate([links.z, still], 1)]
    geometry = np.concatenate([*lengths, np.concatenate([moment, axis], axis=1)])
    flange = transform(np.moveaxis(links.axes, -1, 0).swapaxes(-1, -2), links.origin.T)
    parts = [
        np.moveaxis(geometry, -1, 0).swapaxes(-1, -2)[..., : 5 * n if with_links else 0],
        np.broadcast_to(np.eye(6), (m, 6, 6)),
        adjoint(flange @ arm.tool),
    ]
    return np.concatenate(parts, axis=-1)


def linearise(
    arm: Placed, q: Array, prismatic: Array, measured: Array, length: float, links: bool
) -> tuple[Array, Array]:
    """Residuals (6m,) [m] and their derivative (6m, p), poses compared in the base frame."""
    found = kinematics.chain(arm.mdh, q, prismatic)
    seen = inverse(arm.base) @ measured
    computed = kinematics.forward(arm.mdh, q, prismatic) @ arm.tool
    residual = pose_residual(seen, computed, length)
    slope = pose_slope(seen, computed, twists(arm, found, links), length)
    return residual.reshape(-1), slope.reshape(residual.size, -1)


def place(
    mdh: Array, q: Array, prismatic: Array, measured: Array, length: float, *, links: bool = False
) -> Found[Placed]:
    """Base and tool, and with links the geometry, that fit measured poses best.

    q: (m, n) with signs applied.  measured: (m, 4, 4).  length: of an angle's lever [m].  Starts
    from the closed form with the given geometry.  The link parameters are redundant with base,
    tool and each other (beta where axes are not parallel): see `gauss_newton` for the step taken.
    """
    X, Z = closed_form(kinematics.forward(mdh, q, prismatic), measured)
    problem = partial(
        linearise, q=q, prismatic=prismatic, measured=measured, length=length, links=links
    )
    return gauss_newton(problem, lambda arm, dx: arm.step(dx, links), Placed(mdh, inverse(Z), X))


@dataclass(frozen=True, eq=False)
class Start:
    """What pose methods start from: triangle (3, 3), measured poses (m, 4, 4), base and tool.

    length: lever that makes an angle comparable to a position [m].
    """

    shape: Array
    length: float
    measured: Array
    found: Found[Placed]


def start_of(robot: Robot, train: Measurements) -> Start:
    """Hand-eye calibration with the nominal geometry."""
    shape = triangle(train.y)
    measured, length = poses_of(shape, train.y), lever(shape)
    found = place(robot.mdh, train.q * robot.sign, robot.prismatic, measured, length)
    return Start(shape, length, measured, found)


def placed_fit(robot: Robot, shape: Array, found: Found[Placed]) -> Fit:
    """An MDH arm fitted to poses; the SMRs sit in the tool as measured on average."""
    arm, sign, prismatic = found.x, robot.sign, robot.prismatic
    return Fit(lambda q: points(arm.poses(q * sign, prismatic), shape), str(found.status))


def nominal(robot: Robot, train: Measurements) -> Fit:
    """Nominal geometry, base and tool by hand-eye calibration."""
    start = start_of(robot, train)
    return placed_fit(robot, start.shape, start.found)


def mdh_pose(robot: Robot, train: Measurements) -> Fit:
    """MDH, all parameters, fitted to measured poses."""
    start, q = start_of(robot, train), train.q * robot.sign
    found = place(robot.mdh, q, robot.prismatic, start.measured, start.length, links=True)
    return placed_fit(robot, start.shape, found)
