"""Inverse kinematics: joints at which a point, or the whole flange, is where it shall be.

One search for all: damped Gauss-Newton in a box, every pose of a batch at its own pace.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import cross
from minimax_cal.robots.ranges import near_zero

STEPS = 40  # of the search, at most
STARTS = 12  # random ones, where none is given
NEAR = 1e-7  # what may remain of a pose that counts as reached, turns times the lever [m]
FLANGE = np.zeros(3)
Look = Callable[[Array, Array], tuple[Array, Array]]


def missing(
    mdh: Array,
    q: Array,
    prismatic: Array,
    turning: Array,
    goal: Array,
    lever: float,
    spot: Array = FLANGE,
) -> tuple[Array, Array]:
    """What is missing of goals (m, r) [m], turns times the lever, and its slope (m, r, n).

    q: (m, n), couplings and signs applied [rad, m].  turning: (n, n) that did so.  goal: (m, 4, 4)
    in the base [m].  lever: what a radian counts as [m]; with 0 the place alone counts, r = 3, else
    r = 6.  spot: (3,) that shall be at the goal's origin, in the last frame [m].
    """
    from scipy.spatial.transform import Rotation  # only who asks for joints waits for it

    links = kinematics.chain(mdh, q, prismatic)
    point = kinematics.points(links, spot[None])[0]
    slides = prismatic[:, None, None]
    moves = np.where(slides, links.z, cross(links.z, point - links.before))
    residual, jacobian = goal[:, :3, 3] - point.T, moves
    if lever > 0.0:
        pose = np.moveaxis(links.axes, -1, 0).swapaxes(-1, -2)
        away = Rotation.from_matrix(goal[:, :3, :3] @ np.swapaxes(pose, -1, -2)).as_rotvec()
        residual = np.concatenate([residual, lever * away], axis=1)
        jacobian = np.concatenate([moves, np.where(slides, 0.0, lever * links.z)], axis=1)
    return residual, np.moveaxis(jacobian, (2, 1), (0, 1)) @ turning


def nearest(
    look: Look,
    begin: Array,
    lower: Array,
    upper: Array,
    price: Array | None = None,
    rest: Array | None = None,
    *,
    longest: float = np.inf,
    steps: int = STEPS,
) -> Array:
    """Joints (m, n) nearest to their goals within a box: damped Gauss-Newton on all at once.

    Minimises |missing|^2 + price |change from rest|^2.  A joint at a bound that would leave is
    held; steps are cut to the box, and damped until they lower the cost.  look: of rows and joints,
    what is missing (m, r) and its slope (m, r, n).  begin, lower, upper: (m, n).  price: (m,), none
    unless given; rest: (m, n).  longest: step of a joint [rad, m].
    """
    q = np.clip(begin, lower, upper)
    price = np.zeros(len(q)) if price is None else price
    rest = q.copy() if rest is None else rest
    damping, eye = np.full(len(q), 1e-6), np.eye(q.shape[1])
    todo = np.arange(len(q))

    def at(rows: Array, here: Array) -> tuple[Array, Array, Array]:
        residual, jacobian = look(rows, here)
        cost = (residual**2).sum(1) + price[rows] * ((here - rest[rows]) ** 2).sum(1)
        return residual, jacobian, cost

    residual, jacobian, cost = at(todo, q)
    for _ in range(steps):
        here, weight = q[todo], price[todo]
        force = np.einsum("mij,mi->mj", jacobian, residual) - weight[:, None] * (here - rest[todo])
        free = ~(((here <= lower[todo]) & (force < 0)) | ((here >= upper[todo]) & (force > 0)))
        gram = np.swapaxes(jacobian, 1, 2) @ jacobian + weight[:, None, None] * eye
        scale = np.maximum(np.trace(gram, axis1=1, axis2=2) / len(eye), 1e-12)
        gram = np.where(free[:, :, None] & free[:, None, :], gram, 0.0)
        force = np.where(free, force, 0.0)
        matrix = gram + (damping[todo] * scale)[:, None, None] * eye
        step = np.linalg.solve(matrix, force[..., None])[..., 0]
        if np.isfinite(longest):
            largest = np.maximum(np.abs(step).max(axis=1), 1e-12)
            step = step * np.minimum(1.0, longest / largest)[:, None]
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


def at_poses(
    find: Callable[[Array, Array], tuple[Array, Array]],
    pose: Array,
    near: Array | None,
    lower: Array,
    upper: Array,
) -> tuple[Array, Array]:
    """Joints (..., n) at poses (..., 4, 4), and (...) what is missing [m].

    find: joints (m, n) from a start, and what is missing (m,).  near: where to start, (n,) or
    (..., n); without it from the middle of the limits, then from random joints, seeded, until the
    pose is reached.
    """
    n, batch = len(lower), pose.shape[:-2]
    goal = pose.reshape(-1, 4, 4)
    if not len(goal):  # of which older SciPy makes no rotations
        return np.zeros((*batch, n)), np.zeros(batch)
    span = near_zero(lower, upper)
    middle = np.clip(np.zeros(n), *span)
    begin = middle if near is None else np.asarray(near, dtype=float)
    q, left = find(goal, np.broadcast_to(begin, (*batch, n)).reshape(-1, n))
    rng = np.random.default_rng(0)
    for _ in range(STARTS if near is None else 0):
        todo = np.flatnonzero(left > NEAR)
        if not len(todo):
            break
        other, missed = find(goal[todo], rng.uniform(*span, (len(todo), n)))
        better = missed < left[todo]
        q[todo[better]], left[todo[better]] = other[better], missed[better]
    return q.reshape(*batch, n), left.reshape(batch)
