"""Least squares from a start that is near: the fit without its trimmings."""

from __future__ import annotations

import numpy as np

from minimax_cal.modelling.model import Model, SumOfSquares, arrays_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.kernels import sums
from minimax_cal.robots.kernels.choice import kernels
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import AUTO, NEAR, LeastSquares, method_of
from minimax_cal.solvers.status import Status

MOST = 15  # plain steps; a start from which these do not suffice is not near


def nearby(model: Model, begin: State, method: str = AUTO) -> LeastSquares[State]:
    """The least-squares fit of a model's free parameters from a start nearby, a batch of one.

    method: auto takes plain Gauss-Newton steps, and those of snllm where they do not lead straight
    down; or one of `least_squares.METHODS`, from the first step.
    """
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
