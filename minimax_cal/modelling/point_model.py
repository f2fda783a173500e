"""The bridge from robot and measurements to numbers: errors, normal equations, separable split.

Sums over poses are those of `active_kernels`.  Errors of whole poses (`mix`) and rows of the
Jacobian are taken here, in blocks of poses that fit the cache: the Jacobian of all points is never
stored.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.parameters import (
    ParameterNames,
    ParameterValues,
    flatten_link_parameters,
)
from minimax_cal.robots import kinematics
from minimax_cal.robots.kernels import pose_sums
from minimax_cal.robots.kernels.kernel_choice import active_kernels, prepare_kernel_arrays
from minimax_cal.robots.kernels.pose_sums import KernelData, KernelState
from minimax_cal.robots.kinematics import LinkFrames, skew_matrix
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import (
    CostGradientGram,
    ReducedProblem,
    solve_normal_equations,
)

MAX_POINT_WEIGHT_RATIO = (
    100.0  # no u95 counts as more than so many times better than the typical one
)
DEFAULT_TARGET_NAME = "target"  # the one point on the flange of an arm that has no other
MAX_JACOBIAN_BLOCK_POINTS = 768  # points a block: its Jacobian then fits the second-level cache


NO_POSE_MIX: Array = np.zeros((0, 0, 0))
NO_EFFECT_FIELDS: Array = np.zeros((0, 0, 0, 0))


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Sums of squares and their normal equations, for each target.

    cost: (..., k) F_i = sum_j w_ij |e_ij|^2 [m^2].
    gradient: (..., k, p) J_i' W e_i, so that the gradient of F_i is -2 gradient_i.
    gram: (..., k, p, p) J_i' W J_i.
    """

    cost: Array
    gradient: Array
    gram: Array


@dataclass(frozen=True, eq=False)
class PoseBlock:
    """Some poses and the chain of the arm there."""

    rows: slice
    links: LinkFrames

    @cached_property
    def screw_axes_and_moments(self) -> tuple[Array, Array]:
        """See `kinematics.screw_axes_and_moments`."""
        return kinematics.screw_axes_and_moments(self.links)


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Gaussian knowledge about parameters: mean (p,) and weight (p,) = noise^2 / sigma^2.

    beside: (p,) that noise^2 [m^2], 0 for what a typical coordinate has; empty for all 0.
    """

    mean: Array
    weight: Array
    beside: Array = field(default_factory=lambda: np.zeros(0))


class BlockRows(NamedTuple):
    """Poses of a block, its weighted errors (k, 3, c) and their Jacobian (k, p, 3, c)."""

    poses: slice
    errors: Array
    jacobian: Array


@dataclass(frozen=True, eq=False)
class PointModel:
    """A robot at given poses, and what was measured there.

    Points and their weights lie target by target, poses last, for the kernels sum over poses:
    `point_errors` and `point_jacobian` turn them, without a copy, into (m, k, 3), as points are
    everywhere else.

    q: (m, n) joint values with signs applied.  prismatic: (n,).
    y: (k, 3, m) measured points, 0 where not measured [m].
    weight: (k, m) weight of each point, 0 where not measured.
    names: the parameters.  active: (p,) True where a parameter is free.
    prior: on the parameters, in the order of `names`.
    mix: (m, 3k, 3k) matrices that each pose's errors (all targets, measurement axes) are multiplied
    by, so that the sum of squares weighs position and orientation; empty for plain points.
    fields: (e, k, 3, m) motion of the points, in base axes, per unit of each effect's parameter.
    moved: (k, 3, m) by how much more they are known to move [m]; empty for not at all.
    room: (e, 2) bounds of the effects' parameters; empty for none.
    """

    q: Array
    prismatic: Array
    y: Array
    weight: Array
    names: ParameterNames
    active: Array
    prior: GaussianPrior
    mix: Array = field(default_factory=lambda: NO_POSE_MIX)
    fields: Array = field(default_factory=lambda: NO_EFFECT_FIELDS)
    moved: Array = field(default_factory=lambda: NO_POSE_MIX)
    room: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @cached_property
    def pose_counts_by_target(self) -> Array:
        """(k,) at how many poses each target was measured."""
        return np.asarray(np.count_nonzero(self.weight, axis=1))

    @cached_property
    def measured_mask(self) -> Array:
        """(k, m) True where a target was measured."""
        return np.asarray(self.weight > 0.0)

    @cached_property
    def has_unit_weights(self) -> bool:
        """Whether every weight is one."""
        return bool(np.all(self.weight == 1.0))

    def with_active(self, active: Array) -> PointModel:
        """The same model with other free parameters."""
        return replace(self, active=active)

    def with_prior(self, prior: GaussianPrior) -> PointModel:
        """The same model with another prior."""
        return replace(self, prior=prior)

    def take_poses(self, rows: Array) -> PointModel:
        """The model at some poses.  rows: indices, possibly repeated, or a mask."""
        return replace(
            self,
            q=self.q[rows],
            y=self.y[..., rows],
            weight=self.weight[:, rows],
            fields=self.fields[..., rows] if len(self.fields) else self.fields,
            moved=self.moved[..., rows] if len(self.moved) else self.moved,
            mix=self.mix[rows] if len(self.mix) else self.mix,
        )

    def with_target_weights(self, target_weights: Array) -> PointModel:
        """The same model with the points of target i weighted by share_i too.  target_weights:
        (k,).
        """
        return replace(self, weight=self.weight * target_weights[:, None])

    def point_errors(self, state: ParameterValues) -> Array:
        """Measured minus predicted, in base axes: (..., m, k, 3), NaN where not measured [m]."""
        links = kinematics.compute_link_frames(state.mdh, self.q, self.prismatic)
        point = self.displace_points_by_effects(
            state, kinematics.targets_in_base(links, state.target_positions), slice(None)
        )
        error = np.moveaxis(points_in_base_axes(state, self.y) - point, -1, -3)
        error[..., ~self.measured_mask.T, :] = np.nan
        return np.asarray(error)

    def point_jacobian(self, state: ParameterValues) -> Array:
        """Derivative of every point, in base axes, by every parameter: (..., m, k, 3, p)."""
        links = kinematics.compute_link_frames(state.mdh, self.q, self.prismatic)
        point = kinematics.targets_in_base(links, state.target_positions)
        every = np.ones(self.names.parameter_count, dtype=bool)
        block = PoseBlock(slice(len(self.q)), links)
        swung = self.displace_points_by_effects(state, point, slice(None))
        turned = JacobianColumns.from_active(self.names, every).transposed_jacobian(
            block, point, swung, self.fields
        )
        return np.asarray(np.moveaxis(turned, (-1, -3), (-4, -1)))

    def split_into_blocks(self, state: ParameterValues) -> list[PoseBlock]:
        """The poses cut into blocks that fit the cache, each with its chain."""
        q, flat = self.q, self.prismatic
        parts = self.split_poses(int(np.prod(state.mdh.shape[:-2])))
        return [
            PoseBlock(part, kinematics.compute_link_frames(state.mdh, q[part], flat))
            for part in parts
        ]

    def split_poses(self, robot_count: int) -> list[slice]:
        """The poses cut into parts whose Jacobian, of so many robots, fits the cache."""
        m = len(self.q)
        count = -(-m * robot_count * len(self.y) // MAX_JACOBIAN_BLOCK_POINTS)
        edges = np.linspace(0, m, min(count, m) + 1).astype(int).tolist()
        return [slice(start, stop) for start, stop in itertools.pairwise(edges)]

    def block_errors_and_points(
        self, state: ParameterValues, block: PoseBlock
    ) -> tuple[Array, Array]:
        """Weighted errors and predicted points of one block: (..., k, 3, c) each [m]."""
        point = kinematics.targets_in_base(block.links, state.target_positions)
        error = points_in_base_axes(
            state, self.y[..., block.rows]
        ) - self.displace_points_by_effects(state, point, block.rows)
        if not self.has_unit_weights:
            error *= np.sqrt(self.weight[:, None, block.rows])
        return self.apply_pose_mix(state, error, block.rows), point

    def displace_points_by_effects(
        self, state: ParameterValues, points: Array, poses: slice
    ) -> Array:
        """Points (..., k, 3, c) moved by the effects at the state's values."""
        if len(self.moved):
            points = points + self.moved[..., poses]
        if len(self.fields):
            points = points + np.tensordot(state.effects, self.fields[..., poses], 1)
        return points

    def apply_pose_mix(self, state: ParameterValues, rows: Array, poses: slice) -> Array:
        """Rows (..., k, 3, c) in base axes times the mix, if there is one."""
        if not len(self.mix):
            return rows
        turned = state.rotation[..., None, :, :] @ rows
        *batch, k, _, c = rows.shape
        flat = turned.reshape(*batch, 3 * k, c)
        mixed = np.einsum("cab,...bc->...ac", self.mix[poses], flat)
        return np.asarray(mixed.reshape(rows.shape))

    def apply_transposed_weights(
        self, state: ParameterValues, weighted_errors: Array, poses: slice
    ) -> Array:
        """Weighted errors times the transposed weight, in base axes: what pulls at each point."""
        if len(self.mix):
            *batch, k, _, c = weighted_errors.shape
            flat = weighted_errors.reshape(*batch, 3 * k, c)
            back = np.einsum("cba,...bc->...ac", self.mix[poses], flat).reshape(
                weighted_errors.shape
            )
            weighted_errors = np.swapaxes(state.rotation, -1, -2)[..., None, :, :] @ back
        if not self.has_unit_weights:
            weighted_errors = weighted_errors * np.sqrt(self.weight[:, None, poses])
        return weighted_errors

    @cached_property
    def kernel_data(self) -> KernelData:
        """What the kernels ask of the poses, see `active_kernels.pose_sums`."""
        parts = (self.q, self.prismatic, self.y, self.weight, self.fields, self.moved)
        return prepare_kernel_arrays(*parts)

    def target_costs(self, state: ParameterValues) -> Array:
        """F_i: (..., k) [m^2], the prior left out."""
        if not len(self.mix):
            found = pose_sums.sum_target_costs(
                active_kernels(), to_kernel_state(state), self.kernel_data
            )
            return np.asarray(found.reshape(*state.mdh.shape[:-2], -1))
        total = np.zeros(1)
        for block in self.split_into_blocks(state):
            error, _ = self.block_errors_and_points(state, block)
            total = total + np.einsum("...kcm,...kcm->...k", error, error)
        return np.asarray(total)

    def normal_equations(self, state: ParameterValues, active: Array) -> NormalEquations:
        """Normal equations for the parameters that are True in active (p,), at a state."""
        if not len(self.mix):
            found = pose_sums.sum_normal_equations(
                active_kernels(), to_kernel_state(state), self.kernel_data, np.flatnonzero(active)
            )
            outer = state.mdh.shape[:-2]
            return NormalEquations(*(part.reshape(*outer, *part.shape[1:]) for part in found))
        select = JacobianColumns.from_active(self.names, active)
        cost, gradient, gram = np.zeros((3, 1))
        for block in self.split_into_blocks(state):
            error, turned = self.block_errors_and_selected_jacobian(state, block, select)
            *batch, k, p, _, c = turned.shape
            flat = turned.reshape(*batch, k, p, 3 * c)
            cost = cost + np.einsum("...kcm,...kcm->...k", error, error)
            gradient = gradient + (flat @ error.reshape(*batch, k, 3 * c, 1))[..., 0]
            gram = gram + flat @ np.swapaxes(flat, -1, -2)
        return NormalEquations(np.asarray(cost), np.asarray(gradient), np.asarray(gram))

    def weighted_gram(self, state: ParameterValues, weight: Array) -> Array:
        """J'WJ (p, p) of the free parameters, with other weights (k, m); of one state, no mix."""
        q, prismatic, y, _, fields, moved = self.kernel_data
        given = q, prismatic, y, *prepare_kernel_arrays(weight), fields, moved
        found = pose_sums.sum_normal_equations(
            active_kernels(), to_kernel_state(state), given, np.flatnonzero(self.active)
        )
        return np.asarray(found[2][0].sum(axis=0))

    def gradients_under_pose_weights(
        self, states: ParameterValues, pose_weights_by_state: Array
    ) -> Array:
        """J'We (B, p) by the free parameters at a batch of B states, each over poses of its own.

        pose_weights_by_state: (B, m) weight of each pose besides.
        """
        if not len(self.mix):
            which = np.flatnonzero(self.active)
            return pose_sums.sum_gradients(
                active_kernels(),
                to_kernel_state(states),
                self.kernel_data,
                which,
                pose_weights_by_state,
            )
        out = np.zeros((len(pose_weights_by_state), int(self.active.sum())))
        for i, weight in enumerate(pose_weights_by_state):
            for part, error, rows in self.iterate_errors_and_jacobians(states.take(np.array(i))):
                out[i] += np.einsum("kpac,kac->p", rows, error * weight[part])
        return out

    def squared_distances_and_gradients(self, state: ParameterValues) -> tuple[Array, Array]:
        """Weighted squared distance of every point: (k, m) [m^2], and its derivative (k, m, p).

        Of one state, by the free parameters; without a mix.
        """
        return pose_sums.squared_distances_and_gradients(
            active_kernels(), to_kernel_state(state), self.kernel_data, np.flatnonzero(self.active)
        )

    def block_errors_and_jacobian(
        self, state: ParameterValues, block: PoseBlock, active: Array
    ) -> tuple[Array, Array]:
        """Weighted errors (..., k, 3, c) and transposed Jacobian (..., k, p, 3, c) of one block."""
        return self.block_errors_and_selected_jacobian(
            state, block, JacobianColumns.from_active(self.names, active)
        )

    def iterate_errors_and_jacobians(self, state: ParameterValues) -> Iterator[BlockRows]:
        """Block by block, poses, weighted errors (k, 3, c) and Jacobian (k, p, 3, c), of one state.

        By the free parameters, in axes of each pose's own, so that they are for sums over axes.
        """
        if len(self.mix):
            for block in self.split_into_blocks(state):
                yield BlockRows(
                    block.rows, *self.block_errors_and_jacobian(state, block, self.active)
                )
            return
        given = (
            active_kernels(),
            to_kernel_state(state),
            self.kernel_data,
            np.flatnonzero(self.active),
        )
        for part in self.split_poses(1):
            yield BlockRows(
                part, *pose_sums.weighted_errors_and_jacobian(*given, part.start, part.stop)
            )

    def block_errors_and_selected_jacobian(
        self, state: ParameterValues, block: PoseBlock, columns: JacobianColumns
    ) -> tuple[Array, Array]:
        """`block_errors_and_jacobian` with the choice of columns at hand."""
        error, point = self.block_errors_and_points(state, block)
        swung = self.displace_points_by_effects(state, point, block.rows)
        turned = columns.transposed_jacobian(block, point, swung, self.fields)
        if not self.has_unit_weights:
            turned *= np.sqrt(self.weight[:, None, None, block.rows])
        if len(self.mix):  # parameter by parameter, the targets of a pose together
            axis = turned.ndim - 4
            one = replace(state, rotation=state.rotation[..., None, :, :])
            turned = self.apply_pose_mix(one, np.moveaxis(turned, axis, axis + 1), block.rows)
            turned = np.ascontiguousarray(np.moveaxis(turned, axis + 1, axis))
        return error, turned

    def length_angle_coupling(self, state: ParameterValues, blocks: list[PoseBlock]) -> Array:
        """M = sum of w e . d2x/(dr domega) for free lengths r and angles omega: (..., r, omega).

        The part of the variable-projection Jacobian that Kaufman leaves out [paper S, eq. 24].
        """
        names, active = self.names, self.active
        n, k = names.joints, len(names.target_names)
        linear = names.linear_mask
        total = np.zeros(1)
        for block in blocks:
            links = block.links
            error = self.apply_transposed_weights(
                state, self.block_errors_and_points(state, block)[0], block.rows
            )
            *batch, _, _, c = error.shape
            base = np.broadcast_to(np.eye(3)[..., None], (*batch, 3, 3, c))
            # the axes of theta, alpha, beta and of the base's turn
            axis = np.concatenate([links.z, links.x, links.y, base], axis=-3)
            # e . (w x d) = w . (d x e): of links all targets have the same d, of targets few d
            lengths = np.concatenate([links.x, links.z], axis=-3)
            moments = [kinematics.cross(lengths, error.sum(axis=-3)[..., None, :, :])]
            spots = kinematics.cross(links.axes[..., None, :, :, :], error[..., None, :, :])
            moments += [np.zeros((*batch, 3, 3, c)), spots.reshape(*batch, 3 * k, 3, c)]
            if len(self.fields):
                fields = np.moveaxis(self.fields[..., block.rows], 0, 1)  # (k, e, 3, c)
                moments.append(kinematics.cross(fields, error[..., None, :, :]).sum(axis=-4))
            turned = np.concatenate(moments, axis=-3)
            flat = turned.reshape(*batch, -1, 3 * c), axis.reshape(*batch, 3 * n + 3, 3 * c)
            total = total + flat[0] @ np.swapaxes(flat[1], -1, -2)
        coupled = total * angle_turns_length_mask(n, k, len(self.fields))
        return np.asarray(coupled[..., active[linear], :][..., active[~linear]])

    def parameter_vector(self, state: ParameterValues) -> Array:
        """(..., p) the parameters' values; base rotation entries are 0 (they are steps only)."""
        *batch, n, _ = state.mdh.shape
        k = state.target_positions.shape[-2]
        links = np.swapaxes(state.mdh, -1, -2).reshape(*batch, 5 * n)
        base = np.concatenate([state.origin, np.zeros((*batch, 3))], axis=-1)
        spots = state.target_positions.reshape(*batch, 3 * k)
        more = np.broadcast_to(state.effects, (*batch, len(self.fields)))
        return np.concatenate([links, base, spots, more], axis=-1)


@dataclass(frozen=True, eq=False)
class PointLeastSquares:
    """The sum of F_i over all targets, plus the prior: separable in the free parameters."""

    model: PointModel

    @property
    def names(self) -> ParameterNames:
        """Of all parameters."""
        return self.model.names

    @property
    def active(self) -> Array:
        """(p,) True where one is free."""
        return self.model.active

    @property
    def linear(self) -> Array:
        """(free,) True for lengths."""
        return np.asarray(self.model.names.linear_mask[self.model.active])

    def normal(self, x: ParameterValues) -> CostGradientGram:
        """Cost (...), slope (..., free) and Gram matrix (..., free, free)."""
        return self.normal_equations_of(x, self.model.active)

    def normal_equations_of(self, x: ParameterValues, active: Array) -> CostGradientGram:
        """Cost, slope and Gram matrix over the parameters that `active` (d,) marks."""
        normal, prior = self.model.normal_equations(x, active), self.model.prior
        off = prior.mean - self.model.parameter_vector(x)
        weight = prior.weight[active]
        cost = normal.cost.sum(-1) + (prior.weight * off**2).sum(-1)
        gradient = normal.gradient.sum(-2) + weight * off[..., active]
        return CostGradientGram(cost, gradient, normal.gram.sum(-3) + np.diag(weight))

    def reduced(self, x: ParameterValues, *, full: bool) -> ReducedProblem[ParameterValues]:
        """The states with their best free lengths [paper S, eq. 18], `normal` there, and M.

        full: whether to compute the coupling M (..., r, omega); zeros otherwise.
        """
        model = self.model
        lengths = model.active & model.names.linear_mask
        _, gradient, gram = self.normal_equations_of(x, lengths)
        dx = np.zeros((*gradient.shape[:-1], model.names.parameter_count))
        dx[..., lengths] = solve_normal_equations(gram, gradient[..., None])[..., 0]
        x = x.step(dx)
        found = self.normal_equations_of(x, model.active)
        free = self.linear
        nothing = np.zeros((*gradient.shape[:-1], free.sum(), (~free).sum()))
        coupling = model.length_angle_coupling(x, model.split_into_blocks(x)) if full else nothing
        return ReducedProblem(x, *found, coupling)

    def step(self, x: ParameterValues, dx: Array) -> ParameterValues:
        """The states moved by a step in the free parameters."""
        full = np.zeros((*dx.shape[:-1], self.model.names.parameter_count))
        full[..., self.model.active] = dx
        return x.step(full)


def to_kernel_state(state: ParameterValues) -> KernelState:
    """A state, or a batch of them flattened, as the kernels ask for it."""
    if state.mdh.ndim == 2:
        return prepare_kernel_arrays(
            *(part[None] for part in (*state.geometry_arrays, state.effects))
        )
    batch, (n, _), k = state.mdh.shape[:-2], state.mdh.shape[-2:], state.target_positions.shape[-2]
    count = math.prod(batch)
    effects = np.broadcast_to(state.effects, (*batch, state.effects.shape[-1]))
    return prepare_kernel_arrays(
        state.mdh.reshape(count, n, 5),
        np.broadcast_to(state.rotation, (*batch, 3, 3)).reshape(count, 3, 3),
        np.broadcast_to(state.origin, (*batch, 3)).reshape(count, 3),
        np.broadcast_to(state.target_positions, (*batch, k, 3)).reshape(count, k, 3),
        effects.reshape(count, -1),
    )


def apply_active_step(model: PointModel, state: ParameterValues, step: Array) -> ParameterValues:
    """A single state moved by a step of the free parameters."""
    which = np.flatnonzero(model.active)
    return ParameterValues(
        *(
            part[0]
            for part in active_kernels().apply_parameter_step(*to_kernel_state(state), which, step)
        )
    )


def points_in_base_axes(state: ParameterValues, measured_points: Array) -> Array:
    """Measured points in base axes: (..., k, 3, m).  measured_points: (k, 3, m) in the measurement
    frame.
    """
    centred = measured_points - state.origin[..., None, :, None]
    return np.asarray(np.swapaxes(state.rotation, -1, -2)[..., None, :, :] @ centred)


@cache
def angle_turns_length_mask(joint_count: int, target_count: int, effect_count: int) -> Array:
    """(r, omega) True where turning angle omega turns the direction of length r.

    The fields of effects are held fixed in base axes: only the base turns them.
    """
    link = np.arange(joint_count)
    spots, fields = np.full(3 * target_count, 3 * joint_count), np.full(effect_count, -1)
    length = np.concatenate([3 * link + 1, 3 * link, np.full(3, -9), spots, fields])
    angle = np.concatenate([3 * link, 3 * link + 1, 3 * link + 2, np.full(3, -1)])
    return np.asarray(angle[None, :] <= length[:, None])


@dataclass(frozen=True, eq=False)
class JacobianColumns:
    """Which columns a Jacobian has and where they come from."""

    count: int
    lengths: Array
    angles: Array
    base: Array
    targets: Array
    effects: Array
    targets_at: int
    angles_at: int
    joints: int

    @staticmethod
    def from_active(names: ParameterNames, active: Array) -> JacobianColumns:
        """The columns of the active parameters, in order."""
        n = names.joints
        base = np.flatnonzero(active[5 * n : 5 * n + 3])
        turns = np.flatnonzero(active[5 * n + 3 : 5 * n + 6])
        lengths = np.flatnonzero(active[: 2 * n])
        angles = np.flatnonzero(active[2 * n : 5 * n])
        targets = np.flatnonzero(active[5 * n + 6 : names.geometric_count])
        effects = np.flatnonzero(active[names.geometric_count :])
        count = sum(map(len, (lengths, angles, base, turns, targets, effects)))
        return JacobianColumns(
            count,
            lengths,
            np.concatenate([angles, 3 * n + turns]),
            base,
            targets,
            effects,
            count - len(targets) - len(effects),
            len(lengths),
            len(angles),
        )

    def transposed_jacobian(
        self, block: PoseBlock, points: Array, displaced_points: Array, effect_fields: Array
    ) -> Array:
        """Transposed derivative of points (..., k, 3, c): (..., k, p, 3, c), base axes.

        displaced_points: the points where effects have moved them to: a turn of the base takes both
        along. effect_fields: (e, k, 3, m) of the effects, at all poses.
        """
        *batch, k, _, c = points.shape
        links = block.links
        n = links.x.shape[-3]
        out = np.empty((*batch, k, self.count, 3, c), dtype=points.dtype)
        for column, which in enumerate(self.lengths):
            source = links.x if which < n else links.z
            out[..., column, :, :] = source[..., None, which % n, :, :]
        if len(self.angles):
            axis, moment = block.screw_axes_and_moments
            turns = self.angles[: self.joints]
            axis, moment = axis[..., turns, :, :], moment[..., turns, :, :]
            at = self.angles_at
            out[..., at : at + self.joints, :, :] = moment[..., None, :, :, :] - kinematics.cross(
                points[..., None, :, :], axis[..., None, :, :, :]
            )
            at += self.joints + len(self.base)
            own = np.eye(3)[self.angles[self.joints :] - 3 * n, :, None]
            out[..., at : self.targets_at, :, :] = kinematics.cross(
                own, displaced_points[..., None, :, :]
            )
        at = self.angles_at + self.joints
        out[..., at : at + len(self.base), :, :] = np.eye(3)[self.base][..., None]
        out[..., self.targets_at :, :, :] = 0.0
        for column, which in enumerate(self.targets, start=self.targets_at):
            target, axis_number = divmod(int(which), 3)
            out[..., target, column, :, :] = links.axes[..., axis_number, :, :]
        if len(self.effects):
            chosen = effect_fields[self.effects][..., block.rows]
            out[..., self.targets_at + len(self.targets) :, :, :] = np.moveaxis(chosen, 0, 1)
        return out


def build_point_model(robot: Robot, data: Measurements) -> PointModel:
    """The model of a robot at the measured poses, all parameters free, no prior."""
    seen = data.seen.T
    names = ParameterNames.for_robot(robot, data.target_names)
    mean = np.zeros(names.parameter_count)
    mean[names.link_mask] = flatten_link_parameters(robot.mdh)
    return PointModel(
        q=robot.chain_joint_values(data.q),
        prismatic=robot.prismatic,
        y=np.where(seen[:, None], np.moveaxis(data.y, 0, 2), 0.0),
        weight=point_weights_from_u95(data),
        names=names,
        active=np.ones(names.parameter_count, dtype=bool),
        prior=GaussianPrior(mean, np.zeros(names.parameter_count)),
    )


def point_weights_from_u95(data: Measurements) -> Array:
    """(k, m) weights of points, (typical u95 / u95)^2 where the data have a `u95` column.

    0 where a target was not measured.
    """
    weight = data.seen.T.astype(float)
    if "u95" not in data.columns:
        return weight
    u95 = data.columns["u95"]
    usual = np.nanmedian(u95)
    least = (
        usual / MAX_POINT_WEIGHT_RATIO
    )  # a slip of the pen must not turn the fit into one pose's
    return weight * np.where(np.isfinite(u95), (usual / np.maximum(u95, least)) ** 2, 1.0)


def pose_error_weights(data: Measurements, rotation_lever: float | None = None) -> Array:
    """W (m, 3k, 3k) that turns the errors of three or more targets into pose errors, squared.

    e'We = k |e_c|^2 + k lever^2 |e_w|^2 + stiffness |e_s|^2 per pose: e_c is the error of the
    targets' centroid, e_w the small turn that fits their errors best, e_s what no rigid motion
    explains.  e_s depends on the targets' places alone, and must weigh as much as the turn: a
    smaller triangle would turn errors into small ones.  rotation_lever: metres that a radian counts
    as; None for the targets' own, with which W is nearly the plain sum.  Rows where a target is
    missing are zero.
    """
    k = len(data.target_names)
    whole = np.asarray(data.seen.all(axis=1))
    arm = np.where(whole[:, None, None], data.y - data.y.mean(axis=1, keepdims=True), 0.0)
    inertia = (arm**2).sum((1, 2))[:, None, None] * np.eye(3) - np.swapaxes(arm, 1, 2) @ arm
    inertia[~whole] = np.eye(3)
    own = float(np.sqrt(np.trace(inertia[whole].mean(axis=0)) / 3.0 / k))
    rotation_lever = own if rotation_lever is None else rotation_lever
    centre = np.tile(np.eye(3) / k, k)
    turned = np.concatenate(np.moveaxis(skew_matrix(arm), 1, 0), axis=-1)
    turn = np.linalg.solve(inertia, turned)
    back = np.swapaxes(turn, 1, 2)
    shape = np.eye(3 * k) - k * (centre.T @ centre) - np.swapaxes(turned, 1, 2) @ turn
    weight = (
        k * (centre.T @ centre + rotation_lever**2 * back @ turn)
        + max(1.0, rotation_lever / own) ** 2 * shape
    )
    weight = 0.5 * (weight + np.swapaxes(weight, 1, 2)) + 1e-12 * np.eye(3 * k)
    return np.where(whole[:, None, None], weight, 0.0)


def with_pose_errors(model: PointModel, pose_weights: Array) -> PointModel:
    """The model whose sum of squares is that of pose errors.  pose_weights: as
    `pose_error_weights`.
    """
    mix = np.zeros_like(pose_weights)
    whole = np.asarray(pose_weights.any(axis=(1, 2)))
    mix[whole] = np.swapaxes(np.linalg.cholesky(pose_weights[whole]), 1, 2)
    return replace(model, mix=mix)
