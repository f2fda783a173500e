"""Joints that bring an arm, effects included, to goals along a path; how each goal ended."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.core.arrays import Array, rms
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.robots import kinematics
from minimax_cal.robots.inverse_kinematics import (
    MAX_REACHED_RESIDUAL,
    pose_residual_and_jacobian,
    solve_joints_with_restarts,
    solve_nearest_joints,
)
from minimax_cal.robots.joint_ranges import JointBounds

SLIDE_METRES_PER_RADIAN = (
    0.5  # metres a slide may change by where a turning joint may by a radian [m/rad]
)
MAX_EFFECT_PASSES, PASSES_BEFORE_FIXED_SIDES = 12, 6  # over the effects; those until sides are kept
MIN_JOINT_CHANGE = 1e-10  # change of a joint that no pass need follow [rad, m]
TETRAHEDRON_CORNERS = np.array(
    [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]
)
CORNER_TARGET_NAMES = tuple(f"corner{i + 1}" for i in range(4))
MIN_TOOL_LEVER, DEFAULT_TOOL_LEVER = (
    0.02,
    0.1,
)  # a tool of no size says nothing of what a radian is worth [m]
CHANGE_WEIGHT_PER_LEVER = (
    0.01  # of the lever: what a radian of change costs where the goal is out of reach anyway
)


class InverseOutcome(StrEnum):
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
        return self not in (InverseOutcome.REACHED, InverseOutcome.CLOSEST)

    @property
    def advice(self) -> str:
        """What it means, and what to try."""
        return ADVICE_BY_INVERSE_OUTCOME[self]


ADVICE_BY_INVERSE_OUTCOME = {
    InverseOutcome.REACHED: "within the tolerance",
    InverseOutcome.CLOSEST: "the arm has fewer than six joints: what remains no joint can correct",
    InverseOutcome.LIMIT: "a joint limit is in the way: move the target "
    "inwards, or check lower and upper "
    "in the robot file",
    InverseOutcome.CHANGE: "a joint would have to change by more than "
    "allowed: raise the largest change, "
    "or move the target away from a singular pose",
    InverseOutcome.SINGULAR: (
        "a singular pose or the edge of the workspace: move the target a little"
    ),
    InverseOutcome.STALLED: "no joints were found that hold for this "
    "path: play in the gears may pull "
    "both ways (go there by a point before it, or give columns approach1 ...)",
}


def flange_points_in_base(poses: Array, flange_points: Array) -> Array:
    """Points of the flange: (m, k, 3).  poses: (m, 4, 4).  flange_points: (k, 3) [m]."""
    turned = np.einsum("mij,kj->mki", poses[:, :3, :3], flange_points)
    return np.asarray(turned + poses[:, None, :3, 3])


def fit_rigid_motions(points_before: Array, points_after: Array) -> Array:
    """The rigid motion that takes points nearest to others: (..., 4, 4), by the least turn.

    points_before, points_after: (..., k, 3) [m].  Newton on the turn: what a line or a point does
    not tell is 0.
    """
    centre, end = (
        points_before.mean(axis=-2, keepdims=True),
        points_after.mean(axis=-2, keepdims=True),
    )
    arm, aim = points_before - centre, points_after - end
    out = np.zeros((*points_before.shape[:-2], 4, 4))
    out[..., 3, 3] = 1.0
    out[..., :3, :3] = np.eye(3)
    for _ in range(6):
        here = arm @ np.swapaxes(out[..., :3, :3], -1, -2)
        inertia = np.eye(3) * np.square(here).sum((-1, -2))[..., None, None]
        inertia = inertia - np.swapaxes(here, -1, -2) @ here
        torque = np.cross(here, aim).sum(axis=-2)
        inverse = np.linalg.pinv(inertia, rcond=1e-3, hermitian=True)
        turn = (inverse @ torque[..., None])[..., 0]
        out[..., :3, :3] = kinematics.rotation_from_vector(turn) @ out[..., :3, :3]
        if np.abs(turn).max(initial=0.0) < 1e-14:
            break
    shift = end - centre @ np.swapaxes(out[..., :3, :3], -1, -2)
    out[..., :3, 3] = shift[..., 0, :]
    return out


def effect_joint_shifts_and_flange_motions(cell: Cell, data: Measurements) -> tuple[Array, Array]:
    """What effects do at commanded joints: turns of the joints, and motion of the flange besides.

    Returns (m, n), signs applied [rad, m], and (m, 4, 4) in the base, from the left [m].
    """
    turn = np.zeros((data.poses, cell.robot.joints))
    still_there = np.broadcast_to(np.eye(4), (data.poses, 4, 4))
    if not cell.effects.terms:
        return turn, still_there
    scene = cell.pose_arm(data)
    turn, shift = cell.effects.joint_shifts(scene), cell.effects.target_shifts(scene)
    if not shift.any():
        return turn, still_there
    mdh, prismatic = cell.robot.mdh, cell.robot.prismatic
    before = flange_points_in_base(
        kinematics.forward_kinematics(mdh, scene.angles.T + turn, prismatic), cell.target_positions
    )
    return turn, fit_rigid_motions(before, before + np.moveaxis(shift, -1, 0))


class JointsAndOutcomes(NamedTuple):
    """Corrected joint values (m, n), and how each target ended."""

    q: Array
    outcomes: tuple[InverseOutcome, ...]


class ConsistentJoints(NamedTuple):
    """Joint values (m, n), and (m,) True where they agree with the effects that they cause."""

    q: Array
    is_consistent: Array


@dataclass(frozen=True, eq=False)
class InverseProblem:
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
    def start_joints(self) -> Array:
        """(m, n) the commanded joints, within the limits."""
        return np.clip(self.data.q, self.arm.robot.lower, self.arm.robot.upper)

    @property
    def joint_bounds(self) -> JointBounds:
        """Least and largest joints that are allowed: (m, n) each."""
        robot = self.arm.robot
        room = self.most_change * np.where(robot.prismatic, SLIDE_METRES_PER_RADIAN, 1.0)
        return JointBounds(
            np.maximum(robot.lower, self.start_joints - room),
            np.minimum(robot.upper, self.start_joints + room),
        )

    def data_at_joints(self, q: Array) -> Measurements:
        """The path through other joints: history follows from them, given columns stay."""
        return replace(self.data, q=q)

    def position_and_angle_errors(self, q: Array) -> tuple[Array, Array]:
        """How far the flange is from its goal: (m,) [m] and (m,) [rad], the way there counted."""
        turn, moved = effect_joint_shifts_and_flange_motions(self.arm, self.data_at_joints(q))
        robot = self.arm.robot
        pose = moved @ kinematics.forward_kinematics(
            robot.mdh, robot.chain_joint_values(q) + turn, robot.prismatic
        )
        apart = np.swapaxes(pose[:, :3, :3], -1, -2) @ self.goal[:, :3, :3]
        angle = np.linalg.norm(Rotation.from_matrix(apart).as_rotvec(), axis=1)
        return np.linalg.norm(pose[:, :3, 3] - self.goal[:, :3, 3], axis=1), angle

    def reached_mask(self, q: Array) -> Array:
        """(m,) True where the goal is reached."""
        distance, angle = self.position_and_angle_errors(q)
        return (distance <= self.tolerance) & (self.lever * angle <= self.tolerance)

    def solve(self) -> JointsAndOutcomes:
        """Corrected joints, and how each target ended.

        Goals that cannot be reached are sought again with a price on change: the arm then does
        not swing far for next to nothing.
        """
        q, settled = self.solve_consistent_with_effects(self.start_joints, np.zeros(len(self.goal)))
        good = self.reached_mask(q)
        if not good.all():
            begin = np.where(good[:, None], q, self.start_joints)
            q, settled = self.solve_consistent_with_effects(
                begin, np.where(good, 0.0, CHANGE_WEIGHT_PER_LEVER)
            )
            good = self.reached_mask(q)
        return JointsAndOutcomes(q, self.classify_outcomes(q, good, settled))

    def solve_consistent_with_effects(self, q: Array, change_weights: Array) -> ConsistentJoints:
        """Joints that agree with the effects they cause, and (m,) True where they do.

        Effects are taken from the joints before and kept while Newton reaches the goals.
        """
        data = self.data_at_joints(q)
        for count in range(MAX_EFFECT_PASSES):
            turn, moved = effect_joint_shifts_and_flange_motions(self.arm, data)
            goal = np.linalg.inv(moved) @ self.goal
            new = self.solve_for_fixed_effects(q, goal, turn, change_weights)
            change = np.abs(new - q).max(axis=1)
            q = new
            if not self.arm.effects.terms:
                return ConsistentJoints(q, np.ones(len(q), dtype=bool))
            kept = data.columns if count >= PASSES_BEFORE_FIXED_SIDES else self.data.columns
            data = replace(self.data_at_joints(q), columns=kept)
            if (
                count + 1 == PASSES_BEFORE_FIXED_SIDES
            ):  # play that pulls both ways: decide on a side
                history = add_history_columns(data).columns
                sides = {name: c for name, c in history.items() if name.startswith("approach")}
                data = replace(data, columns={**data.columns, **sides})
            if change.max() < MIN_JOINT_CHANGE:
                break
        walked, _ = effect_joint_shifts_and_flange_motions(self.arm, self.data_at_joints(q))
        agree = np.abs(walked - turn).max(axis=1) < 1e4 * MIN_JOINT_CHANGE
        return ConsistentJoints(q, agree & (change < 1e4 * MIN_JOINT_CHANGE))

    def solve_for_fixed_effects(
        self, start: Array, goal_poses: Array, joint_shifts: Array, change_weights: Array
    ) -> Array:
        """Joints (m, n) nearest to goals for effects that turn the joints by turn (m, n).

        change_weights: (m,) price of change, relative to the lever.
        """

        def look(rows: Array, q: Array) -> tuple[Array, Array]:
            return self.residual_and_jacobian(q, goal_poses[rows], joint_shifts[rows])

        price = (change_weights * self.lever) ** 2
        return solve_nearest_joints(look, start, *self.joint_bounds, price, self.start_joints)

    def residual_and_jacobian(
        self, q: Array, goal_poses: Array, joint_shifts: Array
    ) -> tuple[Array, Array]:
        """What is missing of goals, and its slope, as `inverse.missing` has them."""
        robot = self.arm.robot
        moved = robot.chain_joint_values(q) + joint_shifts
        return pose_residual_and_jacobian(
            robot.mdh, moved, robot.prismatic, robot.joint_to_chain_matrix, goal_poses, self.lever
        )

    def classify_outcomes(
        self, q: Array, reached: Array, settled: Array
    ) -> tuple[InverseOutcome, ...]:
        """How each target ended."""
        turn, moved = effect_joint_shifts_and_flange_motions(self.arm, self.data_at_joints(q))
        robot, (lower, upper) = self.arm.robot, self.joint_bounds
        goal = np.linalg.inv(moved) @ self.goal
        residual, jacobian = self.residual_and_jacobian(q, goal, turn)
        force = np.einsum("mij,mi->mj", jacobian, residual)
        size = np.linalg.norm(jacobian, axis=1) * np.linalg.norm(residual, axis=1)[:, None]
        down, up = force < -1e-2 * size, force > 1e-2 * size
        limit = ((q <= robot.lower) & down) | ((q >= robot.upper) & up)
        bound = ((q <= lower) & down) | ((q >= upper) & up)
        singular = np.linalg.svd(jacobian, compute_uv=False)
        whole = singular[:, -1] > 1e-2 * singular[:, 0]
        out = []
        for i in range(len(q)):
            if reached[i]:
                out.append(InverseOutcome.REACHED)
            elif limit[i].any():
                out.append(InverseOutcome.LIMIT)
            elif bound[i].any():
                out.append(InverseOutcome.CHANGE)
            elif not settled[i]:
                out.append(InverseOutcome.STALLED)
            elif robot.joints < 6 and whole[i]:
                out.append(InverseOutcome.CLOSEST)
            else:
                out.append(InverseOutcome.SINGULAR)
        return tuple(out)


def flange_terms(cell: Cell) -> tuple[Term, ...]:
    """The effects of a cell that move its flange, and not only what is seen of it."""
    return tuple(
        term
        for term in cell.effects.terms
        if EFFECTS[term.effect].moves_flange and term.place not in cell.target_names
    )


def build_flange_cell(cell: Cell) -> Cell:
    """The calibrated arm in its own base, seen by four points about its targets' centre.

    They tell the flange's pose.  Of the effects those that move the flange.
    """
    middle = cell.target_positions.mean(axis=0) if len(cell.target_positions) else np.zeros(3)
    moving = flange_terms(cell)
    return replace(
        cell,
        target_names=CORNER_TARGET_NAMES,
        target_positions=middle + DEFAULT_TOOL_LEVER * TETRAHEDRON_CORNERS,
        effects=cell.effects.select_terms(moving.__contains__),
    )


def target_lever(cell: Cell) -> float:
    """What a radian counts as with the targets of a cell [m]."""
    away = np.linalg.norm(cell.target_positions, axis=1)
    own = rms(away) if len(away) else 0.0
    return own if own > MIN_TOOL_LEVER else DEFAULT_TOOL_LEVER


def solve_joints_at_poses(
    cell: Cell, poses: Array, near_joints: Array | None = None
) -> tuple[Array, Array]:
    """Joints (..., n) that bring the flange of an arm at rest to poses, and (...) what is missing.

    Effects count that move the flange.  Arguments as `Cell.inverse`.
    """
    arm, lever = build_flange_cell(cell), target_lever(cell)

    def find(goal: Array, begin: Array) -> tuple[Array, Array]:
        data = build_measurements_at_rest(begin, arm.target_names, arm.robot)
        reach = InverseProblem(arm, data, goal, lever, MAX_REACHED_RESIDUAL, np.inf)
        q, _ = reach.solve_consistent_with_effects(reach.start_joints, np.zeros(len(goal)))
        distance, angle = reach.position_and_angle_errors(q)
        return q, np.maximum(distance, lever * angle)

    return solve_joints_with_restarts(find, poses, near_joints, cell.robot.lower, cell.robot.upper)
