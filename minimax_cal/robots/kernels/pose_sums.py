"""Errors, rows, normal equations and plain steps, of either module's kernels.

Poses go in blocks that fit the cache: the Jacobian of all points is never stored.
``own`` is the module of the kernels, `plain` or `fast`.  ``at`` is a batch of B robots in their
places: mdh (B, n, 5); rotation (B, 3, 3) and origin (B, 3) of the base; targets (B, k, 3) in the
flange [m]; effects (B, e), their values.  ``sight`` is what was seen of them: q (m, n), prismatic
(n,) as `plain.link_axes_and_origins`; y (k, 3, m) measured [m]; weight (k, m), 0 where not
measured; fields (e, k, 3, m) motion of the points per unit of each effect, moved
(k, 3, m)
besides, in base axes, (0, ...) for none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array

KernelState = tuple[Array, ...]
KernelData = tuple[Array, ...]

# Relative: a cost that grows by more did not come from rounding, 2 eps L / s of points L away that
# miss by s; with 3 m and 0.1 mm 1.3e-11.
MAX_ROUNDING_COST_RISE = 1e-10


def split_poses_into_blocks(
    pose_count: int, points_per_pose: int, max_points: int
) -> list[tuple[int, int]]:
    """The poses in blocks of about as many each.  points_per_pose: at a pose; at most so many in a
    block.
    """
    count = min(-(-pose_count * points_per_pose // max_points), pose_count)
    return [(i * pose_count // count, (i + 1) * pose_count // count) for i in range(count)]


@cache
def parameter_axis_rows(joint_count: int) -> tuple[Array, Array]:
    """Rows of `plain.link_frames_in_flange`, (5n + 6,) each: a parameter's axis, a point on it.

    The point is -1 for those that slide along their axis.
    """
    joint, base = np.arange(joint_count), np.arange(3)
    own, beyond = (
        4 * (joint_count + 1 + joint),
        4 * (joint + 1),
    )  # of the joint, of the frame after it
    axis = [own, own + 2, own + 2, own, beyond + 1, base, base]
    slide, slides = np.full(joint_count, -1), np.full(3, -1)
    point = [slide, slide, 4 * joint + 3, beyond + 3, beyond + 3, slides, 0 * base + 3]
    return np.concatenate(axis), np.concatenate(point)


def sum_target_costs(kernel_module: ModuleType, state: KernelState, data: KernelData) -> Array:
    """Weighted sums of squares F_i of each target: (B, k) [m^2]."""
    (mdh, *place), (q, prismatic, *seen) = state, data
    out = np.zeros((len(mdh), len(seen[0])))
    for lo, hi in split_poses_into_blocks(len(q), out.size, kernel_module.MAX_POINTS_PER_BLOCK):
        arm = kernel_module.link_frames_in_flange(mdh, q, prismatic, lo, hi)
        error, _, _ = kernel_module.weighted_target_errors(arm, *place, *seen, lo)
        out += np.einsum("bkic,bkic->bk", error, error)
    return out


@dataclass(frozen=True, eq=False)
class KernelColumns:
    """Parameters (p,), ascending as `Names`: of links and base, of targets, of effects.

    first: the first of the targets.  s, end: where targets begin and end in `parameter_indices`.
    axis, point: (s,) see `parameter_axis_rows`.  effects: (p - end,) which.
    """

    which: Array
    first: int
    s: int
    end: int
    axis: Array
    point: Array
    effects: Array

    @staticmethod
    def for_parameters(state: KernelState, parameter_indices: Array) -> KernelColumns:
        """The parameters of robots with so many joints and targets."""
        n = state[0].shape[1]
        first, last = 5 * n + 6, 5 * n + 6 + 3 * state[3].shape[1]
        s, end = parameter_indices.searchsorted((first, last)).tolist()
        axis, point = (rows[parameter_indices[:s]] for rows in parameter_axis_rows(n))
        return KernelColumns(
            parameter_indices, first, s, end, axis, point, parameter_indices[end:] - last
        )

    @property
    def target_column_bounds(self) -> tuple[int, int, int]:
        """s, end and first, as the kernels ask for them."""
        return self.s, self.end, self.first

    def shared_errors_and_jacobian(
        self,
        kernel_module: ModuleType,
        state: KernelState,
        data: KernelData,
        first_pose: int,
        end_pose: int,
    ) -> tuple[Array, Array, Array]:
        """Weighted errors (B, k, 3, c), what moves all targets (B, k, h, 3, c), roots (k, c).

        The roots are those of the weights.  Of the poses lo to hi, in the axes of the flange.
        """
        (mdh, *place), (q, prismatic, *seen), fields = state, data, data[4]
        arm = kernel_module.link_frames_in_flange(mdh, q, prismatic, first_pose, end_pose)
        error, swung, root = kernel_module.weighted_target_errors(arm, *place, *seen, first_pose)
        some = fields[..., first_pose:end_pose].take(self.effects, axis=0)
        return (
            error,
            kernel_module.weighted_shared_jacobian(
                arm, self.axis, self.point, state[3], swung, root, some
            ),
            root,
        )

    def sum_normal_equations(
        self, kernel_module: ModuleType, state: KernelState, data: KernelData
    ) -> TargetNormalEquations:
        """See `sums.sum_normal_equations`."""
        B, k, p = len(state[0]), len(data[2]), len(self.which)
        out = np.zeros((B, k)), np.zeros((B, k, p)), np.zeros((B, k, p, p))
        for lo, hi in split_poses_into_blocks(
            len(data[0]), B * k, kernel_module.MAX_POINTS_PER_BLOCK
        ):
            error, J, root = self.shared_errors_and_jacobian(kernel_module, state, data, lo, hi)
            long = 3 * (hi - lo)  # told, as -1 is of no rows that move all targets
            flat = error.reshape(B, k, long), J.reshape(*J.shape[:3], long), root
            kernel_module.add_to_normal_equations(
                *flat, self.which, *self.target_column_bounds, *out
            )
        return TargetNormalEquations(*out)


class TargetNormalEquations(NamedTuple):
    """Normal equations by target: F (B, k), J'We (B, k, p) and J'WJ (B, k, p, p)."""

    costs: Array
    gradients: Array
    grams: Array


def sum_normal_equations(
    kernel_module: ModuleType, state: KernelState, data: KernelData, parameter_indices: Array
) -> TargetNormalEquations:
    """Normal equations by target: F (B, k), J'We (B, k, p) and J'WJ (B, k, p, p).

    parameter_indices: (p,) the parameters, ascending, in the order of `Names`.
    """
    return KernelColumns.for_parameters(state, parameter_indices).sum_normal_equations(
        kernel_module, state, data
    )


class ErrorsWithJacobian(NamedTuple):
    """Weighted errors (k, 3, c) of points, and their derivatives (k, p, 3, c)."""

    errors: Array
    jacobian: Array


def weighted_errors_and_jacobian(
    kernel_module: ModuleType,
    state: KernelState,
    data: KernelData,
    parameter_indices: Array,
    first_pose: int,
    end_pose: int,
) -> ErrorsWithJacobian:
    """Weighted errors (k, 3, c) of the poses lo to hi, and their Jacobian J (k, p, 3, c).

    In the axes of the flange, of a batch of one; the errors' derivative is -J.  As
    `sum_normal_equations`.
    """
    columns = KernelColumns.for_parameters(state, parameter_indices)
    error, J, root = columns.shared_errors_and_jacobian(
        kernel_module, state, data, first_pose, end_pose
    )
    s, end, first = columns.target_column_bounds
    out = np.zeros((len(root), len(parameter_indices), *error.shape[2:]))
    out[:, :s], out[:, end:] = J[0, :, :s], J[0, :, s:]
    t, axis = np.divmod(parameter_indices[s:end] - first, 3)
    out[t, np.arange(s, end), axis] = root[t]
    return ErrorsWithJacobian(error[0], out)


def sum_gradients(
    kernel_module: ModuleType,
    state: KernelState,
    data: KernelData,
    parameter_indices: Array,
    extra_pose_weights: Array,
) -> Array:
    """J'We (B, p) of all targets, each robot's over poses of its own.

    extra_pose_weights: (B, m) weight of each pose besides.  As `sum_normal_equations`.
    """
    (B, k, _), m = state[3].shape, len(data[0])
    columns, out = (
        KernelColumns.for_parameters(state, parameter_indices),
        np.zeros((B, len(parameter_indices))),
    )
    s, end, first = columns.target_column_bounds
    t, axis = np.divmod(parameter_indices[s:end] - first, 3)
    for lo, hi in split_poses_into_blocks(m, B * k, kernel_module.MAX_POINTS_PER_BLOCK):
        error, J, root = columns.shared_errors_and_jacobian(kernel_module, state, data, lo, hi)
        error = error * extra_pose_weights[:, None, None, lo:hi]
        pull = J.reshape(*J.shape[:3], -1) @ error.reshape(B, k, -1, 1)
        pull = pull[..., 0].sum(axis=1)
        out[:, :s] += pull[:, :s]
        out[:, end:] += pull[:, s:]
        out[:, s:end] += (error @ root[..., None])[:, t, axis, 0]
    return out


class DistancesWithGradients(NamedTuple):
    """Weighted squared distances (k, m) [m^2], and their derivatives (k, m, p)."""

    squared_distances: Array
    gradients: Array


def squared_distances_and_gradients(
    kernel_module: ModuleType, state: KernelState, data: KernelData, parameter_indices: Array
) -> DistancesWithGradients:
    """Weighted squared distance of every point (k, m) [m^2] and its derivative (k, m, p).

    Of a batch of one, as `sum_normal_equations`.
    """
    (k, m), columns = data[3].shape, KernelColumns.for_parameters(state, parameter_indices)
    f, slope, ends = (
        np.empty((k, m)),
        np.empty((k, m, len(parameter_indices))),
        columns.target_column_bounds,
    )
    for lo, hi in split_poses_into_blocks(m, k, kernel_module.MAX_POINTS_PER_BLOCK):
        error, J, root = columns.shared_errors_and_jacobian(kernel_module, state, data, lo, hi)
        f[:, lo:hi], slope[:, lo:hi] = kernel_module.squared_errors_and_gradients(
            error[0], J[0], root, parameter_indices, *ends
        )
    return DistancesWithGradients(f, slope)


class DescentResult(NamedTuple):
    """The state after Gauss-Newton steps, sums of squares (B, k) [m^2], whether it converged."""

    state: KernelState
    costs: Array
    has_converged: bool


def descend_by_gauss_newton(
    kernel_module: ModuleType,
    state: KernelState,
    data: KernelData,
    parameter_indices: Array,
    prior: tuple[Array, Array],
    min_point_motion: float,
    max_steps: int,
) -> DescentResult:
    """Plain Gauss-Newton steps from a start that is near: the sum of all F_i, and a prior.

    As `sum_normal_equations`, for a batch of one.  prior: mean and weight (p,) of
    `parameter_indices`. min_point_motion: root mean square motion of a point that ends it [m].
    max_steps: steps. Returns where it ended, the cost at every iterate (t,), and whether it ended
    well: each step led down, and the last one was small.
    """
    (mean, hold), costs, off = prior, [np.inf], np.zeros(len(parameter_indices))
    columns = KernelColumns.for_parameters(state, parameter_indices)
    count = max(int(np.count_nonzero(data[3])), 1)
    for _ in range(max_steps):
        if hold.any():
            off = mean - select_parameter_values(state, parameter_indices)
        dx, before, gain, told = kernel_module.solve_gauss_newton_step(
            *columns.sum_normal_equations(kernel_module, state, data), off, hold
        )
        costs.append(before)
        if (
            not before <= costs[-2] * (1.0 + MAX_ROUNDING_COST_RISE)
            or not np.isfinite(before)
            or not told
        ):
            return DescentResult(state, np.array(costs[1:]), False)
        state = kernel_module.apply_parameter_step(*state, parameter_indices, dx)
        if gain <= count * min_point_motion**2:
            return DescentResult(state, np.array([*costs[1:], before - gain]), True)
    return DescentResult(state, np.array(costs[1:]), False)


def select_parameter_values(state: KernelState, parameter_indices: Array) -> Array:
    """(p,) the parameters of a batch of one; those of the base's turn are 0, as steps are."""
    mdh, _, origin, targets, effects = (part[0] for part in state)
    every = (mdh.T.reshape(-1), origin, np.zeros(3), targets.reshape(-1), effects)
    return np.concatenate(every)[parameter_indices]
