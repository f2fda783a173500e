"""Least squares from a start that is near: the fit without its trimmings."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.table import settled
from minimax_cal.modelling.model import Model, SumOfSquares, arrays_of
from minimax_cal.modelling.parameters import Names, State
from minimax_cal.robots.kernels import sums
from minimax_cal.robots.kernels.choice import kernels
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.bounded import bounded
from minimax_cal.solvers.least_squares import (
    AUTO,
    JOINT,
    METHODS,
    NEAR,
    LeastSquares,
    method_of,
    solve_normal,
)
from minimax_cal.solvers.status import Status

ROUNDING = 1e-13  # of the cost: a decrease by less is none
UNSEEN = 1e-10  # of the cost: a decrease by less may be lost in the rounding of its rows
HALVINGS = 10  # of a step that leads up
MAX_STEPS = 15  # plain steps; a start from which these do not suffice is not near


def nearby(model: Model, begin: State, method: str = JOINT) -> LeastSquares[State]:
    """The least-squares fit of a model's free parameters from a start nearby, a batch of one.

    Parameters of effects stay between the model's bounds.

    method: auto takes steps of variable projection, joint those in all parameters at once, and
    both those of snllm where they do not lead straight down; or one of `least_squares.METHODS`,
    from the first step.
    """
    found = unbounded(model, begin, method)
    if is_kept(found.x.take(np.array(0)), model.room):
        return found
    return between(SumOfSquares(model), float(model.counts.sum()), model.room, found)


def unbounded(model: Model, begin: State, method: str) -> LeastSquares[State]:
    """The same wherever the parameters then are."""
    straight = {AUTO: separated, JOINT: jointly}.get(method)
    if straight and not len(model.mix) and model.active.any():
        found = straight(model, begin)
        if found is not None:
            return found
    problem, points = SumOfSquares(model), float(model.counts.sum())
    return least_squares.solve(problem, begin.batch(), 1, points, method_of(method), NEAR)


def jointly(model: Model, begin: State) -> LeastSquares[State] | None:
    """Gauss-Newton steps in all parameters at once; None where they do not lead straight down."""
    which = np.flatnonzero(model.active)
    prior = model.prior.mean[which], model.prior.weight[which]
    at, trace, well = sums.descend(
        kernels(), arrays_of(begin), model.sight, which, prior, NEAR.step, MAX_STEPS
    )
    return straight_down(State(*at), trace, "nlgn") if well else None


def separated(model: Model, begin: State) -> LeastSquares[State] | None:
    """Gauss-Newton steps of variable projection; None where they do not lead straight down.

    The angles step by the Jacobian of Golub and Pereyra, the lengths are the best ones for every
    angle [paper S, eq. 18-24 and Algorithm 1 with (k+1)omega in c_2].
    """
    own, at, points = kernels(), arrays_of(begin), float(model.counts.sum())
    which = np.flatnonzero(model.active)
    linear = model.names.linear[which]
    lengths, mean, hold = which[linear], model.prior.mean[which], model.prior.weight[which]
    every, few = sums.Columns.of(at, which), sums.Columns.of(at, lengths)
    trace = [np.inf]
    for _ in range(MAX_STEPS + 1):
        off = (mean - sums.values(at, which))[linear] if hold.any() else np.zeros(len(lengths))
        dr, *_, told = own.solved(*few.normal(own, at, model.sight), off, hold[linear])
        if not told:
            return None
        at = own.stepped(*at, lengths, dr)  # r = G(omega)^+ Y, in which G is affine
        cost, gradient, gram = (part[0].sum(axis=0) for part in every.normal(own, at, model.sight))
        if hold.any():
            off = mean - sums.values(at, which)
            cost, gradient = cost + hold @ off**2, gradient + hold * off
            gram = gram + np.diag(hold)
        if not cost <= trace[-1] * (1.0 + sums.RISE) or not np.isfinite(cost):
            return None
        trace.append(float(cost))
        state = State(*(part[0] for part in at))
        mixed = gram[np.ix_(linear, ~linear)]
        coupled = model.coupling_on(state, model.blocks(state))
        shares = solve_normal(gram[np.ix_(linear, linear)], np.hstack([mixed, coupled]))
        projected, second = np.hsplit(shares, 2)
        matrix = gram[np.ix_(~linear, ~linear)] - mixed.T @ projected + coupled.T @ second
        step = np.zeros(len(which))
        step[~linear] = solve_normal(matrix, gradient[~linear, None])[:, 0]
        step[linear] = -projected @ step[~linear]
        if step @ gram @ step <= points * NEAR.step**2:
            return straight_down(State(*at), np.array(trace[1:]), "snlgn")
        at = own.stepped(*at, which, step)
    return None


def straight_down(x: State, trace: Array, method: str) -> LeastSquares[State]:
    """A batch of one that took plain steps, each of which led down.

    x: a batch.  trace: (steps + 1,) costs.
    """
    steps = np.array([len(trace) - 1])
    return LeastSquares(x, trace[-1:], steps, (Status.CONVERGED,), trace[:, None], METHODS[method])


class Squares(Protocol):
    """A sum of squares over the active ones of named parameters."""

    @property
    def names(self) -> Names:
        """Of all p."""

    @property
    def active(self) -> Array:
        """(p,) True where one is free."""

    def normal(self, x: State) -> tuple[Array, Array, Array]:
        """Cost, slope and Gram matrix."""

    def step(self, x: State, dx: Array) -> State:
        """The state moved by a step in the free parameters."""


def between(
    problem: Squares, points: float, room: Array, free: LeastSquares[State]
) -> LeastSquares[State]:
    """The fit between the bounds, from that without them: Gauss-Newton, each step between them.

    room: (e, 2) of the effects of a state.
    """
    closed = np.pad(room, ((problem.names.geometric, 0), (0, 0)))
    closed[: problem.names.geometric] = np.inf * np.array([-1.0, 1.0])
    allowed = closed[problem.active]
    state = kept(free.x.take(np.array(0)), room)
    cost, gradient, gram = problem.normal(state)
    costs, status = [float(cost)], Status.ITERATION_LIMIT
    for _ in range(MAX_STEPS):
        values = np.pad(state.effects, (problem.names.geometric, 0))  # of others none is bounded
        ends = allowed - values[problem.active][:, None]
        step = bounded(gram, gradient, *ends.T)
        square = float(step @ gram @ step)
        gain = 2.0 * float(step @ gradient) - square
        settles = square <= points * NEAR.step**2 or gain <= ROUNDING * costs[-1]
        trial = kept(problem.step(state, step), room)
        found = problem.normal(trial)
        for _ in range(HALVINGS):
            if settles or found[0] <= costs[-1]:
                break
            step = 0.5 * step
            trial = kept(problem.step(state, step), room)
            found = problem.normal(trial)
        if not settles and found[0] > costs[-1]:
            status = Status.CONVERGED if gain <= UNSEEN * costs[-1] else Status.STALLED
            break
        state, (cost, gradient, gram) = trial, found
        costs.append(float(cost))
        if settles:
            status = Status.CONVERGED
            break
    state = replace(state, effects=settled(state.effects, room))
    count, trace = free.iterations + len(costs) - 1, np.array(costs)
    return LeastSquares(state.batch(), trace[-1:], count, (status,), trace[:, None], free.method)


def is_kept(state: State, room: Array) -> bool:
    """Whether a state's effects are between their bounds (e, 2); where there are none, they are."""
    return not len(room) or bool(
        ((state.effects >= room[:, 0]) & (state.effects <= room[:, 1])).all()
    )


def kept(state: State, room: Array) -> State:
    """A state whose effects are between their bounds."""
    return replace(state, effects=np.clip(state.effects, *room.T))
