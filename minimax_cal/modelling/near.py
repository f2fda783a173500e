"""Least squares from a start that is near: the fit without its trimmings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.bounds import settled
from minimax_cal.modelling.model import Model, SumOfSquares, arrays_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.kernels import sums
from minimax_cal.robots.kernels.choice import kernels
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.bounded import bounded
from minimax_cal.solvers.least_squares import AUTO, NEAR, LeastSquares, method_of
from minimax_cal.solvers.status import Status

ROUNDING = 1e-13  # of the cost: a decrease by less is none
HALVINGS = 10  # of a step that leads up
MOST = 15  # plain steps; a start from which these do not suffice is not near


def nearby(model: Model, begin: State, method: str = AUTO) -> LeastSquares[State]:
    """The least-squares fit of a model's free parameters from a start nearby, a batch of one.

    Parameters of effects stay between the model's bounds.

    method: auto takes plain Gauss-Newton steps, and those of snllm where they do not lead straight
    down; or one of `least_squares.METHODS`, from the first step.
    """
    found = unbounded(model, begin, method)
    return found if is_kept(found.x.take(np.array(0)), model.room) else between(model, found)


def unbounded(model: Model, begin: State, method: str) -> LeastSquares[State]:
    """The same wherever the parameters then are."""
    if method == AUTO and not len(model.mix) and model.active.any():
        which = np.flatnonzero(model.active)
        prior = model.prior.mean[which], model.prior.weight[which]
        at, trace, well = sums.descend(
            kernels(), arrays_of(begin), model.sight, which, prior, NEAR.step, MOST
        )
        if well:
            steps = np.array([len(trace) - 1])
            return LeastSquares(State(*at), trace[-1:], steps, (Status.CONVERGED,), trace[:, None])
    problem, points = SumOfSquares(model), float(model.counts.sum())
    return least_squares.solve(problem, begin.batch(), 1, points, method_of(method), NEAR)


def between(model: Model, free: LeastSquares[State]) -> LeastSquares[State]:
    """The fit between the bounds, from that without them: Gauss-Newton, each step between them."""
    problem, points, room = SumOfSquares(model), float(model.counts.sum()), model.room
    open_ends = np.full((model.names.geometric, 2), np.inf) * [-1.0, 1.0]
    allowed = np.concatenate([open_ends, room])[model.active]
    state = kept(free.x.take(np.array(0)), room)
    cost, gradient, gram = problem.normal(state)
    costs, status = [float(cost)], Status.ITERATION_LIMIT
    for _ in range(MOST):
        ends = allowed - model.values(state)[model.active][:, None]
        step = bounded(gram, gradient, *ends.T)
        square = float(step @ gram @ step)
        settles = square <= points * NEAR.step**2
        if not settles:
            settles = 2.0 * float(step @ gradient) - square <= ROUNDING * costs[-1]
        trial = kept(problem.step(state, step), room)
        found = problem.normal(trial)
        for _ in range(HALVINGS):
            if settles or found[0] <= costs[-1]:
                break
            step = 0.5 * step
            trial = kept(problem.step(state, step), room)
            found = problem.normal(trial)
        if not settles and found[0] > costs[-1]:
            status = Status.STALLED
            break
        state, (cost, gradient, gram) = trial, found
        costs.append(float(cost))
        if settles:
            status = Status.CONVERGED
            break
    state = replace(state, effects=settled(state.effects, room))
    count, trace = free.iterations + len(costs) - 1, np.array(costs)
    return LeastSquares(state.batch(), trace[-1:], count, (status,), trace[:, None])


def is_kept(state: State, room: Array) -> bool:
    """Whether a state's effects are between their bounds (e, 2); where there are none, they are."""
    return not len(room) or bool(
        ((state.effects >= room[:, 0]) & (state.effects <= room[:, 1])).all()
    )


def kept(state: State, room: Array) -> State:
    """A state whose effects are between their bounds."""
    return replace(state, effects=np.clip(state.effects, *room.T))
