"""Joints that bring an arm, effects included, to goals along a path; how each goal ended."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.ground.arrays import Array, rms
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.robots import kinematics
from minimax_cal.robots.inverse import NEAR, at_poses, missing, nearest

SLIDE = 0.5  # metres a slide may change by where a turning joint may by a radian [m/rad]
MAX_PASSES, FREE_PASSES = 12, 6  # over the effects; those until sides are kept
JOINT_TOLERANCE = 1e-10  # change of a joint that no pass need follow [rad, m]
TETRAHEDRON = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
CORNERS = tuple(f"corner{i + 1}" for i in range(4))
LEAST_LEVER, USUAL_LEVER = 0.02, 0.1  # a tool of no size says nothing of what a radian is worth [m]
SOFT = 0.01  # of the lever: what a radian of change costs where the goal is out of reach anyway


class Outcome(StrEnum):
    """How a target ended."""

    REACHED = "reached"
    CLOSEST = "closest"
    LIMIT = "limit"
    CHANGE = "change"
    SINGULAR = "singular"
    STALLED = "stalled"

    @property
    def failed(self) -> bool:
        """Whether the target is missed though the arm has the joints for it."""
        return self not in (Outcome.REACHED, Outcome.CLOSEST)

    @property
    def advice(self) -> str:
        """What it means, and what to try."""
        return ADVICE[self]


ADVICE = {
    Outcome.REACHED: "within the tolerance",
    Outcome.CLOSEST: "the arm has fewer than six joints: what remains no joint can correct",
    Outcome.LIMIT: "a joint limit is in the way: move the target inwards, or check lower and upper "
    "in the robot file",
    Outcome.CHANGE: "a joint would have to change by more than allowed: raise the largest change, "
    "or move the target away from a singular pose",
    Outcome.SINGULAR: "a singular pose or the edge of the workspace: move the target a little",
    Outcome.STALLED: "no joints were found that hold for this path: play in the gears may pull "
    "both ways (go there by a point before it, or give columns approach1 ...)",
}


def seen(pose: Array, spots: Array) -> Array:
    """Points of the flange: (m, k, 3).  pose: (m, 4, 4).  spots: (k, 3) [m]."""
    turned = np.einsum("mij,kj->mki", pose[:, :3, :3], spots)
    return np.asarray(turned + pose[:, None, :3, 3])


def motion(before: Array, after: Array) -> Array:
    """The rigid motion that takes points nearest to others: (..., 4, 4), by the least turn.

    before, after: (..., k, 3) [m].  Newton on the turn: what a line or a point does not tell is 0.
    """
    centre, end = before.mean(axis=-2, keepdims=True), after.mean(axis=-2, keepdims=True)
    arm, aim = before - centre, after - end
    out = np.zeros((*before.shape[:-2], 4, 4))
    out[..., 3, 3] = 1.0
    out[..., :3, :3] = np.eye(3)
    for _ in range(6):
        here = arm @ np.swapaxes(out[..., :3, :3], -1, -2)
        inertia = np.eye(3) * np.square(here).sum((-1, -2))[..., None, None]
        inertia = inertia - np.swapaxes(here, -1, -2) @ here
        torque = np.cross(here, aim).sum(axis=-2)
        inverse = np.linalg.pinv(inertia, rcond=1e-3, hermitian=True)
        turn = (inverse @ torque[..., None])[..., 0]
        out[..., :3, :3] = kinematics.rotation(turn) @ out[..., :3, :3]
        if np.abs(turn).max(initial=0.0) < 1e-14:
            break
    shift = end - centre @ np.swapaxes(out[..., :3, :3], -1, -2)
    out[..., :3, 3] = shift[..., 0, :]
    return out


def bent(arm: Cell, data: Measurements) -> tuple[Array, Array]:
    """What effects do at commanded joints: turns of the joints, and motion of the flange besides.

    Returns (m, n), signs applied [rad, m], and (m, 4, 4) in the base, from the left [m].
    """
    turn = np.zeros((data.poses, arm.robot.joints))
    still_there = np.broadcast_to(np.eye(4), (data.poses, 4, 4))
    if not arm.effects.terms:
        return turn, still_there
    scene = arm.scene(data)
    turn, shift = arm.effects.turn(scene), arm.effects.shift(scene)
    if not shift.any():
        return turn, still_there
    mdh, prismatic = arm.robot.mdh, arm.robot.prismatic
    before = seen(kinematics.forward(mdh, scene.angles.T + turn, prismatic), arm.target_positions)
    return turn, motion(before, before + np.moveaxis(shift, -1, 0))


@dataclass(frozen=True, eq=False)
class Reach:
    """The search for joints of an arm at goals along a path.

    data: commanded joints (m, n) and columns.  goal: (m, 4, 4) of the flange in the base [m].
    """

    arm: Cell
    data: Measurements
    goal: Array
    lever: float
    tolerance: float
    most_change: float

    @property
    def start(self) -> Array:
        """(m, n) the commanded joints, within the limits."""
        return np.clip(self.data.q, self.arm.robot.lower, self.arm.robot.upper)

    @property
    def box(self) -> tuple[Array, Array]:
        """Least and largest joints that are allowed: (m, n) each."""
        robot = self.arm.robot
        room = self.most_change * np.where(robot.prismatic, SLIDE, 1.0)
        return np.maximum(robot.lower, self.start - room), np.minimum(
            robot.upper, self.start + room
        )

    def at(self, q: Array) -> Measurements:
        """The path through other joints: history follows from them, given columns stay."""
        return replace(self.data, q=q)

    def error(self, q: Array) -> tuple[Array, Array]:
        """How far the flange is from its goal: (m,) [m] and (m,) [rad], the way there counted."""
        turn, moved = bent(self.arm, self.at(q))
        robot = self.arm.robot
        pose = moved @ kinematics.forward(robot.mdh, robot.turned(q) + turn, robot.prismatic)
        apart = np.swapaxes(pose[:, :3, :3], -1, -2) @ self.goal[:, :3, :3]
        angle = np.linalg.norm(Rotation.from_matrix(apart).as_rotvec(), axis=1)
        return np.linalg.norm(pose[:, :3, 3] - self.goal[:, :3, 3], axis=1), angle

    def good(self, q: Array) -> Array:
        """(m,) True where the goal is reached."""
        distance, angle = self.error(q)
        return (distance <= self.tolerance) & (self.lever * angle <= self.tolerance)

    def best(self) -> tuple[Array, tuple[Outcome, ...]]:
        """Corrected joints, and how each target ended.

        Goals that cannot be reached are sought again with a price on change: the arm then does
        not swing far for next to nothing.
        """
        q, settled = self.settle(self.start, np.zeros(len(self.goal)))
        good = self.good(q)
        if not good.all():
            begin = np.where(good[:, None], q, self.start)
            q, settled = self.settle(begin, np.where(good, 0.0, SOFT))
            good = self.good(q)
        return q, self.outcomes(q, good, settled)

    def settle(self, q: Array, soft: Array) -> tuple[Array, Array]:
        """Joints that agree with the effects they cause, and (m,) True where they do.

        Effects are taken from the joints before and kept while Newton reaches the goals.
        """
        data = self.at(q)
        for count in range(MAX_PASSES):
            turn, moved = bent(self.arm, data)
            goal = np.linalg.inv(moved) @ self.goal
            new = self.nearest(q, goal, turn, soft)
            change = np.abs(new - q).max(axis=1)
            q = new
            if not self.arm.effects.terms:
                return q, np.ones(len(q), dtype=bool)
            kept = data.columns if count >= FREE_PASSES else self.data.columns
            data = replace(self.at(q), columns=kept)
            if count + 1 == FREE_PASSES:  # play that pulls both ways: decide on a side
                history = with_history(data).columns
                sides = {name: c for name, c in history.items() if name.startswith("approach")}
                data = replace(data, columns={**data.columns, **sides})
            if change.max() < JOINT_TOLERANCE:
                break
        walked, _ = bent(self.arm, self.at(q))
        agree = np.abs(walked - turn).max(axis=1) < 1e4 * JOINT_TOLERANCE
        return q, agree & (change < 1e4 * JOINT_TOLERANCE)

    def nearest(self, begin: Array, goal: Array, turn: Array, soft: Array) -> Array:
        """Joints (m, n) nearest to goals for effects that turn the joints by turn (m, n).

        soft: (m,) price of change, relative to the lever.
        """

        def look(rows: Array, q: Array) -> tuple[Array, Array]:
            return self.missing(q, goal[rows], turn[rows])

        price = (soft * self.lever) ** 2
        return nearest(look, begin, *self.box, price, self.start)

    def missing(self, q: Array, goal: Array, turn: Array) -> tuple[Array, Array]:
        """What is missing of goals, and its slope, as `inverse.missing` has them."""
        robot = self.arm.robot
        moved = robot.turned(q) + turn
        return missing(robot.mdh, moved, robot.prismatic, robot.turning, goal, self.lever)

    def outcomes(self, q: Array, good: Array, settled: Array) -> tuple[Outcome, ...]:
        """How each target ended."""
        turn, moved = bent(self.arm, self.at(q))
        robot, (lower, upper) = self.arm.robot, self.box
        goal = np.linalg.inv(moved) @ self.goal
        residual, jacobian = self.missing(q, goal, turn)
        force = np.einsum("mij,mi->mj", jacobian, residual)
        size = np.linalg.norm(jacobian, axis=1) * np.linalg.norm(residual, axis=1)[:, None]
        down, up = force < -1e-2 * size, force > 1e-2 * size
        limit = ((q <= robot.lower) & down) | ((q >= robot.upper) & up)
        bound = ((q <= lower) & down) | ((q >= upper) & up)
        singular = np.linalg.svd(jacobian, compute_uv=False)
        whole = singular[:, -1] > 1e-2 * singular[:, 0]
        out = []
        for i in range(len(q)):
            if good[i]:
                out.append(Outcome.REACHED)
            elif limit[i].any():
                out.append(Outcome.LIMIT)
            elif bound[i].any():
                out.append(Outcome.CHANGE)
            elif not settled[i]:
                out.append(Outcome.STALLED)
            elif robot.joints < 6 and whole[i]:
                out.append(Outcome.CLOSEST)
            else:
                out.append(Outcome.SINGULAR)
        return tuple(out)


def flange_terms(cell: Cell) -> tuple[Term, ...]:
    """The effects of a cell that move its flange, and not only what is seen of it."""
    return tuple(
        term
        for term in cell.effects.terms
        if EFFECTS[term.effect].of_flange and term.place not in cell.target_names
    )


def arm_of(cell: Cell) -> Cell:
    """The calibrated arm in its own base, seen by four points about its targets' centre.

    They tell the flange's pose.  Of the effects those that move the flange.
    """
    middle = cell.target_positions.mean(axis=0) if len(cell.target_positions) else np.zeros(3)
    moving = flange_terms(cell)
    return replace(
        cell,
        target_names=CORNERS,
        target_positions=middle + USUAL_LEVER * TETRAHEDRON,
        effects=cell.effects.where(moving.__contains__),
    )


def lever_of(cell: Cell) -> float:
    """What a radian counts as with the targets of a cell [m]."""
    away = np.linalg.norm(cell.target_positions, axis=1)
    own = rms(away) if len(away) else 0.0
    return own if own > LEAST_LEVER else USUAL_LEVER


def joints_at(cell: Cell, pose: Array, near: Array | None = None) -> tuple[Array, Array]:
    """Joints (..., n) that bring the flange of an arm at rest to poses, and (...) what is missing.

    Effects count that move the flange.  Arguments as `Cell.inverse`.
    """
    arm, lever = arm_of(cell), lever_of(cell)

    def find(goal: Array, begin: Array) -> tuple[Array, Array]:
        data = still(begin, arm.target_names, arm.robot)
        reach = Reach(arm, data, goal, lever, NEAR, np.inf)
        q, _ = reach.settle(reach.start, np.zeros(len(goal)))
        distance, angle = reach.error(q)
        return q, np.maximum(distance, lever * angle)

    return at_poses(find, pose, near, cell.robot.lower, cell.robot.upper)
