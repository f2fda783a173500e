"""Points set aside: the fit to those that belong together.

In concentration steps the points farthest off leave the fit, until the same ones do twice.  Points
are judged by all others (`suspects.scores`), so that one which draws the fit to itself is found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.fitting.suspects import LEAST_SCALE, Scores, Spread, scores, spread_of
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.least_squares import LeastSquares
from minimax_cal.solvers.status import Status

SOFT, STEPS = 8, 20  # reweighted rounds of the start, concentration steps

Fitter = Callable[[Model, State], tuple[Model, LeastSquares[State]]]


@dataclass(frozen=True, eq=False)
class Weighted:
    """A least-squares fit whose points have weights besides those of the measurements.

    fitter: fits a model from a state; it may renew the model's prior.  plain: the model without
    the weights (k, m).  judged: (k,) False for targets that only follow the others.
    rounds: how many fits led here.
    """

    fitter: Fitter
    plain: Model
    found: LeastSquares[State]
    weights: Array
    judged: Array
    rounds: int = 0

    @property
    def state(self) -> State:
        """The geometry that was fitted."""
        return self.found.x.take(np.array(0))

    @property
    def model(self) -> Model:
        """The model that was fitted."""
        return replace(self.plain, weight=self.plain.weight * self.weights)

    @property
    def count(self) -> int:
        """Number of points that are judged."""
        return int(self.plain.seen[self.judged].sum())

    def again(self, weights: Array) -> Weighted:
        """The fit with other weights (k, m), from here; targets that follow keep theirs."""
        weights = np.where(self.judged[:, None], weights, 1.0) * self.plain.seen
        model = replace(self.plain, weight=self.plain.weight * weights)
        model, found = self.fitter(model, self.state)
        plain = self.plain.with_prior(model.prior)
        return replace(self, plain=plain, found=found, weights=weights, rounds=self.rounds + 1)

    def scores(self) -> Scores:
        """How far off each point is, those of the judged targets."""
        if not np.isfinite(self.found.cost).all():  # a fit that diverged tells of no point
            return Scores(np.zeros(self.weights.shape), np.zeros(self.weights.shape, dtype=int))
        found = scores(self.plain, self.state, self.weights)
        return replace(found, directions=np.where(self.judged[:, None], found.directions, 0))

    def spread(self, found: Scores) -> Spread:
        """How ordinary points scatter."""
        used = np.count_nonzero(self.weights[self.judged])
        return spread_of(found, max(3.0 * used - float(self.plain.active.sum()), 1.0))

    def most(self, share: float) -> int:
        """How many points may leave: no more than leave the others a majority, counting what
        determines the parameters [Rousseeuw and Leroy 1987, ch. 3].
        """
        needed = -(-int(self.plain.active.sum()) // 3)
        return max(min(int(share * self.count), (self.count - needed - 1) // 2), 0)

    def unsettled(self) -> Weighted:
        """The same, its status telling that the rounds did not come to rest."""
        return replace(self, found=replace(self.found, status=(Status.ITERATION_LIMIT,)))


def soften(at: Weighted) -> Weighted:
    """A start that few points pull: the sum of distances instead of that of their squares.

    Distances are standardised by leverage: a point that draws the fit to itself is not near.
    """
    for _ in range(SOFT):
        found = at.scores()
        distance = np.sqrt(found.square)
        usual = float(np.median(distance[found.directions > 0])) if found.directions.any() else 0.0
        at = at.again(1.0 / np.maximum(distance / max(usual, LEAST_SCALE), 1.0))
    return at


def farthest(square: Array, count: int) -> Array:
    """(k, m) True for the points farthest off, so many, the first of equals."""
    out = np.zeros(square.size, dtype=bool)
    out[np.argsort(-square, axis=None, kind="stable")[:count]] = True
    return out.reshape(square.shape)


def leave(at: Weighted, goes: Callable[[Scores], Array]) -> Weighted:
    """Fits without the points that go (k, m), to a fixed point; who comes and goes stays in."""
    before: list[Array] = []
    for _ in range(STEPS):
        away = goes(at.scores())
        again = [step for step, other in enumerate(before) if np.array_equal(away, other)]
        if again:
            cycle = before[again[0] :]
            common = np.logical_and.reduce(cycle)
            return at if len(cycle) == 1 else at.again(np.where(common, 0.0, 1.0))
        before.append(away)
        at = at.again(np.where(away, 0.0, 1.0))
    return at.unsettled()


def concentrate(at: Weighted, share: float) -> Weighted:
    """Least trimmed squares: the share of points farthest off leaves [Rousseeuw and Van Driessen
    2006, "Computing LTS regression for large data sets"].
    """
    count = at.most(share)
    return leave(
        at, lambda found: farthest(np.where(found.directions > 0, found.square, -1.0), count)
    )


def set_aside(at: Weighted, share: float) -> Weighted:
    """Only points that stand out leave, and at most the share: the farthest first."""
    count = at.most(share)

    def goes(found: Scores) -> Array:
        far = at.spread(found).far(found)
        return farthest(np.where(far, found.square, -1.0), count) & far

    return leave(at, goes)
