"""Least squares from a start that is near: the fit without its trimmings."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.table import snap_to_near_bounds
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel, to_kernel_state
from minimax_cal.robots.kernels import pose_sums
from minimax_cal.robots.kernels.kernel_choice import active_kernels
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.bounded_least_squares import solve_bounded_normal_equations
from minimax_cal.solvers.least_squares import (
    AUTO_METHOD_NAME,
    JOINT_METHOD_NAME,
    LEAST_SQUARES_METHODS,
    NEAR_START_LIMITS,
    CostGradientGram,
    LeastSquaresSolution,
    find_method,
    solve_normal_equations,
)
from minimax_cal.solvers.status import Status

RELATIVE_COST_ROUNDING = 1e-13  # of the cost: a decrease by less is none
MAX_INVISIBLE_COST_DECREASE = (
    1e-10  # of the cost: a decrease by less may be lost in the rounding of its rows
)
MAX_STEP_HALVINGS = 10  # of a step that leads up
MAX_NEARBY_STEPS = 15  # plain steps; a start from which these do not suffice is not near


def fit_within_bounds_from_start(
    model: PointModel, start: ParameterValues, method: str = JOINT_METHOD_NAME
) -> LeastSquaresSolution[ParameterValues]:
    """The least-squares fit of a model's free parameters from a start nearby, a batch of one.

    Parameters of effects stay between the model's bounds.

    method: auto takes steps of variable projection, joint those in all parameters at once, and both
    those of snllm where they do not lead straight down; or one of
    `least_squares.LEAST_SQUARES_METHODS`, from the first step.
    """
    found = fit_nearby_without_bounds(model, start, method)
    if is_within_bounds(found.x.take(np.array(0)), model.room):
        return found
    return fit_within_bounds(
        PointLeastSquares(model), float(model.pose_counts_by_target.sum()), model.room, found
    )


def fit_nearby_without_bounds(
    model: PointModel, start: ParameterValues, method: str
) -> LeastSquaresSolution[ParameterValues]:
    """The same wherever the parameters then are."""
    straight = {
        AUTO_METHOD_NAME: take_variable_projection_steps,
        JOINT_METHOD_NAME: take_joint_gauss_newton_steps,
    }.get(method)
    if straight and not len(model.mix) and model.active.any():
        found = straight(model, start)
        if found is not None:
            return found
    problem, points = PointLeastSquares(model), float(model.pose_counts_by_target.sum())
    return least_squares.solve(
        problem, start.batch(), 1, points, find_method(method), NEAR_START_LIMITS
    )


def take_joint_gauss_newton_steps(
    model: PointModel, start: ParameterValues
) -> LeastSquaresSolution[ParameterValues] | None:
    """Gauss-Newton steps in all parameters at once; None where they do not lead straight down."""
    which = np.flatnonzero(model.active)
    prior = model.prior.mean[which], model.prior.weight[which]
    at, trace, well = pose_sums.descend_by_gauss_newton(
        active_kernels(),
        to_kernel_state(start),
        model.kernel_data,
        which,
        prior,
        NEAR_START_LIMITS.step,
        MAX_NEARBY_STEPS,
    )
    return build_converged_result(ParameterValues(*at), trace, "nlgn") if well else None


def take_variable_projection_steps(
    model: PointModel, start: ParameterValues
) -> LeastSquaresSolution[ParameterValues] | None:
    """Gauss-Newton steps of variable projection; None where they do not lead straight down.

    The angles step by the Jacobian of Golub and Pereyra, the lengths are the best ones for every
    angle [paper S, eq. 18-24 and Algorithm 1 with (k+1)omega in c_2].
    """
    own, at, points = (
        active_kernels(),
        to_kernel_state(start),
        float(model.pose_counts_by_target.sum()),
    )
    which = np.flatnonzero(model.active)
    linear = model.names.linear_mask[which]
    lengths, mean, hold = which[linear], model.prior.mean[which], model.prior.weight[which]
    every, few = (
        pose_sums.KernelColumns.for_parameters(at, which),
        pose_sums.KernelColumns.for_parameters(at, lengths),
    )
    trace = [np.inf]
    for _ in range(MAX_NEARBY_STEPS + 1):
        off = (
            (mean - pose_sums.select_parameter_values(at, which))[linear]
            if hold.any()
            else np.zeros(len(lengths))
        )
        dr, *_, told = own.solve_gauss_newton_step(
            *few.sum_normal_equations(own, at, model.kernel_data), off, hold[linear]
        )
        if not told:
            return None
        at = own.apply_parameter_step(*at, lengths, dr)  # r = G(omega)^+ Y, in which G is affine
        cost, gradient, gram = (
            part[0].sum(axis=0) for part in every.sum_normal_equations(own, at, model.kernel_data)
        )
        if hold.any():
            off = mean - pose_sums.select_parameter_values(at, which)
            cost, gradient = cost + hold @ off**2, gradient + hold * off
            gram = gram + np.diag(hold)
        if not cost <= trace[-1] * (1.0 + pose_sums.MAX_ROUNDING_COST_RISE) or not np.isfinite(
            cost
        ):
            return None
        trace.append(float(cost))
        state = ParameterValues(*(part[0] for part in at))
        mixed = gram[np.ix_(linear, ~linear)]
        coupled = model.length_angle_coupling(state, model.split_into_blocks(state))
        shares = solve_normal_equations(gram[np.ix_(linear, linear)], np.hstack([mixed, coupled]))
        projected, second = np.hsplit(shares, 2)
        matrix = gram[np.ix_(~linear, ~linear)] - mixed.T @ projected + coupled.T @ second
        step = np.zeros(len(which))
        step[~linear] = solve_normal_equations(matrix, gradient[~linear, None])[:, 0]
        step[linear] = -projected @ step[~linear]
        if step @ gram @ step <= points * NEAR_START_LIMITS.step**2:
            return build_converged_result(ParameterValues(*at), np.array(trace[1:]), "snlgn")
        at = own.apply_parameter_step(*at, which, step)
    return None


def build_converged_result(
    state_batch: ParameterValues, costs: Array, method: str
) -> LeastSquaresSolution[ParameterValues]:
    """A batch of one that took plain steps, each of which led down.

    state_batch: a batch.  costs: (steps + 1,) costs.
    """
    steps = np.array([len(costs) - 1])
    return LeastSquaresSolution(
        state_batch,
        costs[-1:],
        steps,
        (Status.CONVERGED,),
        costs[:, None],
        LEAST_SQUARES_METHODS[method],
    )


class BoundedLeastSquaresProblem(Protocol):
    """A sum of squares over the active ones of named parameters."""

    @property
    def names(self) -> ParameterNames:
        """Of all p."""

    @property
    def active(self) -> Array:
        """(p,) True where one is free."""

    def normal(self, x: ParameterValues) -> CostGradientGram:
        """Cost, slope and Gram matrix."""

    def step(self, x: ParameterValues, dx: Array) -> ParameterValues:
        """The state moved by a step in the free parameters."""


def fit_within_bounds(
    problem: BoundedLeastSquaresProblem,
    point_count: float,
    effect_bounds: Array,
    unbounded_fit: LeastSquaresSolution[ParameterValues],
) -> LeastSquaresSolution[ParameterValues]:
    """The fit between the bounds, from that without them: Gauss-Newton, each step between them.

    effect_bounds: (e, 2) of the effects of a state.
    """
    closed = np.pad(effect_bounds, ((problem.names.geometric_count, 0), (0, 0)))
    closed[: problem.names.geometric_count] = np.inf * np.array([-1.0, 1.0])
    allowed = closed[problem.active]
    state = clip_to_bounds(unbounded_fit.x.take(np.array(0)), effect_bounds)
    cost, gradient, gram = problem.normal(state)
    costs, status = [float(cost)], Status.ITERATION_LIMIT
    for _ in range(MAX_NEARBY_STEPS):
        values = np.pad(
            state.effects, (problem.names.geometric_count, 0)
        )  # of others none is bounded
        ends = allowed - values[problem.active][:, None]
        step = solve_bounded_normal_equations(gram, gradient, *ends.T)
        square = float(step @ gram @ step)
        gain = 2.0 * float(step @ gradient) - square
        settles = (
            square <= point_count * NEAR_START_LIMITS.step**2
            or gain <= RELATIVE_COST_ROUNDING * costs[-1]
        )
        trial = clip_to_bounds(problem.step(state, step), effect_bounds)
        found = problem.normal(trial)
        for _ in range(MAX_STEP_HALVINGS):
            if settles or found[0] <= costs[-1]:
                break
            step = 0.5 * step
            trial = clip_to_bounds(problem.step(state, step), effect_bounds)
            found = problem.normal(trial)
        if not settles and found[0] > costs[-1]:
            status = (
                Status.CONVERGED
                if gain <= MAX_INVISIBLE_COST_DECREASE * costs[-1]
                else Status.STALLED
            )
            break
        state, (cost, gradient, gram) = trial, found
        costs.append(float(cost))
        if settles:
            status = Status.CONVERGED
            break
    state = replace(state, effects=snap_to_near_bounds(state.effects, effect_bounds))
    count, trace = unbounded_fit.iterations + len(costs) - 1, np.array(costs)
    return LeastSquaresSolution(
        state.batch(), trace[-1:], count, (status,), trace[:, None], unbounded_fit.method
    )


def is_within_bounds(state: ParameterValues, effect_bounds: Array) -> bool:
    """Whether a state's effects are between their bounds (e, 2); where there are none, they are."""
    return not len(effect_bounds) or bool(
        ((state.effects >= effect_bounds[:, 0]) & (state.effects <= effect_bounds[:, 1])).all()
    )


def clip_to_bounds(state: ParameterValues, effect_bounds: Array) -> ParameterValues:
    """A state whose effects are between their bounds."""
    return replace(state, effects=np.clip(state.effects, *effect_bounds.T))
