"""Inverse kinematics: joints at which a point, or the whole flange, is where it shall be.

One search for all: damped Gauss-Newton in a box, every pose of a batch at its own pace.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.robots import kinematics
from minimax_cal.robots.joint_ranges import clip_range_near_zero
from minimax_cal.robots.kinematics import cross

MAX_INVERSE_STEPS = 40  # of the search, at most
RANDOM_INVERSE_STARTS = 12  # random ones, where none is given
MAX_REACHED_RESIDUAL = (
    1e-7  # what may remain of a pose that counts as reached, turns times the lever [m]
)
FLANGE_ORIGIN = np.zeros(3)
ResidualAndJacobian = Callable[[Array, Array], tuple[Array, Array]]


class PoseResidual(NamedTuple):
    """What is missing of goal poses (m, r) [m], and its derivatives (m, r, n) by the joints."""

    residual: Array
    jacobian: Array


def pose_residual_and_jacobian(
    mdh: Array,
    q: Array,
    prismatic: Array,
    joint_to_chain: Array,
    goal_poses: Array,
    rotation_lever: float,
    tool_point: Array = FLANGE_ORIGIN,
) -> PoseResidual:
    """What is missing of goals (m, r) [m], turns times the lever, and its slope (m, r, n).

    q: (m, n), couplings and signs applied [rad, m].  joint_to_chain: (n, n) that did so.
    goal_poses: (m, 4, 4) in the base [m].  rotation_lever: what a radian counts as [m]; with 0 the
    place alone counts, r = 3, else r = 6.  tool_point: (3,) that shall be at the goal's origin, in
    the last frame [m].
    """
    from scipy.spatial.transform import Rotation  # only who asks for joints waits for it

    links = kinematics.compute_link_frames(mdh, q, prismatic)
    point = kinematics.targets_in_base(links, tool_point[None])[0]
    slides = prismatic[:, None, None]
    moves = np.where(slides, links.z, cross(links.z, point - links.before))
    residual, jacobian = goal_poses[:, :3, 3] - point.T, moves
    if rotation_lever > 0.0:
        pose = np.moveaxis(links.axes, -1, 0).swapaxes(-1, -2)
        away = Rotation.from_matrix(goal_poses[:, :3, :3] @ np.swapaxes(pose, -1, -2)).as_rotvec()
        residual = np.concatenate([residual, rotation_lever * away], axis=1)
        jacobian = np.concatenate([moves, np.where(slides, 0.0, rotation_lever * links.z)], axis=1)
    return PoseResidual(residual, np.moveaxis(jacobian, (2, 1), (0, 1)) @ joint_to_chain)


def solve_nearest_joints(
    residual_and_jacobian: ResidualAndJacobian,
    start_joints: Array,
    lower: Array,
    upper: Array,
    rest_weight: Array | None = None,
    rest_joints: Array | None = None,
    *,
    max_joint_step: float = np.inf,
    max_steps: int = MAX_INVERSE_STEPS,
) -> Array:
    """Joints (m, n) nearest to their goals within a box: damped Gauss-Newton on all at once.

    Minimises |missing|^2 + price |change from rest|^2.  A joint at a bound that would leave is
    held; steps are cut to the box, and damped until they lower the cost.  residual_and_jacobian: of
    rows and joints, what is missing (m, r) and its slope (m, r, n).  start_joints, lower, upper:
    (m, n).  rest_weight: (m,), none unless given; rest_joints: (m, n).  max_joint_step: step of a
    joint [rad, m].
    """
    q = np.clip(start_joints, lower, upper)
    rest_weight = np.zeros(len(q)) if rest_weight is None else rest_weight
    rest_joints = q.copy() if rest_joints is None else rest_joints
    damping, eye = np.full(len(q), 1e-6), np.eye(q.shape[1])
    todo = np.arange(len(q))

    def at(rows: Array, here: Array) -> tuple[Array, Array, Array]:
        residual, jacobian = residual_and_jacobian(rows, here)
        cost = (residual**2).sum(1) + rest_weight[rows] * ((here - rest_joints[rows]) ** 2).sum(1)
        return residual, jacobian, cost

    residual, jacobian, cost = at(todo, q)
    for _ in range(max_steps):
        here, weight = q[todo], rest_weight[todo]
        force = np.einsum("mij,mi->mj", jacobian, residual) - weight[:, None] * (
            here - rest_joints[todo]
        )
        free = ~(((here <= lower[todo]) & (force < 0)) | ((here >= upper[todo]) & (force > 0)))
        gram = np.swapaxes(jacobian, 1, 2) @ jacobian + weight[:, None, None] * eye
        scale = np.maximum(np.trace(gram, axis1=1, axis2=2) / len(eye), 1e-12)
        gram = np.where(free[:, :, None] & free[:, None, :], gram, 0.0)
        force = np.where(free, force, 0.0)
        matrix = gram + (damping[todo] * scale)[:, None, None] * eye
        step = np.linalg.solve(matrix, force[..., None])[..., 0]
        if np.isfinite(max_joint_step):
            largest = np.maximum(np.abs(step).max(axis=1), 1e-12)
            step = step * np.minimum(1.0, max_joint_step / largest)[:, None]
        trial = np.clip(here + step, lower[todo], upper[todo])
        step = trial - here
        gain = 2.0 * (force * step).sum(1) - np.einsum("mi,mij,mj->m", step, gram, step)
        done = (np.abs(step).max(1) < 1e-13) | (np.abs(gain) <= 1e-12 * cost + 1e-28)
        new_residual, new_slope, new_cost = at(todo, trial)
        better = new_cost < cost
        q[todo[better]] = trial[better]
        pick = better[:, None]
        residual = np.where(pick, new_residual, residual)
        jacobian = np.where(pick[..., None], new_slope, jacobian)
        cost = np.where(better, new_cost, cost)
        damping[todo] = np.clip(damping[todo] * np.where(better, 0.1, 10.0), 1e-12, 1e9)
        todo, residual, jacobian, cost = (part[~done] for part in (todo, residual, jacobian, cost))
        if not len(todo):
            break
    return q


class InverseSolution(NamedTuple):
    """Joint values (..., n) [rad, m], and what is missing of each goal (...) [m]."""

    joint_values: Array
    missing_lengths: Array


def solve_joints_with_restarts(
    solve_from_start: Callable[[Array, Array], tuple[Array, Array]],
    goal_poses: Array,
    near_joints: Array | None,
    lower: Array,
    upper: Array,
) -> InverseSolution:
    """Joints (..., n) at poses (..., 4, 4), and (...) what is missing [m].

    solve_from_start: joints (m, n) from a start, and what is missing (m,).  near_joints: where to
    start, (n,) or (..., n); without it from the middle of the limits, then from random joints,
    seeded, until the pose is reached.
    """
    n, batch = len(lower), goal_poses.shape[:-2]
    goal = goal_poses.reshape(-1, 4, 4)
    if not len(goal):  # of which older SciPy makes no rotations
        return InverseSolution(np.zeros((*batch, n)), np.zeros(batch))
    span = clip_range_near_zero(lower, upper)
    middle = np.clip(np.zeros(n), *span)
    begin = middle if near_joints is None else np.asarray(near_joints, dtype=float)
    q, left = solve_from_start(goal, np.broadcast_to(begin, (*batch, n)).reshape(-1, n))
    rng = np.random.default_rng(0)
    for _ in range(RANDOM_INVERSE_STARTS if near_joints is None else 0):
        todo = np.flatnonzero(left > MAX_REACHED_RESIDUAL)
        if not len(todo):
            break
        other, missed = solve_from_start(goal[todo], rng.uniform(*span, (len(todo), n)))
        better = missed < left[todo]
        q[todo[better]], left[todo[better]] = other[better], missed[better]
    return InverseSolution(q.reshape(*batch, n), left.reshape(batch))
